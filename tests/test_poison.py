"""Memory that was never written must not reach a result."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers import DTYPES, make_problem
from operators import GEOMETRIES, name_of
from surfconv_ops import surf_conv2d

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def poisoned() -> Iterator[None]:
    """Every tensor that torch hands out uninitialized starts as NaN."""
    settings = torch.are_deterministic_algorithms_enabled()
    fill = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = True
    yield
    torch.use_deterministic_algorithms(settings)
    torch.utils.deterministic.fill_uninitialized_memory = fill


def test_poison_works() -> None:
    assert torch.empty(100).isnan().all()


@pytest.mark.parametrize("case", GEOMETRIES, ids=name_of)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("scale", ["random", "nan", "huge", "mixed"])
def test_geometry(case: dict[str, Any], layout: str, scale: str) -> None:
    problem = make_problem(layout=layout, scale=scale, **case)
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("channels", [1, 17, 70])
def test_dtype(dtype: torch.dtype, channels: int) -> None:
    problem = make_problem(1, channels, 33, (5, 19), dtype=dtype, scale="smooth")
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("guide", ["nan", "holes", "levels"])
def test_guide_that_hides_almost_everything(guide: str) -> None:
    problem = make_problem(guide=guide)
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


def test_pixels_that_no_tap_sees_have_gradient_zero() -> None:
    problem = make_problem(2, 3, 4, (20, 20), 1, stride=7, padding=0)
    grad = torch.randn(problem.output_shape())
    seen = problem.gradients(surf_conv2d, grad)["input"].abs().sum((0, 1)) != 0
    assert seen.sum() == 9 and seen[::7, ::7].all()


def test_batch_of_zero() -> None:
    problem = make_problem(1)
    empty = replace(problem, input=problem.input[:0], scale=problem.scale[:0])
    gradients = empty.gradients(surf_conv2d, torch.zeros(0, 4, 7, 8))
    for name in ("weight", "bias"):
        assert gradients[name].eq(0).all(), name


def test_scratch_memory() -> None:
    """The kernels' own buffers are not torch's: let the C library fill what it hands out."""
    environment = os.environ | {"MALLOC_PERTURB_": "1", "OMP_NUM_THREADS": "1"}
    environment.pop("PYTEST_XDIST_WORKER", None)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    files = [
        str(HERE / f"test_{name}.py") for name in ("channels", "forward", "gradients", "paths")
    ]
    selection = [
        *files,
        "-m",
        "core",
        "-k",
        "odd or blocks or ((geometry or guide or dtype) and public)",
    ]
    result = subprocess.run([*command, *selection], cwd=HERE.parent, env=environment,
                            capture_output=True, text=True, timeout=300, check=False)  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
