"""Every argument drawn at random together, forward and backward against the oracle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from hypothesis import example, given, note, settings
from hypothesis import strategies as st

from helpers import (
    DTYPES,
    GUIDES,
    LAYOUTS,
    SCALES,
    Problem,
    assert_same_bits,
    geometry,
    lay_out,
    make_problem,
)
from operators import OPERATORS
from surfconv_ops import surf_conv2d


@dataclass
class Drawn:
    arguments: dict[str, Any]
    threads: int
    grad_layout: str
    unbatched: bool
    scale_layout: str

    def problem(self) -> Problem:
        problem = make_problem(**self.arguments)
        problem.scale = lay_out(problem.scale, self.scale_layout)
        if not self.unbatched:
            return problem
        guide = problem.guide
        return replace(
            problem,
            input=problem.input[0],
            scale=problem.scale[0],
            guide=None if guide is None else guide[0],
        )


@st.composite
def drawn(draw: st.DrawFn) -> Drawn:
    small = st.integers(1, 3)
    kernel = draw(st.tuples(st.integers(1, 5), st.integers(1, 5)))
    dilation = draw(st.one_of(st.just(1), small, st.tuples(small, small)))
    padding = draw(
        st.one_of(st.sampled_from(["same", "valid"]), st.integers(0, 4),
                  st.tuples(st.integers(0, 4), st.integers(0, 4)))
    )  # fmt: skip
    stride = 1 if padding == "same" else draw(st.one_of(st.just(1), small, st.tuples(small, small)))
    groups = draw(st.integers(1, 3))
    depthwise = draw(st.booleans())
    per_group = 1 if depthwise else draw(st.sampled_from([1, 2, 3, 9, 17]))
    out_per_group = draw(st.sampled_from([1, 2, 3, 5, 18]))
    shape = geometry(kernel, stride, padding, dilation)
    reach = [shape.dilation[axis] * (kernel[axis] - 1) + 1 for axis in (0, 1)]
    least = [max(1, reach[a] - shape.padding[a] - shape.padding[a + 2]) for a in (0, 1)]
    size = tuple(low + draw(st.integers(0, 6)) for low in least)
    dtype = draw(st.sampled_from(DTYPES))
    unbatched = draw(st.booleans())
    kinds = [dtype] if dtype == torch.float32 else [torch.float32, dtype]
    arguments = {
        "batch": 1 if unbatched else draw(st.integers(1, 2)),
        "channels": groups * per_group,
        "out_channels": groups * out_per_group,
        "size": size,
        "kernel": kernel,
        "stride": stride,
        "padding": padding,
        "dilation": dilation,
        "groups": groups,
        "dtype": dtype,
        "scale": draw(st.sampled_from(SCALES)),
        "scale_dtype": draw(st.sampled_from(kinds)),
        "axes": draw(st.sampled_from([1, 2])),
        "guide": draw(st.sampled_from(GUIDES)),
        "guide_tolerance": draw(st.sampled_from([0.0, 0.5, 1.0])),
        "bias": draw(st.booleans()),
        "layout": draw(st.sampled_from(LAYOUTS)),
        "seed": draw(st.integers(0, 2**16)),
    }
    return Drawn(
        arguments,
        threads=draw(st.sampled_from([1, 2, 3])),
        grad_layout=draw(st.sampled_from(LAYOUTS)),
        unbatched=unbatched,
        scale_layout=draw(st.sampled_from(["contiguous", "sliced", "transposed"])),
    )


def grad_for(case: Drawn, problem: Problem) -> torch.Tensor:
    generator = torch.Generator().manual_seed(case.arguments["seed"])
    shape = problem.output_shape()
    grad = torch.randn(shape, generator=generator).to(problem.input.dtype)
    return grad if grad.ndim == 3 else lay_out(grad, case.grad_layout)


def solve(case: Drawn, operator: str) -> None:
    torch.set_num_threads(case.threads)
    problem = case.problem()
    note(f"{problem.output_shape()=}")
    problem.check_forward(OPERATORS[operator])
    problem.check_gradients(OPERATORS[operator], grad_for(case, problem))


@pytest.mark.core
@settings(max_examples=300)
@given(drawn())
def test_public(case: Drawn) -> None:
    solve(case, "public")


@settings(max_examples=100)
@given(drawn())
def test_reference(case: Drawn) -> None:
    solve(case, "reference")


@settings(max_examples=100)
@given(drawn(), st.sampled_from([2, 3]))
def test_threads_change_no_bit(case: Drawn, threads: int) -> None:
    problem = case.problem()
    grad = grad_for(case, problem)
    torch.set_num_threads(1)
    out, gradients = problem.run(surf_conv2d), problem.gradients(surf_conv2d, grad)
    torch.set_num_threads(threads)
    assert_same_bits(problem.run(surf_conv2d), out, "output")
    for name, value in problem.gradients(surf_conv2d, grad).items():
        assert_same_bits(value, gradients[name], name)


@settings(max_examples=60)
@given(drawn())
def test_outputs_are_finite_whatever_the_scale(case: Drawn) -> None:
    problem = case.problem()
    assert problem.run(surf_conv2d).isfinite().all()
    for name, value in problem.gradients(surf_conv2d, grad_for(case, problem)).items():
        assert value.isfinite().all(), name


@example((700, 3, 1, 1, 2))
@given(
    st.tuples(st.integers(1, 40), st.integers(1, 6), st.integers(1, 4), st.integers(0, 6),
              st.integers(1, 3))
)  # fmt: skip
def test_output_size_is_conv2ds(case: tuple[int, int, int, int, int]) -> None:
    size, kernel, stride, padding, dilation = case
    if size + 2 * padding < dilation * (kernel - 1) + 1:
        return
    shape = geometry((1, kernel), (1, stride), (0, padding), (1, dilation))
    x, weight = torch.randn(1, 1, 1, size), torch.randn(1, 1, 1, kernel)
    options = {"stride": (1, stride), "padding": (0, padding), "dilation": (1, dilation)}
    expected = torch.nn.functional.conv2d(x, weight, **options)
    assert shape.output_size(1, size) == tuple(expected.shape[2:])
    out = surf_conv2d(x, weight, scale=torch.ones(1, *expected.shape[2:]), **options)
    torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-5)
