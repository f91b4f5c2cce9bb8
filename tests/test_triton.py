"""The CUDA backend's kernels against the oracle; without a GPU they run in Triton's interpreter."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from helpers import DTYPES, SCALES, assert_same_bits, make_problem
from operators import GEOMETRIES, name_of

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton")

from surfconv_ops import reference
from surfconv_ops import triton as backend
from surfconv_ops.layout import memory_format_of
from surfconv_ops.triton import gradients, kernels, layer, tiles

# The interpreter computes lanes that are masked.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
OTHERS: list[dict[str, Any]] = [
    {"channels": 20, "out_channels": 36, "kernel": (3, 2)},
    {"channels": 36, "out_channels": 72, "groups": 2, "size": (4, 5)},
    {"channels": 3, "out_channels": 9, "groups": 3, "guide": "depth", "guide_tolerance": 0.7},
    {"channels": 3, "out_channels": 2, "kernel": 1, "padding": 0},
    {"batch": 1, "channels": 1, "out_channels": 1, "size": (1, 1), "kernel": 1, "padding": 0},
    {"bias": False, "axes": 2, "guide": "levels"},
]


def operator(input: Tensor, weight: Tensor, bias: Tensor | None, **options: Any) -> Tensor:
    """The backend's own entry, on the device that runs it."""
    moved = {k: v.to(DEVICE) if isinstance(v, Tensor) else v for k, v in options.items()}
    bias = None if bias is None else bias.to(DEVICE)
    return backend.surf_conv2d(input.to(DEVICE), weight.to(DEVICE), bias, **moved).to(input.device)


