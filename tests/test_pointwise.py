"""Kernels of 1 x 1: plain products, whatever scale and guide are; every layout, tail and tile."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from helpers import DTYPES, GRADIENTS, Problem, assert_same_bits, make_problem
from operators import name_of
from surfconv_ops import SurfConv2d, depth_layer, surf_conv2d

LAYOUTS = ("contiguous", "channels_last")


def make(*arguments: Any, **options: Any) -> Problem:
    options = {"kernel": 1, "padding": 0, "scale": "mixed"} | options
    return make_problem(*arguments, **options)


def check(problem: Problem) -> None:
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.core
@pytest.mark.parametrize("channels", [1, 3, 4, 8, 16, 20, 64, 70])
@pytest.mark.parametrize("out_channels", [1, 4, 6, 12, 16, 33])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_channels(channels: int, out_channels: int, layout: str) -> None:
    check(make(1, channels, out_channels, (9, 23), layout=layout))


@pytest.mark.core
@pytest.mark.parametrize("size", [(1, 1), (1, 11), (6, 8), (8, 12), (7, 15), (13, 48), (96, 1)])
@pytest.mark.parametrize("channels", [4, 7, 32])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_tiles(size: tuple[int, int], channels: int, layout: str) -> None:
    check(make(2, channels, channels, size, layout=layout))


GEOMETRIES: list[dict[str, Any]] = [
    {"stride": 2},
    {"stride": (1, 3)},
    {"stride": (3, 1)},
    {"padding": 1},
    {"padding": (0, 2), "stride": 2},
    {"padding": (60, 0), "stride": (1, 2)},
    {"padding": 3, "stride": 7},
    {"padding": 2, "stride": 40},
    {"padding": "same", "dilation": 3},
    {"groups": 2},
    {"groups": 2, "padding": 1, "stride": 2},
    {"channels": 12, "out_channels": 24, "groups": 2},
    {"channels": 10, "out_channels": 15, "groups": 5, "bias": False},
    {"channels": 8, "out_channels": 8, "groups": 8},
    {"channels": 140, "out_channels": 12, "groups": 2},
]


@pytest.mark.core
@pytest.mark.parametrize("case", GEOMETRIES, ids=name_of)
@pytest.mark.parametrize("layout", [*LAYOUTS, "sliced", "transposed", "expanded"])
def test_geometries(case: dict[str, Any], layout: str) -> None:
    shape = {"channels": 16, "out_channels": 16, "size": (9, 14), "layout": layout}
    check(make(2, **(shape | case)))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("channels", [4, 5, 24])
@pytest.mark.parametrize("layout", [*LAYOUTS, "sliced"])
@pytest.mark.parametrize("stride", [1, 2])
def test_dtypes(dtype: torch.dtype, channels: int, layout: str, stride: int) -> None:
    check(make(2, channels, 12, (7, 9), dtype=dtype, layout=layout, stride=stride))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("axes", [1, 2])
def test_scale_and_guide_change_nothing(layout: str, axes: int) -> None:
    problem = make(2, 8, 8, (9, 13), layout=layout, axes=axes, guide="holes")
    plain = replace(problem, scale=torch.ones_like(problem.scale), guide=None)
    spread = replace(plain, scale=torch.ones(1).expand_as(problem.scale))
    grad = torch.randn(problem.output_shape())
    wanted = plain.gradients(surf_conv2d, grad)
    assert not wanted["scale"].any()
    for other in (problem, spread):
        assert_same_bits(other.run(surf_conv2d), plain.run(surf_conv2d))
        for name, value in other.gradients(surf_conv2d, grad).items():
            assert_same_bits(value, wanted[name], name)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("channels", "out_channels"), [(4, 4), (16, 16), (12, 40), (72, 16)])
def test_bits_of_every_thread_count(layout: str, channels: int, out_channels: int) -> None:
    """Tiles enough for several slots of partial sums."""
    problem = make(2, channels, out_channels, (120, 131), layout=layout, scale="random")
    grad = torch.randn(problem.output_shape()).contiguous(
        memory_format=torch.channels_last if layout == "channels_last" else torch.contiguous_format
    )
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append((problem.run(surf_conv2d), problem.gradients(surf_conv2d, grad)))
    for out, grads in results[1:]:
        assert_same_bits(out, results[0][0])
        for name in GRADIENTS:
            assert_same_bits(grads[name], results[0][1][name], name)
    double = problem.to(torch.float64)
    x, weight, bias = (
        t.detach().requires_grad_() for t in (double.input, double.weight, double.bias)
    )
    wanted = F.conv2d(x, weight, bias)
    torch.testing.assert_close(results[0][0].double(), wanted, rtol=1e-5, atol=1e-5)
    expected = torch.autograd.grad(wanted, (x, weight, bias), grad.double())
    for name, value in zip(("input", "weight", "bias"), expected, strict=True):
        ours = results[0][1][name].double()
        torch.testing.assert_close(ours, value, rtol=1e-4, atol=1e-3, msg=name)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_gradients_one_by_one(layout: str) -> None:
    problem = make(2, 8, 12, (9, 13), layout=layout)
    grad = torch.randn(problem.output_shape())
    together = problem.gradients(surf_conv2d, grad)
    for name in GRADIENTS:
        leaf = getattr(problem, name).detach().requires_grad_()
        out = replace(problem, **{name: leaf}).run(surf_conv2d)
        alone = torch.autograd.grad(out, leaf, grad)[0]
        torch.testing.assert_close(alone, together[name])


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("channels", [4, 16, 20])
def test_a_pixel_that_is_not_finite_stays_alone(layout: str, channels: int) -> None:
    problem = make(1, channels, 8, (9, 13), layout=layout)
    clean = problem.run(surf_conv2d)
    poisoned = problem.input.clone()
    poisoned[0, 1, 4, 11] = torch.nan
    out = replace(problem, input=poisoned).run(surf_conv2d)
    assert out[0, :, 4, 11].isnan().all()
    out[0, :, 4, 11] = clean[0, :, 4, 11]
    assert_same_bits(out, clean)
    grad = torch.randn(problem.output_shape())
    wanted = problem.gradients(surf_conv2d, grad)["input"]
    grad[0, 2, 0, 5] = torch.inf
    ours = problem.gradients(surf_conv2d, grad)["input"]
    assert not ours[0, :, 0, 5].isfinite().any()
    ours[0, :, 0, 5] = wanted[0, :, 0, 5]
    assert_same_bits(ours, wanted)


@pytest.mark.parametrize("mode", ["plain", "channels_last"])
@pytest.mark.parametrize("other", [False, True])
def test_memory_formats(mode: str, other: bool) -> None:
    """Of the output the input's, of each gradient its tensor's, whatever the gradient's is."""
    formats = (torch.contiguous_format, torch.channels_last)
    own = formats[mode == "channels_last"]
    layer = SurfConv2d(6, 10, 1, stride=2, reference_depth=2.0).to(memory_format=own)
    x = torch.randn(2, 6, 8, 10).contiguous(memory_format=own).requires_grad_()
    out = layer(x, torch.rand(2, 8, 10))
    assert out.is_contiguous(memory_format=own)
    grad = torch.randn(out.shape).contiguous(memory_format=formats[(own is formats[1]) != other])
    (grad_x,) = torch.autograd.grad(out, x, grad)
    assert grad_x.is_contiguous(memory_format=own)
    wanted = torch.autograd.grad(F.conv2d(x, layer.weight, layer.bias, 2), x, grad)[0]
    torch.testing.assert_close(grad_x, wanted)


