"""Pools under hostile scale, guide and depth; memory; the same bits for every thread count."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import surfconv_ops
from helpers import DTYPES, assert_same_bits
from operators import name_of
from pools import CASES, Problem, make
from surfconv_ops import (
    DepthLevels,
    SurfAvgPool2d,
    SurfMaxPool2d,
    surf_avg_pool2d,
    surf_max_pool2d,
)
from test_instruction_sets import ALL, AVAILABLE, environment
from test_safety import POISONS

HERE = Path(__file__).parent
MODES = ("max", "avg")
each_mode = pytest.mark.parametrize("mode", MODES)
INF, NAN = float("inf"), float("nan")


def check_finite(problem: Problem) -> None:
    out = problem.run()
    assert out.isfinite().all()
    for name, value in problem.gradients(torch.randn_like(out)).items():
        assert value.isfinite().all(), name


@pytest.mark.core
@each_mode
@pytest.mark.parametrize("poison", POISONS)
@pytest.mark.parametrize("kernel", [3, (2, 5)])
def test_scale(mode: str, poison: float, kernel: Any) -> None:
    for everywhere, others in ((True, {}), (False, {"guide": "holes"})):
        for pad in (True, False) if mode == "avg" else (None,):
            own = {} if pad is None else {"count_include_pad": pad}
            problem = make(mode, 1, kernel=kernel, stride=1, axes=2, ceil_mode=True, **own,
                           **others)  # fmt: skip
            if everywhere:
                problem.scale.fill_(poison)
            else:
                problem.scale[:, 1, ::2, ::3] = poison
            check_finite(problem)
            problem.check_forward()


@each_mode
@pytest.mark.parametrize("poison", POISONS)
@pytest.mark.parametrize("tolerance", [0.0, 1.0, INF])
def test_guide(mode: str, poison: float, tolerance: float) -> None:
    problem = make(mode, 1, guide="depth", guide_tolerance=tolerance)
    assert problem.guide is not None
    problem.guide[:, ::2, ::3] = poison
    check_finite(problem)
    problem.check_forward()


DEPTH_MODES: dict[str, dict[str, Any]] = {
    "continuous": {},
    "window": {"depth_window": 0.5},
    "same_level_only": {"levels": DepthLevels([2.0], [1.0, 3.0]), "same_level_only": True},
}


@each_mode
@pytest.mark.parametrize("options", DEPTH_MODES)
@pytest.mark.parametrize("poison", POISONS)
def test_depth(mode: str, options: str, poison: float) -> None:
    kind = SurfMaxPool2d if mode == "max" else SurfAvgPool2d
    pool = kind(3, 2, 1, ceil_mode=True, reference_depth=2.0, **DEPTH_MODES[options])
    depth = torch.rand(2, 6, 7) * 3 + 0.5
    depth[0] = poison
    depth[1, ::2, ::3] = poison
    x = torch.randn(2, 2, 6, 7, requires_grad=True)
    out = pool(x, depth.requires_grad_())
    assert out.isfinite().all()
    for value in torch.autograd.grad(out.square().sum(), (x, depth), allow_unused=True):
        assert value is None or value.isfinite().all()


@each_mode
@pytest.mark.parametrize("bad", [INF, NAN])
def test_pixels_that_no_tap_sees_do_not_leak(mode: str, bad: float) -> None:
    for others in ({"stride": 4}, {"stride": 3, "guide": "levels"}, {"stride": 5, "scale": "ones"}):
        problem = make(mode, 1, 5, (16, 18), dtype=torch.float64, **others)
        if "scale" not in others:
            problem.scale += 0.0123
        out = problem.run()
        grad = torch.randn_like(out)
        before = problem.gradients(grad)
        # Positive terms do not cancel: who has a gradient of the average has been seen.
        average = replace(problem, mode="avg", input=torch.ones_like(problem.input))
        seen = average.gradients(torch.ones_like(out))["input"] != 0
        if mode == "max":
            # Clamped samples see the border.
            seen[..., 0, :] = seen[..., -1, :] = seen[..., :, 0] = seen[..., :, -1] = True
        assert not seen.all()
        dirty = replace(problem, input=problem.input.masked_fill(~seen, bad))
        assert_same_bits(dirty.run(), out)
        after = dirty.gradients(grad)
        assert_same_bits(after["input"], before["input"])
        if others.get("scale") != "ones":
            assert_same_bits(after["scale"], before["scale"])


@pytest.mark.parametrize("bad", [INF, NAN])
def test_a_tap_that_does_not_move_adds_nothing_to_the_gradient_of_the_scale(bad: float) -> None:
    problem = make("avg", 1, 5, (16, 19), kernel=3, stride=3, padding=1, scale="ones")
    problem.scale.fill_(1.3)
    grad = torch.randn_like(problem.run())
    before = problem.gradients(grad)["scale"]
    dirty = replace(problem, input=problem.input.clone())
    dirty.input[..., ::3, ::3] = bad  # the centres
    assert_same_bits(dirty.gradients(grad)["scale"], before)


@each_mode
@pytest.mark.parametrize("bad", [INF, NAN])
def test_on_the_grid_nothing_leaks_from_across_a_corner(mode: str, bad: float) -> None:
    """A growing scale moves a tap that lies on a pixel along its edges, for now."""
    problem = make(mode, 1, 5, (16, 18), kernel=3, stride=5, padding=1, scale="ones")
    grad = torch.randn_like(problem.run())
    before = problem.gradients(grad)
    dirty = replace(problem, input=problem.input.clone())
    across = torch.tensor([2, 3, 7, 8, 12, 13])  # two pixels from the centres, which are 5 apart
    dirty.input[..., across[:, None], across] = bad
    after = dirty.gradients(grad)
    assert_same_bits(after["input"], before["input"])
    assert_same_bits(after["scale"], before["scale"])


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_gradients_that_are_not_finite_stay_where_they_belong(layout: str) -> None:
    for mode in MODES:
        for channels in (5, 8):
            problem = make(mode, 1, channels, (9, 9), layout=layout, stride=3)
            grad = torch.randn(problem.run().shape)
            clean = problem.gradients(grad)
            grad[0, 1, 1, 1] = INF
            dirty = problem.gradients(grad)
            others = [c for c in range(channels) if c != 1]
            assert_same_bits(dirty["input"][:, others], clean["input"][:, others], mode)
            assert not dirty["input"].isnan().any() and dirty["input"].isinf().any()


@pytest.mark.core
@each_mode
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("kernel", [1, 2, 3, (5, 4)])
def test_one_pixel_maps(mode: str, dtype: torch.dtype, kernel: Any) -> None:
    padding = kernel // 2 if isinstance(kernel, int) else (2, 2)
    for scale in ("random", "mixed"):
        problem = make(mode, 2, 3, (1, 1), kernel=kernel, stride=1, padding=padding, dtype=dtype,
                       scale=scale)  # fmt: skip
        problem.check_forward()


def test_winners_that_no_forward_gave_stay_in_bounds() -> None:
    """A caller's own numbers must not reach memory that is not the tensor's."""
    problem = make("max", 1, 5, (6, 7), stride=1)
    grad = torch.randn(1, 5, 6, 7)
    arguments = (0.0, [3, 3], [1, 1], [1, 1], [1, 1])
    winner = torch.randint(0, 256, (1, 6, 7, 5), dtype=torch.uint8)
    for scale in (problem.scale, torch.ones_like(problem.scale)):
        grads = torch.ops.surfconv.surf_max_pool2d_backward(
            grad, problem.input, scale, None, winner, *arguments, True, True
        )
        assert all(g.isfinite().all() for g in grads)


def test_wrong_winners_are_refused(compiled: None) -> None:
    problem = make("max", 1, 5, (6, 7), stride=1)
    rest = (0.0, [3, 3], [1, 1], [1, 1], [1, 1], True, True)
    for winner in (torch.zeros(1, 6, 7, 4, dtype=torch.uint8), torch.zeros(1, 6, 7, 5)):
        with pytest.raises(RuntimeError, match="winner"):
            torch.ops.surfconv.surf_max_pool2d_backward(
                torch.randn(1, 5, 6, 7), problem.input, problem.scale, None, winner, *rest
            )


BIG: list[dict[str, Any]] = [
    {"channels": 7, "size": (31, 37)},
    {"channels": 40, "size": (19, 45), "stride": 1, "layout": "channels_last"},
    {"channels": 64, "size": (33, 40), "axes": 2, "guide": "levels"},
    {"batch": 5, "channels": 3, "size": (11, 90), "guide": "holes"},
    {"channels": 130, "size": (20, 24), "scale": "ones", "layout": "channels_last"},
]


@each_mode
@pytest.mark.parametrize("case", BIG, ids=name_of)
def test_every_thread_count_gives_the_same_bits(
    mode: str, case: dict[str, Any], set_threads: Callable[[int], None]
) -> None:
    problem = make(mode, **case)

    def results(threads: int) -> dict[str, Tensor]:
        set_threads(threads)
        out = problem.run()
        grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
        return {"output": out} | problem.gradients(grad)

    first = results(1)
    for threads in (1, 2, 3, 7):
        for name, value in results(threads).items():
            assert_same_bits(value, first[name], f"{name}, {threads} threads")


@pytest.fixture
def poisoned() -> Any:
    """Every tensor that torch hands out uninitialized starts as NaN."""
    settings = torch.are_deterministic_algorithms_enabled()
    fill = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = True
    yield
    torch.use_deterministic_algorithms(settings)
    torch.utils.deterministic.fill_uninitialized_memory = fill


@pytest.mark.parametrize("case", CASES, ids=name_of)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_memory_that_was_never_written(case: dict[str, Any], layout: str, poisoned: None) -> None:
    for channels in (3, 8):
        problem = make(**case, channels=channels, layout=layout, batch=1)
        assert problem.run().isfinite().all()
        for value in problem.gradients(problem.run()).values():
            assert value.isfinite().all()


def test_pixels_without_a_tap_have_gradient_zero(poisoned: None) -> None:
    for layout in ("contiguous", "channels_last"):
        problem = make("avg", 2, 8, (20, 20), kernel=1, stride=7, padding=0, layout=layout)
        grad = problem.gradients(torch.ones_like(problem.run()))["input"]
        assert grad.ne(0).sum() == 2 * 8 * 9 and grad[..., ::7, ::7].eq(1).all()


@pytest.mark.parametrize("capability", ALL)
def test_instruction_set(capability: str, compiled: None) -> None:
    if capability not in AVAILABLE:
        pytest.skip(f"this processor has no {capability}")
    chosen = "test_geometry or test_channels or test_guide or test_dtype or test_nan or more_taps"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist",
               str(HERE / "test_pools.py"), "-k", chosen]  # fmt: skip
    # Scratch memory is not torch's: the C library fills what it hands out.
    settings = environment(capability) | {"MALLOC_PERTURB_": "1"}
    result = subprocess.run(command, cwd=HERE.parent, env=settings, timeout=400,
                            capture_output=True, text=True, check=False)  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-1000:]


def test_without_a_library(tmp_path: Path) -> None:
    """The reference behind the same functions passes the same tests."""
    source = Path(surfconv_ops.__file__).parent
    ignored = shutil.ignore_patterns("*.so", "__pycache__")
    shutil.copytree(source, tmp_path / "surfconv_ops", ignore=ignored)
    settings = os.environ | {"PYTHONPATH": str(tmp_path)}
    settings.pop("SURFCONV_LIBRARY", None)
    chosen = "test_geometry or (test_guide and levels and 0.0) or wins or zero or shapes"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist",
               "-c", os.devnull, "--rootdir", str(tmp_path), str(HERE / "test_pools.py"),
               "-k", chosen]  # fmt: skip
    result = subprocess.run(command, cwd=tmp_path, env=settings, timeout=400,
                            capture_output=True, text=True, check=False)  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:]
    assert "install" in result.stdout, "the fallback's warning shows which implementation ran"


def test_the_rim_of_a_huge_scale_is_clamped_or_zero() -> None:
    x = torch.arange(1.0, 26.0).reshape(1, 1, 5, 5)
    scale = torch.full((1, 5, 5), 1e30)
    top = surf_max_pool2d(x, 3, 1, 1, scale=scale)
    assert top.eq(25).all()
    mean = surf_avg_pool2d(x, 3, 1, 1, scale=scale)
    torch.testing.assert_close(mean, x / 9)
