"""The CUDA backend's pools against the oracle; without a GPU they run in Triton's interpreter."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

import pools
from helpers import DTYPES, SCALES, assert_same_bits
from operators import name_of

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton")

from surfconv_ops import triton as backend
from surfconv_ops.layout import memory_format_of
from test_pools import ON_PIXELS
from triton_pools import DEVICE, deterministic, make

# The interpreter computes lanes that are masked.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

INF, NAN = float("inf"), float("nan")
each_mode = pytest.mark.parametrize("mode", ["max", "avg"])
CASES: list[dict[str, Any]] = [
    {"mode": "max"},
    {"mode": "max", "kernel": (2, 3), "stride": (2, 1), "padding": (1, 0), "axes": 2},
    {"mode": "max", "kernel": (4, 1), "stride": 3, "padding": (2, 0), "ceil_mode": True},
    {"mode": "max", "dilation": (3, 2), "stride": 1, "padding": (0, 1), "kernel": 2, "axes": 2},
    {"mode": "max", "kernel": 2, "stride": None, "padding": 0, "channels": 70, "batch": 1},
    {"mode": "avg", "axes": 2},
    {"mode": "avg", "kernel": 2, "stride": 2, "ceil_mode": True, "channels": 70, "batch": 1},
    {"mode": "avg", "count_include_pad": False, "kernel": (1, 4), "padding": (0, 2)},
    {"mode": "avg", "divisor_override": 5, "kernel": 2},
    {"mode": "avg", "divisor_override": 1, "kernel": 2, "count_include_pad": False},
    {"mode": "avg", "divisor_override": -2, "kernel": 2, "channels": 1},
]
GUIDED: list[dict[str, Any]] = [
    {"mode": "max"},
    {"mode": "avg"},
    {"mode": "avg", "count_include_pad": False},
]


@pytest.mark.parametrize("case", CASES, ids=name_of)
def test_geometry(case: dict[str, Any]) -> None:
    make(**({"batch": 2} | case)).check()


@each_mode
@pytest.mark.parametrize("scale", SCALES)
def test_scale(mode: str, scale: str) -> None:
    problem = make(mode, 1, 2, (4, 5), kernel=(2, 3), stride=1, scale=scale, axes=2,
                   dtype=torch.float64)  # fmt: skip
    problem.check(scale=scale not in ON_PIXELS)


@pytest.mark.parametrize("case", GUIDED, ids=name_of)
@pytest.mark.parametrize("guide", ["levels", "depth", "holes"])
def test_guide(case: dict[str, Any], guide: str) -> None:
    problem = make(**case, size=(4, 5), kernel=2, guide=guide, axes=2, dtype=torch.float64,
                   guide_tolerance=0.0 if guide == "holes" else 0.8)  # fmt: skip
    out, _ = problem.check()
    assert not torch.equal(out, replace(problem, guide=None).run())


@pytest.mark.parametrize("fraction", [2.0**-26, 3 * 2.0**-26])
def test_what_is_seen_of_a_sample_may_weigh_next_to_nothing(fraction: float) -> None:
    """Which weights are none, and quotients of the others, are the CPU's."""
    problem = make(**GUIDED[2], channels=1, kernel=3, stride=1, guide="levels", axes=2)
    problem.scale[:, 0] = fraction
    out, expected = problem.run(), pools.Problem(**vars(problem))
    torch.testing.assert_close(out, expected.run(), rtol=1e-5, atol=1e-6)
    grads, wanted = (one.gradients(torch.ones_like(out)) for one in (problem, expected))
    for name in pools.GRADIENTS:
        torch.testing.assert_close(grads[name], wanted[name], rtol=1e-5, atol=1e-5)


def test_a_guide_that_hides_every_tap_leaves_zeros() -> None:
    problem = make("max", kernel=2, stride=1, padding=0, guide="depth", dtype=torch.float64)
    # Taps of a kernel of 2 then lie further from the centre than its own pixel.
    problem.scale += 3.1
    out, _ = problem.check()
    assert out[..., 1:, :].eq(0).all() and out[..., 0, 0].ne(0).any()
    assert replace(problem, mode="avg").run().eq(0).all()


@each_mode
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_dtype(mode: str, dtype: torch.dtype) -> None:
    """The same sums of the input's gradient in any order, and in one that does not matter."""
    problem = make(mode, 1, 5, dtype=dtype)
    problem.check()
    with deterministic():
        problem.check()