def boom(*_: Any, **__: Any) -> Tensor:
    raise AssertionError("a layer of 1 x 1 has no use for it")


def test_the_layer_computes_no_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    layer = SurfConv2d(3, 4, 1, stride=2, reference_depth=2.0, depth_window=0.5)
    x, depth = torch.randn(2, 3, 7, 9), torch.rand(2, 7, 9)
    monkeypatch.setattr(depth_layer, "depth_to_scale", boom)
    monkeypatch.setattr(SurfConv2d, "_guide", boom)
    wanted = F.conv2d(x, layer.weight, layer.bias, stride=2)
    torch.testing.assert_close(layer(x, depth), wanted)
    torch.testing.assert_close(layer(x[0], depth[0]), wanted[0])
    with pytest.raises(ValueError, match="depth"):
        layer(x, None)
    with pytest.raises(ValueError, match="depth"):
        layer(x, depth[:, 1:])


def test_the_depth_s_gradient_is_zero() -> None:
    layer = SurfConv2d(3, 4, 1, padding=1, reference_depth=2.0)
    x, depth = torch.randn(2, 3, 7, 9), torch.rand(2, 7, 9).requires_grad_()
    (grad,) = torch.autograd.grad(layer(x, depth).square().sum(), depth)
    assert grad.shape == depth.shape and not grad.any()
    with torch.no_grad():
        assert not layer(x, depth).requires_grad


def test_the_layer_compiles() -> None:
    torch._dynamo.reset()
    layer = SurfConv2d(3, 4, 1, reference_depth=2.0)
    compiled = torch.compile(layer, fullgraph=True, dynamic=True, backend="aot_eager")
    for size in ((5, 6), (9, 4)):
        x, depth = torch.randn(2, 3, *size), torch.rand(2, *size)
        torch.testing.assert_close(compiled(x, depth), layer(x, depth))
