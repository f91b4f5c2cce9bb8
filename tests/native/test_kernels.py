"""The torch-free kernels of csrc/cpu/ against the oracle, for each instruction set."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from native_operator import INSTRUCTION_SETS, NativeOperator

from helpers import (
    DTYPES,
    GRADIENTS,
    GUIDES,
    SCALES,
    assert_matches,
    assert_same_bits,
    assert_scale_gradient,
    make_problem,
)
from operators import GEOMETRIES, name_of

pytestmark = pytest.mark.core

# Around the widths of vectors and register blocks, where tails begin.
CHANNELS = [(1, 1), (4, 7), (8, 16), (17, 33), (31, 70)]


@pytest.mark.parametrize("case", GEOMETRIES, ids=name_of)
def test_geometry(native: NativeOperator, case: dict[str, Any]) -> None:
    problem = make_problem(**case)
    problem.check_forward(native)
    problem.check_gradients(native)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("channels", CHANNELS, ids=str)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last", "sliced"])
def test_channels(
    native: NativeOperator, dtype: torch.dtype, channels: tuple[int, int], layout: str
) -> None:
    problem = make_problem(1, *channels, size=(4, 9), dtype=dtype, layout=layout)
    problem.check_forward(native)
    problem.check_gradients(native)


@pytest.mark.parametrize("channels", [1, 7, 24])
@pytest.mark.parametrize("multiplier", [1, 3])
def test_depthwise(native: NativeOperator, channels: int, multiplier: int) -> None:
    problem = make_problem(1, channels, channels * multiplier, size=(4, 9), groups=channels)
    problem.check_forward(native)
    problem.check_gradients(native)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_scale(native: NativeOperator, scale: str, axes: int, dtype: torch.dtype) -> None:
    problem = make_problem(scale=scale, axes=axes, dtype=dtype)
    problem.check_forward(native)
    problem.check_gradients(native)


@pytest.mark.parametrize("guide", GUIDES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_guide(native: NativeOperator, guide: str, dtype: torch.dtype) -> None:
    problem = make_problem(guide=guide, guide_tolerance=0.7, dtype=dtype)
    problem.check_forward(native)
    problem.check_gradients(native)


def test_more_than_one_tile(native: NativeOperator) -> None:
    problem = make_problem(1, 3, 5, size=(17, 41), scale="smooth")
    problem.check_forward(native)
    problem.check_gradients(native)


@pytest.mark.parametrize("pixel", [torch.nan, torch.inf])
def test_unseen_pixels_do_not_leak(native: NativeOperator, pixel: float) -> None:
    problem = make_problem(scale="zero", kernel=3, padding=1)
    clean = problem.run(native)
    problem.input[..., -1, -1] = pixel
    spoilt = problem.run(native)
    assert not torch.isfinite(spoilt[..., -1, -1]).any()
    assert_same_bits(spoilt[..., :-1, :], clean[..., :-1, :])
    assert_same_bits(spoilt[..., :-1], clean[..., :-1])


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("groups", [1, 4])
@pytest.mark.parametrize("threads", [2, 3, 7])
@pytest.mark.parametrize("in_turn", [False, True])
def test_same_bits_for_any_number_and_order_of_workers(
    native: NativeOperator, layout: str, groups: int, threads: int, in_turn: bool
) -> None:
    problem = make_problem(2, 8, 12, size=(33, 40), groups=groups, layout=layout, guide="holes")
    grad = torch.randn(problem.output_shape())
    other = replace(native, threads=threads, in_turn=in_turn)
    assert_same_bits(problem.run(other), problem.run(native))
    expected = problem.gradients(native, grad)
    for name, value in problem.gradients(other, grad).items():
        assert_same_bits(value, expected[name], name)


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("channels", [(8, 12), (70, 130), (12, 256)])
def test_same_bits_however_many_tiles_are_multiplied_at_once(
    native: NativeOperator, layout: str, channels: tuple[int, int]
) -> None:
    problem = make_problem(2, *channels, size=(17, 21), layout=layout)
    grad = torch.randn(problem.output_shape())
    one = replace(native, cache=0)
    assert_same_bits(problem.run(native), problem.run(one))
    expected = problem.gradients(one, grad)
    for name, value in problem.gradients(native, grad).items():
        assert_same_bits(value, expected[name], name)
    problem.check_gradients(native)


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("guide", ["none", "holes"])
@pytest.mark.parametrize("size", [(7, 7), (14, 13), (13, 30)])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("threads", [1, 3])
def test_several_tiles_at_once(
    native: NativeOperator,
    batch: int,
    guide: str,
    size: tuple[int, int],
    layout: str,
    threads: int,
) -> None:
    problem = make_problem(
        batch, 66, 43, size=size, kernel=5, padding=2, guide=guide, layout=layout
    )
    other = replace(native, threads=threads)
    problem.check_forward(other)
    problem.check_gradients(other)


@pytest.mark.parametrize("name", GRADIENTS)
def test_each_gradient_alone(native: NativeOperator, name: str) -> None:
    problem = make_problem()
    grad = torch.randn(problem.output_shape())
    expected = problem.expected_gradients(grad)
    leaf = getattr(problem, name).clone().requires_grad_()
    (actual,) = torch.autograd.grad(replace(problem, **{name: leaf}).run(native), leaf, grad)
    if name == "scale":
        assert_scale_gradient(actual, expected)
    else:
        assert_matches(actual, getattr(expected, name), name)


def test_instruction_sets_are_listed_weakest_first(kernels: ModuleType) -> None:
    names = kernels.names()
    assert tuple(names) == INSTRUCTION_SETS[: len(names)]


@pytest.mark.parametrize("wish", [*INSTRUCTION_SETS, "nonesuch", None])
def test_environment_chooses_among_what_runs(kernels: ModuleType, wish: str | None) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "ATEN_CPU_CAPABILITY"}
    if wish is not None:
        environment["ATEN_CPU_CAPABILITY"] = wish
    script = "import build_kernels; print(build_kernels.load().active())"
    folder = Path(__file__).parent
    active = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert active.returncode == 0, active.stderr
    names = kernels.names()
    assert active.stdout.strip() == (wish if wish in names else names[-1])
