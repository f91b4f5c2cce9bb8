"""The pools' kernels for CUDA tensors: Triton's, imported when the first such tensor comes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .cuda_ops import backend_for
from .pool_fallback import KERNELS


def _kernel(name: str) -> Callable[..., Any]:
    """Operator ``surf_{name}``'s; without Triton it runs the reference, and says so once."""

    def call(first: Tensor, *rest: Any) -> Any:
        if backend_for(first) is None:
            return KERNELS[f"surf_{name}"](first, *rest)
        from .triton import pool_kernels

        return getattr(pool_kernels, name)(first, *rest)

    return call


def register(library: torch.library.Library) -> None:
    """Register them."""
    for name in ("max_pool2d", "max_pool2d_backward", "avg_pool2d", "avg_pool2d_backward"):
        library.impl(f"surf_{name}", _kernel(name), "CUDA")
