"""SurfMaxPool2d and SurfAvgPool2d as modules, and the messages of wrong arguments."""

from __future__ import annotations

import copy
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
    SurfAvgPool2d,
    SurfMaxPool2d,
    depth_to_scale,
    surf_avg_pool2d,
    surf_max_pool2d,
)
from test_errors import says

LEVELS = DepthLevels([1.5, 3.0], [1.0, 2.0, 4.0])
MODES: dict[str, dict[str, Any]] = {
    "continuous": {},
    "window": {"depth_window": 0.75},
    "levels": {"levels": LEVELS},
    "same level": {"levels": LEVELS, "same_level_only": True},
    "limits": {"min_scale": 0.6, "max_scale": 1.5, "invalid_scale": 0.5},
}
KINDS: dict[type[nn.Module], Any] = {SurfMaxPool2d: nn.MaxPool2d, SurfAvgPool2d: nn.AvgPool2d}
FUNCTIONS: dict[type[nn.Module], Any] = {
    SurfMaxPool2d: surf_max_pool2d,
    SurfAvgPool2d: surf_avg_pool2d,
}
each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
pytestmark = pytest.mark.filterwarnings("ignore:depth_to_scale")


def depth_map(*shape: int) -> Tensor:
    depth = torch.rand(shape) * 4 + 0.3
    depth.view(-1)[::7] = 0.0
    depth.view(-1)[3::11] = float("nan")
    return depth


@each_kind
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("ceil_mode", [False, True])
def test_forward_is_the_function_of_its_depth(kind: Any, mode: str, ceil_mode: bool) -> None:
    options = MODES[mode]
    pool = kind(3, 2, 1, ceil_mode=ceil_mode, reference_depth=2.0, **options)
    x, depth = torch.randn(2, 4, 8, 9), depth_map(2, 8, 9)
    passed = {k: v for k, v in options.items() if "scale" in k or k == "levels"}
    scale = depth_to_scale(depth, 2.0, **passed)
    # Centres of a 3 x 3 window of stride 2 and padding 1: every other pixel, the last one clamped.
    rows, columns = torch.arange(0, 8, 2), torch.arange(0, 9, 2)
    if ceil_mode:
        rows = torch.tensor([0, 2, 4, 6, 7])
    valid = (depth > 0) & depth.isfinite()
    guide = None
    if mode == "window":
        guide = depth.where(valid, torch.nan)
    if mode == "same level":
        guide = LEVELS.assign(depth).float().where(valid, torch.nan)
    expected = FUNCTIONS[kind](
        x, 3, 2, 1, ceil_mode=ceil_mode, scale=scale[:, rows][:, :, columns], guide=guide,
        guide_tolerance=options.get("depth_window", 0.0),
    )  # fmt: skip
    assert_same_bits(pool(x, depth), expected)


@each_kind
@pytest.mark.parametrize("depth", [2.0, 0.0, float("nan"), -1.0])
def test_reference_and_invalid_depth_are_nn(kind: Any, depth: float) -> None:
    for arguments in ((2,), (3, 2, 1), ((3, 2), None, (1, 0))):
        pool, plain = kind(*arguments, reference_depth=2.0), KINDS[kind](*arguments)
        x = torch.randn(2, 8, 9, 10)
        out = pool(x, torch.full((2, 9, 10), depth))
        torch.testing.assert_close(out, plain(x), rtol=1e-6, atol=1e-6)
        assert isinstance(pool, KINDS[kind]) and not list(pool.state_dict())


@each_kind
def test_depth_shapes(kind: Any) -> None:
    pool = kind(3, 2, 1, reference_depth=2.0)
    x, depth = torch.randn(2, 3, 6, 7), depth_map(2, 6, 7)
    out = pool(x, depth)
    assert_same_bits(pool(x, depth[:, None]), out)
    assert_same_bits(pool(x, depth=depth), out)
    assert_same_bits(pool(x[0], depth[0]), out[0])
    assert_same_bits(pool(x[1], depth[1:]), out[1])


@each_kind
def test_anisotropic_reference_is_y_then_x(kind: Any) -> None:
    pool = kind((1, 3), 1, (0, 1), reference_depth=(5.0, 1.0))
    x = torch.randn(1, 1, 4, 8)
    plain = kind((1, 3), 1, (0, 1), reference_depth=1.0)
    assert_same_bits(pool(x, torch.ones(1, 4, 8)), plain(x, torch.ones(1, 4, 8)))


