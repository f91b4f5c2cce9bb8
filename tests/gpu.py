"""What the tests on a GPU share: problems moved there, a net, how its results are compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from helpers import GRADIENTS, Problem
from surfconv_ops import (
    DepthGuided,
    DepthLevels,
    SurfAvgPool2d,
    SurfConv2d,
    SurfMaxPool2d,
    convert_conv2d,
)

MARKS = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    # The fallback's: on a GPU with Triton nothing may come to it.
    pytest.mark.filterwarnings("error:surfconv_ops"),
]
SIZES: dict[str, Any] = {"channels": 64, "out_channels": 48, "size": (30, 40), "scale": "smooth"}


def to_gpu(problem: Problem, device: str = "cuda") -> Problem:
    tensors = {name: getattr(problem, name) for name in (*GRADIENTS, "guide")}
    return replace(problem, **{n: None if t is None else t.to(device) for n, t in tensors.items()})


@contextmanager
def settings(tf32: bool = False, deterministic: bool = False) -> Iterator[None]:
    before = torch.get_float32_matmul_precision(), torch.are_deterministic_algorithms_enabled()
    torch.set_float32_matmul_precision("high" if tf32 else "highest")
    torch.use_deterministic_algorithms(deterministic)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.use_deterministic_algorithms(before[1])


class Net(nn.Module):
    """Two layers in both modes and a stride, as a net that somebody has."""

    def __init__(self) -> None:
        super().__init__()
        levels = DepthLevels([2.0, 4.0], [1.0, 3.0, 5.0])
        self.first = SurfConv2d(3, 16, 3, padding=1, reference_depth=3.0)
        self.second = SurfConv2d(16, 16, 3, padding=1, groups=4, reference_depth=3.0, levels=levels,
                                 same_level_only=True)  # fmt: skip

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        out: Tensor = self.second(self.first(x, depth).relu(), depth)
        return out


class PooledNet(nn.Module):
    """A layer and both pools, the second at half the resolution."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = SurfConv2d(3, 16, 3, padding=1, reference_depth=3.0)
        self.top = SurfMaxPool2d(3, 2, 1, reference_depth=3.0, depth_window=2.0)
        self.mean = SurfAvgPool2d(3, 2, 1, count_include_pad=False, reference_depth=3.0)

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        out = self.top(self.conv(x, depth), depth)
        mean: Tensor = self.mean(out, depth[:, ::2, ::2])
        return mean


class GuidedNet(nn.Module):
    """A plain net, converted."""

    def __init__(self) -> None:
        super().__init__()
        plain = nn.Sequential(nn.Conv2d(3, 16, 3, 2, 1), nn.ReLU(), nn.Conv2d(16, 8, 3, padding=1))
        self.net = DepthGuided(convert_conv2d(plain, reference_depth=3.0))

    def forward(self, x: Tensor, depth: Tensor) -> Tensor:
        out: Tensor = self.net(x, depth=depth)
        return out


NETS = {"layers": Net, "pools": PooledNet, "guided": GuidedNet}


def frame(batch: int = 2) -> tuple[Tensor, Tensor]:
    depth = torch.rand(batch, 24, 32) * 6 + 0.3
    depth[:, ::5, ::3] = float("nan")
    return torch.randn(batch, 3, 24, 32).cuda(), depth.cuda()


def step(net: Callable[..., Tensor], owner: nn.Module, *inputs: Tensor) -> list[Tensor]:
    out = net(*inputs)
    return [out.detach(), *torch.autograd.grad(out.float().square().sum(),
                                               list(owner.parameters()))]  # fmt: skip


def assert_close(ours: list[Tensor], expected: list[Tensor], tolerance: float = 1e-4) -> None:
    for mine, wanted in zip(ours, expected, strict=True):
        assert (mine - wanted).norm() <= tolerance * wanted.norm()
