"""Backward where a few pixels reach far: spurious depths close to the camera, as sensors have them.

The images are large enough that their rows are shared out among tasks; such pixels reach beyond
the rows that their task may write, and other pixels as far as their task may reach.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from helpers import assert_same_bits
from surfconv_ops import reference, surf_conv2d

SIZE = (96, 100)
FAR = [(0, 3, 40.3), (17, 99, -33.7), (47, 50, 95.2), (48, 51, 1e30), (70, 0, float("inf"))]
CASES: dict[str, dict[str, Any]] = {
    "plain": {"channels": 3, "outputs": 4},
    "in place": {"channels": 8, "outputs": 5, "channels_last": True},
    "two units": {"channels": 70, "outputs": 2},
    "groups": {"channels": 12, "outputs": 6, "groups": 3},
    "depthwise": {"channels": 16, "outputs": 16, "groups": 16, "channels_last": True},
    "pair": {"channels": 4, "outputs": 4, "components": 2},
    "guide": {"channels": 4, "outputs": 4, "guided": True},
    "stride": {"channels": 4, "outputs": 4, "stride": 2, "size": (190, 200)},
    "everywhere": {"channels": 4, "outputs": 4, "every": 7},
}
NAMES = ("grad_input", "grad_weight", "grad_scale")


class Problem:
    def __init__(
        self,
        channels: int,
        outputs: int,
        groups: int = 1,
        components: int = 1,
        channels_last: bool = False,
        guided: bool = False,
        stride: int = 1,
        size: tuple[int, int] = SIZE,
        every: int = 0,
    ) -> None:
        generator = torch.Generator().manual_seed(5)

        def noise(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        out = tuple((n - 1) // stride + 1 for n in size)
        self.x = noise(1, channels, *size)
        if channels_last:
            self.x = self.x.contiguous(memory_format=torch.channels_last)
        self.weight = noise(outputs, channels // groups, 3, 3)
        self.scale = 1.1 + 0.4 * noise(1, components, *out).tanh()
        for y, x, value in FAR:
            self.scale[0, :, y % out[0], x % out[1]] = value
        if every:
            self.scale[0, :, ::every, ::every] = 37.3
        self.grad = noise(1, outputs, *out)
        self.options = {"stride": stride, "padding": 1, "groups": groups}
        if guided:
            self.options |= {"guide": noise(1, *size), "guide_tolerance": 1.0}

    def solve(self, function: Any, dtype: torch.dtype) -> tuple[Tensor, ...]:
        tensors = (self.x, self.weight, self.scale)
        leaves = [t.detach().to(dtype, copy=True).requires_grad_() for t in tensors]
        options = {k: v.to(dtype) if isinstance(v, Tensor) else v for k, v in self.options.items()}
        out = function(leaves[0], leaves[1], scale=leaves[2], **options)
        return torch.autograd.grad(out, leaves, self.grad.to(dtype))


@pytest.mark.core
@pytest.mark.parametrize("name", CASES)
def test_gradients(name: str) -> None:
    problem = Problem(**CASES[name])
    expected = problem.solve(reference.surf_conv2d, torch.float64)
    got = problem.solve(surf_conv2d, torch.float64)
    torch.testing.assert_close(
        dict(zip(NAMES, got, strict=True)), dict(zip(NAMES, expected, strict=True)),
        rtol=1e-9, atol=1e-9,
    )  # fmt: skip


@pytest.mark.core
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_same_bits_whatever_the_threads(name: str, dtype: torch.dtype) -> None:
    problem = Problem(**CASES[name])
    torch.set_num_threads(1)
    alone = problem.solve(surf_conv2d, dtype)
    for threads in (2, 5):
        torch.set_num_threads(threads)
        for what, ours, theirs in zip(NAMES, problem.solve(surf_conv2d, dtype), alone, strict=True):
            assert_same_bits(ours, theirs, what)


def test_far_pixels_change_nothing_else() -> None:
    """Where no output gradient comes from far pixels, they leave the input's gradient alone."""
    problem = Problem(**CASES["plain"])
    far = [(y, x) for y, x, _ in FAR]
    for y, x in far:
        problem.grad[:, :, y, x] = 0
    got = problem.solve(surf_conv2d, torch.float64)[0]
    for y, x in far:
        problem.scale[:, :, y, x] = 1.0
    expected = problem.solve(surf_conv2d, torch.float64)[0]
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.core
@pytest.mark.parametrize("kernel", [2, 3, 7])
@pytest.mark.parametrize("stride", [1, 2])
def test_tasks_at_one_time_write_different_rows(kernel: int, stride: int) -> None:
    """Two tasks that wrote the same row would add to it in another order on more threads."""
    generator = torch.Generator().manual_seed(6)
    x = torch.randn(1, 4, 96 * stride, 100 * stride, generator=generator).requires_grad_()
    weight = torch.randn(4, 4, kernel, kernel, generator=generator)
    sizes = [(n + kernel // 2 * 2 - kernel) // stride + 1 for n in x.shape[2:]]
    # Of the outermost taps, in pixels: on one, just before it and just after.
    for reach in range(stride, 9 * stride, stride):
        for nudge in (-1e-6, 0.0, 1e-6, 0.5):
            scale = torch.full((1, *sizes), (reach + nudge) * 2 / (kernel - 1))
            out = surf_conv2d(x, weight, scale=scale, stride=stride, padding=kernel // 2)
            grad = torch.randn(out.shape, generator=generator)
            torch.set_num_threads(1)
            (alone,) = torch.autograd.grad(out, x, grad, retain_graph=True)
            for threads in (2, 5):
                torch.set_num_threads(threads)
                (got,) = torch.autograd.grad(out, x, grad, retain_graph=True)
                assert_same_bits(got, alone, f"{reach + nudge} pixels, {threads} threads")
