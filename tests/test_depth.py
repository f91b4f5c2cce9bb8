"""depth_to_scale and at_output_centers against the oracle, pixel by pixel."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import oracle_depth
from helpers import geometry, to_numpy
from surfconv_ops import DepthLevels, at_output_centers, depth_to_scale

pytestmark = [pytest.mark.core, pytest.mark.filterwarnings("ignore:depth_to_scale")]
LEVELS = ([1.0, 2.5, 6.0], [0.5, 1.5, 4.0, 9.0])
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "invalid": {"invalid_scale": 0.25},
    "invalid zero": {"invalid_scale": 0.0},
    "limits": {"min_scale": 0.4, "max_scale": 2.0},
    "limits and invalid": {"min_scale": 0.4, "max_scale": 2.0, "invalid_scale": 5.0},
}


def awkward(dtype: torch.dtype) -> Tensor:
    special = [
        0.0,
        -0.0,
        -1.0,
        math.nan,
        math.inf,
        -math.inf,
        1e-3,
        1e4,
        1.0,
        2.5,
        6.0,
        1.25,
        5.0,
        0.5,
    ]
    return torch.cat([torch.tensor(special), torch.rand(22) * 9]).to(dtype).view(1, 6, 6)


def expected(
    depth: Tensor, reference: float, levels: Any, options: dict[str, Any]
) -> tuple[Tensor, Tensor]:
    pairs = [
        oracle_depth.depth_to_scale(float(z), reference, levels, **options) for z in depth.flatten()
    ]
    values, slopes = (
        torch.tensor(list(part), dtype=torch.float64) for part in zip(*pairs, strict=True)
    )
    return values.view(depth.shape), slopes.view(depth.shape)


@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16], ids=str
)
@pytest.mark.parametrize("levels", [None, LEVELS], ids=["continuous", "levels"])
@pytest.mark.parametrize("options", OPTIONS)
def test_values(dtype: torch.dtype, levels: Any, options: str) -> None:
    depth = awkward(dtype)
    made = None if levels is None else DepthLevels(*levels)
    scale = depth_to_scale(depth, 2.0, levels=made, **OPTIONS[options])
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    assert scale.dtype == wide and scale.shape == depth.shape
    values, _ = expected(depth, 2.0, levels, OPTIONS[options])
    torch.testing.assert_close(scale.double(), values, rtol=torch.finfo(wide).eps, atol=0)


@pytest.mark.parametrize("levels", [None, LEVELS], ids=["continuous", "levels"])
@pytest.mark.parametrize("options", OPTIONS)
def test_gradient(levels: Any, options: str) -> None:
    depth = awkward(torch.float64).requires_grad_()
    made = None if levels is None else DepthLevels(*levels)
    scale = depth_to_scale(depth, 2.0, levels=made, **OPTIONS[options])
    _, slopes = expected(depth.detach(), 2.0, levels, OPTIONS[options])
    if levels is not None:
        assert not scale.requires_grad or not torch.autograd.grad(scale.sum(), depth)[0].any()
        return
    weights = torch.rand_like(scale)
    (grad,) = torch.autograd.grad(scale, depth, weights)
    torch.testing.assert_close(grad, slopes * weights, rtol=1e-13, atol=0)


def test_clamping_is_strict() -> None:
    """A scale that equals its limit is not clamped: its gradient flows."""
    depth = torch.tensor([[1.0, 2.0, 4.0, 8.0, 0.5]], requires_grad=True)
    scale = depth_to_scale(depth, 4.0, min_scale=1.0, max_scale=4.0)
    assert scale.tolist() == [[4.0, 2.0, 1.0, 1.0, 4.0]]
    (grad,) = torch.autograd.grad(scale.sum(), depth)
    assert grad.tolist() == [[-4.0, -1.0, -0.25, 0.0, 0.0]]


def test_invalid_scale_is_not_clamped() -> None:
    scale = depth_to_scale(torch.tensor([[0.0, 1.0]]), 1.0, invalid_scale=9.0, max_scale=2.0)
    assert scale.tolist() == [[9.0, 1.0]]


@pytest.mark.parametrize("shape", [(4, 5), (2, 4, 5), (2, 1, 4, 5), (3, 2, 4, 5), (0, 4, 5)])
def test_shapes(shape: tuple[int, ...]) -> None:
    depth = torch.rand(shape) + 1
    assert depth_to_scale(depth, 2.0).shape == shape
    both = depth_to_scale(depth, (2.0, 3.0))
    assert both.shape == (*shape[:-2], 2, *shape[-2:])
    torch.testing.assert_close(both[..., 0, :, :], depth_to_scale(depth, 2.0), rtol=0, atol=0)
    torch.testing.assert_close(both[..., 1, :, :], depth_to_scale(depth, 3.0), rtol=0, atol=0)


def test_pair_with_levels_limits_and_holes() -> None:
    depth, levels = awkward(torch.float32), DepthLevels(*LEVELS)
    options: dict[str, Any] = {"levels": levels, "min_scale": 0.3, "invalid_scale": 7.0}
    both = depth_to_scale(depth, (2.0, 3.0), **options)
    for axis, reference in enumerate((2.0, 3.0)):
        alone = depth_to_scale(depth, reference, **options)
        torch.testing.assert_close(both[:, axis], alone, rtol=0, atol=0)


@pytest.mark.parametrize("tiny", [1e-30, 1e-38, 1e-45, 1e30, 3e38])
def test_extreme_depths_give_numbers(tiny: float) -> None:
    depth = torch.tensor([[tiny, 1.0]], requires_grad=True)
    scale = depth_to_scale(depth, 2.0)
    assert not scale.isnan().any()
    (grad,) = torch.autograd.grad(scale[0, 1], depth)
    assert grad.tolist() == [[0.0, -2.0]]


@given(
    kernel=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    stride=st.integers(1, 4),
    padding=st.one_of(st.integers(0, 7), st.sampled_from(["same", "valid"])),
    dilation=st.integers(1, 3),
    more=st.tuples(st.integers(0, 6), st.integers(0, 6)),
)
def test_output_centers(
    kernel: tuple[int, int], stride: int, padding: Any, dilation: int, more: tuple[int, int]
) -> None:
    stride = 1 if padding == "same" else stride
    shape = geometry(kernel, stride, padding, dilation)
    size = [
        max(1, dilation * (kernel[a] - 1) + 1 - shape.padding[a] - shape.padding[a + 2]) + more[a]
        for a in (0, 1)
    ]
    values = torch.arange(2 * 3 * size[0] * size[1]).float().view(2, 3, *size)
    wanted = torch.from_numpy(oracle_depth.at_output_centers(to_numpy(values), shape)).float()
    for map, result in ((values, wanted), (values[:, 0], wanted[:, 0])):
        assert torch.equal(at_output_centers(map, kernel, stride, padding, dilation), result)


def test_output_centers_where_a_half_rounds_down() -> None:
    row = torch.arange(6.0).view(1, 1, 6)
    assert at_output_centers(row, (1, 2)).tolist() == [[[0, 1, 2, 3, 4]]]
    assert at_output_centers(row, (1, 4), padding=(0, 3)).tolist() == [
        [[0, 0, 0, 1, 2, 3, 4, 5, 5]]
    ]


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.float16, torch.float64])
def test_output_centers_keep_the_type(dtype: torch.dtype) -> None:
    values = torch.randint(0, 2, (2, 5, 6)).to(dtype)
    out = at_output_centers(values, 3, 2, 1)
    assert out.dtype == dtype and torch.equal(out, values[:, ::2, ::2])


def test_output_centers_gradient() -> None:
    values = torch.randn(1, 3, 4, dtype=torch.float64, requires_grad=True)
    out = at_output_centers(values, 3, 1, 3)
    (grad,) = torch.autograd.grad(out, values, torch.ones_like(out))
    # Two rows and columns beyond each edge read the edge pixel.
    rows, columns = torch.tensor([3.0, 1, 3]), torch.tensor([3.0, 1, 1, 3])
    assert torch.equal(grad[0], (rows[:, None] * columns).double())


CLAMP = """
import warnings, torch
from surfconv_ops import depth_to_scale
depth = torch.full((10, 10), 1.0)
def count(bad, **limits):
    depth.fill_(1.0).view(-1)[:bad] = 100.0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        depth_to_scale(depth, 1.0, **limits)
    return [str(w.message) for w in caught]
assert count(10, min_scale=0.5) == [], "10 % is not more than 10 %"
assert count(90) == [], "nothing clamps without limits"
from surfconv_ops import depth as module
for limits in ({"max_scale": 0.0}, {"max_scale": 0.9}, {"min_scale": 1.5, "max_scale": 2.0}):
    module._warned_of_clamping = False
    assert len(count(0, **limits)) == 1, limits
module._warned_of_clamping = False
first = count(11, min_scale=0.5)
assert len(first) == 1 and "11%" in first[0].replace(" ", "") and "0.5" in first[0], first
assert count(50, min_scale=0.5) == [], "said once"
"""


def test_clamping_much_warns_once() -> None:
    subprocess.run([sys.executable, "-c", CLAMP], check=True, timeout=120)
