"""The one relation of the operator inside Triton kernels (``surfconv_ops/geometry.py``, Eq. 7).

Nothing else in the CUDA backend derives a position. Centres and taps are multiples of one half:
a centre is a whole pixel and a constant half, a tap is kept doubled. Offsets are floored relative
to the centre, so that precision does not depend on where in the image a tap lies.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def tap_doubled(tap, KERNEL: tl.constexpr, DILATION: tl.constexpr):
    """Twice the distance of a tap from its centre at scale 1."""
    return tl.cast(DILATION, tl.int64) * (2 * tap - (KERNEL - 1))


@triton.jit
def locate(centre, scale, doubled, HALF: tl.constexpr, LIMIT: tl.constexpr):
    """The pixel before each sample, how far the sample lies beyond it, and if it is anywhere.

    A sample exactly on a pixel counts to the cell it moves into as the scale grows: then the
    derivatives of all taps are the same one-sided derivative. A tap of zero offset stays on its
    centre, whatever the scale.
    """
    offset = tl.where(doubled == 0, 0.0, HALF + scale * (doubled.to(scale.dtype) * 0.5))
    # NaN compares false; what is further away than any image reaches would not fit an integer.
    reached = tl.abs(offset) < LIMIT
    offset = tl.where(reached, offset, 0.0)
    whole = tl.floor(offset)
    whole = tl.where((doubled < 0) & (whole == offset), whole - 1, whole)
    return centre + whole.to(centre.dtype), offset - whole, reached


@triton.jit
def locate_clamped(centre, scale, doubled, last, HALF: tl.constexpr, LIMIT: tl.constexpr):
    """As :func:`locate`, with samples clamped into an image that ends with pixel ``last``.

    Also twice the distance that a sample moves by as the scale grows by 1: none at the edge.
    Where the scale is exactly 1, taps outside the image are nowhere, as for nn's maximum.
    """
    low, fraction, near = locate(centre, scale, doubled, HALF, LIMIT)
    before = tl.where(near, low < 0, scale * doubled < 0)
    behind = tl.where(near, low >= last, scale * doubled > 0)
    pixel = low + (fraction == 1).to(low.dtype)
    outside = (scale == 1) & ((pixel < 0) | (pixel > last))
    # Where a tap does not move, its scale does not matter.
    finite = tl.abs(tl.where(doubled == 0, 0.0, scale)) < float("inf")
    low = tl.where(before, 0, tl.where(behind, last, low))
    fraction = tl.where(before | behind, 0.0, fraction)
    return low, fraction, tl.where(before | behind, 0, doubled), finite & (outside == 0)


@triton.jit
def pool_window(centre, padding, size, KERNEL: tl.constexpr):
    """Pixels of an axis under a window, padding included, what lies beyond it not."""
    start = centre - (KERNEL - 1) // 2
    return tl.minimum(size + padding - start, KERNEL)