@pytest.fixture(params=["arrival", "deterministic"])
def order(request: pytest.FixtureRequest) -> Any:
    """Both ways to sum the gradient of the input."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(request.param == "deterministic")
    yield request.param
    torch.use_deterministic_algorithms(before)


@pytest.mark.parametrize("case", GEOMETRIES + OTHERS, ids=name_of)
def test_geometry(case: dict[str, Any]) -> None:
    problem = make_problem(**case)
    problem.check_forward(operator)
    problem.check_gradients(operator)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("axes", [1, 2])
def test_scale(scale: str, axes: int) -> None:
    problem = make_problem(1, 2, 3, (5, 6), scale=scale, axes=axes, dtype=torch.float64)
    problem.check_forward(operator)
    problem.check_gradients(operator)


@pytest.mark.parametrize("guide", ["levels", "depth", "holes", "nan"])
def test_guide(guide: str) -> None:
    problem = make_problem(guide=guide, guide_tolerance=0.4, stride=2)
    problem.check_forward(operator)
    problem.check_gradients(operator)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("groups", [1, 4])
def test_dtype(dtype: torch.dtype, groups: int, order: str) -> None:
    problem = make_problem(1, 4, 8, (5, 6), dtype=dtype, groups=groups, guide="depth",
                           guide_tolerance=1.1)  # fmt: skip
    problem.check_forward(operator)
    problem.check_gradients(operator)


@pytest.mark.parametrize("layout", ["channels_last", "sliced", "expanded", "transposed"])
def test_layout(layout: str) -> None:
    problem = make_problem(layout=layout)
    out = problem.check_forward(operator)
    assert memory_format_of(out) == memory_format_of(problem.input)
    problem.check_gradients(operator)


def test_layouts_of_gradients() -> None:
    problem = make_problem(dtype=torch.float64)
    arguments = [problem.input.contiguous(memory_format=torch.channels_last), problem.weight,
                 problem.scale]  # fmt: skip
    leaves = [t.to(DEVICE).requires_grad_() for t in arguments]
    out = backend.surf_conv2d(leaves[0], leaves[1], scale=leaves[2], padding=1)
    grads = torch.autograd.grad(out.sum(), leaves)
    assert [memory_format_of(g) for g in grads] == [memory_format_of(t) for t in leaves]


def test_scale_in_half_type() -> None:
    problem = make_problem(dtype=torch.float16, scale="smooth", scale_dtype=torch.float16,
                           guide="levels")  # fmt: skip
    problem.check_forward(operator)
    problem.check_gradients(operator)


def test_unbatched() -> None:
    problem = make_problem(guide="holes")
    assert problem.guide is not None
    one = replace(problem, input=problem.input[0], scale=problem.scale[0], guide=problem.guide[0])
    assert_same_bits(one.run(operator), problem.run(operator)[0])


def test_empty_batch() -> None:
    problem = make_problem(0, guide="levels")
    out = problem.run(operator)
    assert out.shape == problem.output_shape()
    for name, grad in problem.gradients(operator, torch.zeros_like(out)).items():
        assert grad.shape == getattr(problem, name).shape and not grad.any(), name


@pytest.mark.parametrize("needed", range(16))
def test_only_what_is_needed(needed: int) -> None:
    problem = make_problem(1, 2, 3, (4, 5))
    needs = [bool(needed >> place & 1) for place in range(4)]
    grad = torch.randn(problem.output_shape())
    arguments = (problem.input, problem.weight, problem.scale, None, 0.0, (1, 1), (1, 1), (1, 1), 1)
    grads = kernels.backward(grad.to(DEVICE), *[
        a.to(DEVICE) if isinstance(a, Tensor) else a for a in arguments
    ], *needs)  # fmt: skip
    expected = problem.gradients(operator, grad)
    for value, wanted, need in zip(grads, expected.values(), needs, strict=True):
        assert value.shape == (wanted.shape if need else (0,))
        if need:
            torch.testing.assert_close(value.cpu(), wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("case", [
    {"channels": 20, "out_channels": 36}, {"kernel": (2, 4), "padding": 1, "scale": "mixed"},
    {"channels": 4, "out_channels": 4, "groups": 4},
], ids=name_of)  # fmt: skip
@pytest.mark.parametrize("choice", ["second", "last", "small"])
def test_every_tile(case: dict[str, Any], choice: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever tuning picks is right, and so are tiles smaller than the layer."""

    def pick(name: str, conv: Any, variant: Any, candidates: Any, *_: Any) -> tiles.Tiles:
        if choice == "small":
            return tiles.Tiles(16, 16, 16, 4, 2, unrolled=name == "forward")
        chosen: tiles.Tiles = candidates[:2][-1] if choice == "second" else candidates[-1]
        return chosen

    for module in (kernels, gradients):
        monkeypatch.setattr(module, "fastest", pick)
    problem = make_problem(2, **({"size": (4, 5)} | case))
    problem.check_forward(operator)
    problem.check_gradients(operator)


def test_passes_over_images(order: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sums of half types' gradients hold some of the images at a time."""
    problem = make_problem(5, 2, 4, (4, 5), dtype=torch.float16, guide="holes", axes=2)
    grad = torch.randn(problem.output_shape()).half()
    whole = problem.gradients(operator, grad)
    made = []
    two_images = 2 * 2 * 4 * 5 * (8 if order != "arrival" else 4)
    monkeypatch.setattr(gradients, "_LEAST_SUM_BYTES", two_images)
    run_pass = gradients._pass
    monkeypatch.setattr(gradients, "_pass", lambda c, *a: made.append(c.batch) or run_pass(c, *a))
    for name, value in problem.gradients(operator, grad).items():
        torch.testing.assert_close(value, whole[name], rtol=2e-3, atol=2e-3, msg=name)
    assert made == [2, 2, 1]
    problem.check_gradients(operator, grad)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64], ids=str)
