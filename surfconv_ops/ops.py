"""The registered operators and everything PyTorch must know of them.

The kernels come from the compiled library or from the reference. Here they get their fake
kernels, derivatives, autocast and vmap rules. The public function goes through
:class:`SurfConv2dFunction`, because torch.func needs a Function with a vmap rule; calls to
``torch.ops.surfconv`` use the same rules through ``register_autograd``.

Forward-mode differentiation is not offered and raises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from . import _fallback, cuda_ops, depth_ops, depth_resize, direct, reference
from .autocast import autocast_disabled, cast_to_autocast_dtype
from .geometry import Pair
from .layout import memory_format_of
from .vmap import vmap_backward, vmap_forward

_FORWARD = "surfconv::surf_conv2d"
_BACKWARD = "surfconv::surf_conv2d_backward"
_AUTOCAST_KEYS = {"AutocastCPU": "cpu", "AutocastCUDA": "cuda"}


class Library(torch.library.Library):
    """A library whose derivatives refuse forward mode.

    What register_autograd makes is skipped where nothing requires a gradient, and would lose a
    tangent in silence.
    """

    def impl(
        self, op_name: str, fn: Callable[..., Any], dispatch_key: str = "", **options: Any
    ) -> Any:
        if dispatch_key != "Autograd":
            return super().impl(op_name, fn, dispatch_key, **options)

        def guarded(keyset: Any, *args: Any) -> Any:
            if direct.has_tangent(args):
                raise NotImplementedError(
                    f"{op_name} has no forward-mode derivative; use reverse mode (torch.func.vjp,"
                    " jacrev, or backward)"
                )
            return fn(keyset, *args)

        return super().impl(op_name, guarded, dispatch_key, **options)


# Kept for the life of the process: what it registered goes when it goes.
_library = Library("surfconv", "FRAGMENT")
_fallback.register(_library)
depth_ops.register(_library)
depth_resize.register(_library)
cuda_ops.register(_library)
_forward_op = torch.ops.surfconv.surf_conv2d.default
_backward_op = torch.ops.surfconv.surf_conv2d_backward.default

Grads = tuple[Tensor | None, ...]


@torch.library.register_fake(_FORWARD, lib=_library)
def _fake_forward(
    input: Tensor, weight: Tensor, bias: Tensor | None, scale: Tensor, *_: Any
) -> Tensor:
    shape = (input.shape[0], weight.shape[0], scale.shape[2], scale.shape[3])
    return input.new_empty(shape).contiguous(memory_format=memory_format_of(input))


@torch.library.register_fake(_BACKWARD, lib=_library)
def _fake_backward(
    grad_output: Tensor, input: Tensor, weight: Tensor, scale: Tensor, *rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    need_input, need_weight, need_bias, need_scale = rest[-4:]

    def like(model: Tensor, needed: bool) -> Tensor:
        if not needed:
            return model.new_empty(0)
        return model.new_empty(model.shape).contiguous(memory_format=memory_format_of(model))

    grad_bias = weight.new_empty(weight.shape[0] if need_bias else 0)
    return (
        like(input, need_input),
        like(weight, need_weight),
        grad_bias,
        like(scale, need_scale),
    )


@torch.library.register_fake("surfconv::level_values", lib=_library)
def _fake_level_values(depth: Tensor, edges: Tensor, values: Tensor) -> Tensor:
    return depth.new_empty(depth.shape)


@torch.library.register_vmap("surfconv::level_values", lib=_library)
def _vmap_level_values(
    info: Any, in_dims: tuple[int | None, ...], depth: Tensor, edges: Tensor, values: Tensor
) -> tuple[Tensor, int | None]:
    return torch.ops.surfconv.level_values(depth, edges, values), in_dims[0]


def save_forward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    input, weight, _, scale, guide, *options = inputs
    ctx.save_for_backward(input, weight, scale, guide)
    ctx.options = options


def save_backward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    grad_output, input, weight, scale, guide, *options = inputs
    ctx.save_for_backward(grad_output, input, weight, scale, guide)
    ctx.options, ctx.needs = options[:5], options[5:]
    # A gradient that nobody used comes as None and costs nothing.
    ctx.set_materialize_grads(False)


def differentiate_forward(call: Callable[..., tuple[Tensor, ...]], ctx: Any, grad: Tensor) -> Grads:
    """Gradients of the forward's ten arguments, computed by ``call``, the backward."""
    input, weight, scale, guide = ctx.saved_tensors
    needed = ctx.needs_input_grad
    needs = (needed[0], needed[1], needed[2], needed[3])
    grads = call(grad, input, weight, scale, guide, *ctx.options, *needs)
    used = [g if need else None for g, need in zip(grads, needs, strict=True)]
    return (*used, None, None, None, None, None, None)


