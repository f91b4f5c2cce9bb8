"""The kernels as differentiable functions of their own, apart from the registered operators."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .. import ops
from . import kernels


class SurfConv2dFunction(torch.autograd.Function):
    """The forward kernel; its backward is :class:`SurfConv2dBackwardFunction`."""

    @staticmethod
    def forward(*arguments: Any) -> Tensor:
        return kernels.forward(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ops.save_forward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor) -> ops.Grads:
        return ops.differentiate_forward(SurfConv2dBackwardFunction.apply, ctx, grad_output)


class SurfConv2dBackwardFunction(torch.autograd.Function):
    """The backward kernels; their derivative is that of the reference's formulas."""

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, ...]:
        return kernels.backward(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ops.save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> ops.Grads:
        return ops.differentiate_backward(ctx, *cotangents)
