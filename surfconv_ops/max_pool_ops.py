"""The maximum's operator: fake kernel, derivatives, vmap rules."""

from __future__ import annotations

from collections.abc import Sequence
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

_op = torch.ops.surfconv.surf_max_pool2d.default
_backward_op = torch.ops.surfconv.surf_max_pool2d_backward.default


@torch.library.register_fake("surfconv::surf_max_pool2d", lib=library)
def _fake(
    input: Tensor, scale: Tensor, guide: Any, tolerance: float, kernel: Sequence[int], *_: Any
) -> tuple[Tensor, Tensor]:
    dtype = pool_reference.winner_dtype(kernel[0] * kernel[1])
    shape = (input.shape[0], *scale.shape[2:], input.shape[1])
    return empty_output(input, scale), input.new_empty(shape, dtype=dtype)


def save_forward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    input, scale, guide, *options = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(input, scale, guide, output[1])
    ctx.options = options


def surf_max_pool2d(*arguments: Any) -> tuple[Tensor, Tensor]:
    """The operator on checked arguments: the maximum and its winners."""
    result: tuple[Tensor, Tensor] = direct.apply(SurfMaxPool2dFunction, _op, *arguments)
    return result


def _call_backward(*arguments: Any) -> tuple[Tensor, Tensor]:
    grads: tuple[Tensor, Tensor] = direct.apply(
        SurfMaxPool2dBackwardFunction, _backward_op, *arguments
    )
    return grads


# Arguments one by one: TorchDynamo 2.13 hands its context to a forward that takes ``*args``.
class SurfMaxPool2dFunction(torch.autograd.Function):
    """The maximum and its winners; its backward is :class:`SurfMaxPool2dBackwardFunction`."""

    @staticmethod
    def forward(
        input: Tensor,
        scale: Tensor,
        guide: Tensor | None,
        guide_tolerance: float,
        kernel_size: Pair,
        stride: Pair,
        padding: Pair,
        dilation: Pair,
    ) -> tuple[Tensor, Tensor]:
        result: tuple[Tensor, Tensor] = direct.run_kernel(
            _op,
            input,
            scale,
            guide,
            guide_tolerance,
            kernel_size,
            stride,
            padding,
            dilation,
        )
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        save_forward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor, _: Any) -> Grads:
        return differentiate(_call_backward, ctx, grad_output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_forward(SurfMaxPool2dFunction.apply, info.batch_size, in_dims, args)


class SurfMaxPool2dBackwardFunction(torch.autograd.Function):
    """The maximum's backward operator; its backward runs the reference's formula."""

    @staticmethod
    def forward(
        grad_output: Tensor,
        input: Tensor,
        scale: Tensor,
        guide: Tensor | None,
        winner: Tensor,
        guide_tolerance: float,
        kernel_size: Pair,
        stride: Pair,
        padding: Pair,
        dilation: Pair,
        need_input: bool,
        need_scale: bool,
    ) -> tuple[Tensor, Tensor]:
        grads: tuple[Tensor, Tensor] = direct.run_kernel(
            _backward_op,
            grad_output,
            input,
            scale,
            guide,
            winner,
            guide_tolerance,
            kernel_size,
            stride,
            padding,
            dilation,
            need_input,
            need_scale,
        )
        return grads

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
        return differentiate_backward(pool_reference.max_backward, ctx, *cotangents)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_backward(
            SurfMaxPool2dBackwardFunction.apply, info.batch_size, in_dims, args
        )


register("surf_max_pool2d", save_forward, _op, _backward_op, pool_reference.max_backward)
