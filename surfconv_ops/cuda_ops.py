"""The operators' kernels for CUDA tensors: Triton's, imported when the first such tensor comes."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from . import _fallback


@lru_cache(maxsize=1)
def backend() -> tuple[ModuleType | None, str]:
    """The module of kernels, or None and why it cannot be had."""
    try:
        from .triton import kernels
    except ImportError as error:
        return None, str(error)
    return kernels, ""


def _forward(input: Tensor, *rest: Any) -> Tensor:
    kernels, reason = backend()
    if kernels is None:
        _fallback.warn_once(input.device, reason)
        return _fallback.forward(input, *rest)
    output: Tensor = kernels.forward(input, *rest)
    return output


def _backward(grad_output: Tensor, *rest: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    kernels, reason = backend()
    if kernels is None:
        _fallback.warn_once(grad_output.device, reason)
        return _fallback.backward(grad_output, *rest)
    grads: tuple[Tensor, Tensor, Tensor, Tensor] = kernels.backward(grad_output, *rest)
    return grads


def register(library: torch.library.Library) -> None:
    """Register them; without Triton they run the reference, and say so once."""
    library.impl("surf_conv2d", _forward, "CUDA")
    library.impl("surf_conv2d_backward", _backward, "CUDA")
