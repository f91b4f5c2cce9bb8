"""The scale that a depth gives, and its derivative, in one pass (``surfconv_ops/depth_ops.py``)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .. import depth_ops
from .launch import on_device
from .layer import refuse

_BLOCK = 1024


@triton.jit
def valid(depth):
    """Whether a depth is one: positive and finite."""
    return (depth > 0) & (depth < float("inf"))


@triton.jit
def depth_to_scale_kernel(
    scale_ptr, depth_ptr, count, reference_depth, invalid, low, high, BLOCK: tl.constexpr
):
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    depth = tl.load(depth_ptr + at, mask=at < count, other=0.0)
    # Rounded as a CPU divides: Triton's own quotient may be off by a bit.
    scale = tl.div_rn(tl.full((BLOCK,), 1.0, tl.float32), depth) * reference_depth
    scale = tl.where(scale < low, low, scale)
    scale = tl.where(scale > high, high, scale)
    tl.store(scale_ptr + at, tl.where(valid(depth), scale, invalid), mask=at < count)


@triton.jit
def depth_to_scale_backward_kernel(
    out_ptr, grad_ptr, depth_ptr, count, reference_depth, low, high, steepest, BLOCK: tl.constexpr
):
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    grad = tl.load(grad_ptr + at, mask=at < count, other=0.0)
    depth = tl.load(depth_ptr + at, mask=at < count, other=0.0)
    inverse = tl.div_rn(tl.full((BLOCK,), 1.0, tl.float32), depth)
    wanted = inverse * reference_depth
    square = inverse * inverse
    flows = valid(depth) & (wanted >= low) & (wanted <= high) & (square < float("inf"))
    flows = flows & (tl.div_rn(wanted, depth) <= steepest)
    slope = tl.where(flows, -(grad * reference_depth) * square, 0.0)
    tl.store(out_ptr + at, slope, mask=at < count)


def depth_to_scale(
    depth: Tensor, reference_depth: float, invalid: float, low: float, high: float, steepest: float
) -> Tensor:
    """``torch.ops.surfconv.depth_to_scale``."""
    if depth.dtype != torch.float32:
        # A kernel takes Python numbers as float32.
        numbers = (reference_depth, invalid, low, high, steepest)
        return depth_ops.forward_kernel(depth, *numbers)
    depth = depth.contiguous()
    scale = torch.empty_like(depth)
    if depth.numel():
        with on_device(depth):
            depth_to_scale_kernel[(triton.cdiv(depth.numel(), _BLOCK),)](
                scale, depth, depth.numel(), reference_depth, invalid, low, high, BLOCK=_BLOCK
            )
    return scale


def depth_to_scale_backward(
    grad: Tensor, depth: Tensor, reference_depth: float, low: float, high: float, steepest: float
) -> Tensor:
    """``torch.ops.surfconv.depth_to_scale_backward``."""
    refuse(
        (
            (grad.shape, grad.dtype, grad.device) == (depth.shape, depth.dtype, depth.device),
            "depth_to_scale_backward: grad must have the depth's shape, dtype and device",
        )
    )
    if depth.dtype != torch.float32:
        return depth_ops.backward_kernel(grad, depth, reference_depth, low, high, steepest)
    grad, depth = grad.contiguous(), depth.contiguous()
    out = torch.empty_like(depth)
    if depth.numel():
        with on_device(depth):
            depth_to_scale_backward_kernel[(triton.cdiv(depth.numel(), _BLOCK),)](
                out, grad, depth, depth.numel(), reference_depth, low, high, steepest, BLOCK=_BLOCK
            )
    return out
