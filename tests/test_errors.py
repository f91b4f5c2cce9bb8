"""Wrong arguments of the functions: each message names the argument, what came, what was due."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from operators import OPERATORS
from surfconv_ops import DepthLevels, at_output_centers, depth_to_scale

pytestmark = pytest.mark.core


def good() -> dict[str, Any]:
    return {
        "input": torch.randn(2, 4, 6, 7),
        "weight": torch.randn(6, 4, 3, 3),
        "bias": torch.randn(6),
        "scale": torch.ones(2, 6, 7),
        "guide": torch.ones(2, 6, 7),
        "padding": 1,
    }


def says(error: type[Exception], words: list[str], call: Callable[[], Any]) -> None:
    with pytest.raises(error) as caught:
        call()
    message = str(caught.value)
    assert message.startswith((words[0] + ":", words[0] + "[")), message
    for word in words:
        assert word in message, f"{word!r} is not in: {message}"


def random(*shape: int) -> Tensor:
    return torch.randn(*shape)


CASES: dict[str, tuple[dict[str, Any], type[Exception], list[str]]] = {
    "input rank": ({"input": random(2, 3)}, ValueError, ["input", "(N, C, H, W)", "(2, 3)"]),
    "input rank 5": ({"input": random(1, 2, 4, 6, 7)}, ValueError, ["input", "(1, 2, 4, 6, 7)"]),
    "input type": ({"input": [1.0]}, TypeError, ["input", "list", "tensor"]),
    "input dtype": (
        {"input": torch.ones(2, 4, 6, 7, dtype=torch.int64)}, TypeError,
        ["input", "torch.int64", "torch.float32"],
    ),
    "input complex": (
        {"input": torch.ones(2, 4, 6, 7, dtype=torch.complex64)}, TypeError,
        ["input", "torch.complex64"],
    ),
    "weight rank": ({"weight": random(6, 4, 3)}, ValueError, ["weight", "kH, kW", "(6, 4, 3)"]),
    "weight type": ({"weight": None}, TypeError, ["weight", "NoneType", "tensor"]),
    "weight dtype": (
        {"weight": random(6, 4, 3, 3).double()}, TypeError,
        ["weight", "torch.float64", "torch.float32"],
    ),
    "weight device": (
        {"weight": torch.empty(6, 4, 3, 3, device="meta")}, ValueError, ["weight", "meta", "cpu"],
    ),
    "weight channels": (
        {"weight": random(6, 3, 3, 3)}, ValueError,
        ["weight", "4", "3", "groups=1", "(6, 3, 3, 3)"],
    ),
    "input groups": (
        {"groups": 3, "weight": random(6, 1, 3, 3)}, ValueError,
        ["input", "groups=3", "4", "divisible"],
    ),
    "weight groups": (
        {"groups": 4, "weight": random(6, 1, 3, 3)}, ValueError,
        ["weight", "groups=4", "6", "divisible"],
    ),
    "groups zero": ({"groups": 0}, ValueError, ["groups", "0", "1"]),
    "groups negative": ({"groups": -2}, ValueError, ["groups", "-2", "1"]),
    "groups type": ({"groups": 1.5}, TypeError, ["groups", "1.5", "integer"]),
    "weight empty kernel": ({"weight": random(6, 4, 0, 3)}, ValueError, ["weight", "0", "1"]),
    "no output channels": ({"weight": random(0, 4, 3, 3), "bias": None}, ValueError,
                           ["weight", "0", "positive"]),
    "bias length": ({"bias": random(5)}, ValueError, ["bias", "(6,)", "(5,)"]),
    "bias rank": ({"bias": random(6, 1)}, ValueError, ["bias", "(6,)", "(6, 1)"]),
    "bias dtype": ({"bias": random(6).half()}, TypeError, ["bias", "float16", "float32"]),
    "bias device": ({"bias": torch.empty(6, device="meta")}, ValueError, ["bias", "meta", "cpu"]),
    "scale type": ({"scale": 1.0}, TypeError, ["scale", "float", "tensor"]),
    "scale dtype": ({"scale": torch.ones(2, 6, 7).double()}, TypeError,
                    ["scale", "float64", "float32"]),
    "scale integer": ({"scale": torch.ones(2, 6, 7).long()}, TypeError, ["scale", "int64"]),
    "scale device": ({"scale": torch.ones(2, 6, 7, device="meta")}, ValueError,
                     ["scale", "meta", "cpu"]),
    "scale at stride": (
        {"stride": 2}, ValueError, ["scale", "(2, 3, 4)", "(2, 2, 3, 4)", "(2, 6, 7)", "// 2"],
    ),
    "scale channels": ({"scale": random(2, 3, 6, 7)}, ValueError,
                       ["scale", "(2, 1, 6, 7)", "(2, 2, 6, 7)", "(2, 3, 6, 7)"]),
    "scale batch": ({"scale": random(1, 6, 7)}, ValueError, ["scale", "(2, 6, 7)", "(1, 6, 7)"]),
    "scale rank": ({"scale": random(6, 7)}, ValueError, ["scale", "(2, 6, 7)", "(6, 7)"]),
    "scale with N for input without": (
        {"input": random(4, 6, 7), "guide": None, "scale": random(3, 6, 7)}, ValueError,
        ["scale", "(6, 7)", "(3, 6, 7)"],
    ),
    "guide shape": ({"guide": random(2, 5, 7)}, ValueError, ["guide", "(2, 6, 7)", "(2, 5, 7)"]),
    "guide rank": ({"guide": random(2, 1, 6, 7)}, ValueError,
                   ["guide", "(2, 6, 7)", "(2, 1, 6, 7)"]),
    "guide dtype": ({"guide": torch.ones(2, 6, 7).long()}, TypeError, ["guide", "int64"]),
    "guide device": ({"guide": torch.ones(2, 6, 7, device="meta")}, ValueError,
                     ["guide", "meta", "cpu"]),
    "guide_tolerance negative": ({"guide_tolerance": -0.5}, ValueError,
                                 ["guide_tolerance", "-0.5"]),
    "guide_tolerance NaN": ({"guide_tolerance": float("nan")}, ValueError,
                            ["guide_tolerance", "NaN"]),
    "stride zero": ({"stride": 0}, ValueError, ["stride", "0", "at least 1"]),
    "stride negative": ({"stride": (1, -1)}, ValueError, ["stride", "-1", "at least 1"]),
    "stride three": ({"stride": (1, 1, 1)}, ValueError, ["stride", "3 values"]),
    "stride type": ({"stride": 1.0}, TypeError, ["stride", "1.0", "integer"]),
    "dilation zero": ({"dilation": 0}, ValueError, ["dilation", "0", "at least 1"]),
    "dilation negative": ({"dilation": (-3, 1)}, ValueError, ["dilation", "-3"]),
    "padding negative": ({"padding": -1}, ValueError, ["padding", "-1", "at least 0"]),
    "padding pair negative": ({"padding": (0, -4)}, ValueError, ["padding", "-4"]),
    "padding word": ({"padding": "full"}, ValueError, ["padding", "full", "same", "valid"]),
    "padding same with stride": ({"padding": "same", "stride": 2}, ValueError,
                                 ["padding", "same", "stride"]),
    "empty output": ({"padding": 0, "weight": random(6, 4, 9, 3)}, ValueError,
                     ["input", "6 x 7", "9 x 3", "empty"]),
    "empty output by dilation": ({"dilation": 5}, ValueError, ["input", "dilation", "empty"]),
    "empty image": ({"input": random(2, 4, 0, 7)}, ValueError, ["input", "0 x 7"]),
}  # fmt: skip


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("case", CASES)
def test_surf_conv2d(operator: str, case: str) -> None:
    change, error, words = CASES[case]
    says(error, words, lambda: OPERATORS[operator](**(good() | change)))


@pytest.mark.parametrize("operator", OPERATORS)
def test_the_good_arguments_are_good(operator: str) -> None:
    assert OPERATORS[operator](**good()).shape == (2, 6, 6, 7)


@pytest.mark.parametrize("operator", OPERATORS)
def test_scale_is_a_required_keyword(operator: str) -> None:
    with pytest.raises(TypeError, match="scale"):
        OPERATORS[operator](torch.randn(1, 1, 3, 3), torch.randn(1, 1, 1, 1))
    with pytest.raises(TypeError):
        OPERATORS[operator](
            torch.randn(1, 1, 3, 3), torch.randn(1, 1, 1, 1), None, torch.ones(1, 3, 3)
        )


DEPTH_CASES: dict[str, tuple[Any, Any, dict[str, Any], type[Exception], list[str]]] = {
    "integer depth": (torch.ones(3, 3, dtype=torch.int32), 1.0, {}, TypeError,
                      ["depth", "int32", ".float()", "1000"]),
    "uint16 depth": (torch.ones(3, 3, dtype=torch.uint16), 1.0, {}, TypeError,
                     ["depth", "uint16", ".float()"]),
    "depth type": ([[1.0]], 1.0, {}, TypeError, ["depth", "list"]),
    "zero reference": (torch.ones(3, 3), 0.0, {}, ValueError, ["reference_depth", "0", "positive"]),
    "negative reference": (torch.ones(3, 3), -2.0, {}, ValueError, ["reference_depth", "-2"]),
    "infinite reference": (torch.ones(3, 3), float("inf"), {}, ValueError,
                           ["reference_depth", "inf", "finite"]),
    "NaN reference": (torch.ones(3, 3), float("nan"), {}, ValueError, ["reference_depth", "NaN"]),
    "half a pair": (torch.ones(3, 3), (1.0, -1.0), {}, ValueError, ["reference_depth", "-1"]),
    "reference of three": (torch.ones(3, 3), (1.0, 1.0, 1.0), {}, ValueError,
                           ["reference_depth", "3 values"]),
    "reference type": (torch.ones(3, 3), "far", {}, TypeError, ["reference_depth", "far"]),
    "levels type": (torch.ones(3, 3), 1.0, {"levels": [1.0]}, TypeError, ["levels", "list"]),
    "invalid_scale": (torch.ones(3, 3), 1.0, {"invalid_scale": float("nan")}, ValueError,
                      ["invalid_scale", "NaN"]),
    "min over max": (torch.ones(3, 3), 1.0, {"min_scale": 2.0, "max_scale": 1.0}, ValueError,
                     ["max_scale", "2.0", "1.0"]),
    "min negative": (torch.ones(3, 3), 1.0, {"min_scale": -1.0}, ValueError, ["min_scale", "-1"]),
}  # fmt: skip


@pytest.mark.parametrize("case", DEPTH_CASES)
def test_depth_to_scale(case: str) -> None:
    depth, reference, options, error, words = DEPTH_CASES[case]
    says(error, words, lambda: depth_to_scale(depth, reference, **options))


CENTER_CASES: dict[str, tuple[tuple[Any, ...], type[Exception], list[str]]] = {
    "rank": ((torch.ones(3), 3), ValueError, ["map", "(3,)"]),
    "type": (([1.0], 3), TypeError, ["map", "list"]),
    "kernel": ((torch.ones(1, 3, 3), 0), ValueError, ["kernel_size", "0"]),
    "stride": ((torch.ones(1, 3, 3), 3, 0), ValueError, ["stride", "0"]),
    "padding": ((torch.ones(1, 3, 3), 3, 1, -1), ValueError, ["padding", "-1"]),
    "dilation": ((torch.ones(1, 3, 3), 3, 1, 1, 0), ValueError, ["dilation", "0"]),
    "empty": ((torch.ones(1, 3, 3), 5), ValueError, ["map", "3 x 3", "5 x 5", "empty"]),
}


@pytest.mark.parametrize("case", CENTER_CASES)
def test_at_output_centers(case: str) -> None:
    arguments, error, words = CENTER_CASES[case]
    says(error, words, lambda: at_output_centers(*arguments))


LEVEL_CASES: dict[str, tuple[tuple[Any, ...], type[Exception], list[str]]] = {
    "unsorted edges": (
        ([2.0, 1.0], [0.5, 1.5, 3.0]),
        ValueError,
        ["edges", "2.0", "1.0", "ascending"],
    ),
    "equal edges": (([1.0, 1.0], [0.5, 1.5, 3.0]), ValueError, ["edges", "ascending"]),
    "unsorted centers": (([1.0], [3.0, 0.5]), ValueError, ["centers", "3.0", "0.5", "ascending"]),
    "counts": (([1.0, 2.0], [0.5, 1.5]), ValueError, ["edges", "1", "2"]),
    "no centers": (([], []), ValueError, ["centers", "at least one"]),
    "zero edge": (([0.0], [0.5, 1.5]), ValueError, ["edges", "0"]),
    "negative center": (([1.0], [-0.5, 1.5]), ValueError, ["centers", "-0.5"]),
    "NaN edge": (([float("nan")], [0.5, 1.5]), ValueError, ["edges", "NaN"]),
    "infinite center": (([1.0], [0.5, float("inf")]), ValueError, ["centers", "inf"]),
    "edges type": ((3.0, [1.0, 4.0]), TypeError, ["edges", "3.0"]),
}


@pytest.mark.parametrize("case", LEVEL_CASES)
def test_levels(case: str) -> None:
    arguments, error, words = LEVEL_CASES[case]
    says(error, words, lambda: DepthLevels(*arguments))


def test_levels_of_integer_depth() -> None:
    levels = DepthLevels([1.0], [0.5, 2.0])
    for call in (levels.assign, levels.quantize):
        says(TypeError, ["depth", "int16", ".float()"],
             lambda call=call: call(torch.ones(2, 2, dtype=torch.int16)))  # fmt: skip
