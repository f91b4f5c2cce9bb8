"""The reference as a kernel: for devices without a compiled one, or for all without a library."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from . import reference
from ._loader import missing_library_reason
from .checks import valid_depth
from .geometry import Pair
from .layout import lay_out, memory_format_of

FORWARD_SCHEMA = (
    "surf_conv2d(Tensor input, Tensor weight, Tensor? bias, Tensor scale, Tensor? guide,"
    " float guide_tolerance, int[] stride, int[] padding, int[] dilation, int groups) -> Tensor"
)
BACKWARD_SCHEMA = (
    "surf_conv2d_backward(Tensor grad_output, Tensor input, Tensor weight, Tensor scale,"
    " Tensor? guide, float guide_tolerance, int[] stride, int[] padding, int[] dilation,"
    " int groups, bool need_input, bool need_weight, bool need_bias, bool need_scale)"
    " -> (Tensor, Tensor, Tensor, Tensor)"
)
LEVEL_VALUES_SCHEMA = "level_values(Tensor depth, Tensor edges, Tensor values) -> Tensor"

_warned = False


def warn_once(device: torch.device, missing: str = "") -> None:
    """Say once that the reference runs; ``missing`` is why a CUDA tensor has no kernels."""
    global _warned
    if _warned:
        return
    _warned = True
    if missing:
        reason = f"the kernels for {device.type} tensors cannot be used ({missing})"
        remedy = "install Triton: `pip install triton`"
    elif missing_library_reason is None:
        reason = f"there is no compiled kernel for {device.type} tensors"
        remedy = "move the module and its inputs to the CPU"
    else:
        reason = missing_library_reason
        remedy = (
            "install a wheel built for this platform, or install a C++17 compiler and run"
            " `pip install --no-build-isolation .` (or `make build`) in the source folder"
        )
    warnings.warn(
        f"surfconv_ops: {reason}, so it runs its plain PyTorch reference, which is many"
        f" times slower. For the fast path, {remedy}. This is said once.",
        RuntimeWarning,
        stacklevel=3,
    )


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
    warn_once(input.device)
    output = reference.forward(
        input, weight, bias, scale, guide, guide_tolerance, stride, padding, dilation, groups
    )
    return lay_out(output, memory_format_of(input))


def backward(
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
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    warn_once(input.device)
    grads = reference.backward(
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
    grad_input, grad_weight, grad_bias, grad_scale = grads
    if need_input:
        grad_input = lay_out(grad_input, memory_format_of(input))
    if need_weight:
        grad_weight = lay_out(grad_weight, memory_format_of(weight))
    if need_scale:
        grad_scale = lay_out(grad_scale, memory_format_of(scale))
    # An operator's results may not share memory, and the unneeded ones are one tensor.
    if not (need_input and need_weight and need_bias and need_scale):
        needs = (need_input, need_weight, need_bias, need_scale)
        grads = (grad_input, grad_weight, grad_bias, grad_scale)
        grad_input, grad_weight, grad_bias, grad_scale = (
            grad if need else input.new_empty(0) for grad, need in zip(grads, needs, strict=True)
        )
    return grad_input, grad_weight, grad_bias, grad_scale


def level_values(depth: Tensor, edges: Tensor, values: Tensor) -> Tensor:
    """``values[level]`` of every depth; the last value stands where a depth is invalid."""
    level = torch.bucketize(depth.contiguous(), edges)
    return values[torch.where(valid_depth(depth), level, -1)]


def register(library: torch.library.Library) -> None:
    """Register the reference as the kernel of every device that has none of its own."""
    if missing_library_reason is not None:
        library.define(FORWARD_SCHEMA)
        library.define(BACKWARD_SCHEMA)
        library.define(LEVEL_VALUES_SCHEMA)
    library.impl("surf_conv2d", forward, "CompositeExplicitAutograd")
    library.impl("surf_conv2d_backward", backward, "CompositeExplicitAutograd")
    library.impl("level_values", level_values, "CompositeExplicitAutograd")
