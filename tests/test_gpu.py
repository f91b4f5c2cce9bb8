"""The operators on CUDA tensors; `make test-gpu` runs these, and whole nets in test_gpu_nets.py."""

from __future__ import annotations

import os
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

from gpu import MARKS, SIZES, settings, to_gpu
from helpers import DTYPES, GRADIENTS, SCALES, assert_same_bits, make_problem
from operators import GEOMETRIES, name_of
from surfconv_ops import surf_conv2d
from surfconv_ops.validation import check_surf_conv2d

pytestmark = MARKS


def on_gpu(input: Tensor, weight: Tensor, bias: Tensor | None, **options: Any) -> Tensor:
    moved = {k: v.cuda() if isinstance(v, Tensor) else v for k, v in options.items()}
    out = surf_conv2d(input.cuda(), weight.cuda(), None if bias is None else bias.cuda(), **moved)
    return out.to(input.device)


@pytest.mark.parametrize("case", GEOMETRIES, ids=name_of)
def test_geometry(case: dict[str, Any]) -> None:
    problem = make_problem(**case)
    problem.check_forward(on_gpu)
    problem.check_gradients(on_gpu)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("groups", [1, 2, 16])
@pytest.mark.parametrize("deterministic", [False, True])
def test_dtype(dtype: torch.dtype, groups: int, deterministic: bool) -> None:
    problem = make_problem(**SIZES, dtype=dtype, groups=groups, guide="levels")
    with settings(deterministic=deterministic):
        problem.check_forward(on_gpu)
        problem.check_gradients(on_gpu)


def test_tensor_float32_follows_torch() -> None:
    problem = to_gpu(make_problem(**SIZES))
    with settings(tf32=False):
        exact = problem.run(surf_conv2d)
    with settings(tf32=True):
        fast = problem.run(surf_conv2d)
    error = (fast - exact).norm() / exact.norm()
    assert 1e-6 < error < 2e-3


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("guide", ["none", "holes", "nan"])
def test_safe_whatever_the_scale(scale: str, guide: str) -> None:
    """Under `compute-sanitizer` as well: nothing is touched outside its tensor."""
    problem = to_gpu(make_problem(**(SIZES | {"scale": scale}), axes=2, guide=guide))
    out = problem.run(surf_conv2d)
    assert out.isfinite().all()
    for name, grad in problem.gradients(surf_conv2d, torch.randn_like(out)).items():
        assert grad.isfinite().all(), name


def test_deterministic_bits() -> None:
    problem = to_gpu(make_problem(**SIZES, batch=4))
    grad = torch.randn(problem.output_shape(), device="cuda")
    with settings(deterministic=True):
        first = problem.gradients(surf_conv2d, grad)
        for _ in range(5):
            for name, value in problem.gradients(surf_conv2d, grad).items():
                assert_same_bits(value, first[name], name)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one CUDA device alone")