def differentiate_backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
    """Gradients of the backward's fourteen arguments: the derivative of the reference's formula."""
    saved = ctx.saved_tensors
    wanted = [i for i in range(4) if ctx.needs_input_grad[i]]
    present = [c for c, need in zip(cotangents, ctx.needs, strict=True) if need and c is not None]
    needs = [need and c is not None for c, need in zip(cotangents, ctx.needs, strict=True)]
    result: list[Tensor | None] = [None] * 14
    if not wanted or not present:
        return tuple(result)

    def formula(*variables: Tensor) -> tuple[Tensor, ...]:
        arguments: list[Any] = [*saved, *ctx.options, *needs]
        for position, variable in zip(wanted, variables, strict=True):
            arguments[position] = variable
        grads = reference.backward(*arguments)
        return tuple(grad for grad, need in zip(grads, needs, strict=True) if need)

    pull_back = torch.func.vjp(formula, *[saved[i] for i in wanted])[1]
    for position, grad in zip(wanted, pull_back(tuple(present)), strict=True):
        result[position] = grad
    return tuple(result)


def surf_conv2d(*arguments: Any) -> Tensor:
    """The operator on checked arguments, differentiable through torch.func as well."""
    output: Tensor = direct.apply(SurfConv2dFunction, _forward_op, *arguments)
    return output


def _call_backward(*arguments: Any) -> tuple[Tensor, ...]:
    grads: tuple[Tensor, ...] = direct.apply(SurfConv2dBackwardFunction, _backward_op, *arguments)
    return grads


class SurfConv2dFunction(torch.autograd.Function):
    """The forward operator; its backward is :class:`SurfConv2dBackwardFunction`."""

    @staticmethod
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
        output: Tensor = direct.run_kernel(
            _forward_op,
            input,
            weight,
            bias,
            scale,
            guide,
            guide_tolerance,
            stride,
            padding,
            dilation,
            groups,
        )
        return output

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        save_forward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, grad_output: Tensor) -> Grads:
        return differentiate_forward(_call_backward, ctx, grad_output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Tensor, int]:
        return vmap_forward(SurfConv2dFunction.apply, info.batch_size, in_dims, args)


class SurfConv2dBackwardFunction(torch.autograd.Function):
    """The backward operator; its backward runs the reference's formulas."""

    @staticmethod
    def forward(
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
    ) -> tuple[Tensor, ...]:
        grads: tuple[Tensor, ...] = direct.run_kernel(
            _backward_op,
            grad_output,
            input,
            weight,
            scale,
            guide,
            guide_tolerance,
            stride,
            padding,
            dilation,
            groups,
            need_input,
            need_weight,
            need_bias,
            need_scale,
        )
        return grads

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        save_backward(ctx, inputs, output)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
        return differentiate_backward(ctx, *cotangents)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], *args: Any
    ) -> tuple[tuple[Tensor, ...], tuple[int | None, ...]]:
        return vmap_backward(SurfConv2dBackwardFunction.apply, info.batch_size, in_dims, args)


def _register_derivatives() -> None:
    def of_forward(ctx: Any, grad: Tensor) -> Grads:
        return differentiate_forward(_backward_op, ctx, grad)

    torch.library.register_autograd(_FORWARD, of_forward, setup_context=save_forward, lib=_library)
    torch.library.register_autograd(
        _BACKWARD, differentiate_backward, setup_context=save_backward, lib=_library
    )


def _register_vmap() -> None:
    def forward_rule(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Tensor, int]:
        return vmap_forward(_forward_op, info.batch_size, in_dims, args)

    def backward_rule(
        info: Any, in_dims: tuple[int | None, ...], *args: Any
    ) -> tuple[tuple[Tensor, ...], tuple[int | None, ...]]:
        return vmap_backward(_backward_op, info.batch_size, in_dims, args)

    torch.library.register_vmap(_FORWARD, forward_rule, lib=_library)
    torch.library.register_vmap(_BACKWARD, backward_rule, lib=_library)


def _register_autocast(key: str, device_type: str) -> None:
    # torch.library.register_autocast would cast the scale too, and to one dtype fixed here.
    def cast(
        input: Tensor, weight: Tensor, bias: Tensor | None, scale: Tensor, *rest: Any
    ) -> Tensor:
        input, weight, bias = cast_to_autocast_dtype(input, weight, bias)
        with autocast_disabled(device_type):
            output: Tensor = _forward_op(input, weight, bias, scale, *rest)
        return output

    _library.impl("surf_conv2d", cast, key)


_register_derivatives()
_register_vmap()
for _key, _device_type in _AUTOCAST_KEYS.items():
    _register_autocast(_key, _device_type)
