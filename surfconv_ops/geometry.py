"""The geometry of the operator on the Python side: centres, taps, sizes, in exact integers.

Chu et al., CVPR 2018, Eq. 7, in pixels and per axis::

    centre(o)    = stride * o - padding + dilation * (kernel - 1) / 2
    tap(t)       = dilation * (t - (kernel - 1) / 2)
    sample(o, t) = centre(o) + scale(o) * tap(t)

Centres and taps are multiples of one half. They are kept doubled, or as a whole pixel and a
fraction, so that no position loses precision far from the image's origin. ``csrc/geometry.h``
holds the same formulas for the compiled operator.
"""

from __future__ import annotations

import torch
from torch import Tensor

Pair = tuple[int, int]
FloatPair = tuple[float, float]


def doubled_tap(tap: int, kernel: int, dilation: int) -> int:
    """Twice ``tap(t)``."""
    return dilation * (2 * tap - (kernel - 1))


def centre_fraction(kernel: int, dilation: int) -> float:
    """Fractional part of every centre: 0.5 where centres lie between two pixels, else 0."""
    return 0.5 * (dilation * (kernel - 1) % 2)


def first_centre_pixel(kernel: int, padding: int, dilation: int) -> int:
    """Integer part of ``centre(0)``."""
    return dilation * (kernel - 1) // 2 - padding


def centre_pixels(
    count: int,
    kernel: int,
    stride: int,
    padding: int,
    dilation: int,
    device: torch.device | None = None,
) -> Tensor:
    """Integer part of ``centre(o)`` for o = 0 .. count-1, as int64.

    It is also the pixel nearest to the centre, a half rounding down: ceil(centre - 1/2) equals
    floor(centre) for every multiple of one half.
    """
    first = first_centre_pixel(kernel, padding, dilation)
    return torch.arange(count, device=device) * stride + first


def same_padding(kernel: int, dilation: int) -> Pair:
    """Padding before and after an axis for ``padding='same'``; the odd pixel goes to the end."""
    total = dilation * (kernel - 1)
    return total // 2, total - total // 2


def output_size(size: int, kernel: int, stride: int, padding: Pair, dilation: int) -> int:
    """Number of output pixels along an axis; below 1 where the kernel does not fit."""
    return (size + padding[0] + padding[1] - dilation * (kernel - 1) - 1) // stride + 1


def pool_output_size(
    size: int, kernel: int, stride: int, padding: int, dilation: int, ceil_mode: bool
) -> int:
    """Number of output pixels of a pool along an axis, as nn's pools count them.

    In ceil mode a window may reach beyond the padding, but has to start before its far side.
    """
    span = dilation * (kernel - 1)
    room = size + 2 * padding - span - 1
    if not ceil_mode:
        return room // stride + 1
    last = (room + stride - 1) // stride
    # No window starts too late where a stride takes it no further than the kernel reaches. Asking
    # the size would tie an exported net to it.
    if stride + padding > span + 1:
        last = torch.sym_min(last, (size + padding - 1) // stride)
    return last + 1


def pool_window_sizes(
    size: int, count: int, kernel: int, stride: int, padding: int, device: torch.device | None
) -> Tensor:
    """Pixels of an axis under each window, padding included, what lies beyond it not."""
    start = torch.arange(count, device=device) * stride - padding
    return (start + kernel).clamp(max=size + padding) - start


def reference_depth_of_radius(
    radius: float, focal_length: float, kernel: int, dilation: int
) -> float:
    """Depth at which a kernel tiles a cube of half-width ``radius`` metres.

    The cube is 2 * radius * focal_length / z pixels wide at depth z (Eq. 7). The kernel's cells
    are kernel * dilation pixels wide, so both agree at the depth returned here.
    """
    return 2.0 * radius * focal_length / (kernel * dilation)
