"""The gradient of the weight: each program sums one tap over a share of the pixels."""

from __future__ import annotations

import triton
import triton.language as tl

from .taps import Image, interpolate, samples_of, tile_of_pixels


@triton.jit
def put(at, value, mask, ADDS: tl.constexpr):
    """Store a program's share, or add it to what other programs add."""
    if ADDS:
        tl.atomic_add(at, value, mask=mask, sem="relaxed")
    else:
        tl.store(at, value.to(at.dtype.element_ty), mask=mask)


@triton.jit
def backward_weight_kernel(
    sums_ptr,
    grad_output_ptr,
    input_ptr,
    scale_ptr,
    guide_ptr,
    tolerance_ptr,
    share_stride,
    tap_stride,
    in_stride,
    out_stride,
    splits,
    tiles,
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
    ADDS: tl.constexpr,
    BLOCK_PIXELS: tl.constexpr,
    BLOCK_IN: tl.constexpr,
    BLOCK_OUT: tl.constexpr,
):
    """A block of one tap's gradient, summed over a share of the tiles; added to what others add."""
    span = out_channels if LANES else group_out
    out_blocks = tl.cdiv(span, BLOCK_OUT)
    groups = 1 if LANES else out_channels // group_out
    in_blocks = group_channels if LANES else tl.cdiv(group_channels, BLOCK_IN)
    # All taps and blocks of the same pixels run side by side and share what they read.
    rest = tl.program_id(0)
    part = rest % (out_blocks * groups)
    rest = rest // (out_blocks * groups)
    in_block = rest % in_blocks
    rest = rest // in_blocks
    tap = rest % (KERNEL_Y * KERNEL_X)
    split = rest // (KERNEL_Y * KERNEL_X)

    group = part // out_blocks
    within = (part - group * out_blocks) * BLOCK_OUT + tl.arange(0, BLOCK_OUT)
    out_exists = within < span
    out_channel = group * group_out + within
    image = Image(input_ptr, channels, height, width, guide_ptr, tolerance_ptr)
    if LANES:
        lane_sums = tl.zeros((BLOCK_OUT,), ACC)
        channel = (within // group_out) * group_channels + in_block
        in_exists = out_exists
    else:
        sums = tl.zeros((BLOCK_IN, BLOCK_OUT), ACC)
        row = in_block * BLOCK_IN + tl.arange(0, BLOCK_IN)
        in_exists = row < group_channels
        channel = group * group_channels + row
    for tile in range(split, tiles, splits):
        pixels = tile_of_pixels(
            tl.cast(tile, tl.int64) * BLOCK_PIXELS, count, plane, columns, image, scale_ptr,
            stride_y, stride_x, first_y, first_x, AXES, ACC, INDEX, BLOCK_PIXELS,
        )  # fmt: skip
        samples = samples_of(
            image, pixels, tap // KERNEL_X, tap % KERNEL_X, KERNEL_Y, KERNEL_X, DILATION_Y,
            DILATION_X, LIMIT,
        )  # fmt: skip
        seen = interpolate(image, pixels, samples, channel, in_exists, 2, 2)
        grad = tl.load(
            grad_output_ptr + (pixels.number * out_channels)[:, None] + out_channel[None, :],
            mask=pixels.exist[:, None] & out_exists[None, :],
            other=0.0,
        )
        if LANES:
            lane_sums += tl.sum(seen * grad.to(ACC), axis=0)
        else:
            sums = tl.dot(tl.trans(seen.to(grad.dtype)), grad, sums, input_precision=PRECISION)
    first = sums_ptr + tl.cast(split, tl.int64) * share_stride + tl.cast(tap, tl.int64) * tap_stride
    column = out_channel.to(tl.int64) * out_stride
    if LANES:
        first += tl.cast(in_block, tl.int64) * in_stride
        put(first + column, lane_sums, out_exists, ADDS)
    else:
        at = (first + row.to(tl.int64) * in_stride)[:, None] + column[None, :]
        put(at, sums, in_exists[:, None] & out_exists[None, :], ADDS)