@each_mode
@pytest.mark.parametrize("layout", ["channels_last", "sliced", "expanded", "transposed"])
def test_layout(mode: str, layout: str) -> None:
    problem = make(mode, 2, 3, kernel=2, layout=layout)
    out, grads = problem.check()
    assert memory_format_of(out) == memory_format_of(problem.input)
    if layout == "channels_last":
        assert memory_format_of(grads["input"]) == torch.channels_last


@each_mode
def test_scale_and_guide_in_half_types(mode: str) -> None:
    for dtype in (torch.bfloat16, torch.float16):
        problem = make(mode, kernel=2, dtype=dtype, scale_dtype=dtype, guide="levels")
        out = problem.run()
        pools.assert_close(out, problem.expected(), "output")
        assert problem.gradients(out)["scale"].dtype == dtype


@each_mode
@pytest.mark.parametrize("kernel", [1, (5, 4)])
def test_one_pixel_maps(mode: str, kernel: Any) -> None:
    padding = 0 if kernel == 1 else (2, 2)
    make(mode, 2, 1, (1, 1), kernel=kernel, stride=1, padding=padding, axes=2).check()


@each_mode
def test_unbatched(mode: str) -> None:
    problem = make(mode, 2, kernel=2, guide="levels")
    assert problem.guide is not None
    one = replace(problem, input=problem.input[0], scale=problem.scale[0], guide=problem.guide[0])
    assert_same_bits(one.run(), problem.run()[0])


@each_mode
def test_empty_batch(mode: str) -> None:
    problem = make(mode, 0, guide="levels")
    for context in (torch.enable_grad(), deterministic()):
        with context:
            out = problem.run()
            assert out.shape == (0, 2, 3, 3)
            for name, value in problem.gradients(out).items():
                assert value.shape == getattr(problem, name).shape


def test_the_first_of_equal_taps_wins() -> None:
    x = torch.ones(1, 1, 4, 4, requires_grad=True)
    out = backend.surf_max_pool2d(x.to(DEVICE), 2, scale=torch.ones(1, 2, 2, device=DEVICE))
    (grad,) = torch.autograd.grad(out.sum(), x)
    assert grad[0, 0, ::2, ::2].eq(1).all() and grad.sum() == 4


@pytest.mark.parametrize("value", [NAN, -INF])
def test_nan_wins_and_all_minus_infinity_is_a_maximum(value: float) -> None:
    problem = make("max", 1, 2, (5, 6), stride=1, scale="ones")
    problem.input[0, :, 2:4, 3] = value
    problem.input[0, 1] = -INF
    x = problem.input.requires_grad_()
    out, expected = problem.run(), problem.run_nn()
    assert_same_bits(out, expected)
    ours, theirs = (torch.autograd.grad(y.sum(), x)[0] for y in (out, expected))
    assert_same_bits(ours, theirs)


@each_mode
@pytest.mark.parametrize("bad", [NAN, INF])
def test_pixels_that_no_tap_sees_do_not_leak(mode: str, bad: float) -> None:
    problem = make(mode, 1, 1, (3, 8), kernel=(1, 2), stride=(1, 5), padding=0)
    # Taps on pixels 0, 1, 5 and 6, each beside one without weight; and between pixels.
    for scale, unseen in ((1.0, [2, 3, 4, 7]), (1.25, [3])):
        problem.scale.fill_(scale)
        out = problem.run()
        clean = problem.gradients(torch.ones_like(out))
        dirty = replace(problem, input=problem.input.clone())
        dirty.input[..., unseen] = bad
        assert_same_bits(dirty.run(), out)
        grads = dirty.gradients(torch.ones_like(out))
        assert_same_bits(grads["input"], clean["input"])
        assert grads["scale"].isfinite().all()


def test_a_window_without_a_tap_is_zero() -> None:
    x = torch.randn(1, 2, 1, 1, requires_grad=True)
    scale = torch.ones(1, 1, 1, requires_grad=True)
    out = backend.surf_max_pool2d(x.to(DEVICE), 2, 1, 1, 2, scale=scale.to(DEVICE))
    assert out.eq(0).all()
    assert not any(g.any() for g in torch.autograd.grad(out.sum(), (x, scale)))
    clamped = backend.surf_max_pool2d(x.to(DEVICE), 2, 1, 1, 2, scale=scale.to(DEVICE) * 1.5)
    assert_same_bits(clamped.cpu(), x)
