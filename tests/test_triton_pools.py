"""The CUDA backend's pools against the oracle; without a GPU they run in Triton's interpreter."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import oracle_pools
import pools
from helpers import DTYPES, SCALES, assert_same_bits, to_numpy
from operators import name_of

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton")

import surfconv_ops
from surfconv_ops import _fallback, cuda_ops, cuda_pool_ops, pool_reference
from surfconv_ops import triton as backend
from surfconv_ops.layout import memory_format_of
from surfconv_ops.triton import layer, pool_kernels, pool_tiles
from test_pools import ON_PIXELS

# The interpreter computes lanes that are masked.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

HERE = Path(__file__).parent
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
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


@dataclass
class Problem(pools.Problem):
    """As the pools' own, run by the backend's own entries."""

    def run(self) -> Tensor:
        call = backend.surf_max_pool2d if self.mode == "max" else backend.surf_avg_pool2d
        guide = None if self.guide is None else self.guide.to(DEVICE)
        tensors = {"scale": self.scale.to(DEVICE), "guide": guide}
        out = call(self.input.to(DEVICE), guide_tolerance=self.guide_tolerance, **tensors,
                   **self.options)  # fmt: skip
        return out.to(self.input.device)

    def check(self, scale: bool = True) -> tuple[Tensor, dict[str, Tensor]]:
        """Output and gradients of one run; `scale` as in check_gradients."""
        leaves = {n: getattr(self, n).detach().requires_grad_() for n in pools.GRADIENTS}
        out = replace(self, **leaves).run()
        assert out.dtype == self.input.dtype
        pools.assert_close(out, self.expected(), "output")
        grad = torch.randn(out.shape).to(out.dtype)
        found = torch.autograd.grad(out, list(leaves.values()), grad, materialize_grads=True)
        grads = dict(zip(leaves, found, strict=True))
        expected = oracle_pools.backward(grad=to_numpy(grad), **self._oracle_arguments())
        for name in pools.GRADIENTS if scale else ("input",):
            assert grads[name].dtype == getattr(self, name).dtype, name
            pools.assert_close(grads[name], getattr(expected, name), f"grad_{name}")
        return out.detach(), grads


def make(mode: str, batch: int = 1, channels: int = 2, size: Any = (5, 6), **options: Any) -> Any:
    return Problem(**vars(pools.make(mode, batch, channels, size, **options)))


@contextmanager
def deterministic() -> Iterator[None]:
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)


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


@pytest.mark.parametrize("case", GUIDED, ids=name_of)
@pytest.mark.parametrize("fraction", [2.0**-24, 3 * 2.0**-24, 2.0**-26])
def test_what_a_guide_leaves_of_a_sample_may_weigh_next_to_nothing(
    case: dict[str, Any], fraction: float
) -> None:
    """Quotients of small weights are the CPU's, and a single corner is the sample itself."""
    problem = make(**case, channels=1, size=(3, 4), kernel=3, stride=1, guide="levels")
    problem.scale.fill_(1 + fraction)
    outputs, grads = [], []
    reference = pools.Problem(**vars(problem))
    for one in (problem, reference):
        outputs.append(one.run())
        grads.append(one.gradients(torch.ones_like(outputs[0])))
    torch.testing.assert_close(*outputs, rtol=1e-5, atol=1e-6)
    for name in pools.GRADIENTS:
        torch.testing.assert_close(grads[0][name], grads[1][name], rtol=1e-5, atol=1e-5)


def test_a_guide_that_would_hide_every_tap_does_not_apply_to_a_maximum() -> None:
    problem = make("max", kernel=2, stride=1, padding=0, guide="depth", dtype=torch.float64)
    # Taps of a kernel of 2 then lie further from the centre than its own pixel.
    problem.scale += 3.1
    out, _ = problem.check()
    assert_same_bits(out[..., 1:, :], replace(problem, guide=None).run()[..., 1:, :])
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
        patch.setattr(pool_tiles, "_BACKWARD_LANES", 16)
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
def test_pixels_that_no_tap_sees_do_not_leak(mode: str) -> None:
    problem = make(mode, 1, 1, (3, 8), kernel=(1, 2), stride=(1, 5), padding=0, scale="ones")
    problem.scale.fill_(1.25)
    clean = problem.gradients(torch.ones_like(problem.run()))
    problem.input[..., 3:4] = NAN
    problem.input[..., -1:] = INF if mode == "avg" else problem.input[..., -1:]
    assert problem.run().isfinite().all()
    for name, value in problem.gradients(torch.ones_like(problem.run())).items():
        assert_same_bits(value, clean[name], name)


def test_a_window_without_a_tap_is_zero() -> None:
    x = torch.randn(1, 2, 1, 1, requires_grad=True)
    scale = torch.ones(1, 1, 1, requires_grad=True)
    out = backend.surf_max_pool2d(x.to(DEVICE), 2, 1, 1, 2, scale=scale.to(DEVICE))
    assert out.eq(0).all()
    assert not any(g.any() for g in torch.autograd.grad(out.sum(), (x, scale)))
    clamped = backend.surf_max_pool2d(x.to(DEVICE), 2, 1, 1, 2, scale=scale.to(DEVICE) * 1.5)
    assert_same_bits(clamped.cpu(), x)


@pytest.mark.parametrize("kernel", [(5, 51), (16, 16)])
def test_winners_are_those_of_the_cpu(kernel: tuple[int, int]) -> None:
    """255 taps and the number that means none fit 8 bits."""
    x = torch.rand(1, 2, 17, 52)
    window = (list(kernel), [1, 9], [0, 0], [1, 1])
    sizes = [1, 17 - kernel[0] + 1, (52 - kernel[1]) // 9 + 1]
    scale = torch.full([1, *sizes], 0.9)
    output, winner = pool_kernels.max_pool2d(x.to(DEVICE), scale.to(DEVICE), None, 0.0, *window)
    wanted, numbers = torch.ops.surfconv.surf_max_pool2d(x, scale, None, 0.0, *window)
    assert winner.dtype == numbers.dtype and torch.equal(winner.cpu(), numbers)
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
@pytest.mark.parametrize("lanes", [8, 64])
def test_every_tile(mode: str, lanes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many tiles of pixels and blocks of channels add up."""

    def cut(*_: Any) -> list[pool_tiles.PoolTiles]:
        return [pool_tiles.PoolTiles(lanes // 4, 4, 4)]

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
    monkeypatch.setattr(cuda_pool_ops, "backend", lambda: (None, "no module named triton"))
    monkeypatch.setattr(_fallback, "_warned", False)
    with pytest.warns(RuntimeWarning, match="no module named triton.*pip install triton"):
        plain = call(x, scale, guide, tolerance, *options)
    forward = pool_reference.max_forward if mode == "max" else pool_reference.avg_forward
    wanted = forward(x, scale, guide, tolerance, *options)
    pairs = zip(plain, wanted, strict=True) if mode == "max" else [(plain, wanted)]
    for mine, other in pairs:
        assert_same_bits(mine, other)
    assert cuda_ops.backend()[0] is not None


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
