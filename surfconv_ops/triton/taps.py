"""What the taps of a tile of output pixels see, shared by all kernels of the CUDA backend."""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl

from .geometry import locate, locate_clamped, tap_doubled


class Image(NamedTuple):
    """The sampled images, channels innermost, and what limits the view of them."""

    pointer: Any
    channels: Any
    height: Any
    width: Any
    guide: Any  # None: everything is seen
    tolerance: Any


class Pixels(NamedTuple):
    """A tile of output pixels, one lane each."""

    number: Any
    exist: Any
    scale_at: Any
    scale_y: Any
    scale_x: Any
    centre_y: Any
    centre_x: Any
    origin: Any  # of their image, in pixels
    guide: Any  # at the input pixel nearest to the centre


class Samples(NamedTuple):
    """Where one tap of a tile samples; a sample lies between pixel y and y + 1, x and x + 1."""

    doubled_y: Any  # twice what the sample moves by as the scale grows by 1
    doubled_x: Any
    y: Any
    x: Any
    fraction_y: Any
    fraction_x: Any
    reached: Any
    place: Any  # of pixel (y, x) in the flat images


@triton.jit
def tile_of_pixels(
    first,
    count,
    plane,
    columns,
    image,
    scale_ptr,
    stride_y,
    stride_x,
    first_y,
    first_x,
    AXES: tl.constexpr,
    ACC: tl.constexpr,
    INDEX: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Everything about output pixels first .. first + BLOCK - 1 that no tap changes."""
    number = first + tl.arange(0, BLOCK)
    exist = number < count
    frame = number // plane
    place = number - frame * plane
    row = place // columns
    column = place - row * columns
    scale_at = frame * plane * AXES + place
    scale_y = tl.load(scale_ptr + scale_at, mask=exist, other=0.0).to(ACC)
    scale_x = scale_y
    if AXES == 2:
        scale_x = tl.load(scale_ptr + scale_at + plane, mask=exist, other=0.0).to(ACC)
    centre_y = (row * stride_y + first_y).to(INDEX)
    centre_x = (column * stride_x + first_x).to(INDEX)
    origin = frame * image.height * image.width
    guide = scale_y
    if image.guide is not None:
        nearest_y = tl.minimum(tl.maximum(centre_y, 0), image.height - 1)
        nearest_x = tl.minimum(tl.maximum(centre_x, 0), image.width - 1)
        nearest = origin + nearest_y.to(tl.int64) * image.width + nearest_x
        guide = tl.load(image.guide + nearest, mask=exist, other=0.0).to(ACC)
    return Pixels(number, exist, scale_at, scale_y, scale_x, centre_y, centre_x, origin, guide)


@triton.jit
def samples_of(
    image,
    pixels,
    tap_y,
    tap_x,
    KERNEL_Y: tl.constexpr,
    KERNEL_X: tl.constexpr,
    DILATION_Y: tl.constexpr,
    DILATION_X: tl.constexpr,
    LIMIT: tl.constexpr,
    CLAMPED: tl.constexpr = False,
):
    """Where a tile samples with one tap; clamped, all samples are in the image."""
    doubled_y = tap_doubled(tap_y, KERNEL_Y, DILATION_Y)
    doubled_x = tap_doubled(tap_x, KERNEL_X, DILATION_X)
    half_y: tl.constexpr = 0.5 * (DILATION_Y * (KERNEL_Y - 1) % 2)
    half_x: tl.constexpr = 0.5 * (DILATION_X * (KERNEL_X - 1) % 2)
    if CLAMPED:
        y, fraction_y, doubled_y, reached_y = locate_clamped(
            pixels.centre_y, pixels.scale_y, doubled_y, image.height - 1, half_y, LIMIT
        )
        x, fraction_x, doubled_x, reached_x = locate_clamped(
            pixels.centre_x, pixels.scale_x, doubled_x, image.width - 1, half_x, LIMIT
        )
    else:
        y, fraction_y, reached_y = locate(pixels.centre_y, pixels.scale_y, doubled_y, half_y, LIMIT)
        x, fraction_x, reached_x = locate(pixels.centre_x, pixels.scale_x, doubled_x, half_x, LIMIT)
    reached = reached_y & reached_x & pixels.exist
    place = pixels.origin + y.to(tl.int64) * image.width + x
    return Samples(doubled_y, doubled_x, y, x, fraction_y, fraction_x, reached, place)


@triton.jit
def share(fraction, SIDE: tl.constexpr):
    """What the pixel before (0) or behind (1) a sample weighs along one axis."""
    return fraction if SIDE == 1 else 1 - fraction


@triton.jit
def has_corner(image, samples, SIDE_Y: tl.constexpr, SIDE_X: tl.constexpr):
    """Which samples have a corner in the image, seen or hidden."""
    y = samples.y + SIDE_Y
    x = samples.x + SIDE_X
    return samples.reached & (y >= 0) & (y < image.height) & (x >= 0) & (x < image.width)


@triton.jit
def corner(image, pixels, samples, SIDE_Y: tl.constexpr, SIDE_X: tl.constexpr):
    """Which samples see a corner, whatever its weight, and its distance from theirs in memory."""
    seen = has_corner(image, samples, SIDE_Y, SIDE_X)
    step = tl.cast(image.width, tl.int64) * SIDE_Y + SIDE_X
    if image.guide is not None:
        there = tl.load(image.guide + samples.place + step, mask=seen, other=0.0)
        near = tl.abs(there.to(pixels.guide.dtype) - pixels.guide) <= tl.load(image.tolerance)
        applies = tl.abs(pixels.guide) < float("inf")
        seen = seen & (near | (applies == 0))
    return seen, step


@triton.jit
def interpolate(
    image, pixels, samples, channel, exists, CORNERS_Y: tl.constexpr, CORNERS_X: tl.constexpr
):
    """(pixels, channels) bilinear samples of one tap; ``exists`` says which channels there are."""
    total = tl.zeros((pixels.number.shape[0], channel.shape[0]), samples.fraction_y.dtype)
    # One 64-bit address a sample: its corners lie at fixed distances.
    first = image.pointer + (samples.place * image.channels)[:, None] + channel[None, :]
    for i in tl.static_range(CORNERS_Y):
        for j in tl.static_range(CORNERS_X):
            weight = share(samples.fraction_y, i) * share(samples.fraction_x, j)
            seen, step = corner(image, pixels, samples, i, j)
            # Without weight a corner is not seen: 0 * inf must not appear.
            seen = seen & (weight != 0)
            mask = seen[:, None] & exists[None, :]
            value = tl.load(first + step * image.channels, mask=mask, other=0.0)
            total += weight[:, None] * value.to(total.dtype)
    return total
