"""Whatever is in scale, depth or guide: finite pixels give finite results, and nothing leaks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from helpers import DTYPES, Problem, assert_same_bits, make_problem
from operators import OPERATORS
from surfconv_ops import DepthLevels, SurfConv2d, surf_conv2d

pytestmark = pytest.mark.core
each_operator = pytest.mark.parametrize("operator", OPERATORS)
NAN, INF = float("nan"), float("inf")
POISONS = [NAN, INF, -INF, 0.0, -0.0, -1.0, 1e30, -1e30, 1e-30, -1e-30, 3e38, -3e38, 1e-45, 2.0**31,
           -(2.0**31), 2.0**32, 2.0**63, -(2.0**63), 1e18, 16777217.0]  # fmt: skip


def check_finite(operator: Any, problem: Problem) -> None:
    assert problem.run(operator).isfinite().all()
    grad = torch.randn(problem.output_shape()).to(problem.input.dtype)
    for name, value in problem.gradients(operator, grad).items():
        assert value.isfinite().all(), name


@each_operator
@pytest.mark.parametrize("poison", POISONS)
@pytest.mark.parametrize("kernel", [3, (2, 5)])
@pytest.mark.parametrize("axes", [1, 2])
def test_scale(operator: str, poison: float, kernel: Any, axes: int) -> None:
    for everywhere in (True, False):
        problem = make_problem(kernel=kernel, axes=axes)
        if everywhere:
            problem.scale.fill_(poison)
        else:
            problem.scale[:, axes - 1, ::2, ::3] = poison
        check_finite(OPERATORS[operator], problem)
        problem.check_forward(OPERATORS[operator])
        problem.check_gradients(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("poison", POISONS)
def test_double_scale(operator: str, poison: float) -> None:
    for value in (poison, poison * 1e250):
        problem = make_problem(dtype=torch.float64)
        problem.scale[:, :, ::2, ::3] = value
        check_finite(OPERATORS[operator], problem)
        problem.check_gradients(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("poison", POISONS)
def test_half_scale(operator: str, dtype: torch.dtype, poison: float) -> None:
    problem = make_problem(dtype=dtype, scale_dtype=dtype)
    problem.scale[:, :, ::2, ::3] = poison
    check_finite(OPERATORS[operator], problem)


@each_operator
@pytest.mark.parametrize("poison", POISONS)
@pytest.mark.parametrize("tolerance", [0.0, 1.0, 1e30, INF])
def test_guide(operator: str, poison: float, tolerance: float) -> None:
    problem = make_problem(guide="depth", guide_tolerance=tolerance)
    assert problem.guide is not None
    problem.guide[:, ::2, ::3] = poison
    check_finite(OPERATORS[operator], problem)
    problem.check_forward(OPERATORS[operator])
    problem.check_gradients(OPERATORS[operator])


MODES: dict[str, dict[str, Any]] = {
    "continuous": {},
    "window": {"depth_window": 0.5},
    "levels": {"levels": DepthLevels([2.0], [1.0, 3.0])},
    "same_level_only": {"levels": DepthLevels([2.0], [1.0, 3.0]), "same_level_only": True},
    "clamped": {"min_scale": 0.5, "max_scale": 2.0},
}


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("poison", POISONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_depth(mode: str, poison: float, dtype: torch.dtype) -> None:
    conv = SurfConv2d(2, 3, 3, padding=1, reference_depth=2.0, dtype=dtype, **MODES[mode])
    depth = torch.rand(2, 6, 7, dtype=dtype) * 3 + 0.5
    depth[0] = poison
    depth[1, ::2, ::3] = poison
    x = torch.randn(2, 2, 6, 7, dtype=dtype, requires_grad=True)
    out = conv(x, depth.requires_grad_())
    assert out.isfinite().all()
    leaves = [x, conv.weight, conv.bias, depth]
    for value in torch.autograd.grad(out, leaves, torch.randn_like(out), allow_unused=True):
        assert value is None or value.isfinite().all()


@pytest.mark.parametrize("poison", [0.0, -1.0, NAN, INF, -INF])
def test_invalid_depth_has_gradient_zero(poison: float) -> None:
    conv = SurfConv2d(1, 2, 3, padding=1, reference_depth=2.0)
    depth = torch.rand(1, 5, 5) + 1
    depth[0, 2, 2] = poison
    out = conv(torch.randn(1, 1, 5, 5), depth.requires_grad_())
    (grad,) = torch.autograd.grad(out.square().sum(), depth)
    assert grad[0, 2, 2] == 0 and grad[0, 1, 1] != 0


def seen_pixels(operator: str, problem: Problem) -> Tensor:
    """Pixels that reach any output, found by autograd of a sum of positive terms."""
    ones = replace(
        problem, input=torch.ones_like(problem.input), weight=torch.ones_like(problem.weight)
    )
    grad = torch.ones(problem.output_shape(), dtype=problem.input.dtype)
    return ones.gradients(OPERATORS[operator], grad)["input"] != 0


@each_operator
@pytest.mark.parametrize("bad", [INF, -INF, NAN])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("case", [
    {"stride": 4, "scale": "random"},
    {"stride": 3, "scale": "ones"},
    {"scale": "integers", "stride": 5},
    {"guide": "levels", "stride": 4},
    {"guide": "holes", "axes": 2, "stride": 3},
    {"scale": "nan", "stride": 2},
    {"scale": "mixed", "stride": 4},
    {"kernel": (2, 4), "scale": "zero", "stride": 5},
], ids=str)  # fmt: skip
def test_pixels_that_no_tap_sees_do_not_leak(
    operator: str, bad: float, layout: str, case: dict[str, Any]
) -> None:
    problem = make_problem(1, 2, 3, (16, 18), layout=layout, dtype=torch.float64, **case)
    # No slope on a kink: there the neighbour of zero weight counts, for grad_scale.
    problem.scale[(problem.scale % 0.5 != 0)] += 0.0123
    clean = problem.run(OPERATORS[operator])
    grad = torch.randn(problem.output_shape(), dtype=torch.float64)
    before = problem.gradients(OPERATORS[operator], grad)
    hidden = ~seen_pixels(operator, problem)
    assert hidden.any(), "the case hides nothing"
    dirty = replace(problem, input=problem.input.masked_fill(hidden, bad))
    assert_same_bits(dirty.run(OPERATORS[operator]), clean)
    after = dirty.gradients(OPERATORS[operator], grad)
    for name in ("input", "weight", "bias"):
        assert_same_bits(after[name], before[name], name)


@each_operator
@pytest.mark.parametrize("bad", [INF, NAN])
def test_slopes_see_only_what_taps_see_off_the_kinks(operator: str, bad: float) -> None:
    problem = make_problem(1, 2, 3, (16, 18), stride=5, dtype=torch.float64)
    grad = torch.randn(problem.output_shape(), dtype=torch.float64)
    before = problem.gradients(OPERATORS[operator], grad)["scale"]
    hidden = ~seen_pixels(operator, problem)
    dirty = replace(problem, input=problem.input.masked_fill(hidden, bad))
    assert_same_bits(dirty.gradients(OPERATORS[operator], grad)["scale"], before)


@each_operator
def test_a_seen_nan_shows(operator: str) -> None:
    """The counterpart: what a tap does see must not be swallowed."""
    problem = make_problem(1, 2, 3, (9, 9), scale="smooth")
    problem.input[0, 1, 4, 4] = NAN
    out = problem.run(OPERATORS[operator])
    expected = torch.from_numpy(problem.expected().value)
    assert torch.equal(out.isnan(), expected.isnan()) and out.isnan().any()


@each_operator
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("kernel", [1, 2, 3, (5, 4)])
def test_one_pixel_maps(operator: str, dtype: torch.dtype, kernel: Any) -> None:
    for scale in ("random", "mixed"):
        problem = make_problem(2, 3, 4, (1, 1), kernel, padding=4, dtype=dtype, scale=scale)
        problem.check_forward(OPERATORS[operator])
        problem.check_gradients(OPERATORS[operator])


@each_operator
def test_empty_batch(operator: str) -> None:
    problem = make_problem(2, guide="levels")
    assert problem.guide is not None
    empty = replace(
        problem, input=problem.input[:0], scale=problem.scale[:0], guide=problem.guide[:0]
    )
    assert empty.run(OPERATORS[operator]).shape == (0, 4, 7, 8)
    for name, value in empty.gradients(OPERATORS[operator], torch.zeros(0, 4, 7, 8)).items():
        assert value.shape == getattr(empty, name).shape and not value.any(), name


@each_operator
@pytest.mark.parametrize("padding", [20, (0, 300)])
def test_huge_padding(operator: str, padding: Any) -> None:
    case = {"size": (3, 4), "padding": padding, "batch": 1, "channels": 2, "out_channels": 2}
    problem = make_problem(stride=3, scale="smooth", guide="levels", **case)
    problem.check_forward(OPERATORS[operator])
    problem.check_gradients(OPERATORS[operator])


def test_padding_larger_than_any_tap_leaves_the_bias() -> None:
    x, weight, bias = torch.randn(1, 2, 3, 3), torch.randn(4, 2, 3, 3), torch.randn(4)
    out = surf_conv2d(x, weight, bias, scale=torch.ones(1, 1, 9), padding=(50, 4), stride=(200, 1))
    assert_same_bits(out, bias.view(1, 4, 1, 1).expand(1, 4, 1, 9))


@pytest.mark.parametrize("dilation", [10_000, 2**20])
def test_huge_dilation(dilation: int) -> None:
    x, weight = torch.randn(1, 1, 5, 5), torch.randn(1, 1, 3, 3)
    scale = torch.full((1, 5, 5), 1e-4)
    out = surf_conv2d(x, weight, scale=scale, padding=dilation, dilation=dilation)
    problem = make_problem(1, 1, 1, (5, 5), padding=dilation, dilation=dilation)
    problem = replace(problem, input=x, weight=weight, bias=None, scale=scale)
    problem.check_forward(surf_conv2d)
    assert out.isfinite().all()
