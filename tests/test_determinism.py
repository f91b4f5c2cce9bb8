"""The same inputs give the same bits: every run, every thread count, every kind of memory."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from helpers import DTYPES, Problem, assert_same_bits, make_problem
from operators import name_of
from surfconv_ops import surf_conv2d

CASES: list[dict[str, Any]] = [
    {"channels": 7, "out_channels": 9, "size": (31, 37)},
    {"channels": 40, "out_channels": 33, "size": (19, 45), "stride": 2},
    {"channels": 24, "out_channels": 24, "size": (33, 40), "groups": 24},
    {"channels": 12, "out_channels": 18, "size": (40, 21), "groups": 3, "kernel": (2, 5)},
    {"batch": 5, "channels": 3, "out_channels": 4, "size": (11, 90), "axes": 2, "guide": "levels"},
    {"channels": 16, "out_channels": 16, "size": (64, 80), "kernel": 5, "padding": 2},
]
# Fewer tiles than threads, whose outputs are shared among them.
SMALL_MAPS: list[dict[str, Any]] = [
    {"channels": 72, "out_channels": 201, "size": (5, 7)},
    {"channels": 64, "out_channels": 128, "size": (8, 9), "guide": "depth", "guide_tolerance": 1.0},
    {"channels": 96, "out_channels": 150, "size": (7, 7), "groups": 3},
    {"channels": 130, "out_channels": 202, "size": (7, 7), "kernel": 1, "padding": 0},
    {"channels": 128, "out_channels": 256, "size": (4, 12), "kernel": 1, "padding": 0},
    {"channels": 120, "out_channels": 165, "size": (5, 7), "groups": 3, "kernel": 1, "padding": 0},
]


def results(problem: Problem, grad: Tensor, threads: int) -> dict[str, Tensor]:
    torch.set_num_threads(threads)
    return problem.gradients(surf_conv2d, grad) | {"output": problem.run(surf_conv2d)}


@pytest.mark.parametrize("case", CASES + SMALL_MAPS, ids=name_of)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_threads_and_runs(case: dict[str, Any], layout: str, dtype: torch.dtype) -> None:
    problem = make_problem(**({"scale": "smooth", "layout": layout, "dtype": dtype} | case))
    grad = torch.randn(problem.output_shape()).to(dtype)
    first = results(problem, grad, 1)
    for threads in (1, 2, 3, 7):
        for name, value in results(problem, grad, threads).items():
            assert_same_bits(value, first[name], f"{name}, {threads} threads")


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_many_runs(layout: str) -> None:
    """A race would show sooner or later."""
    problem = make_problem(2, 20, 20, (24, 25), layout=layout, scale="mixed", guide="depth",
                           guide_tolerance=1.0)  # fmt: skip
    grad = torch.randn(problem.output_shape())
    first = results(problem, grad, 1)
    for _ in range(25):
        for name, value in results(problem, grad, 2).items():
            assert_same_bits(value, first[name], name)


@pytest.mark.parametrize("offset", [1, 2, 3, 5])
def test_alignment(offset: int) -> None:
    """Where an allocation happens to start must not choose another order of summation."""
    problem = make_problem(1, 19, 21, (13, 17))
    grad = torch.randn(problem.output_shape())
    first = results(problem, grad, 1)

    def moved(tensor: Tensor) -> Tensor:
        room = torch.empty(tensor.numel() + offset, dtype=tensor.dtype)[offset:]
        return room.copy_(tensor.flatten()).view(tensor.shape)

    assert problem.bias is not None
    shifted = Problem(
        moved(problem.input), moved(problem.weight), moved(problem.bias), moved(problem.scale),
        padding=1,
    )  # fmt: skip
    for name, value in results(shifted, moved(grad), 1).items():
        assert_same_bits(value, first[name], name)


def test_threads_are_honoured(set_threads: Any, compiled: None) -> None:
    """One thread uses one core: its processor time is not more than its wall time."""
    import time

    problem = make_problem(1, 64, 64, (60, 80), scale="smooth")
    set_threads(1)
    problem.run(surf_conv2d)
    wall, processor = time.perf_counter(), time.process_time()
    for _ in range(10):
        problem.run(surf_conv2d)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    assert processor < 1.2 * wall + 0.02
