"""vmap rules of the operators.

A mapped dimension becomes part of N where the filters are shared. Where they are not, or where
each sample needs a filter gradient of its own, the samples are computed one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

# A pair among the arguments has a pair of None here.
Dims = Sequence[Any]


def vmap_forward(
    call: Callable[..., Tensor], size: int, in_dims: Dims, args: Sequence[Any]
) -> tuple[Tensor, int]:
    """The forward over a mapped dimension; ``call`` takes the operator's arguments."""
    input, weight, bias, scale, guide, *options = args
    _, weight_dim, bias_dim, *_ = in_dims
    if weight_dim is None and bias_dim is None:
        folded = [_fold(args[i], in_dims[i], size) for i in (0, 3, 4)]
        output = call(folded[0], weight, bias, folded[1], folded[2], *options)
        return _unfold(output, size), 0
    outputs = [call(*_pick(args, in_dims, i)) for i in range(size)]
    return torch.stack(outputs), 0


def vmap_backward(
    call: Callable[..., tuple[Tensor, ...]], size: int, in_dims: Dims, args: Sequence[Any]
) -> tuple[tuple[Tensor, ...], tuple[int | None, ...]]:
    """The backward over a mapped dimension; gradients that are not needed stay unmapped."""
    grad_output, input, weight, scale, guide, *rest = args
    needs = rest[5:]
    _, need_weight, need_bias, _ = needs
    out_dims = tuple(0 if need else None for need in needs)
    if in_dims[2] is None and not need_weight and not need_bias:
        folded = [_fold(args[i], in_dims[i], size) for i in (0, 1, 3, 4)]
        grads = call(folded[0], folded[1], weight, folded[2], folded[3], *rest)
        unfolded = [_unfold(g, size) if need else g for g, need in zip(grads, needs, strict=True)]
        return tuple(unfolded), out_dims
    samples = [call(*_pick(args, in_dims, i)) for i in range(size)]
    stacked = [
        torch.stack(grads) if need else grads[0]
        for grads, need in zip(zip(*samples, strict=True), needs, strict=True)
    ]
    return tuple(stacked), out_dims


def vmap_pool_forward(
    call: Callable[..., Any], size: int, in_dims: Dims, args: Sequence[Any]
) -> tuple[Any, Any]:
    """A pool's forward over a mapped dimension, which becomes part of N."""
    folded = [_fold(args[i], in_dims[i], size) for i in range(3)]
    result = call(*folded, *args[3:])
    if isinstance(result, Tensor):
        return _unfold(result, size), 0
    return tuple(_unfold(part, size) for part in result), (0,) * len(result)


def vmap_pool_backward(
    call: Callable[..., Any], size: int, in_dims: Dims, args: Sequence[Any]
) -> tuple[Any, Any]:
    """A pool's backward over a mapped dimension; a maximum's has one tensor more, its winners."""
    tensors = 5 if isinstance(args[4], Tensor) else 4
    folded = [_fold(args[i], in_dims[i], size) for i in range(tensors)]
    grads = call(*folded, *args[tensors:])
    needs = args[-2:]
    unfolded = [_unfold(g, size) if need else g for g, need in zip(grads, needs, strict=True)]
    return tuple(unfolded), tuple(0 if need else None for need in needs)


def _fold(tensor: Tensor | None, dim: int | None, size: int) -> Tensor | None:
    """(N, ...) with a mapped dimension somewhere or nowhere, as (size * N, ...)."""
    if tensor is None:
        return None
    spread = tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
    return spread.flatten(0, 1)


def _unfold(tensor: Tensor, size: int) -> Tensor:
    return tensor.reshape(size, tensor.shape[0] // size, *tensor.shape[1:])


def _pick(args: Sequence[Any], in_dims: Dims, index: int) -> list[Any]:
    return [
        arg.select(dim, index) if isinstance(dim, int) else arg
        for arg, dim in zip(args, in_dims, strict=True)
    ]
