"""Gradients of input and scale: what each tap's sample gets, scattered and summed by pixel."""

from __future__ import annotations

import triton
import triton.language as tl

from .accumulate import accumulate
from .taps import Image, corner, has_corner, samples_of, share, tile_of_pixels


@triton.jit
def pulled_by_tap(
    grad_output_ptr,
    weight_ptr,
    pixels,
    tap,
    group,
    channel,
    exists,
    group_channels,
    group_out,
    out_channels,
    LANES: tl.constexpr,
    PRECISION: tl.constexpr,
    BLOCK_OUT: tl.constexpr,
):
    """(pixels, channels) gradient of one tap's samples; weight is (taps, O, C/groups)."""
    exist = pixels.exist[:, None]
    first_row = tap * out_channels
    if LANES:
        own = channel // group_channels
        within = channel - own * group_channels
        total = tl.zeros((pixels.number.shape[0], channel.shape[0]), pixels.scale_y.dtype)
        for k in range(group_out):
            out_channel = own * group_out + k
            grad = tl.load(
                grad_output_ptr + (pixels.number * out_channels)[:, None] + out_channel[None, :],
                mask=exist & exists[None, :],
                other=0.0,
            )
            row = (first_row + out_channel).to(tl.int64) * group_channels
            factor = tl.load(weight_ptr + row + within, mask=exists, other=0.0)
            total += grad.to(total.dtype) * factor.to(total.dtype)[None, :]
    else:
        within = channel - group * group_channels
        total = tl.zeros((pixels.number.shape[0], channel.shape[0]), tl.float32)
        for block in range(0, group_out, BLOCK_OUT):
            k = block + tl.arange(0, BLOCK_OUT)
            out_channel = group * group_out + k
            grad = tl.load(
                grad_output_ptr + (pixels.number * out_channels)[:, None] + out_channel[None, :],
                mask=exist & (k < group_out)[None, :],
                other=0.0,
            )
            row = (first_row + out_channel).to(tl.int64) * group_channels
            factors = tl.load(
                weight_ptr + row[:, None] + within[None, :],
                mask=(k < group_out)[:, None] & exists[None, :],
                other=0.0,
            )
            total = tl.dot(grad, factors, total, input_precision=PRECISION)
    return total


@triton.jit
def rise_of_samples(image, pixels, samples, channel, exists, mean=None):
    """(pixels, channels) derivatives of a tap's samples with respect to both scales.

    ``mean``: comes off the values of all corners in the image, of which hidden ones are zero.
    """
    along_y = tl.zeros((pixels.number.shape[0], channel.shape[0]), samples.fraction_y.dtype)
    along_x = along_y
    first = image.pointer + (samples.place * image.channels)[:, None] + channel[None, :]
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            weight_y = share(samples.fraction_y, i)
            weight_x = share(samples.fraction_x, j)
            seen, step = corner(image, pixels, samples, i, j)
            mask = seen[:, None] & exists[None, :]
            value = tl.load(first + step * image.channels, mask=mask, other=0.0).to(along_y.dtype)
            # A finite value without weight still has the derivative of a sample on a pixel.
            weighs = (weight_y * weight_x != 0)[:, None]
            value = tl.where(weighs | (tl.abs(value) < float("inf")), value, 0.0)
            if mean is not None:
                inside = has_corner(image, samples, i, j)[:, None]
                value = tl.where(inside & exists[None, :], value - mean, 0.0)
            along_y += (weight_x * (2 * i - 1))[:, None] * value
            along_x += (weight_y * (2 * j - 1))[:, None] * value
    # Where a tap does not move, 0 * inf must not appear.
    tap_y = samples.doubled_y.to(along_y.dtype) * 0.5
    along_y = tl.where(tap_y == 0, 0.0, along_y * tap_y)
    tap_x = samples.doubled_x.to(along_x.dtype) * 0.5
    along_x = tl.where(tap_x == 0, 0.0, along_x * tap_x)
    return along_y, along_x


@triton.jit
def scatter(
    sums_ptr,
    factors_ptr,
    extent,
    image,
    pixels,
    samples,
    channel,
    exists,
    pulled,
    WORDS: tl.constexpr,
):
    """Add a tap's gradients to the pixels that its samples were made of."""
    first = (samples.place * image.channels)[:, None] + channel[None, :]
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            weight = share(samples.fraction_y, i) * share(samples.fraction_x, j)
            seen, step = corner(image, pixels, samples, i, j)
            mask = (seen & (weight != 0))[:, None] & exists[None, :]
            accumulate(
                sums_ptr, first + step * image.channels, weight[:, None] * pulled, mask,
                factors_ptr, extent, WORDS,
            )  # fmt: skip


@triton.jit
def backward_data_kernel(
    sums_ptr,
    factors_ptr,
    partial_ptr,
    grad_output_ptr,
    input_ptr,
    weight_ptr,
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
    out_channels,
    group_channels,
    group_out,
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
    LANES: tl.constexpr,
    PRECISION: tl.constexpr,
    NEED_INPUT: tl.constexpr,
    NEED_SCALE: tl.constexpr,
    WORDS: tl.constexpr,
    BLOCK_PIXELS: tl.constexpr,
    BLOCK_IN: tl.constexpr,
    BLOCK_OUT: tl.constexpr,
):
    """All taps of a tile of pixels and a block of channels; grad_output is (N, Ho, Wo, O).

    The gradient of the scale comes as one partial sum per block of channels.
    """
    span = channels if LANES else group_channels
    blocks = tl.cdiv(span, BLOCK_IN)
    parts = blocks if LANES else blocks * (channels // group_channels)
    program = tl.program_id(0)
    tile = program // parts
    part = program - tile * parts
    group = part // blocks
    within = (part - group * blocks) * BLOCK_IN + tl.arange(0, BLOCK_IN)
    exists = within < span
    channel = group * group_channels + within

    image = Image(input_ptr, channels, height, width, guide_ptr, tolerance_ptr)
    pixels = tile_of_pixels(
        tile.to(tl.int64) * BLOCK_PIXELS, count, plane, columns, image, scale_ptr,
        stride_y, stride_x, first_y, first_x, AXES, ACC, INDEX, BLOCK_PIXELS,
    )  # fmt: skip
    rise_y = tl.zeros((BLOCK_PIXELS, BLOCK_IN), ACC)
    rise_x = tl.zeros((BLOCK_PIXELS, BLOCK_IN), ACC)
    for tap in range(KERNEL_Y * KERNEL_X):
        samples = samples_of(
            image, pixels, tap // KERNEL_X, tap % KERNEL_X, KERNEL_Y, KERNEL_X, DILATION_Y,
            DILATION_X, LIMIT,
        )  # fmt: skip
        pulled = pulled_by_tap(
            grad_output_ptr, weight_ptr, pixels, tap, group, channel, exists, group_channels,
            group_out, out_channels, LANES, PRECISION, BLOCK_OUT,
        )  # fmt: skip
        if NEED_SCALE:
            along_y, along_x = rise_of_samples(image, pixels, samples, channel, exists)
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
        at = partial_ptr + part.to(tl.int64) * scales + pixels.scale_at
        tl.store(at, tl.sum(rise_y, axis=1), mask=pixels.exist)
        if AXES == 2:
            tl.store(at + plane, tl.sum(rise_x, axis=1), mask=pixels.exist)
