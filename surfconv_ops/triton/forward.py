"""The forward: an implicit matrix product over taps and channels, sampled tile by tile."""

from __future__ import annotations

import triton
import triton.language as tl

from .taps import Image, interpolate, samples_of, tile_of_pixels


@triton.jit
def contract(
    total,
    image,
    pixels,
    weight_ptr,
    tap_y,
    tap_x,
    group,
    group_channels,
    out_channel,
    out_exists,
    out_channels,
    KERNEL_Y: tl.constexpr,
    KERNEL_X: tl.constexpr,
    DILATION_Y: tl.constexpr,
    DILATION_X: tl.constexpr,
    LIMIT: tl.constexpr,
    CORNERS_Y: tl.constexpr,
    CORNERS_X: tl.constexpr,
    LANES: tl.constexpr,
    PRECISION: tl.constexpr,
    BLOCK_IN: tl.constexpr,
):
    """Add one tap's share to a (pixels, output channels) tile; weight is (taps, C/groups, O)."""
    samples = samples_of(
        image, pixels, tap_y, tap_x, KERNEL_Y, KERNEL_X, DILATION_Y, DILATION_X, LIMIT
    )
    first_row = (tap_y * KERNEL_X + tap_x) * group_channels
    if LANES:
        first = group * group_channels
        for k in range(group_channels):
            seen = interpolate(image, pixels, samples, first + k, out_exists, CORNERS_Y, CORNERS_X)
            row = tl.cast(first_row + k, tl.int64) * out_channels
            factor = tl.load(weight_ptr + row + out_channel, mask=out_exists, other=0.0)
            total += seen * factor.to(total.dtype)[None, :]
    else:
        for block in range(0, group_channels, BLOCK_IN):
            within = block + tl.arange(0, BLOCK_IN)
            exists = within < group_channels
            channel = group * group_channels + within
            seen = interpolate(image, pixels, samples, channel, exists, CORNERS_Y, CORNERS_X)
            row = (first_row + within).to(tl.int64) * out_channels
            factors = tl.load(
                weight_ptr + row[:, None] + out_channel[None, :],
                mask=exists[:, None] & out_exists[None, :],
                other=0.0,
            )
            total = tl.dot(seen.to(factors.dtype), factors, total, input_precision=PRECISION)
    return total


@triton.jit
def forward_kernel(
    output_ptr,
    input_ptr,
    weight_ptr,
    bias_ptr,
    scale_ptr,
    guide_ptr,
    tolerance_ptr,
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
    UNROLL: tl.constexpr,
    BLOCK_PIXELS: tl.constexpr,
    BLOCK_IN: tl.constexpr,
    BLOCK_OUT: tl.constexpr,
):
    """A (pixels, output channels) tile of the output, which is (N, Ho, Wo, O)."""
    # Tiles of the same pixels run side by side and share what they read.
    span = out_channels if LANES else group_out
    blocks = tl.cdiv(span, BLOCK_OUT)
    groups = 1 if LANES else out_channels // group_out
    program = tl.program_id(0)
    tile = program // (blocks * groups)
    part = program - tile * (blocks * groups)
    group = part // blocks
    within = (part - group * blocks) * BLOCK_OUT + tl.arange(0, BLOCK_OUT)
    out_exists = within < span
    out_channel = group * group_out + within
    if LANES:
        group = within // group_out

    image = Image(input_ptr, channels, height, width, guide_ptr, tolerance_ptr)
    pixels = tile_of_pixels(
        tile.to(tl.int64) * BLOCK_PIXELS, count, plane, columns, image, scale_ptr,
        stride_y, stride_x, first_y, first_x, AXES, ACC, INDEX, BLOCK_PIXELS,
    )  # fmt: skip
    total = tl.zeros((BLOCK_PIXELS, BLOCK_OUT), ACC)
    if UNROLL:
        for tap_y in tl.static_range(KERNEL_Y):
            for tap_x in tl.static_range(KERNEL_X):
                # A tap in its row's or column's middle lies on pixels.
                total = contract(
                    total, image, pixels, weight_ptr, tap_y, tap_x, group, group_channels,
                    out_channel, out_exists, out_channels, KERNEL_Y, KERNEL_X, DILATION_Y,
                    DILATION_X, LIMIT, 1 if 2 * tap_y == KERNEL_Y - 1 else 2,
                    1 if 2 * tap_x == KERNEL_X - 1 else 2, LANES, PRECISION, BLOCK_IN,
                )  # fmt: skip
    else:
        for tap in range(KERNEL_Y * KERNEL_X):
            total = contract(
                total, image, pixels, weight_ptr, tap // KERNEL_X, tap % KERNEL_X, group,
                group_channels, out_channel, out_exists, out_channels, KERNEL_Y, KERNEL_X,
                DILATION_Y, DILATION_X, LIMIT, 2, 2, LANES, PRECISION, BLOCK_IN,
            )  # fmt: skip
    if bias_ptr is not None:
        bias = tl.load(bias_ptr + out_channel, mask=out_exists, other=0.0)
        total += bias.to(ACC)[None, :]
    at = (pixels.number * out_channels)[:, None] + out_channel[None, :]
    tl.store(
        output_ptr + at,
        total.to(output_ptr.dtype.element_ty),
        mask=pixels.exist[:, None] & out_exists[None, :],
    )
