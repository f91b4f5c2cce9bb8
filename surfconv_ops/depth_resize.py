"""A depth map at another resolution: the pixel picked, or the nearest valid one it stands for."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from . import direct
from ._loader import missing_library_reason
from .checks import valid_depth

SCHEMA = "nearest_depth(Tensor depth, int height, int width) -> Tensor"


def resize_depth(depth: Tensor, height: int, width: int) -> Tensor:
    """Depth of a ``height`` x ``width`` view of the same image, by sizes alone.

    Pixel i of h takes the depth at full-resolution row ``floor(i * H / h)``, columns likewise:
    the pixels that 'same'-padded kernels of odd size keep. Where that depth is invalid, it is the
    nearest valid one (Euclidean distance from the pixel picked; ties go to the lower row, then the
    lower column) within the pixel's footprint ``[floor(i * H / h), ceil((i + 1) * H / h))``. The
    result is invalid only where the whole footprint is. Depths are picked, never mixed, so that no
    surface appears between two others. Gradients flow to the pixels picked.

    Args:
        depth: Metres, float32 or float64.
        height: Rows wanted; more than there are repeats rows.
        width: Columns wanted.

    Returns:
        Depth in the dtype of ``depth``.

    Shape:
        - depth: ``(N, H, W)``
        - output: ``(N, height, width)``
    """
    if direct.watched():
        # The compiler fuses the search; sizes may be symbols to it.
        return depth.reshape(-1)[_nearest(depth.detach(), height, width)]
    nearest = direct.run_kernel(
        torch.ops.surfconv.nearest_depth.default, depth.detach(), height, width
    )
    return depth.reshape(-1).index_select(0, nearest.reshape(-1)).reshape(nearest.shape)


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


def _nearest(depth: Tensor, height: int, width: int) -> Tensor:
    """Where in the depth the one of each pixel is, as the compiled operator has it."""
    H, W = depth.shape[-2], depth.shape[-1]
    rows, columns = _axis(H, height, depth.device), _axis(W, width, depth.device)
    image = torch.arange(depth.shape[0], device=depth.device)[:, None, None]
    row = torch.arange(height, device=depth.device)[:, None]
    column = torch.arange(width, device=depth.device)
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
    usable = valid_depth(depth.reshape(-1)[at])
    best = torch.where(usable, rank, torch.iinfo(torch.int32).max).amin(0)
    return start + offset[torch.where(best < tall * wide, best, 0)]


def _fake(depth: Tensor, height: int, width: int) -> Tensor:
    return depth.new_empty((depth.shape[0], height, width), dtype=torch.int64)


def register(library: torch.library.Library) -> None:
    """Everything about the operator that is not in the compiled library."""
    if missing_library_reason is not None:
        library.define(SCHEMA)
    library.impl("nearest_depth", _nearest, "CompositeExplicitAutograd")
    torch.library.register_fake("surfconv::nearest_depth", _fake, lib=library)
