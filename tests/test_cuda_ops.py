"""How CUDA tensors reach their kernels, as far as it can be seen without a GPU."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

import surfconv_ops
from helpers import Problem, assert_same_bits, make_problem
from surfconv_ops import _fallback, cuda_ops, depth_to_scale, reference, surf_conv2d
from surfconv_ops.validation import check_surf_conv2d

OPERATORS = ("surf_conv2d", "surf_max_pool2d", "surf_avg_pool2d", "depth_to_scale")
OPERATORS += (*(f"{name}_backward" for name in OPERATORS), "level_values")
HERE = Path(__file__).parent
# Where the kernels run: on the CPU in Triton's interpreter.
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
#: What a kernel may use of it on a consumer GPU of Ampere and on Hopper: CUDA C++ Programming
#: Guide, "Technical Specifications per Compute Capability". Code for one is not code for the other.
SHARED_MEMORY = {86: 99 * 1024, 90: 227 * 1024}


def on_device(values: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(v.to(DEVICE) if isinstance(v, Tensor) else v for v in values)


def arguments_of(problem: Problem) -> tuple[Any, ...]:
    tensors = (problem.input, problem.weight, problem.bias)
    return on_device(check_surf_conv2d(*tensors, **problem.options)[0])


def run_python(code: str, **variables: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(Path(surfconv_ops.__file__).parents[1])}
    environment |= variables
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", OPERATORS)
def test_are_registered_for_cuda(name: str) -> None:
    assert torch._C._dispatch_has_kernel_for_dispatch_key(f"surfconv::{name}", "CUDA")


def test_triton_is_not_imported_before_a_cuda_tensor_comes() -> None:
    run_python(
        "import sys, torch, surfconv_ops\n"
        "x, w = torch.randn(1, 2, 5, 5), torch.randn(3, 2, 3, 3, requires_grad=True)\n"
        "surfconv_ops.surf_conv2d(x, w, scale=torch.ones(1, 3, 3)).sum().backward()\n"
        "assert 'triton' not in sys.modules and 'surfconv_ops.triton' not in sys.modules\n"
    )


def test_the_backend_is_an_attribute_of_the_package() -> None:
    pytest.importorskip("triton")
    run_python("import surfconv_ops; surfconv_ops.triton.surf_conv2d")
    with pytest.raises(AttributeError, match="no_such_name"):
        surfconv_ops.no_such_name  # noqa: B018


def test_without_triton_the_package_works_and_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "triton.py").write_text("raise ImportError('no Triton here')\n")
    package = str(Path(surfconv_ops.__file__).parents[1])
    run_python(
        "import surfconv_ops\n"
        "from surfconv_ops import cuda_ops\n"
        "kernels, reason = cuda_ops.backend()\n"
        "assert kernels is None and 'no Triton here' in reason, reason\n"
        "try: surfconv_ops.triton\n"
        "except ImportError as error: assert 'needs the package triton' in str(error)\n"
        "else: raise AssertionError\n",
        PYTHONPATH=os.pathsep.join((str(tmp_path), package)),
    )


def test_the_registered_functions_run_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the dispatcher calls for CUDA tensors, without one on CPU tensors."""
    pytest.importorskip("triton")
    monkeypatch.setattr(_fallback, "forward", None)
    monkeypatch.setattr(_fallback, "backward", None)
    problem = make_problem(1, 2, 3, (4, 5))
    arguments = arguments_of(problem)
    output = cuda_ops._forward(*arguments)
    torch.testing.assert_close(output.cpu(), problem.run(surf_conv2d))
    grad = torch.randn(output.shape)
    needs = (True, True, True, True)
    grads = cuda_ops._backward(grad.to(DEVICE), *arguments[:2], *arguments[3:], *needs)
    expected = problem.gradients(reference.surf_conv2d, grad)
    for value, (name, wanted) in zip(grads, expected.items(), strict=True):
        torch.testing.assert_close(value.cpu(), wanted, msg=name)


