"""The average's operator: fake kernel, derivatives, vmap rules."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from . import direct, pool_reference
from .geometry import Pair
from .pool_ops import (
    Grads,
    differentiate,
    differentiate_backward,
    empty_output,
    library,
    register,
    save_backward,
)
from .vmap import vmap_pool_backward, vmap_pool_forward

_op = torch.ops.surfconv.surf_avg_pool2d.default
_backward_op = torch.ops.surfconv.surf_avg_pool2d_backward.default


@torch.library.register_fake("surfconv::surf_avg_pool2d", lib=library)
def _fake(input: Tensor, scale: Tensor, *_: Any) -> Tensor:
    return empty_output(input, scale)


def save_forward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    input, scale, guide, *options = inputs
    ctx.save_for_backward(input, scale, guide)
    ctx.options = options


def surf_avg_pool2d(*arguments: Any) -> Tensor:
    """The operator on checked arguments."""
    output: Tensor = direct.apply(SurfAvgPool2dFunction, _op, *arguments)
    return output


def _call_backward(*arguments: Any) -> tuple[Tensor, Tensor]:
    grads: tuple[Tensor, Tensor] = direct.apply(
        SurfAvgPool2dBackwardFunction, _backward_op, *arguments
    )
    return grads


# Arguments one by one: TorchDynamo 2.13 hands its context to a forward that takes ``*args``.
class SurfAvgPool2dFunction(torch.autograd.Function):
    """The average; its backward is :class:`SurfAvgPool2dBackwardFunction`."""

    @staticmethod
    def forward(
        input: Tensor,
        scale: Tensor,
        guide: Tensor | None,
        guide_tolerance: float,
        kernel_size: Pair,
        stride: Pair,
        padding: Pair,
        count_include_pad: bool,
        divisor_override: int,
    ) -> Tensor:
        output: Tensor = direct.run_kernel(
            _op,
            input,
            scale,
            guide,
            guide_tolerance,
            kernel_size,
            stride,
            padding,
            count_include_pad,
            divisor_override,
        )
        return output

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        save_forward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor) -> Grads:
        return differentiate(_call_backward, ctx, grad_output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_forward(SurfAvgPool2dFunction.apply, info.batch_size, in_dims, args)


class SurfAvgPool2dBackwardFunction(torch.autograd.Function):
    """The average's backward operator; its backward runs the reference's formula."""

    @staticmethod
    def forward(
        grad_output: Tensor,
        input: Tensor,
        scale: Tensor,
        guide: Tensor | None,
        guide_tolerance: float,
        kernel_size: Pair,
        stride: Pair,
        padding: Pair,
        count_include_pad: bool,
        divisor_override: int,
        need_input: bool,
        need_scale: bool,
    ) -> tuple[Tensor, Tensor]:
        grads: tuple[Tensor, Tensor] = direct.run_kernel(
            _backward_op,
            grad_output,
            input,
            scale,
            guide,
            guide_tolerance,
            kernel_size,
            stride,
            padding,
            count_include_pad,
            divisor_override,
            need_input,
            need_scale,
        )
        return grads

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
        return differentiate_backward(pool_reference.avg_backward, ctx, *cotangents)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_backward(
            SurfAvgPool2dBackwardFunction.apply, info.batch_size, in_dims, args
        )


register("surf_avg_pool2d", save_forward, _op, _backward_op, pool_reference.avg_backward)
