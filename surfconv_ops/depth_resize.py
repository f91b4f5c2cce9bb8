"""A depth map at another resolution: the pixel picked, or the nearest valid one it stands for."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from . import direct
from .checks import valid_depth


def resize_depth(depth: Tensor, height: int, width: int) -> Tensor:
    """Depth of a ``height`` x ``width`` view of the same image, by sizes alone.

    Pixel i of h takes the depth at full-resolution row ``floor(i * H / h)``, columns likewise:
    the pixels that 'same'-padded kernels of odd size keep. Where that depth is invalid, it is the
    nearest valid one (Euclidean distance from the pixel picked; ties go to the lower row, then the
    lower column) within the pixel's footprint ``[floor(i * H / h), ceil((i + 1) * H / h))``. The
    result is invalid only where the whole footprint is. Depths are picked, never mixed, so that no
    surface appears between two others. Gradients flow to the pixels picked.

    Args:
        depth: Metres, floating point.
        height: Rows wanted; more than there are repeats rows.
        width: Columns wanted.

    Returns:
        Depth in the dtype of ``depth``.

    Shape:
        - depth: ``(N, H, W)``
        - output: ``(N, height, width)``
    """
    H, W = depth.shape[-2], depth.shape[-1]
    rows, columns = _axis(H, height, depth.device), _axis(W, width, depth.device)
    if _values_may_be_read(depth):
        # Most pixels are no holes, and only holes need a search.
        picked = depth.index_select(-2, rows.first).index_select(-1, columns.first)
        if rows.largest == columns.largest == 1:
            return picked
        holes = (~valid_depth(picked.detach())).nonzero(as_tuple=True)
        if not len(holes[0]):
            return picked
        nearest = _nearest_valid(depth, rows, columns, *holes)
        return picked.index_put(holes, depth.reshape(-1)[nearest])
    image = torch.arange(depth.shape[0], device=depth.device)[:, None, None]
    row = torch.arange(height, device=depth.device)[:, None]
    nearest = _nearest_valid(
        depth, rows, columns, image, row, torch.arange(width, device=depth.device)
    )
    return depth.reshape(-1)[nearest]


class _Axis(NamedTuple):
    """The footprints along one axis."""

    first: Tensor
    size: Tensor
    #: No footprint is larger.
    largest: int
    #: All footprints are as large.
    even: bool


def _axis(size: int, wanted: int, device: torch.device) -> _Axis:
    pixels = torch.arange(wanted, device=device)
    first = torch.div(pixels * size, wanted, rounding_mode="floor")
    end = torch.div((pixels + 1) * size + wanted - 1, wanted, rounding_mode="floor")
    # Without the greatest common divisor, a size can stay a symbol.
    step = 1 if torch.compiler.is_compiling() else math.gcd(size, wanted)
    return _Axis(first, end - first, -((step - size - wanted) // wanted), step in (size, wanted))


def _nearest_valid(
    depth: Tensor, rows: _Axis, columns: _Axis, image: Tensor, row: Tensor, column: Tensor
) -> Tensor:
    """Where the valid depth nearest to each pixel's first is; its first where there is none."""
    H, W = depth.shape[-2], depth.shape[-1]
    start = (image * H + rows.first[row]) * W + columns.first[column]
    tall, wide = rows.largest, columns.largest
    # In the order of preference: a stable sort leaves ties by row, then by column. Places come
    # first, and in int32, so that the search for the least runs over whole vectors.
    place = torch.arange(tall * wide, device=depth.device)
    distance = (place // wide).square() + (place % wide).square()
    place = distance.argsort(stable=True)
    offset = place // wide * W + place % wide
    column_of = [-1, *[1] * start.ndim]
    at = start + offset.view(column_of)
    if not (rows.even and columns.even):
        down, aside = (place // wide).view(column_of), (place % wide).view(column_of)
        inside = (down < rows.size[row]) & (aside < columns.size[column])
        at = torch.where(inside, at, start)
    rank = torch.arange(tall * wide, dtype=torch.int32, device=depth.device).view(column_of)
    usable = valid_depth(depth.detach().reshape(-1)[at])
    best = torch.where(usable, rank, torch.iinfo(torch.int32).max).amin(0)
    return start + offset[torch.where(best < tall * wide, best, 0)]


def _values_may_be_read(depth: Tensor) -> bool:
    """Whether a shape may depend on values. A GPU would have to be waited for."""
    return not (direct.watched() or depth.is_meta or depth.is_cuda)
