"""A depth map at another resolution: the pixel picked, or the nearest valid one it stands for."""

from __future__ import annotations

import torch
from torch import Tensor

from .checks import valid_depth


def resize_depth(depth: Tensor, height: int, width: int) -> Tensor:
    """Depth of a ``height`` x ``width`` view of the same image, by sizes alone.

    Pixel i of h takes the depth at full-resolution row ``floor(i * H / h)``, columns likewise:
    the pixels that 'same'-padded kernels of odd size keep. Where that depth is invalid, it is the
    nearest valid one (Euclidean distance from the pixel picked; ties go to the lower row, then the
    lower column) within the pixel's footprint ``[floor(i * H / h), ceil((i + 1) * H / h))``. The
    result is invalid only where the whole footprint is. Depths are picked, never mixed, so that no
    surface appears between two others. Gradients flow to the pixels picked.

    Time and memory are in proportion to the larger of the two sizes, whatever their ratio.

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
    top, bottom, tall = _footprints(H, height, depth.device)
    left, right, wide = _footprints(W, width, depth.device)

    # The nearest valid pixel of one row is its first, because the pixel picked is the leftmost.
    # So each row is reduced to that one column, and then the rows compete.
    columns = torch.arange(W, device=depth.device)
    column_or_none = torch.where(valid_depth(depth.detach()), columns, W)
    first = _gather_windows(column_or_none, left, wide, -1).amin(-2)
    first = torch.where(first < right, first, W)
    aside = torch.where(first < W, (first - left).square(), (H + W) ** 2)

    steps = torch.arange(tall, device=depth.device)
    rows = top[:, None] + steps
    distance = _gather_windows(aside, top, tall, -2) + steps.square()[:, None]
    # One number orders by distance, then by row; a row beyond the footprint loses to all.
    rank = torch.where((rows < bottom[:, None])[..., None], distance, 2 * (H + W) ** 2)
    best = (rank * tall + steps[:, None]).amin(-2)
    found = best < (H + W) ** 2 * tall
    row = top[:, None] + torch.where(found, best % tall, 0)
    column = torch.where(found, first.gather(-2, row), left)
    picked = depth.flatten(-2).gather(-1, (row * W + column).flatten(-2))
    return picked.unflatten(-1, (height, width))


def _footprints(size: int, wanted: int, device: torch.device) -> tuple[Tensor, Tensor, int]:
    """First pixel of each footprint, the pixel after its last, and the size of the largest."""
    pixels = torch.arange(wanted, device=device)
    first = torch.div(pixels * size, wanted, rounding_mode="floor")
    end = torch.div((pixels + 1) * size + wanted - 1, wanted, rounding_mode="floor")
    return first, end, (size + 2 * wanted - 2) // wanted


def _gather_windows(map: Tensor, first: Tensor, size: int, dim: int) -> Tensor:
    """Windows of ``size`` pixels along ``dim``, in a dimension of their own beside it.

    Along the last dimension ``(..., size, windows)``, along the one before it
    ``(..., windows, size, W)``: either way the sum over windows runs over whole vectors. Pixels
    beyond the end repeat the last.
    """
    steps = torch.arange(size, device=map.device)
    at = steps[:, None] + first if dim == -1 else first[:, None] + steps
    windows = map.index_select(dim, at.clamp(max=map.shape[dim] - 1).flatten())
    return windows.unflatten(dim, at.shape)
