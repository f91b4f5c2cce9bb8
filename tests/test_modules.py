"""SurfConv2d as a module: an nn.Conv2d, its checkpoints, copies and constructors."""

from __future__ import annotations

import copy
import io
import pickle
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from helpers import assert_same_bits
from surfconv_ops import (
    DepthLevels,
    SurfConv2d,
    at_output_centers,
    depth_to_scale,
    reference,
)

LEVELS = DepthLevels([1.5, 3.0], [1.0, 2.0, 4.0], gamma=1.0)
MODES: dict[str, dict[str, Any]] = {
    "continuous": {},
    "window": {"depth_window": 0.75},
    "levels": {"levels": LEVELS},
    "same level": {"levels": LEVELS, "same_level_only": True},
    "limits": {"min_scale": 0.6, "max_scale": 1.5, "invalid_scale": 0.5},
}
pytestmark = pytest.mark.filterwarnings("ignore:depth_to_scale")


def depth_map(*shape: int) -> Tensor:
    depth = torch.rand(shape) * 4 + 0.3
    depth.view(-1)[::7] = 0.0
    depth.view(-1)[3::11] = float("nan")
    return depth


def test_sizes_that_numpy_computed() -> None:
    two, three = np.int64(2), np.int32(3)
    layer = SurfConv2d(three, 4, three, two, np.int8(1), reference_depth=2.0)
    x, depth = torch.randn(1, 3, 8, 9), torch.rand(1, 8, 9) + 1.0
    plain = SurfConv2d(3, 4, 3, 2, 1, reference_depth=2.0)
    plain.load_state_dict(layer.state_dict())
    assert_same_bits(layer(x, depth), plain(x, depth))


@pytest.mark.core
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "shape",
    [{}, {"stride": 2}, {"kernel_size": (2, 3), "padding": "same"}, {"groups": 2, "dilation": 2}],
    ids=str,
)
def test_forward_is_the_function_of_its_depth(mode: str, shape: dict[str, Any]) -> None:
    arguments = {"kernel_size": 3, "padding": 1} | shape
    options = MODES[mode]
    conv = SurfConv2d(4, 6, **arguments, reference_depth=2.0, **options)
    x, depth = torch.randn(2, 4, 9, 10), depth_map(2, 9, 10)
    passed = {
        k: v
        for k, v in options.items()
        if k in ("levels", "min_scale", "max_scale", "invalid_scale")
    }
    window = {k: getattr(conv, k) for k in ("kernel_size", "stride", "padding", "dilation")}
    scale = at_output_centers(depth_to_scale(depth, 2.0, **passed), **window)
    valid = (depth > 0) & depth.isfinite()
    guide = None
    if mode == "window":
        guide = depth.where(valid, torch.nan)
    if mode == "same level":
        guide = LEVELS.assign(depth).float().where(valid, torch.nan)
    expected = reference.surf_conv2d(
        x, conv.weight, conv.bias, scale=scale, guide=guide,
        guide_tolerance=options.get("depth_window", 0.0),
        stride=conv.stride, padding=conv.padding, dilation=conv.dilation, groups=conv.groups,
    )  # fmt: skip
    torch.testing.assert_close(conv(x, depth), expected, rtol=1e-5, atol=1e-6)


def test_depth_shapes() -> None:
    conv = SurfConv2d(3, 4, 3, padding=1, reference_depth=2.0)
    x, depth = torch.randn(2, 3, 6, 7), depth_map(2, 6, 7)
    out = conv(x, depth)
    assert_same_bits(conv(x, depth[:, None]), out)
    assert_same_bits(conv(x, depth=depth), out)
    assert_same_bits(conv(x[0], depth[0]), out[0])
    assert_same_bits(conv(x[1], depth[1:]), out[1])
    assert_same_bits(conv(x, depth.double()), out)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16], ids=str)
def test_other_types(dtype: torch.dtype) -> None:
    conv = SurfConv2d(3, 4, 3, padding=1, reference_depth=2.0, dtype=dtype)
    x, depth = torch.randn(2, 3, 6, 7).to(dtype), depth_map(2, 6, 7)
    out = conv(x, depth)
    exact = copy.deepcopy(conv).double()(x.double(), depth.double())
    assert out.dtype == dtype
    error = (out - exact).double().square().mean().sqrt() / exact.square().mean().sqrt()
    assert error < max(torch.finfo(dtype).eps / 2, 1e-7)


