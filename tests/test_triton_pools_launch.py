"""The CUDA backend's pools: determinism, what they are handed, how they are cut and reached."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import pools
from helpers import assert_same_bits

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton")

import surfconv_ops
from surfconv_ops import _fallback, cuda_ops, cuda_pool_ops, pool_reference
from surfconv_ops.triton import layer, pool_kernels, pool_tiles
from triton_pools import DEVICE, deterministic, make

# The interpreter computes lanes that are masked.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

HERE = Path(__file__).parent
INF = float("inf")
each_mode = pytest.mark.parametrize("mode", ["max", "avg"])


@each_mode
def test_deterministic_sums_are_the_same_bits_every_time(mode: str) -> None:
    options: dict[str, Any] = {} if mode == "max" else {"divisor_override": 1000003}
    problem = make(mode, 1, 3, kernel=2, stride=1, dtype=torch.float64, **options)
    with deterministic():
        out, first = problem.check()
        grad = torch.randn_like(out)
        first, second = (problem.gradients(grad) for _ in range(2))
    for name in pools.GRADIENTS:
        assert_same_bits(first[name], second[name], name)
    # Whatever tile a contribution comes from.
    with deterministic(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool_tiles, "_BACKWARD_LANES", 64)
        assert_same_bits(problem.gradients(grad)["input"], first["input"])


@each_mode
def test_deterministic_sums_of_gradients_that_are_not_finite(mode: str) -> None:
    problem = make(mode, kernel=2, stride=1)
    grad = torch.randn(problem.run().shape)
    grad[0, 0, 1, 1] = INF
    with deterministic():
        assert problem.gradients(grad)["input"].isnan().all()
    found = problem.gradients(grad)["input"]
    assert found[0, 0].isinf().any() and found[0, 1].isfinite().all()


def test_winners_are_those_of_the_cpu() -> None:
    """The number that means none does not fit 8 bits here."""
    x, scale = torch.rand(1, 2, 17, 16), torch.full((1, 1, 2, 1), 0.9)
    window = ([16, 16], [1, 1], [0, 0], [1, 1])
    output, winner = pool_kernels.max_pool2d(x.to(DEVICE), scale.to(DEVICE), None, 0.0, *window)
    wanted, numbers = torch.ops.surfconv.surf_max_pool2d(x, scale, None, 0.0, *window)
    assert winner.dtype == numbers.dtype == torch.int32 and torch.equal(winner.cpu(), numbers)
    torch.testing.assert_close(output.cpu(), wanted)


def backward_arguments(problem: Any) -> tuple[Any, ...]:
    guide = None if problem.guide is None else problem.guide.to(DEVICE)
    x, scale = problem.input.to(DEVICE), problem.scale.to(DEVICE)
    return x, scale, guide, problem.guide_tolerance


def test_winners_that_no_forward_gave() -> None:
    """A caller's own numbers must not reach memory that is not the tensor's."""
    problem = make("max", 1, 3, (5, 6), stride=1)
    x, scale, *rest = backward_arguments(problem)
    window = ([3, 3], [1, 1], [1, 1], [1, 1], True, True)
    winner = torch.randint(0, 256, (1, 5, 6, 3), dtype=torch.uint8, device=DEVICE)
    grads = pool_kernels.max_pool2d_backward(x, x, scale, rest[0], winner, rest[1], *window)
    assert all(g.isfinite().all() for g in grads)
    nothing, bad = torch.full_like(winner, 9), torch.full_like(x, torch.nan)
    grads = pool_kernels.max_pool2d_backward(x, bad, scale, rest[0], nothing, rest[1], *window)
    assert not any(g.any() for g in grads)
    for wrong in (winner[..., :2], winner.float()):
        with pytest.raises(RuntimeError, match="winner"):
            pool_kernels.max_pool2d_backward(x, x, scale, rest[0], wrong, rest[1], *window)


@pytest.mark.parametrize("needs", [(True, False), (False, True), (False, False)])
@pytest.mark.parametrize("order", ["arrival", "deterministic"])
def test_only_what_is_needed(needs: tuple[bool, bool], order: str) -> None:
    torch.manual_seed(1)
    for mode in ("max", "avg"):
        problem = make(mode, 1, 2, (4, 5), kernel=2)
        x, scale, guide, tolerance = backward_arguments(problem)
        window: tuple[Any, ...] = ([2, 2], [2, 2], [1, 1])
        out = problem.run()
        grad = torch.randn_like(out).to(DEVICE)
        if mode == "max":
            winner = pool_kernels.max_pool2d(x, scale, guide, tolerance, *window, [1, 1])[1]
            call, own = pool_kernels.max_pool2d_backward, (x, scale, guide, winner, tolerance)
            window = (*window, [1, 1])
        else:
            call, own = pool_kernels.avg_pool2d_backward, (x, scale, guide, tolerance)
            window = (*window, True, 0)
        if order == "deterministic":
            with deterministic():
                grads = call(grad, *own, *window, *needs)
        else:
            grads = call(grad, *own, *window, *needs)
        expected = problem.gradients(grad.cpu())
        for value, wanted, need in zip(grads, expected.values(), needs, strict=True):
            assert value.shape == (wanted.shape if need else (0,))
            if need:
                torch.testing.assert_close(value.cpu(), wanted, rtol=1e-5, atol=1e-6)


@each_mode
def test_every_tile(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many tiles of pixels and blocks of channels add up."""

    def cut(*_: Any) -> list[pool_tiles.PoolTiles]:
        return [pool_tiles.PoolTiles(4, 4, 4)]

    monkeypatch.setattr(pool_kernels, "pool_tiles", cut)
    make(mode, 1, 9, (4, 5), kernel=2, guide="levels", axes=2).check()


