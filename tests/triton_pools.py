"""Pool problems that the CUDA backend's own entries solve."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

import oracle_pools
import pools
from helpers import to_numpy
from surfconv_ops import triton as backend

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@dataclass
class Problem(pools.Problem):
    """As the pools' own, run by the backend's own entries."""

    def run(self) -> Tensor:
        call = backend.surf_max_pool2d if self.mode == "max" else backend.surf_avg_pool2d
        guide = None if self.guide is None else self.guide.to(DEVICE)
        tensors = {"scale": self.scale.to(DEVICE), "guide": guide}
        out = call(self.input.to(DEVICE), guide_tolerance=self.guide_tolerance, **tensors,
                   **self.options)  # fmt: skip
        return out.to(self.input.device)

    def check(self, scale: bool = True) -> tuple[Tensor, dict[str, Tensor]]:
        """Output and gradients of one run; `scale` as in check_gradients."""
        leaves = {n: getattr(self, n).detach().requires_grad_() for n in pools.GRADIENTS}
        out = replace(self, **leaves).run()
        assert out.dtype == self.input.dtype
        pools.assert_close(out, self.expected(), "output")
        grad = torch.randn(out.shape).to(out.dtype)
        found = torch.autograd.grad(out, list(leaves.values()), grad, materialize_grads=True)
        grads = dict(zip(leaves, found, strict=True))
        expected = oracle_pools.backward(grad=to_numpy(grad), **self._oracle_arguments())
        for name in pools.GRADIENTS if scale else ("input",):
            assert grads[name].dtype == getattr(self, name).dtype, name
            pools.assert_close(grads[name], getattr(expected, name), f"grad_{name}")
        return out.detach(), grads


def make(mode: str, batch: int = 1, channels: int = 2, size: Any = (5, 6), **options: Any) -> Any:
    return Problem(**vars(pools.make(mode, batch, channels, size, **options)))


@contextmanager
def deterministic() -> Iterator[None]:
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)
