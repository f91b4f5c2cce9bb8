"""Wrong arguments of SurfConv2d: each message names the argument, what came, what was due."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from surfconv_ops import DepthLevels, SurfConv2d
from test_errors import says

LEVELS = DepthLevels([2.0], [1.0, 3.0])
NAN, INF = float("nan"), float("inf")

CONSTRUCTION: dict[str, tuple[dict[str, Any], type[Exception], list[str]]] = {
    "padding mode": ({"padding_mode": "reflect"}, NotImplementedError,
                     ["padding_mode", "reflect", "zeros"]),
    "zero reference": ({"reference_depth": 0.0}, ValueError, ["reference_depth", "0", "positive"]),
    "negative reference": ({"reference_depth": -1.0}, ValueError, ["reference_depth", "-1"]),
    "NaN reference": ({"reference_depth": NAN}, ValueError, ["reference_depth", "NaN"]),
    "infinite reference": ({"reference_depth": INF}, ValueError, ["reference_depth", "inf"]),
    "pair of reference": ({"reference_depth": (1.0, 0.0)}, ValueError, ["reference_depth", "0"]),
    "same level without levels": ({"same_level_only": True}, ValueError,
                                  ["same_level_only", "levels"]),
    "window with levels": ({"levels": LEVELS, "depth_window": 1.0}, ValueError,
                           ["depth_window", "levels", "1.0"]),
    "negative window": ({"depth_window": -0.5}, ValueError, ["depth_window", "-0.5"]),
    "NaN window": ({"depth_window": NAN}, ValueError, ["depth_window", "NaN"]),
    "levels type": ({"levels": [1.0, 2.0]}, TypeError, ["levels", "list", "DepthLevels"]),
    "limits": ({"min_scale": 2.0, "max_scale": 1.0}, ValueError, ["max_scale", "1.0", "2.0"]),
    "NaN limit": ({"max_scale": NAN}, ValueError, ["max_scale", "NaN"]),
    "invalid_scale": ({"invalid_scale": INF}, ValueError, ["invalid_scale", "inf", "finite"]),
    "kernel": ({"kernel_size": 0}, ValueError, ["kernel_size", "0"]),
    "stride": ({"stride": 0}, ValueError, ["stride", "0"]),
    "dilation": ({"dilation": -1}, ValueError, ["dilation", "-1"]),
    "padding": ({"padding": -2}, ValueError, ["padding", "-2"]),
}  # fmt: skip


@pytest.mark.parametrize("case", CONSTRUCTION)
def test_construction(case: str) -> None:
    change, error, words = CONSTRUCTION[case]
    arguments = {"in_channels": 2, "out_channels": 3, "kernel_size": 3, "reference_depth": 1.0}
    says(error, words, lambda: SurfConv2d(**(arguments | change)))


@pytest.mark.parametrize("case", [c for c in CONSTRUCTION if "reference" in c or "window" in c])
def test_from_conv2d(case: str) -> None:
    change, error, words = CONSTRUCTION[case]
    plain = nn.Conv2d(2, 3, 3)
    says(error, words, lambda: SurfConv2d.from_conv2d(plain, **({"reference_depth": 1.0} | change)))


def test_from_conv2d_of_another_padding_mode() -> None:
    plain = nn.Conv2d(2, 3, 3, padding=1, padding_mode="circular")
    says(NotImplementedError, ["padding_mode", "circular", "zeros"],
         lambda: SurfConv2d.from_conv2d(plain, reference_depth=1.0))  # fmt: skip


def test_from_conv2d_of_something_else() -> None:
    says(TypeError, ["conv", "Linear", "Conv2d"],
         lambda: SurfConv2d.from_conv2d(nn.Linear(2, 3), reference_depth=1.0))  # fmt: skip


@pytest.mark.parametrize("name", ["radius", "focal_length"])
@pytest.mark.parametrize("bad", [0.0, -1.0, NAN, INF, (1.0, -1.0)])
def test_from_radius(name: str, bad: Any) -> None:
    arguments: dict[str, Any] = {"radius": 0.1, "focal_length": 500.0} | {name: bad}
    says(ValueError, [name], lambda: SurfConv2d.from_radius(2, 3, 3, **arguments))


def test_reference_depth_is_required() -> None:
    with pytest.raises(TypeError, match="reference_depth"):
        SurfConv2d(2, 3, 3)  # type: ignore[call-arg]


X, DEPTH = torch.ones(2, 2, 6, 7), torch.ones(2, 6, 7)
CALLS: dict[str, tuple[tuple[Any, ...], type[Exception], list[str]]] = {
    "no depth": ((X,), ValueError, ["depth", "None"]),
    "depth type": ((X, 2.0), TypeError, ["depth", "float", "tensor"]),
    "integer depth": ((X, DEPTH.int()), TypeError, ["depth", "int32", ".float()"]),
    "depth of the output's size": ((X, DEPTH[:, 1:-1, 1:-1]), ValueError,
                                   ["depth", "(2, 6, 7)", "(2, 4, 5)"]),
    "depth of half the size": ((X, DEPTH[:, ::2, ::2]), ValueError, ["depth", "(2, 6, 7)"]),
    "depth channels": ((X, torch.ones(2, 3, 6, 7)), ValueError,
                       ["depth", "(2, 1, 6, 7)", "(2, 3, 6, 7)"]),
    "depth batch": ((X, DEPTH[:1]), ValueError, ["depth", "(2, 6, 7)", "(1, 6, 7)"]),
    "depth rank": ((X, DEPTH[0]), ValueError, ["depth", "(2, 6, 7)", "(6, 7)"]),
    "unbatched depth": ((X[0], DEPTH), ValueError, ["depth", "(6, 7)", "(2, 6, 7)"]),
    "depth device": ((X, DEPTH.to("meta")), ValueError, ["depth", "meta", "cpu"]),
    "input rank": ((X[0, 0], DEPTH[0]), ValueError, ["input", "(6, 7)", "(N, C, H, W)"]),
    "input channels": ((X[:, :1], DEPTH), ValueError, ["weight", "1", "2"]),
    "input dtype": ((X.double(), DEPTH), TypeError, ["weight", "float32", "float64"]),
    "small image": ((X[..., :2], DEPTH[..., :2]), ValueError, ["input", "6 x 2", "3 x 3", "empty"]),
}  # fmt: skip


@pytest.mark.parametrize("case", CALLS)
def test_calls(case: str) -> None:
    arguments, error, words = CALLS[case]
    conv = SurfConv2d(2, 3, 3, reference_depth=1.0)
    says(error, words, lambda: conv(*arguments))
