"""What PyTorch must know of both pools' operators; each has a file of its own besides.

As for the convolution in ``ops.py``: the public functions go through autograd Functions,
``torch.ops.surfconv`` through the same rules by ``register_autograd``. A pool does not cast under
autocast. Forward-mode differentiation raises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from . import cuda_pool_ops, pool_fallback
from .layout import memory_format_of
from .ops import Library
from .vmap import vmap_pool_backward, vmap_pool_forward

Grads = tuple[Tensor | None, ...]


# Kept for the life of the process: what it registered goes when it goes.
library = Library("surfconv", "FRAGMENT")
pool_fallback.register(library)
cuda_pool_ops.register(library)


def empty_output(input: Tensor, scale: Tensor) -> Tensor:
    shape = (*input.shape[:2], *scale.shape[2:])
    return input.new_empty(shape).contiguous(memory_format=memory_format_of(input))


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


def save_backward(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    # The needs are the last two of the options.
    tensors = 5 if isinstance(inputs[4], Tensor) else 4
    ctx.save_for_backward(*inputs[:tensors])
    ctx.options = inputs[tensors:]
    # A gradient that nobody used comes as None and costs nothing.
    ctx.set_materialize_grads(False)


def differentiate(call: Callable[..., tuple[Tensor, ...]], ctx: Any, grad: Tensor) -> Grads:
    """Gradients of a forward's arguments, computed by ``call``, the backward."""
    needs = ctx.needs_input_grad[:2]
    grads = call(grad, *ctx.saved_tensors, *ctx.options, *needs)
    used = [g if need else None for g, need in zip(grads, needs, strict=True)]
    return (*used, *[None] * (1 + len(ctx.options)))


def differentiate_backward(
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


def register(
    name: str,
    save: Callable[..., None],
    forward_op: Callable[..., Any],
    backward_op: Callable[..., Any],
    formula: Callable[..., tuple[Tensor, Tensor]],
) -> None:
    def of_forward(ctx: Any, grad: Tensor, *_: Any) -> Grads:
        return differentiate(backward_op, ctx, grad)

    def of_backward(ctx: Any, *cotangents: Tensor | None) -> Grads:
        return differentiate_backward(formula, ctx, *cotangents)

    def map_forward(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_forward(forward_op, info.batch_size, in_dims, args)

    def map_backward(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        return vmap_pool_backward(backward_op, info.batch_size, in_dims, args)

    forward, backward = f"surfconv::{name}", f"surfconv::{name}_backward"
    torch.library.register_fake(backward, _fake_backward, lib=library)
    torch.library.register_autograd(forward, of_forward, setup_context=save, lib=library)
    torch.library.register_autograd(backward, of_backward, setup_context=save_backward, lib=library)
    torch.library.register_vmap(forward, map_forward, lib=library)
    torch.library.register_vmap(backward, map_backward, lib=library)