@each_kind
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("how", ["pickle", "deepcopy"])
def test_copies(kind: Any, mode: str, how: str) -> None:
    pool = kind(3, 2, 1, reference_depth=(2.0, 3.0), **MODES[mode])
    twin = pickle.loads(pickle.dumps(pool)) if how == "pickle" else copy.deepcopy(pool)
    x, depth = torch.randn(1, 2, 6, 6), depth_map(1, 6, 6)
    assert_same_bits(twin(x, depth), pool(x, depth))
    assert repr(twin) == repr(pool)


@each_kind
def test_loading_under_another_depth_warns(kind: Any) -> None:
    state = nn.Sequential(nn.ReLU(), kind(2, reference_depth=2.0)).state_dict()
    with pytest.warns(UserWarning, match="reference_depth"):
        nn.Sequential(nn.ReLU(), kind(2, reference_depth=3.0)).load_state_dict(state)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nn.Sequential(nn.ReLU(), kind(2, reference_depth=2.0)).load_state_dict(state)
        plain = nn.Sequential(nn.ReLU(), KINDS[kind](2)).state_dict()
        nn.Sequential(nn.ReLU(), kind(2, reference_depth=2.0)).load_state_dict(plain)


def test_from_pool_keeps_every_argument() -> None:
    plain = nn.MaxPool2d((3, 2), (2, 1), (1, 0), (1, 2), ceil_mode=True).eval()
    surf = SurfMaxPool2d.from_pool(plain, reference_depth=2.0, levels=LEVELS, same_level_only=True)
    for name in ("kernel_size", "stride", "padding", "dilation", "ceil_mode", "training"):
        assert getattr(surf, name) == getattr(plain, name), name
    assert surf.levels == LEVELS and surf.same_level_only
    mean = nn.AvgPool2d(3, None, 1, True, False, 4)
    ours = SurfAvgPool2d.from_pool(mean, reference_depth=(1.0, 2.0), max_scale=3.0)
    for name in ("kernel_size", "stride", "padding", "ceil_mode", "count_include_pad",
                 "divisor_override", "training"):  # fmt: skip
        assert getattr(ours, name) == getattr(mean, name), name
    assert ours.reference_depth == (1.0, 2.0) and ours.max_scale == 3.0
    assert type(SurfAvgPool2d.from_pool(ours, reference_depth=1.0)) is SurfAvgPool2d


@each_kind
def test_repr(kind: Any) -> None:
    text = repr(kind(3, 2, 1, reference_depth=2.5, **MODES["limits"]))
    for part in (kind.__name__, "kernel_size=3", "stride=2", "padding=1", "reference_depth=2.5",
                 "max_scale=1.5"):  # fmt: skip
        assert part in text


@each_kind
def test_gradient_flows_to_depth(kind: Any) -> None:
    depth = depth_map(1, 8, 8).requires_grad_()
    out = kind(3, 2, 1, reference_depth=2.0)(torch.randn(1, 4, 8, 8), depth)
    (grad,) = torch.autograd.grad(out.square().sum(), depth)
    assert grad.isfinite().all() and grad.any()
    assert grad[~((depth > 0) & depth.isfinite())].eq(0).all()


CONSTRUCTION: dict[str, tuple[dict[str, Any], type[Exception], list[str]]] = {
    "reference": ({"reference_depth": 0.0}, ValueError, ["reference_depth", "0", "positive"]),
    "same level": ({"same_level_only": True}, ValueError, ["same_level_only", "levels"]),
    "window": ({"depth_window": -1.0}, ValueError, ["depth_window", "-1.0"]),
    "levels": ({"levels": [1.0]}, TypeError, ["levels", "list"]),
    "kernel": ({"kernel_size": 0}, ValueError, ["kernel_size", "0"]),
    "kernel type": ({"kernel_size": 2.0}, TypeError, ["kernel_size", "2.0"]),
    "stride": ({"stride": 0}, ValueError, ["stride", "0"]),
    "padding": ({"padding": -1}, ValueError, ["padding", "-1"]),
}


@each_kind
@pytest.mark.parametrize("case", CONSTRUCTION)
def test_construction(kind: Any, case: str) -> None:
    change, error, words = CONSTRUCTION[case]
    says(error, words, lambda: kind(**({"kernel_size": 3, "reference_depth": 1.0} | change)))


