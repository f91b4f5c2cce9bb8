"""A guide that hides little: pixels that are known to see all of their corners look at none.

Depth is smooth but for an edge, a step and holes, so that both kinds of pixels are many, and scales
are such that taps end exactly where what is known does. All depths, scales and tolerances are short
binary fractions: every comparison comes out the same in float32 and float64.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from surfconv_ops import reference, surf_conv2d

INF, NAN = float("inf"), float("nan")
SIZE = (41, 53)
CASES: dict[str, dict[str, Any]] = {
    "3 x 3": {},
    "channels_last": {"channels": 8, "layout": torch.channels_last},
    "2 x 2": {"kernel": 2, "padding": 1},
    "4 x 3": {"kernel": (4, 3)},
    "5 x 5": {"kernel": 5, "padding": 2},
    "1 x 7": {"kernel": (1, 7), "padding": (0, 3)},
    "far apart": {"dilation": 4, "padding": 4},
    "further than is known": {"dilation": 9, "padding": 9},
    "stride": {"stride": 2},
    "no padding": {"padding": 0},
    "pair": {"components": 2},
    "depthwise": {"channels": 4, "outputs": 4, "groups": 4},
    "batch": {"batch": 3},
    "wide": {"size": (9, 530)},
    "one pixel": {"size": (1, 1)},
}


def depth_with_edges(batch: int, size: tuple[int, int]) -> Tensor:
    y, x = torch.meshgrid(
        *(torch.arange(float(n), dtype=torch.float64) for n in size), indexing="ij"
    )
    depth = (5 + y / 32 + x / 128).repeat(batch, 1, 1)
    depth += 2 * ((x + 20) // 50 % 2)
    depth[:, 20:24, 8:15] = 2.0
    depth[:, 33:34, 20:22] = NAN
    depth[:, 5:6, 40:41] = INF
    depth[:, 38:39, 3:4] = -INF
    return depth


class Problem:
    def __init__(
        self,
        channels: int = 3,
        outputs: int = 4,
        groups: int = 1,
        batch: int = 1,
        components: int = 1,
        layout: torch.memory_format = torch.contiguous_format,
        kernel: Any = 3,
        size: tuple[int, int] = SIZE,
        **options: Any,
    ) -> None:
        generator = torch.Generator().manual_seed(7)

        def noise(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        sides = (kernel, kernel) if isinstance(kernel, int) else kernel
        self.options: dict[str, Any] = {"padding": 1, "groups": groups, **options}
        self.guide = depth_with_edges(batch, size)
        self.x = noise(batch, channels, *size).contiguous(memory_format=layout)
        self.weight = noise(outputs, channels // groups, *sides)
        out = torch.nn.functional.conv2d(self.x, self.weight, **self.options).shape[2:]
        # Half of them on multiples of 1/4, where taps meet pixels and the ends of squares.
        scale = (0.3 + 4 * torch.rand(batch, components, *out, generator=generator)).double()
        step = torch.where(torch.rand(scale.shape, generator=generator) < 0.5, 1 / 256, 1 / 4)
        scale = (scale / step).round() * step
        self.scale = scale * (1 - 2 * (torch.rand(scale.shape, generator=generator) < 0.1).double())
        self.grad = noise(batch, outputs, *out)

    def solve(
        self, operator: Any, tolerance: float, dtype: torch.dtype = torch.float64
    ) -> dict[str, Tensor]:
        leaves = [
            t.detach().to(dtype, copy=True).requires_grad_()
            for t in (self.x, self.weight, self.scale)
        ]
        x, weight, scale = leaves
        out = operator(x, weight, scale=scale, guide=self.guide.to(dtype),
                       guide_tolerance=tolerance, **self.options)  # fmt: skip
        names = ("grad_input", "grad_weight", "grad_scale")
        gradients = torch.autograd.grad(out, leaves, self.grad.to(dtype))
        return {"output": out.detach(), **dict(zip(names, gradients, strict=True))}


@pytest.mark.core
@pytest.mark.parametrize("tolerance", [0.0, 7 / 64, 1.0, INF])
@pytest.mark.parametrize("case", CASES)
def test_against_the_reference(case: str, tolerance: float) -> None:
    problem = Problem(**CASES[case])
    expected = problem.solve(reference.surf_conv2d, tolerance)
    for dtype, error in ((torch.float64, 1e-12), (torch.float32, 4e-6)):
        actual = problem.solve(surf_conv2d, tolerance, dtype)
        for name, value in actual.items():
            size = expected[name].abs().max().item()
            torch.testing.assert_close(
                value.double(), expected[name], rtol=0, atol=error * size, msg=f"{name} {dtype}"
            )


@pytest.mark.parametrize("tolerance", [7 / 64, 1.0])
def test_nothing_hidden_leaks(tolerance: float) -> None:
    """What lies behind the step does not reach pixels in front of it, whatever it is."""
    problem = Problem()
    problem.scale.clamp_(-2.0, 2.0)
    before = problem.solve(surf_conv2d, tolerance)["output"]
    problem.x[..., 30:] = NAN
    after = problem.solve(surf_conv2d, tolerance)["output"]
    valid = problem.guide[0].isfinite()
    valid[:, 30:] = False
    assert torch.equal(after[0, :, valid], before[0, :, valid])