@each_mode
def test_wide_positions(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images whose pixels 32 bits cannot number along one axis."""
    problem = make(mode, scale="mixed", axes=2, guide="holes", kernel=2)
    narrow = problem.run()
    monkeypatch.setattr(layer, "NARROW_REACH", 1)
    out, _ = problem.check(scale=False)
    assert_same_bits(out, narrow)


@each_mode
def test_derivatives_of_second_order(mode: str) -> None:
    problem = make(mode, 1, 1, (3, 4), kernel=2, dtype=torch.float64)
    results = []
    for one in (problem, pools.Problem(**vars(problem))):
        leaves = {n: getattr(one, n).detach().requires_grad_() for n in pools.GRADIENTS}
        out = replace(one, **leaves).run()
        (grad,) = torch.autograd.grad(out.square().sum(), leaves["input"], create_graph=True)
        results.append(torch.autograd.grad(grad.square().sum(), list(leaves.values())))
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs)


@each_mode
def test_cuda_tensors_reach_the_kernels(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On CPU tensors here: what the dispatcher would call for CUDA tensors."""
    for name in (f"surf_{mode}_pool2d", f"surf_{mode}_pool2d_backward"):
        assert torch._C._dispatch_has_kernel_for_dispatch_key(f"surfconv::{name}", "CUDA")
    problem = make(mode, 1, 2, (4, 5), kernel=2)
    x, scale, guide, tolerance = backward_arguments(problem)
    options: list[Any] = [(2, 2), (2, 2), (1, 1), *([(1, 1)] if mode == "max" else [True, 0])]
    call = cuda_pool_ops._kernel(f"{mode}_pool2d")
    out = call(x, scale, guide, tolerance, *options)
    assert_same_bits((out[0] if mode == "max" else out).cpu(), problem.run())
    assert cuda_ops.backend()[0] is not None
    monkeypatch.setattr(cuda_ops, "backend", lambda: (None, "no module named triton"))
    monkeypatch.setattr(_fallback, "_warned", False)
    with pytest.warns(RuntimeWarning, match="no module named triton.*pip install triton"):
        plain = call(x, scale, guide, tolerance, *options)
    forward = pool_reference.max_forward if mode == "max" else pool_reference.avg_forward
    wanted = forward(x, scale, guide, tolerance, *options)
    pairs = zip(plain, wanted, strict=True) if mode == "max" else [(plain, wanted)]
    for mine, other in pairs:
        assert_same_bits(mine, other)


@pytest.mark.skipif(sys.platform != "linux", reason="Triton compiles on Linux")
def test_kernels_compile_for_gpus_that_are_not_here(tmp_path: Path) -> None:
    environment = os.environ | {"TRITON_CACHE_DIR": str(tmp_path), "TRITON_INTERPRET": "0"}
    environment["PYTHONPATH"] = str(Path(surfconv_ops.__file__).parents[1])
    command = [sys.executable, str(HERE / "triton_compile_pools.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len({row["kernel"] for row in rows}) == 4
    for row in rows:
        assert row.get("stack", 0) == 0, f"spills registers: {row}"
