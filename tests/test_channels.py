"""Channel counts that leave vector tails, and shapes of several tiles, threads and blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from helpers import DTYPES, RMS_TOLERANCE, Problem, make_problem
from operators import name_of
from surfconv_ops import reference, surf_conv2d

CHANNELS = [1, 3, 5, 17, 33, 70]


@pytest.mark.core
@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("out_channels", CHANNELS)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_odd_channels(channels: int, out_channels: int, layout: str) -> None:
    problem = make_problem(1, channels, out_channels, (4, 9), layout=layout)
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("dtype", DTYPES[1:], ids=str)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_odd_channels_of_other_types(channels: int, dtype: torch.dtype, layout: str) -> None:
    problem = make_problem(1, channels, 19, (5, 6), dtype=dtype, layout=layout)
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.core
@pytest.mark.parametrize("groups", [3, 7, 17, 64])
@pytest.mark.parametrize("per_group", [(1, 1), (1, 2), (2, 1), (5, 3)])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_groups(groups: int, per_group: tuple[int, int], layout: str) -> None:
    channels, out_channels = groups * per_group[0], groups * per_group[1]
    problem = make_problem(1, channels, out_channels, (4, 5), groups=groups, layout=layout)
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.core
@pytest.mark.parametrize("width", [1, 2, 7, 8, 9, 15, 16, 17, 31, 33, 63, 65])
@pytest.mark.parametrize("stride", [1, 2])
def test_widths_that_leave_part_of_a_tile(width: int, stride: int) -> None:
    problem = make_problem(2, 2, 3, (3, width), stride=stride, guide="levels")
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


LARGER: list[dict[str, Any]] = [
    {"batch": 2, "channels": 70, "out_channels": 45, "size": (37, 53)},
    {"batch": 1, "channels": 130, "out_channels": 130, "size": (20, 24)},
    {"batch": 3, "channels": 64, "out_channels": 64, "size": (30, 40), "stride": 2},
    {"batch": 1, "channels": 96, "out_channels": 96, "size": (40, 41), "groups": 96},
    {"batch": 1, "channels": 48, "out_channels": 96, "size": (33, 29), "groups": 3},
    {"batch": 1, "channels": 3, "out_channels": 200, "size": (64, 64), "kernel": 7, "padding": 3},
    {"batch": 1, "channels": 300, "out_channels": 3, "size": (24, 31), "kernel": 1, "padding": 0},
    {"batch": 17, "channels": 9, "out_channels": 10, "size": (11, 13)},
    {"batch": 1, "channels": 16, "out_channels": 16, "size": (120, 160)},
    {"batch": 1, "channels": 520, "out_channels": 20, "size": (9, 10)},
]


def sums_of_terms(exact: Problem) -> dict[str, torch.Tensor]:
    """The sum of absolute terms of each result: terms are products, so the operator sums them."""
    tensors = {name: getattr(exact, name).abs() for name in ("input", "weight", "bias")}
    sizes = replace(exact, **tensors)
    grad = torch.ones(exact.output_shape(), dtype=torch.float64)
    sums = sizes.gradients(reference.surf_conv2d, grad)
    return sums | {"output": sizes.run(reference.surf_conv2d)}


@pytest.mark.parametrize("case", LARGER, ids=name_of)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_larger(case: dict[str, Any], layout: str, dtype: torch.dtype) -> None:
    problem = make_problem(**({"scale": "smooth", "layout": layout, "dtype": dtype} | case))
    # Off the grid of round numbers, so that rounding moves no sample across a kink.
    problem.scale.add_(0.00123)
    exact = problem.to(torch.float64)
    grad = torch.randint(0, 2, problem.output_shape()).double() * 2 - 1
    expected = exact.gradients(reference.surf_conv2d, grad)
    expected["output"] = exact.run(reference.surf_conv2d)
    actual = problem.gradients(surf_conv2d, grad.to(dtype))
    actual["output"] = problem.run(surf_conv2d)
    sums = sums_of_terms(exact)
    for name, value in actual.items():
        error = (value.double() - expected[name]).abs()
        if not expected[name].any():
            assert not value.any(), name
            continue
        rms = (error.square().mean() / expected[name].square().mean()).sqrt()
        if value.dtype in RMS_TOLERANCE:
            assert rms < RMS_TOLERANCE[value.dtype], name
        elif name == "scale":
            # Slopes have signs, so no sum of magnitudes bounds them; their RMS does.
            assert rms < 1e-5, name
        else:
            # A position is off by an ulp of its offset: it sees a little of the next pixel.
            assert (error <= 2e-6 * sums[name] + 1e-6 * sums[name].mean()).all(), name


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("case", LARGER[:4], ids=name_of)
def test_larger_in_double(case: dict[str, Any], threads: int) -> None:
    torch.set_num_threads(threads)
    problem = make_problem(**(case | {"batch": 1, "dtype": torch.float64, "guide": "depth"}),
                           guide_tolerance=1.0)  # fmt: skip
    torch.testing.assert_close(
        problem.run(surf_conv2d), problem.run(reference.surf_conv2d), rtol=1e-11, atol=1e-11
    )
    grad = torch.randn(problem.output_shape(), dtype=torch.float64)
    expected = problem.gradients(reference.surf_conv2d, grad)
    for name, value in problem.gradients(surf_conv2d, grad).items():
        torch.testing.assert_close(value, expected[name], rtol=1e-9, atol=1e-9)
