"""Autocast on the CPU: input, weight and bias follow it, scale and guide never do."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from helpers import Problem, assert_same_bits, make_problem
from surfconv_ops import SurfConv2d, surf_conv2d

HALVES = [torch.bfloat16, torch.float16]


def half(problem: Problem, dtype: torch.dtype) -> Tensor:
    bias = None if problem.bias is None else problem.bias.to(dtype)
    return surf_conv2d(problem.input.to(dtype), problem.weight.to(dtype), bias, **problem.options)


@pytest.mark.parametrize("dtype", HALVES, ids=str)
def test_public_function(dtype: torch.dtype) -> None:
    problem = make_problem(2, 5, 6, guide="depth", guide_tolerance=0.7)
    with torch.autocast("cpu", dtype):
        out = problem.run(surf_conv2d)
    assert out.dtype == dtype
    assert_same_bits(out, half(problem, dtype))


@pytest.mark.parametrize("dtype", HALVES, ids=str)
def test_operator(dtype: torch.dtype) -> None:
    p = make_problem()
    arguments = (p.scale, None, 0.0, [1, 1], [1, 1], [1, 1], 1)
    with torch.autocast("cpu", dtype):
        out = torch.ops.surfconv.surf_conv2d(p.input, p.weight, p.bias, *arguments)
    assert_same_bits(out, half(p, dtype))


def test_scale_keeps_its_precision() -> None:
    """A scale that bfloat16 cannot hold would move the taps by pixels."""
    x = torch.arange(4000.0).view(1, 1, 1, 4000)
    weight = torch.tensor([0.0, 0.0, 1.0]).view(1, 1, 1, 3)
    scale = torch.full((1, 1, 4000), 257.0)
    image = torch.zeros(1, 1, 1, 4000)
    image[..., 1257] = 1.0
    with torch.autocast("cpu", torch.bfloat16):
        out = surf_conv2d(image, weight, scale=scale, padding=(0, 1))
    assert out.flatten().nonzero().flatten().tolist() == [1000]
    assert x.shape == image.shape


def test_double_is_left_alone() -> None:
    problem = make_problem(dtype=torch.float64)
    with torch.autocast("cpu", torch.bfloat16):
        out = problem.run(surf_conv2d)
    assert out.dtype == torch.float64
    assert_same_bits(out, problem.run(surf_conv2d))


@pytest.mark.parametrize("enabled", [True, False])
def test_disabled_region(enabled: bool) -> None:
    problem = make_problem()
    with torch.autocast("cpu", torch.bfloat16), torch.autocast("cpu", enabled=enabled):
        assert problem.run(surf_conv2d).dtype == (torch.bfloat16 if enabled else torch.float32)


def test_gradients_come_back_in_float32() -> None:
    problem = make_problem(2, 5, 6)
    grad = torch.randn(problem.output_shape()).bfloat16()

    def cast(*arguments: Tensor | None, **options: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return surf_conv2d(*arguments, **options)  # type: ignore[arg-type]

    exact = problem.gradients(surf_conv2d, grad.float())
    for name, value in problem.gradients(cast, grad).items():
        assert value.dtype == torch.float32, name
        error = (value - exact[name]).square().mean().sqrt() / exact[name].square().mean().sqrt()
        assert error < 2.0**-7, name


def test_module_with_depth() -> None:
    conv = SurfConv2d(3, 4, 3, padding=1, reference_depth=2.0)
    x, depth = torch.randn(1, 3, 8, 8), torch.rand(1, 8, 8) + 0.5
    depth.requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        out = conv(x.bfloat16(), depth)
    assert out.dtype == torch.bfloat16
    exact = conv(x, depth)
    torch.testing.assert_close(out.float(), exact, rtol=0.02, atol=0.02)
    out.float().sum().backward()
    assert depth.grad is not None and depth.grad.dtype == torch.float32
    assert conv.weight.grad is not None and conv.weight.grad.dtype == torch.float32


def test_mixed_types_are_made_one() -> None:
    problem = make_problem()
    with torch.autocast("cpu", torch.bfloat16):
        out = surf_conv2d(problem.input.bfloat16(), problem.weight, problem.bias, **problem.options)
    assert_same_bits(out, half(problem, torch.bfloat16))


def test_compiled() -> None:
    torch._dynamo.reset()
    conv = SurfConv2d(3, 4, 3, padding=1, reference_depth=2.0)
    x, depth = torch.randn(1, 3, 8, 8), torch.rand(1, 8, 8) + 0.5
    compiled = torch.compile(conv, fullgraph=True, backend="aot_eager")
    with torch.autocast("cpu", torch.bfloat16):
        assert_same_bits(compiled(x, depth), conv(x, depth))
