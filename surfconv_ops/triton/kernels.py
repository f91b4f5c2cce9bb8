"""The registered operators on one device: memory, launches, what is left to torch's operators."""

from __future__ import annotations

import torch
import triton
from torch import Tensor

from ..geometry import Pair
from ..layout import lay_out, memory_format_of
from .accumulate import Sums
from .backward_data import backward_data_kernel
from .backward_weight import backward_weight_kernel
from .conv import Conv, channels_innermost, limits_of_view, tensor_float32
from .depth_to_scale import depth_to_scale, depth_to_scale_backward
from .forward import forward_kernel
from .interpreter import in_float32, needs_float32
from .launch import on_device
from .level_values import level_values
from .tiles import Tiles, data_tiles, fastest, forward_tiles, weight_tiles

__all__ = ["backward", "depth_to_scale", "depth_to_scale_backward", "forward", "level_values"]

#: Programs that sum the gradient of the weight. Not the device's own number: what is added to
#: what, and so the last bit, is to depend on the shapes alone.
_WEIGHT_PROGRAMS = 1024


def forward(
    input: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
    groups: int,
) -> Tensor:
    """``torch.ops.surfconv.surf_conv2d`` on CUDA tensors, or on the CPU in the interpreter."""
    if needs_float32(input):
        options = (guide, guide_tolerance, stride, padding, dilation, groups)
        wide: Tensor = in_float32(forward, (input, weight, bias, scale, *options))
        return wide.to(input.dtype)
    conv = Conv.of(input, weight, scale, stride, padding, dilation, groups)
    shape = (conv.batch, *conv.output, conv.out_channels)
    output = torch.empty(shape, dtype=conv.dtype, device=input.device)
    if output.numel():
        image = channels_innermost(input)
        factors = weight.permute(2, 3, 1, 0).contiguous()
        view = limits_of_view(guide, guide_tolerance, conv.compute_dtype)
        arguments = (
            output,
            image,
            factors,
            None if bias is None else bias.contiguous(),
            scale.contiguous(),
            *view,
            *conv.places(),
            *conv.channel_counts(),
            *conv.centres(),
        )

        def run(tiles: Tiles) -> None:
            width, groups = (conv.out_channels, 1) if conv.lanes else (conv.group_out, conv.groups)
            blocks = triton.cdiv(width, tiles.channels_out) * groups
            grid = (triton.cdiv(conv.pixels, tiles.pixels) * blocks,)
            forward_kernel[grid](
                *arguments, **conv.constants(), UNROLL=tiles.unrolled, **tiles.constants()
            )

        with on_device(input):
            variant = (guide is not None, tensor_float32())
            run(fastest("forward", conv, variant, forward_tiles(conv), run, input.device))
    return lay_out(output.permute(0, 3, 1, 2), memory_format_of(input))


