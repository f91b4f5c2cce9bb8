"""What the taps of both pools see, beyond what those of a convolution do."""

from __future__ import annotations

import triton
import triton.language as tl

from .taps import Pixels, Samples, has_corner, samples_of, share


@triton.jit
def divide(total, divisor):
    """A quotient rounded as IEEE says: what is divided by itself is 1."""
    return total / divisor if total.dtype == tl.float64 else tl.div_rn(total, divisor)


@triton.jit
def block_of_channels(channels, BLOCK: tl.constexpr):
    """A program's tile of pixels, its block of channels, and the channels themselves."""
    blocks = tl.cdiv(channels, BLOCK)
    program = tl.program_id(0)
    # Tiles of the same pixels run side by side and share what they read.
    tile = program // blocks
    part = program - tile * blocks
    return tile.to(tl.int64), part.to(tl.int64), part * BLOCK + tl.arange(0, BLOCK)


@triton.jit
def pool_samples_of(
    image,
    pixels,
    tap,
    KERNEL_Y: tl.constexpr,
    KERNEL_X: tl.constexpr,
    DILATION_Y: tl.constexpr,
    DILATION_X: tl.constexpr,
    LIMIT: tl.constexpr,
    CLAMPED: tl.constexpr,
):
    """Where tap number ``tap`` of a tile samples, or a tap of its own for every lane."""
    at = samples_of(
        image, pixels, tap // KERNEL_X, tap % KERNEL_X, KERNEL_Y, KERNEL_X, DILATION_Y,
        DILATION_X, LIMIT, CLAMPED,
    )  # fmt: skip
    # In steps of what 1 - fraction can tell, so that a quotient of weights keeps its precision
    # where the image ends beside a corner that is all but at its end.
    fraction_y = 1 - (1 - at.fraction_y)
    fraction_x = 1 - (1 - at.fraction_x)
    return Samples(
        at.doubled_y, at.doubled_x, at.y, at.x, fraction_y, fraction_x, at.reached, at.place
    )


@triton.jit
def weight_of_samples(image, samples):
    """What the corners of each sample weigh together that lie in the image, seen or hidden."""
    total = 0.0 * samples.fraction_y
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            weight = share(samples.fraction_y, i) * share(samples.fraction_x, j)
            total += tl.where(has_corner(image, samples, i, j), weight, 0.0)
    return total


@triton.jit
def slopes_of_corner(samples, SIDE_Y: tl.constexpr, SIDE_X: tl.constexpr):
    """Derivatives of a corner's weight with respect to both scales."""
    tap_y = samples.doubled_y.to(samples.fraction_y.dtype) * (SIDE_Y - 0.5)
    tap_x = samples.doubled_x.to(samples.fraction_x.dtype) * (SIDE_X - 0.5)
    return tap_y * share(samples.fraction_x, SIDE_X), tap_x * share(samples.fraction_y, SIDE_Y)


@triton.jit
def as_column(pixels):
    """The same tile beside channels, so that every channel can have a tap of its own."""
    return Pixels(
        pixels.number[:, None],
        pixels.exist[:, None],
        pixels.scale_at[:, None],
        pixels.scale_y[:, None],
        pixels.scale_x[:, None],
        pixels.centre_y[:, None],
        pixels.centre_x[:, None],
        pixels.origin[:, None],
        pixels.guide[:, None],
    )
