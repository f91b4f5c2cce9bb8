"""The oracle itself: against conv2d where scale is 1, and its gradients against differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

import oracle_depth
from helpers import Problem, geometry, make_problem, to_numpy

pytestmark = pytest.mark.core


@pytest.mark.parametrize(
    ("kernel", "stride", "padding", "dilation", "groups"),
    [(3, 1, 1, 1, 1), ((2, 5), (2, 1), (1, 3), (3, 1), 2), (4, 1, "same", 1, 4), (1, 3, 0, 1, 1)],
)
def test_scale_one_is_conv2d(
    kernel: int, stride: int, padding: int, dilation: int, groups: int
) -> None:
    p = make_problem(
        2, 4, 8, (9, 11), kernel, stride=stride, padding=padding, dilation=dilation,
        groups=groups, dtype=torch.float64, scale="ones",
    )  # fmt: skip
    expected = F.conv2d(p.input, p.weight, p.bias, stride, padding, dilation, groups)
    np.testing.assert_allclose(p.expected().value, to_numpy(expected), atol=1e-13)


def total(problem: Problem, grad: np.ndarray) -> float:
    return float((problem.expected().value * grad).sum())


@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("guide", ["none", "levels", "holes"])
def test_gradients_are_differences(axes: int, guide: str) -> None:
    p = make_problem(
        1, 2, 2, (5, 6), (3, 2), dilation=(1, 2), groups=2, dtype=torch.float64, axes=axes,
        guide=guide,
    )  # fmt: skip
    grad = torch.randn(p.output_shape(), dtype=torch.float64)
    gradients = p.expected_gradients(grad)
    step = 1e-6
    rng = np.random.default_rng(1)
    for name in ("input", "weight", "bias", "scale"):
        tensor = getattr(p, name).view(-1)
        analytic = getattr(gradients, name).value.reshape(-1)
        for index in rng.choice(tensor.numel(), min(8, tensor.numel()), replace=False):
            start = float(tensor[index])
            tensor[index] = start + step
            above = total(p, to_numpy(grad))
            tensor[index] = start - step
            below = total(p, to_numpy(grad))
            tensor[index] = start
            assert analytic[index] == pytest.approx((above - below) / (2 * step), abs=1e-7), name


def test_kink_bounds_hold_both_sides() -> None:
    p = make_problem(1, 1, 1, (1, 7), (1, 3), padding=(0, 1), dtype=torch.float64, scale="ones")
    p.weight.copy_(torch.tensor([0.0, 0.0, 1.0]).view(1, 1, 1, 3))
    grad = torch.ones(p.output_shape(), dtype=torch.float64)
    bounds = p.expected_gradients(grad)
    x = np.concatenate([to_numpy(p.input)[0, 0, 0], [0.0, 0.0]])
    left, right = x[1:8] - x[0:7], x[2:9] - x[1:8]
    np.testing.assert_allclose(bounds.scale_low[0, 0, 0], np.minimum(left, right), atol=1e-14)
    np.testing.assert_allclose(bounds.scale_high[0, 0, 0], np.maximum(left, right), atol=1e-14)


def test_output_centers_of_odd_same_kernels_are_the_pixels() -> None:
    values = np.arange(12.0).reshape(1, 3, 4)
    np.testing.assert_array_equal(oracle_depth.at_output_centers(values, geometry(3, 1, 1)), values)
    halves = oracle_depth.at_output_centers(values, geometry(2, 1, "same"))
    np.testing.assert_array_equal(halves, values)


def test_levels_and_scales_of_single_pixels() -> None:
    assert [oracle_depth.assign_level(z, [1.0, 2.0]) for z in (0.5, 1.0, 1.5, 2.0, 3.0)] == [
        0,
        0,
        1,
        1,
        2,
    ]
    assert [oracle_depth.assign_level(z, [1.0]) for z in (0.0, -1.0, math.nan, math.inf)] == [
        -1
    ] * 4
    assert oracle_depth.depth_to_scale(4.0, 2.0) == (0.5, -0.125)
    assert oracle_depth.depth_to_scale(math.nan, 2.0, invalid_scale=3.0) == (3.0, 0.0)
    assert oracle_depth.depth_to_scale(4.0, 2.0, min_scale=0.7) == (0.7, 0.0)
    assert oracle_depth.depth_to_scale(4.0, 2.0, levels=([3.0], [1.0, 8.0])) == (0.25, 0.0)
