"""The maximum over the taps, and where its gradient goes: to the tap that has won."""

from __future__ import annotations

import triton
import triton.language as tl

from .accumulate import accumulate
from .pool_taps import as_column, block_of_channels, pool_samples_of, slopes_of_corner
from .taps import Image, corner, share, tile_of_pixels


@triton.jit
def max_forward_kernel(
    output_ptr,
    winner_ptr,
    input_ptr,
    scale_ptr,
    guide_ptr,
    tolerance_ptr,
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
    BLOCK_PIXELS: tl.constexpr,
    BLOCK_CHANNELS: tl.constexpr,
):
    """A (pixels, channels) tile of the maxima and of their taps' numbers, both (N, Ho, Wo, C)."""
    tile, part, channel = block_of_channels(channels, BLOCK_CHANNELS)
    exists = channel < channels
    image = Image(input_ptr, channels, height, width, guide_ptr, tolerance_ptr)
    pixels = tile_of_pixels(
        tile * BLOCK_PIXELS, count, plane, columns, image, scale_ptr,
        stride_y, stride_x, first_y, first_x, AXES, ACC, INDEX, BLOCK_PIXELS,
    )  # fmt: skip
    best = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
    winner = tl.full((BLOCK_PIXELS, BLOCK_CHANNELS), KERNEL_Y * KERNEL_X, tl.int32)
    for tap in range(KERNEL_Y * KERNEL_X):
        samples = pool_samples_of(
            image, pixels, tap, KERNEL_Y, KERNEL_X, DILATION_Y, DILATION_X, LIMIT, True
        )
        value = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
        first = input_ptr + (samples.place * channels)[:, None] + channel[None, :]
        for i in tl.static_range(2):
            for j in tl.static_range(2):
                weight = share(samples.fraction_y, i) * share(samples.fraction_x, j)
                seen, step = corner(image, pixels, samples, i, j)
                # Without weight a corner is not seen: 0 * inf must not appear.
                mask = (seen & (weight != 0))[:, None] & exists[None, :]
                pixel = tl.load(first + step * channels, mask=mask, other=0.0)
                value += weight[:, None] * pixel.to(ACC)
        is_first = winner == KERNEL_Y * KERNEL_X
        # A tap that sees nothing is one of zeros; there is none where its scale is not finite.
        wins = samples.reached[:, None] & (is_first | (value > best) | (value != value))
        best = tl.where(wins, value, best)
        winner = tl.where(wins, tap, winner)
    at = (pixels.number * channels)[:, None] + channel[None, :]
    mask = pixels.exist[:, None] & exists[None, :]
    tl.store(output_ptr + at, best.to(output_ptr.dtype.element_ty), mask=mask)
    tl.store(winner_ptr + at, winner.to(winner_ptr.dtype.element_ty), mask=mask)


@triton.jit
def max_backward_kernel(
    sums_ptr,
    factors_ptr,
    partial_ptr,
    grad_output_ptr,
    winner_ptr,
    input_ptr,
    scale_ptr,
    guide_ptr,
    tolerance_ptr,
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
    NEED_INPUT: tl.constexpr,
    NEED_SCALE: tl.constexpr,
    WORDS: tl.constexpr,
    BLOCK_PIXELS: tl.constexpr,
    BLOCK_CHANNELS: tl.constexpr,
):
    """A tile of grad_output, (N, Ho, Wo, C); every one of its values has a tap of its own.

    The gradient of the scale comes as one partial sum per block of channels.
    """
    tile, part, channel = block_of_channels(channels, BLOCK_CHANNELS)
    image = Image(input_ptr, channels, height, width, guide_ptr, tolerance_ptr)
    pixels = tile_of_pixels(
        tile * BLOCK_PIXELS, count, plane, columns, image, scale_ptr,
        stride_y, stride_x, first_y, first_x, AXES, ACC, INDEX, BLOCK_PIXELS,
    )  # fmt: skip
    at = (pixels.number * channels)[:, None] + channel[None, :]
    exist = pixels.exist[:, None] & (channel < channels)[None, :]
    tap = tl.load(winner_ptr + at, mask=exist, other=0).to(tl.int32)
    won = exist & (tap >= 0) & (tap < KERNEL_Y * KERNEL_X)
    grad = tl.load(grad_output_ptr + at, mask=won, other=0.0).to(ACC)

    beside = as_column(pixels)
    samples = pool_samples_of(
        image, beside, tap, KERNEL_Y, KERNEL_X, DILATION_Y, DILATION_X, LIMIT, True
    )
    rise_y = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
    rise_x = tl.zeros((BLOCK_PIXELS, BLOCK_CHANNELS), ACC)
    first = samples.place * channels + channel[None, :]
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            weight = share(samples.fraction_y, i) * share(samples.fraction_x, j)
            slope_y, slope_x = slopes_of_corner(samples, i, j)
            seen, step = corner(image, beside, samples, i, j)
            seen = seen & won
            if NEED_SCALE:
                value = tl.load(input_ptr + first + step * channels, mask=seen, other=0.0).to(ACC)
                # A finite value without weight still has the derivative of a sample on a pixel.
                counts = seen & ((weight != 0) | (tl.abs(value) < float("inf")))
                pulled = value * grad
                # Where a sample does not move, 0 * inf must not appear.
                along_y = tl.where(counts & (slope_y != 0), slope_y * pulled, 0.0)
                along_x = tl.where(counts & (slope_x != 0), slope_x * pulled, 0.0)
                if AXES == 2:
                    rise_y += along_y
                    rise_x += along_x
                else:
                    rise_y += along_y + along_x
            if NEED_INPUT:
                accumulate(
                    sums_ptr, first + step * channels, weight * grad, seen & (weight != 0),
                    factors_ptr, extent, WORDS,
                )  # fmt: skip
    if NEED_SCALE:
        into = partial_ptr + part * scales + pixels.scale_at
        tl.store(into, tl.sum(rise_y, axis=1), mask=pixels.exist)
        if AXES == 2:
            tl.store(into + plane, tl.sum(rise_x, axis=1), mask=pixels.exist)
