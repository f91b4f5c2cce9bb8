"""Pools at scale 1 are nn's."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch

import oracle_pools
from helpers import DTYPES, assert_same_bits
from pools import CASES, MAXIMA, Problem, make

pytestmark = pytest.mark.core
both_counts = pytest.mark.parametrize("count_include_pad", [True, False])

NN = [
    {"kernel": k, "stride": s, "padding": p, "ceil_mode": c, "dilation": d}
    for k, s, p, c, d in itertools.product(
        [1, 2, 3, (2, 3), (4, 1), 5], [None, 1, 2, (3, 2)], [0, 1, 2], [False, True], [1, 2]
    )
    if p <= min(k if isinstance(k, tuple) else (k, k)) // 2
]


def at_scale_one(mode: str, case: dict[str, Any], **others: Any) -> Problem | None:
    """None where nn has no such pool: the dilated kernel does not fit."""
    kernel, ceil = case["kernel"], case.get("ceil_mode", False)
    kernel = kernel if isinstance(kernel, tuple) else (kernel, kernel)
    spans = [case.get("dilation", 1) * (k - 1) + 1 for k in kernel]
    if any(span > size + 2 * case["padding"] for span, size in zip(spans, (7, 8), strict=True)):
        assert not ceil or case["dilation"] > 1
        return None
    return make(mode, scale="ones", **(case | others))


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_maximum_at_scale_one_is_nn(layout: str, dtype: torch.dtype) -> None:
    compared = 0
    for case in NN:
        problem = at_scale_one("max", case, channels=8, layout=layout, dtype=dtype)
        if problem is None or problem.run_nn().isinf().any():
            continue
        compared += 1
        problem.input.copy_((problem.input * 2).round())  # ties
        x = problem.input.requires_grad_()
        ours, theirs = problem.run(), problem.run_nn()
        assert_same_bits(ours, theirs, str(case))
        grad = torch.randn_like(ours)
        values = [torch.autograd.grad(out, x, grad)[0] for out in (ours, theirs)]
        # nn adds float16 gradients in float16; ours round once.
        loose = dtype in (torch.bfloat16, torch.float16)
        torch.testing.assert_close(*values, rtol=4e-2 if loose else 1e-6,
                                   atol=4e-2 if loose else 1e-6)  # fmt: skip
    assert compared > 100


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@both_counts
@pytest.mark.parametrize("divisor", [None, 7])
def test_average_at_scale_one_is_nn(
    layout: str, dtype: torch.dtype, count_include_pad: bool, divisor: int | None
) -> None:
    compared = 0
    for case in NN:
        if case["dilation"] != 1:
            continue
        case = {k: v for k, v in case.items() if k != "dilation"}
        others = {"count_include_pad": count_include_pad, "divisor_override": divisor}
        problem = at_scale_one("avg", case | others, channels=8, layout=layout, dtype=dtype)
        if problem is None:
            continue
        compared += 1
        x = problem.input.requires_grad_()
        ours, theirs = problem.run(), problem.run_nn()
        tolerance = {"rtol": 4 * torch.finfo(dtype).eps, "atol": 4 * torch.finfo(dtype).eps}
        torch.testing.assert_close(ours, theirs, **tolerance)
        grad = torch.randn_like(ours)
        torch.testing.assert_close(
            torch.autograd.grad(ours, x, grad)[0], torch.autograd.grad(theirs, x, grad)[0],
            **tolerance,
        )  # fmt: skip
    assert compared > 50


def test_the_oracle_agrees_with_nn() -> None:
    """The judge itself: at scale 1 its loops are nn's pools."""
    for case in [c for c in CASES if c not in [{"mode": "max"} | m for m in MAXIMA]]:
        problem = make(**case, scale="ones", dtype=torch.float64)
        np.testing.assert_allclose(problem.expected(), problem.run_nn().numpy(), atol=1e-12)
        x = problem.input.requires_grad_()
        grad = torch.randn_like(problem.run_nn())
        (wanted,) = torch.autograd.grad(problem.run_nn(), x, grad)
        actual = oracle_pools.backward(
            problem.pool, grad.numpy(), x.detach().numpy(), problem.scale.numpy()
        )
        np.testing.assert_allclose(actual.input, wanted.numpy(), atol=1e-12)
