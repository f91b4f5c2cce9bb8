"""The registered pools and everything PyTorch must know of them.

As for the convolution in ``ops.py``: the public functions go through the autograd Functions here,
``torch.ops.surfconv`` through the same rules by ``register_autograd``. A pool does not cast under
autocast. Forward-mode differentiation raises.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from . import pool_fallback, pool_reference
from .geometry import Pair
from .layout import memory_format_of
from .ops import Library
from .vmap import vmap_pool_backward, vmap_pool_forward

Grads = tuple[Tensor | None, ...]


# Kept for the life of the process: what it registered goes when it goes.
_library = Library("surfconv", "FRAGMENT")
pool_fallback.register(_library)
_max_op = torch.ops.surfconv.surf_max_pool2d.default
_max_backward_op = torch.ops.surfconv.surf_max_pool2d_backward.default
_avg_op = torch.ops.surfconv.surf_avg_pool2d.default
_avg_backward_op = torch.ops.surfconv.surf_avg_pool2d_backward.default


def _empty_output(input: Tensor, scale: Tensor) -> Tensor:
    shape = (*input.shape[:2], *scale.shape[2:])
    return input.new_empty(shape).contiguous(memory_format=memory_format_of(input))


@torch.library.register_fake("surfconv::surf_max_pool2d", lib=_library)
def _fake_max(
    input: Tensor, scale: Tensor, guide: Any, tolerance: float, kernel: Sequence[int], *_: Any
) -> tuple[Tensor, Tensor]:
    dtype = pool_reference.winner_dtype(kernel[0] * kernel[1])
    shape = (input.shape[0], *scale.shape[2:], input.shape[1])
    return _empty_output(input, scale), input.new_empty(shape, dtype=dtype)


@torch.library.register_fake("surfconv::surf_avg_pool2d", lib=_library)
def _fake_avg(input: Tensor, scale: Tensor, *_: Any) -> Tensor:
    return _empty_output(input, scale)


def _fake_backward(
    grad_output: Tensor, input: Tensor, scale: Tensor, *rest: Any
) -> tuple[Tensor, Tensor]:
    empty = [
        model.new_empty(model.shape).contiguous(memory_format=memory_format_of(model))
        if need
        else model.new_empty(0)
        for model, need in zip((input, scale), rest[-2:], strict=True)
    ]
    return empty[0], empty[1]


def _save_max(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    input, scale, guide, *options = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(input, scale, guide, output[1])
    ctx.options = options


def _save_avg(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    input, scale, guide, *options = inputs
    ctx.save_for_backward(input, scale, guide)
    ctx.options = options


def _save_backward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    # The needs are the last two of the options.
    tensors = 5 if isinstance(inputs[4], Tensor) else 4
    ctx.save_for_backward(*inputs[:tensors])
    ctx.options = inputs[tensors:]
    # A gradient that nobody used comes as None and costs nothing.
    ctx.set_materialize_grads(False)


def _differentiate(call: Callable[..., tuple[Tensor, ...]], ctx: Any, grad: Tensor) -> Grads:
    """Gradients of a forward's arguments, computed by ``call``, the backward."""
    needs = ctx.needs_input_grad[:2]
    grads = call(grad, *ctx.saved_tensors, *ctx.options, *needs)
    used = [g if need else None for g, need in zip(grads, needs, strict=True)]
    return (*used, *[None] * (1 + len(ctx.options)))


def _differentiate_backward(
    formula: Callable[..., tuple[Tensor, Tensor]], ctx: Any, *cotangents: Tensor | None
) -> Grads:
    """Gradients of a backward's arguments: the derivative of the reference's formula."""
    saved = ctx.saved_tensors
    *options, need_input, need_scale = ctx.options
    result: list[Tensor | None] = [None] * (len(saved) + len(ctx.options))
    wanted = [i for i in range(3) if ctx.needs_input_grad[i]]
    pairs = zip(cotangents, (need_input, need_scale), strict=True)
    needs = [need and cotangent is not None for cotangent, need in pairs]
    present = tuple(c for c, need in zip(cotangents, needs, strict=True) if need)
    if not wanted or not present:
        return tuple(result)

    def of_wanted(*variables: Tensor) -> tuple[Tensor, ...]:
        arguments = list(saved)
        for position, variable in zip(wanted, variables, strict=True):
            arguments[position] = variable
        grads = formula(*arguments, *options, *needs)
        return tuple(grad for grad, need in zip(grads, needs, strict=True) if need)

    pull_back = torch.func.vjp(of_wanted, *[saved[i] for i in wanted])[1]
    for position, grad in zip(wanted, pull_back(present), strict=True):
        result[position] = grad
    return tuple(result)


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
        result: tuple[Tensor, Tensor] = _max_op(
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
        _save_max(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor, _: Any) -> Grads:
        return _differentiate(SurfMaxPool2dBackwardFunction.apply, ctx, grad_output)

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
        grads: tuple[Tensor, Tensor] = _max_backward_op(
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
        _save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
        return _differentiate_backward(pool_reference.max_backward, ctx, *cotangents)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_backward(
            SurfMaxPool2dBackwardFunction.apply, info.batch_size, in_dims, args
        )


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
        output: Tensor = _avg_op(
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
        _save_avg(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor) -> Grads:
        return _differentiate(SurfAvgPool2dBackwardFunction.apply, ctx, grad_output)

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
        grads: tuple[Tensor, Tensor] = _avg_backward_op(
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
        _save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
        return _differentiate_backward(pool_reference.avg_backward, ctx, *cotangents)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_backward(
            SurfAvgPool2dBackwardFunction.apply, info.batch_size, in_dims, args
        )


def _register(
    name: str,
    save: Callable[..., None],
    forward_op: Callable[..., Any],
    backward_op: Callable[..., Any],
    formula: Callable[..., tuple[Tensor, Tensor]],
) -> None:
    def differentiate(ctx: Any, grad: Tensor, *_: Any) -> Grads:
        return _differentiate(backward_op, ctx, grad)

    def differentiate_backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
        return _differentiate_backward(formula, ctx, *cotangents)

    def map_forward(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_forward(forward_op, info.batch_size, in_dims, args)

    def map_backward(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_backward(backward_op, info.batch_size, in_dims, args)

    forward, backward = f"surfconv::{name}", f"surfconv::{name}_backward"
    torch.library.register_fake(backward, _fake_backward, lib=_library)
    torch.library.register_autograd(forward, differentiate, setup_context=save, lib=_library)
    torch.library.register_autograd(
        backward, differentiate_backward, setup_context=_save_backward, lib=_library
    )
    torch.library.register_vmap(forward, map_forward, lib=_library)
    torch.library.register_vmap(backward, map_backward, lib=_library)


_register("surf_max_pool2d", _save_max, _max_op, _max_backward_op, pool_reference.max_backward)
_register("surf_avg_pool2d", _save_avg, _avg_op, _avg_backward_op, pool_reference.avg_backward)
