"""gradcheck and gradgradcheck in float64, away from the kinks of bilinear sampling."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from helpers import Problem, make_problem
from operators import OPERATORS, name_of
from surfconv_ops import SurfConv2d, depth_to_scale

CASES: list[dict[str, Any]] = [
    {},
    {"axes": 2, "kernel": (2, 3), "stride": (1, 2)},
    {"groups": 2, "dilation": 2, "padding": 2},
    {"guide": "levels"},
    {"guide": "depth", "guide_tolerance": 1.0, "axes": 2},
    {"layout": "channels_last"},
    {"scale": "negative"},
    {"scale": "nan"},
]


def away_from_kinks(scale: Tensor) -> Tensor:
    """Scales in steps of 0.1, off by 0.03: with whole and half taps no sample is near a pixel."""
    return (scale * 10).round() / 10 + 0.033


def small(**case: Any) -> Problem:
    problem = make_problem(1, 2, 2, (3, 4), dtype=torch.float64, **case)
    problem.scale = away_from_kinks(problem.scale)
    return problem


def function_of(problem: Problem, operator: str) -> tuple[Any, tuple[Tensor, ...]]:
    def call(x: Tensor, weight: Tensor, bias: Tensor, scale: Tensor) -> Tensor:
        options = problem.options | {"scale": scale}
        return OPERATORS[operator](x, weight, bias, **options)

    names = ("input", "weight", "bias", "scale")
    return call, tuple(getattr(problem, name).detach().requires_grad_() for name in names)


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("case", CASES, ids=name_of)
def test_gradcheck(operator: str, case: dict[str, Any]) -> None:
    call, leaves = function_of(small(**case), operator)
    assert gradcheck(call, leaves, atol=1e-6, rtol=1e-6, nondet_tol=0.0)


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("case", CASES[:5], ids=name_of)
def test_gradgradcheck(operator: str, case: dict[str, Any]) -> None:
    problem = make_problem(1, 2, 2, (3, 3), dtype=torch.float64, **(case | {"padding": 1}))
    problem.scale = away_from_kinks(problem.scale)
    call, leaves = function_of(problem, operator)
    # Random projections of the Hessian; one case is checked entry by entry below.
    assert gradgradcheck(call, leaves, atol=1e-6, rtol=1e-6, fast_mode=True)


@pytest.mark.parametrize("operator", OPERATORS)
def test_gradgradcheck_entry_by_entry(operator: str) -> None:
    problem = make_problem(1, 1, 2, (2, 3), (3, 2), axes=2, dtype=torch.float64)
    problem.scale = away_from_kinks(problem.scale)
    call, leaves = function_of(problem, operator)
    assert gradgradcheck(call, leaves, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("order", [1, 2])
def test_depth(order: int) -> None:
    x = torch.randn(1, 1, 4, 4, dtype=torch.float64)
    weight = torch.randn(2, 1, 3, 3, dtype=torch.float64)
    z = (1.0 / away_from_kinks(torch.rand(1, 4, 4, dtype=torch.float64) + 0.4)).requires_grad_()

    def call(depth: Tensor) -> Tensor:
        return OPERATORS["public"](x, weight, scale=depth_to_scale(depth, 1.0), padding=1)

    assert (gradcheck if order == 1 else gradgradcheck)(call, (z,), atol=1e-6)


def test_third_derivatives_through_the_reference() -> None:
    """ "Differentiable as often as you like": the input enters squared, so this is not zero."""
    call, (x, weight, bias, scale) = function_of(small(), "reference")
    value = call(x.square(), weight, bias, scale).square().sum()
    for _ in range(3):
        (grad,) = torch.autograd.grad(value, x, create_graph=True)
        value = grad.sum()
    assert value.isfinite() and value != 0


def test_module() -> None:
    conv = SurfConv2d(2, 2, 3, padding=1, reference_depth=1.0, dtype=torch.float64)
    z = 1.0 / away_from_kinks(torch.rand(1, 4, 4, dtype=torch.float64) + 0.4)
    x = torch.randn(1, 2, 4, 4, dtype=torch.float64, requires_grad=True)
    assert gradcheck(conv, (x, z.requires_grad_()), atol=1e-6)


@pytest.mark.parametrize("needed", [(0,), (1,), (3,), (0, 3), (1, 2)])
def test_double_backward_of_some_inputs(needed: tuple[int, ...]) -> None:
    problem = small(axes=2)
    call, leaves = function_of(problem, "public")
    slow, slow_leaves = function_of(problem, "reference")
    results = []
    for function, tensors in ((call, leaves), (slow, slow_leaves)):
        inputs = [t.detach().requires_grad_(i in needed) for i, t in enumerate(tensors)]
        chosen = [inputs[i] for i in needed]
        out = function(*inputs).square().sum()
        first = torch.autograd.grad(out, chosen, create_graph=True)
        results.append(torch.autograd.grad(sum(g.square().sum() for g in first), chosen))
    for fast, reference in zip(*results, strict=True):
        torch.testing.assert_close(fast, reference, rtol=1e-10, atol=1e-10)
