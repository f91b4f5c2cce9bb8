"""Images read at rows and columns of real positions."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from .layout import lay_out, memory_format_of

# Weights below this are rounding of positions that meet a pixel, which then is all they see.
_ROUNDING = 1e-9


class AxisTaps(NamedTuple):
    """What is read along one axis: ``(K, n)`` pixels and weights for n positions."""

    pixels: Tensor  # int64
    weights: Tensor  # float64


def axis_taps(positions: Tensor, size: int, reach: float = 1.0) -> AxisTaps:
    """Pixels within ``reach`` of every position, weighted by a triangle, by weights that sum to 1.

    Args:
        positions: float64 in pixels; those beyond the first or last pixel count as on it.
        size: Number of pixels of the axis.
        reach: Half-width of the triangle in pixels, at least 1; 1 is linear interpolation.
    """
    positions = positions.clamp(0, size - 1)
    first = (positions - reach).floor().clamp(min=-1) + 1
    count = min(math.ceil(2 * reach), size)
    pixels = first + torch.arange(count, dtype=torch.float64, device=positions.device)[:, None]
    weights = 1 - (pixels - positions).abs() / reach
    inside = (pixels >= 0) & (pixels < size)
    weights = torch.where(inside & (weights > _ROUNDING), weights, 0.0)
    weights = weights / weights.sum(0)
    # A tap without weight shares the place and the weight of the heaviest: read elsewhere, an
    # infinity there would become 0 * inf.
    heaviest = weights.max(0)
    empty = weights == 0
    main = torch.zeros_like(empty).scatter_(0, heaviest.indices[None], True)
    shared = heaviest.values / (1 + empty.sum(0))
    weights = torch.where(empty | main, shared, weights)
    pixels = torch.where(empty, pixels.gather(0, heaviest.indices[None]), pixels)
    return AxisTaps(pixels.to(torch.int64), weights)


def read_grid(image: Tensor, rows: AxisTaps | None, columns: AxisTaps | None) -> Tensor:
    """``(N, C, rows, columns)`` of an image ``(N, C, H, W)`` in its dtype and memory format.

    None leaves an axis as it is. Half types are computed in float32 and rounded once. Gradients
    flow to ``image``, of any order.
    """
    if rows is None and columns is None:
        return image
    memory_format = memory_format_of(image)
    wide = image if image.dtype == torch.float64 else image.to(torch.float32)
    values = wide.contiguous()
    # Rows are copied whole, columns pixel by pixel: columns are read while there are fewer rows.
    axes = [(2, rows), (3, columns)]
    if rows is not None and rows.pixels.shape[1] > image.shape[2]:
        axes.reverse()
    for axis, taps in axes:
        if taps is not None:
            values = _read_axis(values, axis, taps)
    return lay_out(values.to(image.dtype), memory_format)


def _read_axis(image: Tensor, axis: int, taps: AxisTaps) -> Tensor:
    shape = (-1, 1) if axis == 2 else (-1,)
    total: Tensor | None = None
    for pixels, weights in zip(taps.pixels, taps.weights.to(image.dtype), strict=True):
        pixels, weights = pixels.to(image.device), weights.to(image.device).view(shape)
        if axis == 2:
            values = image.index_select(2, pixels)
        else:
            # Along the last axis gather is several times as fast as index_select.
            values = image.gather(3, pixels.expand(*image.shape[:3], -1))
        # In place: what is read is a copy, and its gradient does not need it.
        total = values.mul_(weights) if total is None else total.addcmul_(values, weights)
    assert total is not None
    return total