@pytest.mark.parametrize("programs", [1, 10**6])
def test_shares_of_the_weights_gradient(
    dtype: torch.dtype, programs: int, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One share is written in place, more are added up: where all sizes are alike as well."""
    monkeypatch.setattr(gradients, "_WEIGHT_PROGRAMS", programs)
    for groups in (1, 3):
        problem = make_problem(2, 3, 3, (6, 7), groups=groups, dtype=dtype)
        problem.check_gradients(operator)


def test_wide_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images whose pixels 32 bits cannot number along one axis."""
    problem = make_problem(scale="mixed", axes=2, guide="holes", dtype=torch.float64)
    narrow = problem.run(operator)
    monkeypatch.setattr(layer, "NARROW_REACH", 1)
    assert_same_bits(problem.check_forward(operator), narrow)
    problem.check_gradients(operator)


@pytest.mark.parametrize("kernel", [3, 4])
def test_one_side_for_all_taps_on_pixels(kernel: int) -> None:
    """Where samples lie on pixels the slope is the one towards larger scales, as on the CPU."""
    problem = make_problem(1, 2, 3, (6, 7), kernel, scale="integers", axes=2, dtype=torch.float64)
    grad = torch.randn(problem.output_shape(), dtype=torch.float64)
    ours = problem.gradients(operator, grad)["scale"]
    torch.testing.assert_close(ours, problem.gradients(reference.surf_conv2d, grad)["scale"])


def test_far_taps() -> None:
    """Offsets that would wrap to a place inside the image if they were cut to 32 bits."""
    problem = make_problem(1, 2, 3, (6, 7), dtype=torch.float64)
    far = torch.tensor([2.0**31, 2.0**32 - 1, 2.0**32 + 1, 2.0**30, 2.0**40, 2.0**53])
    problem.scale.copy_(torch.cat((far, -far))[torch.arange(42) % 12].view(1, 1, 6, 7))
    problem.check_forward(operator)
    problem.check_gradients(operator)


def test_taps_beyond_32_bits() -> None:
    far = 2**30
    problem = make_problem(1, 1, 2, (3, 3), dilation=far, padding=far, dtype=torch.float64)
    problem.scale.mul_(1 / far)
    problem.check_forward(operator)
    problem.check_gradients(operator)


def test_scale_one_hides_what_conv2d_does_not_see() -> None:
    problem = make_problem(scale="ones")
    problem.input[0, 0, 2, 3] = torch.inf
    problem.input[1, 1, 4, 4] = torch.nan
    out = problem.run(operator)
    expected = torch.nn.functional.conv2d(problem.input, problem.weight, problem.bias, padding=1)
    assert torch.equal(out.isnan(), expected.isnan()) and out.isnan().any()
    assert torch.equal(out.isinf(), expected.isinf()) and out.isinf().any()


def test_derivatives_of_second_order() -> None:
    problem = make_problem(1, 2, 2, (3, 4), dtype=torch.float64, kernel=2, padding=1)
    leaves = [t.to(DEVICE).requires_grad_() for t in
              (problem.input, problem.weight, problem.scale)]  # fmt: skip

    def call(x: Tensor, weight: Tensor, scale: Tensor) -> Tensor:
        return backend.surf_conv2d(x, weight, scale=scale, padding=1)

    (grad,) = torch.autograd.grad(call(*leaves).square().sum(), leaves[0], create_graph=True)
    ours = torch.autograd.grad(grad.square().sum(), leaves)
    expected = reference.surf_conv2d(leaves[0], leaves[1], scale=leaves[2], padding=1)
    (grad,) = torch.autograd.grad(expected.square().sum(), leaves[0], create_graph=True)
    for mine, wanted in zip(ours, torch.autograd.grad(grad.square().sum(), leaves), strict=True):
        torch.testing.assert_close(mine, wanted)


def test_autocast() -> None:
    problem = make_problem()
    with torch.autocast(DEVICE, torch.bfloat16):
        out = problem.run(operator)
    assert out.dtype == torch.bfloat16
    half = problem.to(torch.bfloat16)
    assert_same_bits(out, replace(half, scale=problem.scale).run(operator))