@pytest.mark.parametrize(("place", "shape", "words"), [
    (0, (1, 2, 4, 5), "scale must be"), (1, (3, 4, 3, 3), "channels"), (2, (4,), "bias"),
    (3, (1, 3, 4, 5), "scale must be"), (3, (4, 5), "4 dimensions"), (4, (2, 3, 5), "guide"),
])  # fmt: skip
def test_direct_calls_refuse_what_is_unsafe(place: int, shape: Any, words: str) -> None:
    pytest.importorskip("triton")
    from surfconv_ops.triton import kernels

    arguments = list(arguments_of(make_problem(2, 2, 3, (4, 5), guide="levels")))
    arguments[place] = torch.ones(shape, device=DEVICE)
    with pytest.raises(RuntimeError, match=words):
        kernels.forward(*arguments)
    if place != 2:
        grad = torch.ones(2, 3, 4, 5, device=DEVICE)
        needs = (True, True, True, True)
        with pytest.raises(RuntimeError, match=words):
            kernels.backward(grad, *arguments[:2], *arguments[3:], *needs)


@pytest.mark.parametrize("place", [1, 2, 3, 4], ids=["weight", "bias", "scale", "guide"])
@pytest.mark.parametrize("other", ["meta", torch.int32], ids=["device", "dtype"])
def test_direct_calls_refuse_tensors_of_another_kind(place: int, other: Any) -> None:
    """A kernel would take them for what they are not, or reach another device's memory."""
    pytest.importorskip("triton")
    from surfconv_ops.triton import kernels

    arguments = list(arguments_of(make_problem(2, 2, 3, (4, 5), guide="levels")))
    words = f"{('weight', 'bias', 'scale', 'guide')[place - 1]}.* must"
    kept = arguments[place]
    arguments[place] = kept.to(other)
    with pytest.raises(RuntimeError, match=words):
        kernels.forward(*arguments)
    grad, needs = torch.ones(2, 3, 4, 5, device=DEVICE), (True, True, True, True)
    if place != 2:
        with pytest.raises(RuntimeError, match=words):
            kernels.backward(grad, *arguments[:2], *arguments[3:], *needs)
    arguments[place] = kept
    with pytest.raises(RuntimeError, match="grad_output must"):
        kernels.backward(grad.to(other), *arguments[:2], *arguments[3:], *needs)


def test_direct_calls_of_the_maps_operators_refuse_what_is_unsafe() -> None:
    pytest.importorskip("triton")
    depth, edges = torch.ones(4, 5, device=DEVICE), torch.ones(2, device=DEVICE)
    with pytest.raises(RuntimeError, match="dtype and device"):
        cuda_ops._level_values(depth, edges.to("meta"), torch.ones(4, device=DEVICE))
    with pytest.raises(RuntimeError, match="N levels"):
        cuda_ops._level_values(depth, edges, torch.ones(3, device=DEVICE))
    with pytest.raises(RuntimeError, match="grad must"):
        cuda_ops._depth_to_scale_backward(depth[:3], depth, 2.0, 0.0, 3e38, 1e30)


