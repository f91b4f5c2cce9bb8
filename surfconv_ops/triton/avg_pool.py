"""The average over the taps, and its gradients."""

from __future__ import annotations

import triton
import triton.language as tl

from .backward_data import rise_of_samples, scatter
from .geometry import pool_window
from .pool_taps import block_of_channels, divide, pool_samples_of, weight_of_samples
from .taps import Image, interpolate, tile_of_pixels

#: What an average divides by: what its taps weigh, the pixels of its window, or a given number.
BY_WEIGHT = tl.constexpr(0)
BY_WINDOW = tl.constexpr(1)
BY_NUMBER = tl.constexpr(2)


@triton.jit
def fixed_divisor(
    image,
    pixels,
    override,
    padding_y,
    padding_x,
    KERNEL_Y: tl.constexpr,
    KERNEL_X: tl.constexpr,
    DIVISOR: tl.constexpr,
):
    """What each pixel's sum is divided by; the number 0 where that is not known beforehand."""
    none = tl.zeros_like(pixels.scale_y)
    if DIVISOR == BY_WINDOW:
        rows = pool_window(pixels.centre_y, padding_y, image.height, KERNEL_Y)
        columns = pool_window(pixels.centre_x, padding_x, image.width, KERNEL_X)
        divisor = rows.to(none.dtype) * columns.to(none.dtype)
    elif DIVISOR == BY_NUMBER:
        divisor = none + tl.cast(override, none.dtype)
    else:
        divisor = none
    return divisor


@triton.jit
def average(total, divisor):
    """(pixels, channels) by divisors of the pixels, 0 where the divisor is."""
    # As large as the quotient: a precise division does not make it so.
    by = tl.zeros_like(total) + divisor[:, None]
    return tl.where(by != 0, divide(total, by), 0.0)


@triton.jit
def avg_forward_kernel(
    output_ptr,
    input_ptr,
    scale_ptr,
    guide_ptr,
    tolerance_ptr,
    override,
    padding_y,
    padding_x,
    count,
    plane,
    columns,
    channels,
    height,
    width,
    stride_y,
    stride_x,
    first_y,
    first_x,
    KERNEL_Y: tl.constexpr,
    KERNEL_X: tl.constexpr,
    DILATION_Y: tl.constexpr,
    DILATION_X: tl.constexpr,
    AXES: tl.constexpr,
    LIMIT: tl.constexpr,
    INDEX: tl.constexpr,
    ACC: tl.constexpr,
    DIVISOR: tl.constexpr,
    BLOCK_PIXELS: tl.constexpr,
    BLOCK_CHANNELS: tl.constexpr,
):
    """A (pixels, channels) tile of the averages, (N, Ho, Wo, C)."""
    tile, part, channel = block_of_channels(channels, BLOCK_CHANNELS)
    exists = channel < channels
    image = Image(input_ptr, channels, height, width, guide_ptr, tolerance_ptr)
    pixels = tile_of_pixels(
        tile * BLOCK_PIXELS, count, plane, columns, image, scale_ptr,
        stride_y, stride_x, first_y, first_x, AXES, ACC, INDEX, BLOCK_PIXELS,
    )  # fmt: skip
    divisor = fixed_divisor(
        image, pixels, override, padding_y, padding_x, KERNEL_Y, KERNEL_X, DIVISOR
    )
    total = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
    for tap in range(KERNEL_Y * KERNEL_X):
        samples = pool_samples_of(
            image, pixels, tap, KERNEL_Y, KERNEL_X, DILATION_Y, DILATION_X, LIMIT, False
        )
        total += interpolate(image, pixels, samples, channel, exists, 2, 2)
        if DIVISOR == BY_WEIGHT:
            divisor += weight_of_samples(image, samples)
    at = (pixels.number * channels)[:, None] + channel[None, :]
    tl.store(
        output_ptr + at,
        average(total, divisor).to(output_ptr.dtype.element_ty),
        mask=pixels.exist[:, None] & exists[None, :],
    )


@triton.jit
def avg_backward_kernel(
    sums_ptr,
    factors_ptr,
    partial_ptr,
    grad_output_ptr,
    input_ptr,
    scale_ptr,
    guide_ptr,
    tolerance_ptr,
    override,
    padding_y,
    padding_x,
    extent,
    scales,
    count,
    plane,
    columns,
    channels,
    height,
    width,
    stride_y,
    stride_x,
    first_y,
    first_x,
    KERNEL_Y: tl.constexpr,
    KERNEL_X: tl.constexpr,
    DILATION_Y: tl.constexpr,
    DILATION_X: tl.constexpr,
    AXES: tl.constexpr,
    LIMIT: tl.constexpr,
    INDEX: tl.constexpr,
    ACC: tl.constexpr,
    DIVISOR: tl.constexpr,
    NEED_INPUT: tl.constexpr,
    NEED_SCALE: tl.constexpr,
    WORDS: tl.constexpr,
    BLOCK_PIXELS: tl.constexpr,
    BLOCK_CHANNELS: tl.constexpr,
):
    """All taps of a tile of pixels and a block of channels; grad_output is (N, Ho, Wo, C).

    The gradient of the scale comes as one partial sum per block of channels.
    """
    tile, part, channel = block_of_channels(channels, BLOCK_CHANNELS)
    exists = channel < channels
    image = Image(input_ptr, channels, height, width, guide_ptr, tolerance_ptr)
    pixels = tile_of_pixels(
        tile * BLOCK_PIXELS, count, plane, columns, image, scale_ptr,
        stride_y, stride_x, first_y, first_x, AXES, ACC, INDEX, BLOCK_PIXELS,
    )  # fmt: skip
    divisor = fixed_divisor(
        image, pixels, override, padding_y, padding_x, KERNEL_Y, KERNEL_X, DIVISOR
    )
    mean = None
    if DIVISOR == BY_WEIGHT:
        total = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
        for tap in range(KERNEL_Y * KERNEL_X):
            samples = pool_samples_of(
                image, pixels, tap, KERNEL_Y, KERNEL_X, DILATION_Y, DILATION_X, LIMIT, False
            )
            divisor += weight_of_samples(image, samples)
            if NEED_SCALE:
                total += interpolate(image, pixels, samples, channel, exists, 2, 2)
        # Where a corner's weight is a part of the divisor, the mean comes off its value.
        mean = average(total, divisor)
    at = (pixels.number * channels)[:, None] + channel[None, :]
    grad = tl.load(
        grad_output_ptr + at, mask=pixels.exist[:, None] & exists[None, :], other=0.0
    ).to(ACC)
    pulled = average(grad, divisor)
    rise_y = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
    rise_x = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
    for tap in range(KERNEL_Y * KERNEL_X):
        samples = pool_samples_of(
            image, pixels, tap, KERNEL_Y, KERNEL_X, DILATION_Y, DILATION_X, LIMIT, False
        )
        if NEED_SCALE:
            along_y, along_x = rise_of_samples(image, pixels, samples, channel, exists, mean)
            if AXES == 2:
                rise_y += pulled * along_y
                rise_x += pulled * along_x
            else:
                rise_y += pulled * (along_y + along_x)
        if NEED_INPUT:
            scatter(
                sums_ptr, factors_ptr, extent, image, pixels, samples, channel, exists, pulled,
                WORDS,
            )  # fmt: skip
    if NEED_SCALE:
        into = partial_ptr + part * scales + pixels.scale_at
        tl.store(into, tl.sum(rise_y, axis=1), mask=pixels.exist)
        if AXES == 2:
            tl.store(into + plane, tl.sum(rise_x, axis=1), mask=pixels.exist)
