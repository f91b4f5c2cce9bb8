"""Scale 1 is torch.nn.functional.conv2d, for every combination of its arguments."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from helpers import assert_same_bits, geometry, lay_out
from operators import OPERATORS
from surfconv_ops import SurfConv2d, surf_conv2d

KERNELS: list[Any] = [1, 2, 3, (1, 4), (5, 2)]
PADDINGS: list[Any] = [0, 2, (1, 3), "same", "valid"]
COMBINATIONS = [
    (kernel, stride, padding, dilation, groups)
    for kernel, stride, padding, dilation, groups in itertools.product(
        KERNELS, [1, 2, (3, 1)], PADDINGS, [1, (2, 3)], [1, 2, 4]
    )
    if padding != "same" or stride == 1
]


def ones_for(x: Tensor, weight: Tensor, *arguments: Any) -> Tensor:
    size = geometry(tuple(weight.shape[2:]), *arguments).output_size(*x.shape[2:])
    return torch.ones(x.shape[0], *size, dtype=x.dtype)


def both(
    operator: str, x: Tensor, weight: Tensor, bias: Tensor | None, *arguments: Any
) -> tuple[Tensor, Tensor]:
    stride, padding, dilation, groups = arguments
    out = OPERATORS[operator](
        x, weight, bias, scale=ones_for(x, weight, *arguments), stride=stride, padding=padding,
        dilation=dilation, groups=groups,
    )  # fmt: skip
    return out, F.conv2d(x, weight, bias, stride, padding, dilation, groups)


@pytest.mark.core
@pytest.mark.filterwarnings("ignore:Using padding='same'")
@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_every_combination(operator: str, kernel: Any) -> None:
    for combination in COMBINATIONS:
        if combination[0] != kernel:
            continue
        _, *arguments = combination
        x = torch.randn(2, 4, 11, 12, dtype=torch.float64, requires_grad=True)
        size = (kernel, kernel) if isinstance(kernel, int) else kernel
        weight = torch.randn(8, 4 // arguments[3], *size, dtype=torch.float64, requires_grad=True)
        bias = torch.randn(8, dtype=torch.float64, requires_grad=True)
        out, expected = both(operator, x, weight, bias, *arguments)
        torch.testing.assert_close(out, expected, rtol=1e-12, atol=1e-12, msg=str(combination))
        grad = torch.randn_like(expected)
        leaves = (x, weight, bias)
        ours = torch.autograd.grad(out, leaves, grad)
        for ours_one, theirs in zip(ours, torch.autograd.grad(expected, leaves, grad), strict=True):
            torch.testing.assert_close(ours_one, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_float32(operator: str, layout: str) -> None:
    x, weight = lay_out(torch.randn(2, 33, 20, 21), layout), torch.randn(17, 33, 3, 3)
    out, _ = both(operator, x, weight, None, 1, 1, 1, 1)
    exact = F.conv2d(x.double(), weight.double(), None, 1, 1)
    bound = F.conv2d(x.abs(), weight.abs(), None, 1, 1)
    assert ((out - exact).abs() <= 2e-6 * bound).all()


@pytest.mark.core
@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("bad", [float("inf"), float("-inf"), float("nan")])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("arguments", [(1, 1, 1, 1), (2, 0, 2, 2), (1, "same", 1, 1)], ids=str)
def test_pattern_of_nonfinite_pixels(
    operator: str, bad: float, layout: str, arguments: tuple[Any, ...]
) -> None:
    x = torch.randn(2, 4, 9, 10)
    x[0, 1, 4, 5] = x[1, 3, 0, 0] = x[1, 0, 8, 9] = bad
    weight = torch.randn(6, 4 // arguments[3], 3, 3)
    out, expected = both(operator, lay_out(x, layout), weight, None, *arguments)
    assert torch.equal(out.isnan(), expected.isnan())
    assert torch.equal(out.isposinf(), expected.isposinf())
    assert torch.equal(out.isneginf(), expected.isneginf())
    fine = expected.isfinite()
    assert fine.any() and not fine.all()
    torch.testing.assert_close(out[fine], expected[fine], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("bad", [float("inf"), float("nan")])
def test_pattern_of_even_kernels(bad: float) -> None:
    """Half-pixel centres and half-pixel taps meet on whole pixels, and on no others."""
    x = torch.randn(1, 1, 8, 8)
    x[0, 0, 3, 4] = bad
    for kernel, padding in itertools.product([(2, 2), (4, 2), (2, 3)], [0, 1]):
        weight = torch.randn(1, 1, *kernel)
        out, expected = both("public", x, weight, None, 1, padding, 1, 1)
        assert torch.equal(out.isfinite(), expected.isfinite())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_module(dtype: torch.dtype) -> None:
    plain = torch.nn.Conv2d(4, 8, (3, 2), 2, (1, 2), 1, 2, dtype=dtype)
    surf = SurfConv2d.from_conv2d(plain, reference_depth=3.0)
    x = torch.randn(2, 4, 9, 10, dtype=dtype)
    out = surf(x, torch.full((2, 9, 10), 3.0))
    torch.testing.assert_close(out, plain(x), rtol=1e-5, atol=1e-6)


def test_a_hole_is_conv2d() -> None:
    """The default invalid_scale: an image without any depth gets the ordinary convolution."""
    plain = torch.nn.Conv2d(3, 5, 3, padding=1)
    surf = SurfConv2d.from_conv2d(plain, reference_depth=2.0)
    x = torch.randn(1, 3, 8, 8)
    torch.testing.assert_close(surf(x, torch.zeros(1, 8, 8)), plain(x), rtol=1e-5, atol=1e-6)


def test_ones_guide_changes_nothing() -> None:
    x, weight = torch.randn(1, 2, 6, 6), torch.randn(3, 2, 3, 3)
    scale = torch.ones(1, 6, 6)
    plain = surf_conv2d(x, weight, scale=scale, padding=1)
    guided = surf_conv2d(x, weight, scale=scale, padding=1, guide=torch.ones(1, 6, 6))
    assert_same_bits(guided, plain)
