"""The registered operators on one device: memory, launches, what is left to torch's operators."""

from __future__ import annotations

import torch
import triton
from torch import Tensor

from ..geometry import Pair
from ..layout import lay_out, memory_format_of
from .conv import Conv, tensor_float32
from .depth_to_scale import depth_to_scale, depth_to_scale_backward
from .forward import forward_kernel
from .gradients import Operands, gradient_of_weight, gradients_of_data
from .interpreter import in_float32, needs_float32
from .launch import on_device
from .layer import channels_innermost, check_grad_output, check_maps, limits_of_view, refuse
from .level_values import level_values
from .tiles import Tiles, fastest, forward_tiles

__all__ = ["backward", "depth_to_scale", "depth_to_scale_backward", "forward", "level_values"]


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
    check_maps("surf_conv2d", input, scale, guide)
    conv = Conv.of(input, weight, scale, stride, padding, dilation, groups)
    kind = (bias.shape, bias.dtype, bias.device) if bias is not None else None
    refuse(
        (
            kind in (None, ((conv.out_channels,), conv.dtype, input.device)),
            "surf_conv2d: bias must be (O,) in the input's dtype and on its device",
        )
    )
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
    check_maps("surf_conv2d_backward", input, scale, guide)
    conv = Conv.of(input, weight, scale, stride, padding, dilation, groups)
    shape = (conv.batch, conv.out_channels, *conv.output)
    check_grad_output("surf_conv2d_backward", grad_output, input, shape)
    grads = [input.new_empty(0), weight.new_empty(0), weight.new_empty(0), scale.new_empty(0)]
    with on_device(input):
        outer, image = channels_innermost(grad_output), channels_innermost(input)
        scale_in_order = scale.contiguous()
        view = limits_of_view(guide, guide_tolerance, conv.compute_dtype)
        operands = Operands(outer, image, scale_in_order, *view)
        if need_input or need_scale:
            grad_input, grad_scale = gradients_of_data(
                conv, operands, weight, need_input, need_scale
            )
            if need_input:
                grad_input = grad_input.permute(0, 3, 1, 2)
                grads[0] = lay_out(grad_input, memory_format_of(input))
            if need_scale:
                grad_scale = grad_scale.reshape(scale.shape).to(scale.dtype)
                grads[3] = lay_out(grad_scale, memory_format_of(scale))
        if need_weight:
            grads[1] = lay_out(gradient_of_weight(conv, operands), memory_format_of(weight))
        if need_bias:
            total = outer.sum((0, 1, 2), dtype=conv.compute_dtype)
            grads[2] = total.to(weight.dtype)
    return grads[0], grads[1], grads[2], grads[3]