def backward(
    grad_output: Tensor,
    input: Tensor,
    weight: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
    groups: int,
    need_input: bool,
    need_weight: bool,
    need_bias: bool,
    need_scale: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``torch.ops.surfconv.surf_conv2d_backward``; what is not needed has shape (0,)."""
    if needs_float32(input):
        options = (guide, guide_tolerance, stride, padding, dilation, groups)
        needs = (need_input, need_weight, need_bias, need_scale)
        wide = in_float32(backward, (grad_output, input, weight, scale, *options, *needs))
        models = (input, weight, weight, scale)
        narrow = [grad.to(model.dtype) for grad, model in zip(wide, models, strict=True)]
        return narrow[0], narrow[1], narrow[2], narrow[3]
    conv = Conv.of(input, weight, scale, stride, padding, dilation, groups)
    grads = [input.new_empty(0), weight.new_empty(0), weight.new_empty(0), scale.new_empty(0)]
    with on_device(input):
        outer, image = channels_innermost(grad_output), channels_innermost(input)
        scale_in_order = scale.contiguous()
        view = limits_of_view(guide, guide_tolerance, conv.compute_dtype)
        shared = (outer, image, scale_in_order, view)
        if need_input or need_scale:
            grad_input, grad_scale = _backward_data(conv, shared, weight, need_input, need_scale)
            if need_input:
                grad_input = grad_input.permute(0, 3, 1, 2)
                grads[0] = lay_out(grad_input, memory_format_of(input))
            if need_scale:
                grad_scale = grad_scale.reshape(scale.shape).to(scale.dtype)
                grads[3] = lay_out(grad_scale, memory_format_of(scale))
        if need_weight:
            total = _backward_weight(conv, shared).to(weight.dtype)
            grads[1] = lay_out(total, memory_format_of(weight))
        if need_bias:
            total = outer.sum((0, 1, 2), dtype=conv.compute_dtype)
            grads[2] = total.to(weight.dtype)
    return grads[0], grads[1], grads[2], grads[3]


_Shared = tuple[Tensor, Tensor, Tensor, tuple[Tensor | None, Tensor | None]]


def _backward_data(
    conv: Conv, shared: _Shared, weight: Tensor, need_input: bool, need_scale: bool
) -> tuple[Tensor, Tensor]:
    """Gradients of input, (N, H, W, C), and of scale."""
    outer, image, scale, view = shared
    factors = weight.permute(2, 3, 0, 1).contiguous()
    sums = _sums_of_input(conv, outer, image, weight) if need_input else None
    scale_sums = scale.new_zeros(0)

    def parts(tiles: Tiles) -> int:
        width, groups = (conv.channels, 1) if conv.lanes else (conv.group_channels, conv.groups)
        blocks: int = triton.cdiv(width, tiles.channels_in)
        return blocks * groups

    def run(tiles: Tiles) -> Tensor:
        if sums is not None:
            sums.zero_()
        shape = (parts(tiles) if need_scale else 0, *scale.shape)
        partial = torch.empty(shape, dtype=conv.compute_dtype, device=scale.device)
        grid = (triton.cdiv(conv.pixels, tiles.pixels) * parts(tiles),)
        backward_data_kernel[grid](
            partial if sums is None else sums.totals,
            None if sums is None else sums.factors,
            partial,
            outer,
            image,
            factors,
            scale,
            *view,
            image.numel(),
            scale.numel(),
            *conv.places(),
            *conv.channel_counts(),
            *conv.centres(),
            **conv.constants(),
            NEED_INPUT=need_input,
            NEED_SCALE=need_scale,
            WORDS=0 if sums is None else sums.words,
            **tiles.constants(),
        )
        return partial

    if conv.pixels:
        variant = (view[0] is not None, tensor_float32(), need_input, need_scale)
        tiles = fastest("backward_data", conv, variant, data_tiles(conv), run, image.device)
        scale_sums = run(tiles).sum(0)
    else:
        scale_sums = torch.zeros_like(scale)
    return image if sums is None else sums.result(conv.dtype), scale_sums


def _sums_of_input(conv: Conv, outer: Tensor, image: Tensor, weight: Tensor) -> Sums:
    shape = tuple(image.shape)
    if not torch.are_deterministic_algorithms_enabled() or not conv.pixels:
        return Sums.floating(shape, conv.compute_dtype, image.device)
    # No sample gets more than a pixel's gradients times the largest factor.
    bound = outer.abs().sum(-1, dtype=torch.float64).amax() * weight.abs().amax()
    words = 2 if conv.dtype == torch.float64 else 1
    return Sums.exact(shape, bound, conv.pixels * conv.taps, words)


def _backward_weight(conv: Conv, shared: _Shared) -> Tensor:
    """The gradient of the weight, (O, C/groups, kH, kW), in the compute dtype."""
    outer, image, scale, view = shared
    kernel = conv.kernel
    if not conv.pixels:
        shape = (conv.out_channels, conv.group_channels, *kernel)
        return torch.zeros(shape, dtype=conv.compute_dtype, device=image.device)

    def run(tiles: Tiles) -> Tensor:
        if conv.lanes:
            blocks = triton.cdiv(conv.out_channels, tiles.channels_out) * conv.group_channels
        else:
            blocks = triton.cdiv(conv.group_out, tiles.channels_out) * conv.groups
            blocks *= triton.cdiv(conv.group_channels, tiles.channels_in)
        steps = triton.cdiv(conv.pixels, tiles.pixels)
        splits = max(1, min(steps, _WEIGHT_PROGRAMS // (blocks * conv.taps)))
        shape = (splits, *kernel, conv.group_channels, conv.out_channels)
        partial = torch.empty(shape, dtype=conv.compute_dtype, device=image.device)
        backward_weight_kernel[(splits * blocks * conv.taps,)](
            partial,
            outer,
            image,
            scale,
            *view,
            splits,
            steps,
            *conv.places(),
            *conv.channel_counts(),
            *conv.centres(),
            **conv.constants(),
            **tiles.constants(),
        )
        return partial

    variant = (view[0] is not None, tensor_float32())
    tiles = fastest("backward_weight", conv, variant, weight_tiles(conv), run, image.device)
    return run(tiles).sum(0).permute(3, 2, 0, 1)
