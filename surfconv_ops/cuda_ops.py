"""The operators' kernels for CUDA tensors: Triton's, imported when the first such tensor comes."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from . import _fallback, depth_ops


@lru_cache(maxsize=1)
def backend() -> tuple[ModuleType | None, str]:
    """The module of kernels, or None and why it cannot be had."""
    try:
        from .triton import kernels
    except ImportError as error:
        return None, str(error)
    return kernels, ""


def backend_for(tensor: Tensor) -> ModuleType | None:
    """The module of kernels; without one, a warning that the reference runs instead."""
    kernels, reason = backend()
    if kernels is None:
        _fallback.warn_once(tensor.device, reason)
    return kernels


def _forward(input: Tensor, *rest: Any) -> Tensor:
    kernels = backend_for(input)
    output: Tensor = (kernels or _fallback).forward(input, *rest)
    return output


def _backward(grad_output: Tensor, *rest: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    kernels = backend_for(grad_output)
    grads: tuple[Tensor, Tensor, Tensor, Tensor]
    grads = (kernels or _fallback).backward(grad_output, *rest)
    return grads


def _level_values(depth: Tensor, edges: Tensor, values: Tensor) -> Tensor:
    # Without Triton PyTorch's own operators do it nearly as well: nothing to warn of.
    kernels = backend()[0]
    found: Tensor = (kernels or _fallback).level_values(depth, edges, values)
    return found


def _depth_to_scale(depth: Tensor, *numbers: float) -> Tensor:
    kernels = backend()[0]
    scale: Tensor = (kernels.depth_to_scale if kernels else depth_ops.forward_kernel)(
        depth, *numbers
    )
    return scale


def _depth_to_scale_backward(grad: Tensor, depth: Tensor, *numbers: float) -> Tensor:
    kernels = backend()[0]
    slope: Tensor = (kernels.depth_to_scale_backward if kernels else depth_ops.backward_kernel)(
        grad, depth, *numbers
    )
    return slope


def register(library: torch.library.Library) -> None:
    """Register them; without Triton they run the reference, and say so once."""
    library.impl("surf_conv2d", _forward, "CUDA")
    library.impl("surf_conv2d_backward", _backward, "CUDA")
    library.impl("level_values", _level_values, "CUDA")
    library.impl("depth_to_scale", _depth_to_scale, "CUDA")
    library.impl("depth_to_scale_backward", _depth_to_scale_backward, "CUDA")
