"""Every gradient by name against the oracle: input, weight, bias, scale, and through depth."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest
import torch

import oracle_depth
from helpers import (
    DTYPES,
    GRADIENTS,
    GUIDES,
    LAYOUTS,
    SCALES,
    Problem,
    assert_matches,
    assert_same_bits,
    assert_scale_gradient,
    make_problem,
    to_numpy,
)
from operators import GEOMETRIES, OPERATORS, name_of
from surfconv_ops import at_output_centers, depth_to_scale, reference, surf_conv2d

pytestmark = pytest.mark.core
each_operator = pytest.mark.parametrize("operator", OPERATORS)


@each_operator
@pytest.mark.parametrize("case", GEOMETRIES, ids=name_of)
@pytest.mark.parametrize("axes", [1, 2])
def test_geometry(operator: str, case: dict[str, Any], axes: int) -> None:
    make_problem(axes=axes, **case).check_gradients(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("kernel", [3, (2, 3)])
@pytest.mark.parametrize("axes", [1, 2])
def test_scale(operator: str, scale: str, kernel: Any, axes: int) -> None:
    make_problem(scale=scale, kernel=kernel, axes=axes).check_gradients(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("scale_dtype", ["float32", "input's"])
@pytest.mark.parametrize("guide", ["none", "depth"])
def test_dtype(operator: str, dtype: torch.dtype, scale_dtype: str, guide: str) -> None:
    kind = torch.float32 if scale_dtype == "float32" else dtype
    problem = make_problem(
        2, 6, 8, (9, 11), dtype=dtype, scale_dtype=kind, guide=guide, guide_tolerance=0.8
    )
    problem.check_gradients(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("guide", GUIDES)
@pytest.mark.parametrize("tolerance", [0.0, 0.7])
@pytest.mark.parametrize("case", [{}, {"kernel": (4, 3), "stride": (1, 2)}], ids=name_of)
def test_guide(operator: str, guide: str, tolerance: float, case: dict[str, Any]) -> None:
    problem = make_problem(guide=guide, guide_tolerance=tolerance, scale="smooth", **case)
    problem.check_gradients(OPERATORS[operator])


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("groups", [1, 2])
def test_layout(layout: str, groups: int) -> None:
    problem = make_problem(2, 4, 6, (8, 9), layout=layout, groups=groups)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("needed", ["input", "weight", "bias", "scale"])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_one_gradient_at_a_time(needed: str, layout: str) -> None:
    """Each gradient is right whichever others are asked for."""
    problem = make_problem(2, 5, 6, (9, 7), layout=layout)
    grad = torch.randn(problem.output_shape())
    leaf = getattr(problem, needed).detach().requires_grad_()
    out = replace(problem, **{needed: leaf}).run(surf_conv2d)
    (alone,) = torch.autograd.grad(out, leaf, grad)
    expected = problem.expected_gradients(grad)
    if needed == "scale":
        assert_scale_gradient(alone, expected)
    else:
        assert_matches(alone, getattr(expected, needed), needed)


@pytest.mark.parametrize("needs", list(itertools.product([False, True], repeat=4)), ids=str)
def test_every_set_of_gradients(needs: tuple[bool, ...]) -> None:
    problem = make_problem(1, 3, 4)
    grad = torch.randn(problem.output_shape())
    expected = problem.expected_gradients(grad)
    actual = torch.ops.surfconv.surf_conv2d_backward(
        grad,
        problem.input,
        problem.weight,
        problem.scale,
        None,
        0.0,
        [1, 1],
        [1, 1],
        [1, 1],
        1,
        *needs,
    )
    for name, value, need in zip(GRADIENTS, actual, needs, strict=True):
        if not need:
            assert value.shape == (0,), name
        elif name == "scale":
            assert_scale_gradient(value, expected)
        else:
            assert_matches(value, getattr(expected, name), name)


def test_unbatched() -> None:
    problem = make_problem(1, axes=2)
    grad = torch.randn(problem.output_shape())
    batched = problem.gradients(surf_conv2d, grad)
    alone = replace(problem, input=problem.input[0], scale=problem.scale[0])
    for name, value in alone.gradients(surf_conv2d, grad[0]).items():
        assert_same_bits(value.reshape(batched[name].shape), batched[name], name)


def test_scale_without_a_channel_dimension() -> None:
    problem = make_problem()
    flat = replace(problem, scale=problem.scale[:, 0])
    grad = torch.randn(problem.output_shape())
    value = flat.gradients(surf_conv2d, grad)["scale"]
    assert_same_bits(value[:, None], problem.gradients(surf_conv2d, grad)["scale"])


@each_operator
@pytest.mark.parametrize("tap", [(0, 2), (2, 1), (1, 1)])
@pytest.mark.parametrize("scale", [1.0, 2.0, -1.0, 0.0, 0.5])
def test_scale_gradient_of_one_tap_on_a_kink(
    operator: str, tap: tuple[int, int], scale: float
) -> None:
    """With one tap alone the bounds are the two one-sided derivatives, nothing between."""
    problem = make_problem(1, 1, 1, (6, 5), dtype=torch.float64, axes=2, bias=False)
    problem.scale.fill_(scale)
    problem.weight.zero_()
    problem.weight[0, 0, tap[0], tap[1]] = 1.5
    grad = torch.randn(problem.output_shape(), dtype=torch.float64)
    actual = to_numpy(problem.gradients(OPERATORS[operator], grad)["scale"])
    bounds = problem.expected_gradients(grad)
    low, high = abs(actual - bounds.scale_low), abs(actual - bounds.scale_high)
    assert ((low < 1e-12) | (high < 1e-12)).all()


@each_operator
@pytest.mark.parametrize("levels", [False, True])
@pytest.mark.parametrize("case", [{}, {"kernel": (2, 3), "stride": 2}], ids=name_of)
def test_depth(operator: str, levels: bool, case: dict[str, Any]) -> None:
    """Down the chain depth -> scale -> nearest centre -> operator, holes and clamps included."""
    from surfconv_ops import DepthLevels

    problem = make_problem(dtype=torch.float64, **case)
    depth = torch.rand(2, 7, 8, dtype=torch.float64) * 4 + 0.5
    for index, hole in enumerate((0.0, -1.0, float("nan"), float("inf"), 1e-30, 1e30)):
        depth[0, index, 1 : 7 : index + 1] = hole
    level_set = DepthLevels([1.5, 3.0], [1.1, 2.2, 4.1]) if levels else None
    limits = {} if levels else {"min_scale": 0.55, "max_scale": 2.3}
    scaled = [
        oracle_depth.depth_to_scale(
            float(z), 2.0, ([1.5, 3.0], [1.1, 2.2, 4.1]) if levels else None, 1.0,
            limits.get("min_scale", 0.0), limits.get("max_scale", float("inf")),
        )
        for z in depth.flatten()
    ]  # fmt: skip
    values = torch.tensor([s for s, _ in scaled], dtype=torch.float64).view_as(depth)
    slopes = torch.tensor([d for _, d in scaled], dtype=torch.float64).view_as(depth)
    shape = problem.geometry
    centred = torch.from_numpy(oracle_depth.at_output_centers(to_numpy(values), shape))[:, None]
    solved = replace(problem, scale=centred)
    grad = torch.randn(problem.output_shape(), dtype=torch.float64)

    z = depth.requires_grad_()
    scale = depth_to_scale(z, 2.0, levels=level_set, **limits)
    at = at_output_centers(scale, tuple(problem.weight.shape[2:]), problem.stride, problem.padding)
    out = replace(problem, scale=at).run(OPERATORS[operator])
    torch.testing.assert_close(out.detach(), torch.from_numpy(solved.expected().value))
    if levels:
        assert not out.requires_grad or torch.autograd.grad(out, z, grad)[0].eq(0).all()
        return
    (actual,) = torch.autograd.grad(out, z, grad)
    by_scale = solved.expected_gradients(grad).scale.value[:, 0]
    expected = torch.zeros_like(depth)
    for oy in range(by_scale.shape[1]):
        for ox in range(by_scale.shape[2]):
            y, x = shape.centre_pixel(0, oy, 7), shape.centre_pixel(1, ox, 8)
            expected[:, y, x] += torch.from_numpy(by_scale[:, oy, ox])
    torch.testing.assert_close(actual, expected * slopes, rtol=1e-10, atol=1e-12)
    assert actual.ne(0).any()


@pytest.mark.parametrize("case", GEOMETRIES[:8], ids=name_of)
def test_public_and_reference_agree(case: dict[str, Any]) -> None:
    problem = make_problem(dtype=torch.float64, guide="depth", guide_tolerance=1.2, **case)
    grad = torch.randn(problem.output_shape(), dtype=torch.float64)
    slow = problem.gradients(reference.surf_conv2d, grad)
    for name, value in problem.gradients(surf_conv2d, grad).items():
        torch.testing.assert_close(value, slow[name], rtol=1e-11, atol=1e-11)


def test_a_gradient_of_one_output_reaches_its_own_pixels_only() -> None:
    problem = make_problem(1, 2, 2, (9, 9), scale="ones")
    grad = torch.zeros(problem.output_shape())
    grad[0, 1, 4, 4] = 1.0
    gradients = problem.gradients(surf_conv2d, grad)
    touched = gradients["input"].abs().sum((0, 1)).nonzero()
    assert touched.min() == 3 and touched.max() == 5
    assert gradients["scale"].count_nonzero() == 1
    assert gradients["bias"].tolist() == [0.0, 1.0]


def test_scale_gradient_bounds_are_used() -> None:
    """The check that the other tests rely on rejects a slope outside the two sides."""
    problem = make_problem()
    grad = torch.randn(problem.output_shape())
    value = problem.gradients(surf_conv2d, grad)["scale"]
    expected = problem.expected_gradients(grad)
    assert_scale_gradient(value, expected)
    with pytest.raises(AssertionError):
        assert_scale_gradient(value * 1.001, expected)


def test_problem_check_rejects_a_wrong_gradient() -> None:
    def doubled(*args: Any, **options: Any) -> torch.Tensor:
        out = surf_conv2d(*args, **options)
        return out + (args[1].sum() - args[1].sum().detach()) * 1e-3

    problem: Problem = make_problem()
    with pytest.raises(AssertionError, match="grad_weight"):
        problem.check_gradients(doubled)
