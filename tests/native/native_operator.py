"""The kernels of one instruction set as an operator that any test problem can be put to."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from helpers import geometry

# Weakest first, as csrc/cpu/dispatch.cpp lists them.
INSTRUCTION_SETS = ("default", "avx2", "avx512")
GUARD = 64


def to_array(tensor: Tensor | None) -> np.ndarray | None:
    """The same memory; bfloat16 as its bits."""
    if tensor is None:
        return None
    tensor = tensor.detach()
    return (tensor.view(torch.int16) if tensor.dtype == torch.bfloat16 else tensor).numpy()


class Poisoned:
    """Memory for a result, NaN until it is written, between two guards that must stay NaN."""

    def __init__(self, like: Tensor, shape: tuple[int, ...] | None = None) -> None:
        shape = tuple(like.shape) if shape is None else shape
        count = int(np.prod(shape))
        self._memory = torch.full((count + 2 * GUARD,), torch.nan, dtype=like.dtype)
        inside = self._memory[GUARD : GUARD + count]
        last = len(shape) == 4 and like.is_contiguous(memory_format=torch.channels_last)
        if last and not like.is_contiguous():
            n, c, h, w = shape
            self.tensor = inside.view(n, h, w, c).permute(0, 3, 1, 2)
        else:
            self.tensor = inside.view(shape)

    def result(self) -> Tensor:
        guards = torch.cat([self._memory[:GUARD], self._memory[-GUARD:]])
        assert guards.isnan().all(), "a kernel wrote outside its result"
        return self.tensor


@dataclass
class NativeOperator:
    """Called as surf_conv2d is; `in_turn` runs the workers one by one, last first. `cache`: bytes
    that a worker is told it has, which decides how much is computed at once."""

    kernels: ModuleType
    name: str
    threads: int = 1
    in_turn: bool = False
    cache: int = 1 << 21

    @property
    def executor(self) -> tuple[int, bool, int]:
        return self.threads, self.in_turn, self.cache

    def __call__(
        self,
        input: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        *,
        scale: Tensor,
        guide: Tensor | None,
        guide_tolerance: float,
        stride: Any,
        padding: Any,
        dilation: Any,
        groups: int,
    ) -> Tensor:
        shape = geometry(tuple(weight.shape[2:]), stride, padding, dilation, groups)
        arguments = self.kernels.Arguments(
            shape.stride, shape.padding[:2], shape.dilation, groups, guide_tolerance
        )
        result: Tensor = _Native.apply(self, arguments, input, weight, bias, scale, guide)
        return result


class _Native(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        operator: NativeOperator,
        arguments: Any,
        input: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        scale: Tensor,
        guide: Tensor | None,
    ) -> Tensor:
        ctx.operator, ctx.arguments, ctx.bias = operator, arguments, bias
        ctx.save_for_backward(input, weight, scale, guide)
        output = Poisoned(input, (input.shape[0], weight.shape[0], *scale.shape[2:]))
        arrays = map(to_array, (input, weight, bias, scale, guide, output.tensor))
        operator.kernels.forward(operator.name, *arrays, arguments, *operator.executor)
        return output.result()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        operator = ctx.operator
        input, weight, scale, guide = ctx.saved_tensors
        needed = ctx.needs_input_grad[2:6]
        results = [
            Poisoned(tensor) if need else None
            for need, tensor in zip(needed, (input, weight, ctx.bias, scale), strict=True)
        ]
        tensors = (grads[0], input, weight, scale, guide)
        written = (None if result is None else result.tensor for result in results)
        operator.kernels.backward(
            operator.name,
            *map(to_array, (*tensors, *written)),
            ctx.arguments,
            *operator.executor,
        )
        return (None, None, *(r if r is None else r.result() for r in results), None)