def test_numbers_that_numpy_computed() -> None:
    two, three = np.int64(2), np.int32(3)
    layer = SurfAvgPool2d(three, two, np.int8(1), divisor_override=two, reference_depth=2.0)
    x, depth = torch.randn(1, 3, 8, 9), torch.rand(1, 8, 9) + 1.0
    plain = SurfAvgPool2d(3, 2, 1, divisor_override=2, reference_depth=2.0)
    assert_same_bits(layer(x, depth), plain(x, depth))


def test_construction_of_one_kind() -> None:
    says(NotImplementedError, ["return_indices", "True"],
         lambda: SurfMaxPool2d(2, return_indices=True, reference_depth=1.0))  # fmt: skip
    says(NotImplementedError, ["return_indices"],
         lambda: SurfMaxPool2d.from_pool(nn.MaxPool2d(2, return_indices=True),
                                         reference_depth=1.0))  # fmt: skip
    says(ValueError, ["divisor_override", "0"],
         lambda: SurfAvgPool2d(2, divisor_override=0, reference_depth=1.0))  # fmt: skip
    says(TypeError, ["divisor_override", "1.5"],
         lambda: SurfAvgPool2d(2, divisor_override=1.5, reference_depth=1.0))  # fmt: skip
    says(ValueError, ["dilation", "0"],
         lambda: SurfMaxPool2d(2, dilation=0, reference_depth=1.0))  # fmt: skip


@each_kind
def test_from_pool_of_something_else(kind: Any) -> None:
    class Own(KINDS[kind]):  # type: ignore[misc]
        pass

    name = KINDS[kind].__name__
    says(TypeError, ["pool", f"nn.{name}", "Conv2d"],
         lambda: kind.from_pool(nn.Conv2d(1, 1, 1), reference_depth=1.0))  # fmt: skip
    says(TypeError, ["pool", f"nn.{name}", "Own"],
         lambda: kind.from_pool(Own(2), reference_depth=1.0))  # fmt: skip


X, SCALE = torch.randn(2, 3, 6, 7), torch.ones(2, 3, 3)
CALLS: dict[str, tuple[dict[str, Any], type[Exception], list[str]]] = {
    "padding": ({"padding": 2}, ValueError, ["padding", "half", "(1, 1)", "(2, 2)"]),
    "too small": ({"kernel_size": 9}, ValueError, ["input", "empty", "9"]),
    "scale shape": ({"scale": torch.ones(2, 3, 4)}, ValueError,
                    ["scale", "(2, 3, 3)", "(2, 3, 4)", "kernel_size"]),
    "scale dtype": ({"scale": SCALE.double()}, TypeError, ["scale", "float64", "float32"]),
    "scale type": ({"scale": 1.0}, TypeError, ["scale", "float"]),
    "input type": ({"input": [1.0]}, TypeError, ["input", "list"]),
    "input dtype": ({"input": X.int()}, TypeError, ["input", "int32"]),
    "input shape": ({"input": X[0, 0]}, ValueError, ["input", "(6, 7)"]),
    "no channels": ({"input": X[:, :0]}, ValueError, ["input", "channel"]),
    "guide shape": ({"guide": torch.ones(2, 6, 6)}, ValueError, ["guide", "(2, 6, 7)"]),
    "guide dtype": ({"guide": torch.ones(2, 6, 7).long()}, TypeError, ["guide", "int64"]),
    "tolerance": ({"guide_tolerance": -1.0}, ValueError, ["guide_tolerance", "-1.0"]),
    "kernel": ({"kernel_size": (1, 2, 3)}, ValueError, ["kernel_size", "3 values"]),
}  # fmt: skip


@pytest.mark.parametrize("function", [surf_max_pool2d, surf_avg_pool2d])
@pytest.mark.parametrize("case", CALLS)
def test_calls(function: Any, case: str) -> None:
    change, error, words = CALLS[case]
    arguments = {"input": X, "kernel_size": 2, "scale": SCALE} | change
    says(error, words, lambda: function(**arguments))


@each_kind
def test_depth_is_missing_or_wrong(kind: Any) -> None:
    pool = kind(2, reference_depth=1.0)
    says(ValueError, ["depth", kind.__name__, "None"], lambda: pool(X))
    says(ValueError, ["depth", "(2, 6, 7)", "(2, 3, 3)"], lambda: pool(X, torch.ones(2, 3, 3)))
    says(TypeError, ["depth", "int64", "metres"],
         lambda: pool(X, torch.ones(2, 6, 7).long()))  # fmt: skip
