"""Calls of the operators at little cost: on small layers PyTorch's own bookkeeping shows."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

# Both are PyTorch's own means and private: without them every call takes the long way.
_transforms_active: Callable[[], bool] = getattr(
    torch._C, "_are_functorch_transforms_active", lambda: True
)
_below_autograd: Callable[[], AbstractContextManager[Any]] = getattr(
    torch._C, "_AutoDispatchBelowAutograd", nullcontext
)


def watched() -> bool:
    """Whether something records or replaces operations: a compiler, a trace, torch.func, a mode."""
    return (
        torch.compiler.is_compiling()
        or _transforms_active()
        or torch._C._get_tracing_state() is not None
        or torch._C._len_torch_dispatch_stack() > 0
    )


def has_tangent(args: tuple[Any, ...]) -> bool:
    """Whether forward-mode differentiation is under way for one of ``args``."""
    if getattr(forward_ad, "_current_level", 0) < 0:
        return False
    return any(
        isinstance(arg, Tensor) and forward_ad.unpack_dual(arg).tangent is not None for arg in args
    )


def apply(function: Any, operator: Any, *args: Any) -> Any:
    """``function.apply(*args)``, or ``operator``, its kernel, where nothing is differentiated."""
    if torch.compiler.is_compiling() or _transforms_active():
        return function.apply(*args)
    if torch.is_grad_enabled():
        for arg in args:
            if isinstance(arg, Tensor) and arg.requires_grad:
                return function.apply(*args)
    if has_tangent(args):
        return function.apply(*args)
    with _below_autograd():
        return operator(*args)


def run_kernel(operator: Any, *args: Any) -> Any:
    """``operator`` from within a Function, which has taken care of derivatives already."""
    if torch.compiler.is_compiling() or _transforms_active():
        return operator(*args)
    with _below_autograd():
        return operator(*args)
