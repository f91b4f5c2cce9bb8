"""The pools' reference as kernels: where there is no compiled one, or no library at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from . import pool_reference
from ._fallback import warn_once
from ._loader import missing_library_reason
from .layout import lay_out, memory_format_of

_TENSORS = "Tensor input, Tensor scale, Tensor? guide, "
_MAX_OPTIONS = (
    "float guide_tolerance, int[] kernel_size, int[] stride, int[] padding, int[] dilation"
)
_AVG_OPTIONS = (
    "float guide_tolerance, int[] kernel_size, int[] stride, int[] padding,"
    " bool count_include_pad, int divisor_override"
)
_NEEDS = ", bool need_input, bool need_scale) -> (Tensor, Tensor)"
SCHEMAS = {
    "surf_max_pool2d": f"surf_max_pool2d({_TENSORS}{_MAX_OPTIONS}) -> (Tensor, Tensor)",
    "surf_max_pool2d_backward": (
        f"surf_max_pool2d_backward(Tensor grad_output, {_TENSORS}Tensor winner,"
        f" {_MAX_OPTIONS}{_NEEDS}"
    ),
    "surf_avg_pool2d": f"surf_avg_pool2d({_TENSORS}{_AVG_OPTIONS}) -> Tensor",
    "surf_avg_pool2d_backward": (
        f"surf_avg_pool2d_backward(Tensor grad_output, {_TENSORS}{_AVG_OPTIONS}{_NEEDS}"
    ),
}


def _max_forward(input: Tensor, *rest: Any) -> tuple[Tensor, Tensor]:
    warn_once(input.device)
    output, winner = pool_reference.max_forward(input, *rest)
    return lay_out(output, memory_format_of(input)), winner


def _avg_forward(input: Tensor, *rest: Any) -> Tensor:
    warn_once(input.device)
    return lay_out(pool_reference.avg_forward(input, *rest), memory_format_of(input))


def _laid_out(
    grads: tuple[Tensor, Tensor], input: Tensor, scale: Tensor, needs: Sequence[bool]
) -> tuple[Tensor, Tensor]:
    # An operator's results may not share memory: each that is not needed is a tensor of its own.
    grad_input, grad_scale = (
        lay_out(grad, memory_format_of(model)) if need else model.new_empty(0)
        for grad, model, need in zip(grads, (input, scale), needs, strict=True)
    )
    return grad_input, grad_scale


def _max_backward(
    grad_output: Tensor, input: Tensor, scale: Tensor, *rest: Any
) -> tuple[Tensor, Tensor]:
    warn_once(input.device)
    grads = pool_reference.max_backward(grad_output, input, scale, *rest)
    return _laid_out(grads, input, scale, rest[-2:])


def _avg_backward(
    grad_output: Tensor, input: Tensor, scale: Tensor, *rest: Any
) -> tuple[Tensor, Tensor]:
    warn_once(input.device)
    grads = pool_reference.avg_backward(grad_output, input, scale, *rest)
    return _laid_out(grads, input, scale, rest[-2:])


#: By the operators' names.
KERNELS: dict[str, Callable[..., Any]] = {
    "surf_max_pool2d": _max_forward,
    "surf_max_pool2d_backward": _max_backward,
    "surf_avg_pool2d": _avg_forward,
    "surf_avg_pool2d_backward": _avg_backward,
}


def register(library: torch.library.Library) -> None:
    """Register the reference as the kernel of every device that has none of its own."""
    for name, kernel in KERNELS.items():
        if missing_library_reason is not None:
            library.define(SCHEMAS[name])
        library.impl(name, kernel, "CompositeExplicitAutograd")
