"""The value of every depth's level, in one pass (``surfconv_ops/_fallback.py``)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .depth_to_scale import valid
from .launch import on_device
from .layer import refuse

_BLOCK = 1024


@triton.jit
def level_values_kernel(
    out_ptr, depth_ptr, edges_ptr, values_ptr, count, levels, BLOCK: tl.constexpr
):
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    depth = tl.load(depth_ptr + at, mask=at < count, other=0.0)
    level = tl.zeros((BLOCK,), tl.int32)
    for k in range(levels - 1):
        level += (depth > tl.load(edges_ptr + k)).to(tl.int32)
    # The last value is that of a depth that is none.
    level = tl.where(valid(depth), level, levels)
    tl.store(out_ptr + at, tl.load(values_ptr + level), mask=at < count)


def level_values(depth: Tensor, edges: Tensor, values: Tensor) -> Tensor:
    """``torch.ops.surfconv.level_values``."""
    refuse(
        (
            all(t.dtype == depth.dtype and t.device == depth.device for t in (edges, values)),
            "level_values: edges and values must have the depth's dtype and device",
        ),
        (
            edges.ndim == 1 and values.shape == (edges.numel() + 2,),
            "level_values: N levels have N - 1 edges and N + 1 values",
        ),
    )
    depth = depth.contiguous()
    out = torch.empty_like(depth)
    if depth.numel():
        with on_device(depth):
            level_values_kernel[(triton.cdiv(depth.numel(), _BLOCK),)](
                out,
                depth,
                edges.contiguous(),
                values.contiguous(),
                depth.numel(),
                values.numel() - 1,
                BLOCK=_BLOCK,
            )
    return out