def test_direct_calls_refuse_a_wrong_gradient() -> None:
    pytest.importorskip("triton")
    from surfconv_ops.triton import kernels, pool_kernels

    arguments = arguments_of(make_problem(2, 3, 3, (4, 5)))
    grad, scale = torch.ones(2, 3, 4, 4, device=DEVICE), arguments[3]
    with pytest.raises(RuntimeError, match="grad_output"):
        kernels.backward(grad, *arguments[:2], *arguments[3:], True, True, True, True)
    window = ((3, 3), (1, 1), (1, 1))
    x = arguments[0]
    with pytest.raises(RuntimeError, match="grad_output"):
        pool_kernels.avg_pool2d_backward(grad, x, scale, None, 0.0, *window, True, 0, True, True)
    with pytest.raises(RuntimeError, match="scale must be"):
        pool_kernels.max_pool2d(x, scale[:1], None, 0.0, *window, (1, 1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("limits", [(0.0, 3e38), (0.4, 2.0)], ids=str)
@pytest.mark.parametrize("reference_depth", [2.0, 1e-3])
def test_scale_of_depth(dtype: torch.dtype, limits: Any, reference_depth: float) -> None:
    """The same bits as on the CPU, whose test has an oracle."""
    pytest.importorskip("triton")
    odd = [0.0, -1.0, torch.nan, torch.inf, -torch.inf, 1e-45, 1e-38, 1e-20, 1e30, 3.4e38]
    depth = torch.cat((torch.tensor(odd), torch.rand(1490) * 9)).to(dtype).view(30, 50).t()
    grad = torch.randn(50, 30, dtype=dtype)
    numbers = (*limits, 1e30)
    ops = torch.ops.surfconv
    there = depth.to(DEVICE)
    scale = cuda_ops._depth_to_scale(there, reference_depth, 0.25, *numbers)
    assert_same_bits(scale.cpu(), ops.depth_to_scale(depth, reference_depth, 0.25, *numbers))
    slope = cuda_ops._depth_to_scale_backward(grad.to(DEVICE), there, reference_depth, *numbers)
    wanted = ops.depth_to_scale_backward(grad, depth, reference_depth, *numbers)
    assert slope.any()
    assert_same_bits(slope.cpu(), wanted)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("levels", [1, 2, 5])
def test_values_of_levels(dtype: torch.dtype, levels: int) -> None:
    pytest.importorskip("triton")
    edges = torch.arange(1, levels, dtype=dtype) * 1.5
    values = torch.arange(levels + 1, dtype=dtype) + 0.25
    depth = torch.cat(
        (edges, torch.tensor([0.0, -2.0, torch.nan, torch.inf]), torch.rand(1100) * 9)
    )
    depth = depth.to(dtype)
    there = on_device((depth, edges, values))
    found = cuda_ops._level_values(*there)
    assert_same_bits(found.cpu(), torch.ops.surfconv.level_values(depth, edges, values))
    empty = cuda_ops._level_values(there[0][:0], *there[1:])
    assert empty.shape == (0,)


def test_without_triton_the_reference_runs_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_ops, "backend", lambda: (None, "no module named triton"))
    monkeypatch.setattr(_fallback, "_warned", False)
    problem = make_problem(1, 2, 3, (4, 5))
    tensors = (problem.input, problem.weight, problem.bias)
    arguments = tuple(check_surf_conv2d(*tensors, **problem.options)[0])
    with pytest.warns(RuntimeWarning, match="no module named triton.*pip install triton"):
        output = cuda_ops._forward(*arguments)
    assert_same_bits(output, problem.run(reference.surf_conv2d))
    grad = torch.randn_like(output)
    grads = cuda_ops._backward(grad, *arguments[:2], *arguments[3:], True, True, True, True)
    wanted = problem.gradients(reference.surf_conv2d, grad)
    torch.testing.assert_close(grads[3], wanted["scale"])


def test_refuses_the_cpu_outside_the_interpreter() -> None:
    pytest.importorskip("triton")
    out = run_python(
        "import torch, surfconv_ops.triton as backend\n"
        "x, w = torch.zeros(1, 1, 3, 3), torch.zeros(1, 1, 3, 3)\n"
        "try: backend.surf_conv2d(x, w, scale=torch.ones(1, 1, 1))\n"
        "except ValueError as error: print(error)\n",
        TRITON_INTERPRET="0",
    )
    assert "input: expected a CUDA tensor, got one on cpu" in out and "TRITON_INTERPRET" in out


def test_fake_cuda_tensors() -> None:
    """What compile and export trace with."""
    with FakeTensorMode():
        x = torch.empty(2, 3, 8, 9, device="cuda")
        weight = torch.empty(4, 3, 3, 3, device="cuda")
        scale = depth_to_scale(torch.empty(2, 8, 9, device="cuda"), 2.0)
        out: Tensor = surf_conv2d(x, weight, scale=scale, padding=1)
        assert out.device.type == "cuda" and out.shape == (2, 4, 8, 9)


@pytest.mark.skipif(sys.platform != "linux", reason="Triton compiles on Linux")
def test_kernels_compile_for_gpus_that_are_not_here(tmp_path: Path) -> None:
    pytest.importorskip("triton")
    environment = os.environ | {"TRITON_CACHE_DIR": str(tmp_path), "TRITON_INTERPRET": "0"}
    environment["PYTHONPATH"] = str(Path(surfconv_ops.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, str(HERE / "triton_compile.py")],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert {row["kernel"] for row in rows} == {"forward", "backward_data", "backward_weight"}
    assert {row["sm"] for row in rows} == SHARED_MEMORY.keys()
    for row in rows:
        assert row["sm"] != 90 or row.get("stack", 0) == 0, f"spills registers: {row}"
        assert row["shared"] <= SHARED_MEMORY[row["sm"]], f"more than such a GPU has: {row}"
        uses_tensor_cores = row["groups"] == 1 and (row["dtype"] == "torch.bfloat16" or row["tf32"])
        assert bool(row["mma"]) == uses_tensor_cores, row
