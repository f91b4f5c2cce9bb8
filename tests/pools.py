"""Pool problems to solve, and the oracle's answer to them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import oracle_pools
from helpers import RMS_TOLERANCE, compute_dtype, lay_out, make_guide, make_scale, pair, to_numpy
from surfconv_ops import surf_avg_pool2d, surf_max_pool2d

# Results are of the order of 1; averages divided by few weights lose a digit or two.
TOLERANCE = {torch.float32: 2e-5, torch.float64: 2e-12}
GRADIENTS = ("input", "scale")

GEOMETRIES: list[dict[str, Any]] = [
    {},
    {"stride": 1},
    {"kernel": 2, "stride": None, "padding": 0},
    {"kernel": (2, 3), "stride": (2, 1), "padding": (1, 0)},
    {"kernel": (4, 1), "stride": 3, "padding": (2, 0), "ceil_mode": True},
    {"kernel": 3, "stride": 2, "padding": 1, "ceil_mode": True},
    {"size": (1, 1), "kernel": 3, "stride": 1},
    {"size": (2, 13), "kernel": (2, 5), "stride": 1},
]
MAXIMA: list[dict[str, Any]] = [
    {"dilation": 2},
    {"dilation": (3, 2), "stride": 1, "padding": (0, 1), "kernel": (2, 3)},
]
AVERAGES: list[dict[str, Any]] = [
    {"count_include_pad": False},
    {"count_include_pad": False, "kernel": 2, "stride": 1, "ceil_mode": True},
    {"divisor_override": 5},
    {"divisor_override": -2, "count_include_pad": False},
]
CASES = [
    {"mode": mode} | case
    for mode, own in (("max", MAXIMA), ("avg", AVERAGES))
    for case in GEOMETRIES + own
]


@dataclass
class Problem:
    """A pool's arguments, and how the oracle answers them."""

    mode: str
    input: Tensor
    scale: Tensor
    guide: Tensor | None
    guide_tolerance: float
    options: dict[str, Any]  # kernel_size, stride, ... as the public functions take them

    def run(self) -> Tensor:
        call = surf_max_pool2d if self.mode == "max" else surf_avg_pool2d
        return call(self.input, scale=self.scale, guide=self.guide,
                    guide_tolerance=self.guide_tolerance, **self.options)  # fmt: skip

    def run_nn(self) -> Tensor:
        """nn's own pool, where every scale is 1."""
        functional = torch.nn.functional
        call = functional.max_pool2d if self.mode == "max" else functional.avg_pool2d
        return call(self.input, **self.options)

    @property
    def pool(self) -> oracle_pools.Pool:
        kernel = pair(self.options["kernel_size"])
        stride = self.options["stride"]
        return oracle_pools.Pool(
            kernel,
            kernel if stride is None else pair(stride),
            pair(self.options["padding"]),
            pair(self.options.get("dilation", 1)),
            self.mode == "avg",
            self.options.get("count_include_pad", True),
            self.options.get("divisor_override") or 0,
        )

    def _oracle_arguments(self) -> dict[str, Any]:
        return {
            "pool": self.pool,
            "x": to_numpy(self.input),
            "scale": to_numpy(self.scale),
            "guide": None if self.guide is None else to_numpy(self.guide),
            "tolerance": self.guide_tolerance,
            "single": self.input.dtype != torch.float64,
        }

    def expected(self) -> np.ndarray:
        return oracle_pools.forward(**self._oracle_arguments())

    def gradients(self, grad: Tensor) -> dict[str, Tensor]:
        leaves = {name: getattr(self, name).detach().requires_grad_() for name in GRADIENTS}
        out = replace(self, **leaves).run()
        values = torch.autograd.grad(out, list(leaves.values()), grad, materialize_grads=True)
        return dict(zip(leaves, values, strict=True))

    def check_forward(self) -> None:
        out = self.run()
        assert out.dtype == self.input.dtype
        assert_close(out, self.expected(), "output")

    def check_gradients(self, scale: bool = True) -> None:
        """`scale` False where samples lie on pixels, where its gradient has two sides."""
        grad = torch.randn(self.run().shape).to(self.input.dtype)
        actual = self.gradients(grad)
        expected = oracle_pools.backward(grad=to_numpy(grad), **self._oracle_arguments())
        for name in GRADIENTS if scale else ("input",):
            target = getattr(self, name)
            assert actual[name].dtype == target.dtype, name
            assert_close(actual[name], getattr(expected, name), f"grad_{name}")


def assert_close(actual: Tensor, expected: np.ndarray, what: str) -> None:
    assert tuple(actual.shape) == expected.shape, f"{what}: {tuple(actual.shape)}"
    error = np.abs(to_numpy(actual) - expected)
    assert not np.isnan(error).any(), f"{what}: NaN"
    if actual.dtype in RMS_TOLERANCE:
        size = float(np.sqrt(np.mean(expected**2))) if error.size else 0.0
        rms = float(np.sqrt(np.mean(error**2))) if error.size else 0.0
        assert rms <= RMS_TOLERANCE[actual.dtype] * size, f"{what}: RMS {rms:.3g} of {size:.3g}"
        return
    worst = error - TOLERANCE[actual.dtype] * (1.0 + np.abs(expected))
    assert (worst <= 0).all(), f"{what}: error {error.max():.3g}"


def make(
    mode: str,
    batch: int = 2,
    channels: int = 3,
    size: tuple[int, int] = (7, 8),
    *,
    kernel: Any = 3,
    stride: Any = 2,
    padding: Any = 1,
    ceil_mode: bool = False,
    dtype: torch.dtype = torch.float32,
    scale: str = "random",
    scale_dtype: torch.dtype | None = None,
    axes: int = 1,
    guide: str = "none",
    guide_tolerance: float = 0.0,
    layout: str = "contiguous",
    seed: int = 0,
    **others: Any,
) -> Problem:
    """A problem of random numbers; `axes` = 2 gives a (y, x) scale."""
    rng = np.random.default_rng(seed)
    options = {"kernel_size": kernel, "stride": stride, "padding": padding, "ceil_mode": ceil_mode}
    options |= others
    window = {
        k: v for k, v in options.items() if k not in ("count_include_pad", "divisor_override")
    }
    out_size = torch.nn.functional.max_pool2d(torch.zeros(1, 1, *size), **window).shape[2:]
    kind = compute_dtype(dtype) if scale_dtype is None else scale_dtype
    x = torch.from_numpy(rng.standard_normal((batch, channels, *size))).to(dtype)
    scales = torch.from_numpy(make_scale(scale, (batch, axes, *out_size), rng)).to(kind)
    guides = None
    if guide != "none":
        guides = torch.from_numpy(make_guide(guide, (batch, *size), rng)).to(kind)
    return Problem(mode, lay_out(x, layout), scales, guides, guide_tolerance, options)
