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
