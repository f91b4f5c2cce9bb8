"""Whether Triton's interpreter runs the kernels, and what it cannot do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import triton
from torch import Tensor

#: Decided when the kernels are imported, as Triton itself decides it.
INTERPRETED = bool(triton.knobs.runtime.interpret)


def check_device(tensor: Tensor) -> None:
    """Raise ValueError where the kernels cannot run."""
    if tensor.is_cuda or (tensor.device.type == "cpu" and INTERPRETED):
        return
    raise ValueError(
        f"input: expected a CUDA tensor, got one on {tensor.device}; on the CPU the kernels run"
        " only in Triton's interpreter: set TRITON_INTERPRET=1 before surfconv_ops.triton is"
        " imported"
    )


def needs_float32(tensor: Tensor) -> bool:
    """Whether a call has to be computed on a float32 copy of its tensors.

    The interpreter multiplies bfloat16 matrices as integers and cuts off where it should round.
    """
    return INTERPRETED and tensor.dtype == torch.bfloat16


def in_float32(kernel: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """``kernel`` on the arguments with every bfloat16 tensor widened."""
    return kernel(
        *(
            a.float() if isinstance(a, Tensor) and a.dtype == torch.bfloat16 else a
            for a in arguments
        )
    )