def test_anisotropic_reference_is_y_then_x() -> None:
    conv = SurfConv2d(1, 1, 3, padding=1, reference_depth=(1.0, 2.0), bias=False)
    x, depth = torch.randn(1, 1, 9, 9), torch.ones(1, 9, 9)
    stretched = nn.functional.conv2d(x, conv.weight, padding=(1, 2), dilation=(1, 2))
    torch.testing.assert_close(conv(x, depth), stretched, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("bias", [True, False])
def test_checkpoints_load_both_ways(bias: bool) -> None:
    plain = nn.Conv2d(4, 6, (3, 2), 2, 1, 1, 2, bias=bias)
    surf = SurfConv2d(4, 6, (3, 2), 2, 1, 1, 2, bias=bias, reference_depth=2.0)
    assert isinstance(surf, nn.Conv2d)
    assert list(surf.state_dict()) == list(plain.state_dict())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        surf.load_state_dict(plain.state_dict(), strict=True)
        assert_same_bits(surf.weight, plain.weight)
        fresh = nn.Conv2d(4, 6, (3, 2), 2, 1, 1, 2, bias=bias)
        fresh.load_state_dict(surf.state_dict(), strict=True)
        assert_same_bits(fresh.weight, plain.weight)


def saved_and_loaded(module: nn.Module) -> Any:
    buffer = io.BytesIO()
    torch.save(module.state_dict(), buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


@pytest.mark.parametrize(
    ("other", "word"),
    [
        ({"reference_depth": 3.0}, "reference_depth"),
        ({"reference_depth": (2.0, 3.0)}, "reference_depth"),
        ({"reference_depth": 2.0, "levels": LEVELS}, "levels"),
    ],
)
def test_loading_under_other_depths_warns(other: dict[str, Any], word: str) -> None:
    net = nn.Sequential(nn.ReLU(), SurfConv2d(2, 3, 3, reference_depth=2.0))
    state = saved_and_loaded(net)
    changed = nn.Sequential(nn.ReLU(), SurfConv2d(2, 3, 3, **other))
    with pytest.warns(UserWarning, match=word):
        changed.load_state_dict(state)
    same = nn.Sequential(nn.ReLU(), SurfConv2d(2, 3, 3, reference_depth=2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same.load_state_dict(state)


def test_same_levels_load_silently() -> None:
    state = saved_and_loaded(SurfConv2d(2, 3, 3, reference_depth=(2.0, 3.0), levels=LEVELS))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SurfConv2d(2, 3, 3, reference_depth=(2.0, 3.0), levels=LEVELS).load_state_dict(state)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("how", ["pickle", "deepcopy", "torch.save"])
def test_copies(mode: str, how: str) -> None:
    conv = SurfConv2d(2, 3, 3, padding=1, reference_depth=(2.0, 3.0), **MODES[mode])
    if how == "pickle":
        twin = pickle.loads(pickle.dumps(conv))
    elif how == "deepcopy":
        twin = copy.deepcopy(conv)
    else:
        buffer = io.BytesIO()
        torch.save(conv, buffer)
        buffer.seek(0)
        twin = torch.load(buffer, weights_only=False)
    x, depth = torch.randn(1, 2, 6, 6), depth_map(1, 6, 6)
    assert_same_bits(twin(x, depth), conv(x, depth))
    assert repr(twin) == repr(conv)
    assert twin.weight is not conv.weight


def test_from_conv2d_shares_parameters() -> None:
    plain = nn.Conv2d(4, 6, (3, 5), 2, (1, 2), 1, 2).eval()
    plain.weight.requires_grad_(False)
    surf = SurfConv2d.from_conv2d(plain, reference_depth=2.0, levels=LEVELS, same_level_only=True)
    assert type(surf) is SurfConv2d
    assert surf.weight is plain.weight and surf.bias is plain.bias
    for name in (
        "kernel_size",
        "stride",
        "padding",
        "dilation",
        "groups",
        "in_channels",
        "out_channels",
    ):
        assert getattr(surf, name) == getattr(plain, name), name
    assert (surf.training, surf.levels, surf.same_level_only) == (False, LEVELS, True)
    without = SurfConv2d.from_conv2d(
        nn.Conv2d(1, 2, 3, padding="same", bias=False), reference_depth=1.0
    )
    assert without.bias is None and without.padding == "same"


@pytest.mark.parametrize(
    ("radius", "focal", "kernel", "dilation"),
    [(0.15, 500.0, 3, 1), (0.3, 365.0, (5, 2), (1, 3)), ((0.1, 0.2), (700.0, 710.0), 3, 2)],
)
def test_from_radius(radius: Any, focal: Any, kernel: Any, dilation: Any) -> None:
    conv = SurfConv2d.from_radius(
        2, 3, kernel, dilation=dilation, radius=radius, focal_length=focal, invalid_scale=0.5
    )
    pairs = [v if isinstance(v, tuple) else (v, v) for v in (radius, focal, kernel, dilation)]
    wanted = [2 * pairs[0][a] * pairs[1][a] / (pairs[2][a] * pairs[3][a]) for a in (0, 1)]
    made = conv.reference_depth
    made = made if isinstance(made, tuple) else (made, made)
    assert made == pytest.approx(tuple(wanted)) and conv.invalid_scale == 0.5
    # Taps lie 2*radius/k metres apart: that many pixels times depth over focal length.
    depth = 1.7
    for axis in (0, 1):
        pixels = pairs[3][axis] * made[axis] / depth
        assert pixels * depth / pairs[1][axis] == pytest.approx(2 * pairs[0][axis] / pairs[2][axis])


def test_fuse_conv_bn() -> None:
    conv = SurfConv2d(3, 4, 3, padding=1, reference_depth=2.0, levels=LEVELS).eval()
    norm = nn.BatchNorm2d(4).eval()
    norm.running_mean, norm.running_var = torch.randn(4), torch.rand(4) + 0.5
    fused = nn.utils.fusion.fuse_conv_bn_eval(conv, norm)
    assert type(fused) is SurfConv2d and fused.reference_depth == 2.0 and fused.levels == LEVELS
    x, depth = torch.randn(2, 3, 7, 7), depth_map(2, 7, 7)
    torch.testing.assert_close(fused(x, depth), norm(conv(x, depth)), rtol=1e-5, atol=1e-5)


def test_repr_tells_the_depth_arguments() -> None:
    text = repr(SurfConv2d(3, 4, 3, reference_depth=2.5, **MODES["limits"]))
    for part in ("SurfConv2d(3, 4, kernel_size=(3, 3)", "reference_depth=2.5", "min_scale=0.6",
                 "max_scale=1.5", "invalid_scale=0.5"):  # fmt: skip
        assert part in text
    assert "same_level_only" in repr(
        SurfConv2d(3, 4, 3, reference_depth=1.0, **MODES["same level"])
    )
    assert "depth_window=0.75" in repr(SurfConv2d(3, 4, 3, reference_depth=1.0, depth_window=0.75))


def test_parametrization_and_hooks_work() -> None:
    conv = SurfConv2d(2, 3, 3, padding=1, reference_depth=2.0)
    x, depth = torch.randn(1, 2, 5, 5), torch.ones(1, 5, 5)
    calls: list[tuple[int, ...]] = []
    conv.register_forward_hook(lambda module, inputs, out: calls.append(tuple(out.shape)))
    nn.utils.parametrizations.weight_norm(conv)
    conv(x, depth).sum().backward()
    assert calls == [(1, 3, 5, 5)]
    assert all(p.grad is not None and p.grad.isfinite().all() for p in conv.parameters())


def test_training_moves_the_filters_to_the_target() -> None:
    target = SurfConv2d(2, 2, 3, padding=1, reference_depth=2.0)
    learner = SurfConv2d(2, 2, 3, padding=1, reference_depth=2.0)
    depth = depth_map(4, 12, 12)
    optimizer = torch.optim.Adam(learner.parameters(), 0.05)
    for _ in range(150):
        x = torch.randn(4, 2, 12, 12)
        loss = (learner(x, depth) - target(x, depth).detach()).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    torch.testing.assert_close(learner.weight, target.weight, rtol=0, atol=0.02)