def test_runs_on_the_tensors_own_device() -> None:
    problem = make_problem(**SIZES)
    grad = torch.randn(problem.output_shape())
    first, second = (to_gpu(problem, f"cuda:{place}") for place in (0, 1))
    out = second.run(surf_conv2d)
    assert out.device.index == 1 and torch.cuda.current_device() == 0
    torch.testing.assert_close(out.cpu(), first.run(surf_conv2d).cpu())
    ours, theirs = (p.gradients(surf_conv2d, grad.to(p.input.device)) for p in (second, first))
    for name in GRADIENTS:
        assert ours[name].device.index == 1
        torch.testing.assert_close(ours[name].cpu(), theirs[name].cpu(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["weight", "bias", "scale", "guide"])
def test_direct_calls_refuse_tensors_of_another_device(name: str) -> None:
    problem = to_gpu(make_problem(**SIZES, guide="levels"))
    tensors = (problem.input, problem.weight, problem.bias)
    arguments = check_surf_conv2d(*tensors, **problem.options)[0]
    arguments = arguments._replace(**{name: getattr(arguments, name).cpu()})
    with pytest.raises(RuntimeError, match=name):
        torch.ops.surfconv.surf_conv2d(*arguments)


@pytest.mark.parametrize("axes", [1, 2])
def test_opcheck(axes: int) -> None:
    problem = to_gpu(make_problem(2, 3, 4, (6, 7), axes=axes, guide="levels"))
    leaves = [t.detach().requires_grad_() for t in (problem.input, problem.weight, problem.scale)]
    arguments = check_surf_conv2d(leaves[0], leaves[1], problem.bias,
                                  **problem.options | {"scale": leaves[2]})[0]  # fmt: skip
    torch.library.opcheck(torch.ops.surfconv.surf_conv2d.default, tuple(arguments))


def test_memory_holds_no_columns() -> None:
    """Taps are sampled where they are used: nine times the input is never there."""
    x = torch.randn(2, 64, 256, 256, device="cuda").to(memory_format=torch.channels_last)
    weight = torch.randn(64, 64, 3, 3, device="cuda")
    scale = torch.rand(2, 256, 256, device="cuda") + 0.5
    surf_conv2d(x, weight, scale=scale, padding=1)
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    out = surf_conv2d(x, weight, scale=scale, padding=1)
    extra = torch.cuda.max_memory_allocated() - before
    assert extra <= out.numel() * 4 + 2**21


@pytest.mark.skipif(
    torch.cuda.is_available() and torch.cuda.mem_get_info()[0] < 24 * 2**30,
    reason="needs 24 GiB of free GPU memory",
)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_more_than_2_to_the_31_elements(layout: str) -> None:
    """The far end of a tensor that 32 bits cannot index equals a crop of it."""
    rows, width, channels = 2**15 + 8, 2**13, 8
    x = torch.empty(1, channels, rows, width, dtype=torch.float16, device="cuda")
    if layout == "channels_last":
        x = x.to(memory_format=torch.channels_last)
    assert x.numel() > 2**31
    x.normal_()
    weight = torch.randn(channels, 1, 3, 3, dtype=torch.float16, device="cuda")
    scale = torch.rand(1, rows, width, device="cuda") + 0.5
    out = surf_conv2d(x, weight, scale=scale, padding=1, groups=channels)
    crop = surf_conv2d(x[:, :, -32:].contiguous(), weight, scale=scale[:, -32:].contiguous(),
                       padding=1, groups=channels)  # fmt: skip
    assert_same_bits(out[:, :, -16:], crop[:, :, -16:])


@pytest.mark.skipif(
    torch.cuda.is_available() and torch.cuda.mem_get_info()[0] < 48 * 2**30,
    reason="needs 48 GiB of free GPU memory",
)
def test_gradients_of_more_than_2_to_the_31_elements() -> None:
    """At the far end they are those of a crop."""
    rows, width, channels = 2**15 + 8, 2**13, 8
    x = torch.empty(1, channels, rows, width, dtype=torch.float16, device="cuda")
    x = x.to(memory_format=torch.channels_last).normal_()
    weight = torch.randn(channels, 1, 3, 3, dtype=torch.float16, device="cuda")
    scale = torch.rand(1, rows, width, device="cuda") + 0.5
    results = []
    for first in (0, rows - 32):
        near, at = (t[..., first:, :].detach().requires_grad_() for t in (x, scale))
        filters = weight.detach().requires_grad_()
        out = surf_conv2d(near, filters, scale=at, padding=1, groups=channels)
        # One row alone pulls, so that the crop's own upper rim adds nothing.
        pull = torch.zeros_like(out)
        pull[:, :, -8] = 1
        grads = torch.autograd.grad(out, (near, at, filters), pull)
        results.append([grad[..., -16:, :].float() for grad in grads])
    for whole, crop in zip(*results, strict=True):
        torch.testing.assert_close(whole, crop, rtol=1e-2, atol=1e-2)


def test_no_warning_of_a_fallback() -> None:
    assert not os.environ.get("TRITON_INTERPRET")
    problem = to_gpu(make_problem())
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="surfconv_ops")
        problem.gradients(surf_conv2d, torch.ones(problem.output_shape(), device="cuda"))
