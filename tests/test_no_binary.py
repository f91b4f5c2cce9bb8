"""A copy of the package without its compiled library: right results, one warning."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import surfconv_ops

HERE = Path(__file__).parent
CODE = """
import warnings
import torch, torch.nn.functional as F
with warnings.catch_warnings(record=True) as at_import:
    warnings.simplefilter("always")
    import surfconv_ops
from surfconv_ops import DepthLevels, SurfConv2d, surf_conv2d
assert not [w for w in at_import if "surfconv" in str(w.message)], "nothing has run yet"
assert not hasattr(torch.ops.surfconv, "cpu_capability"), "the compiled library is loaded"
x, weight = torch.randn(2, 3, 8, 9, requires_grad=True), torch.randn(4, 3, 3, 3, requires_grad=True)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for _ in range(3):
        out = surf_conv2d(x, weight, scale=torch.full((2, 8, 9), 2.0), padding=1)
        grads = torch.autograd.grad(out.square().sum(), (x, weight))
    levels = DepthLevels([1.0, 2.0], [0.5, 1.5, 3.0])
    SurfConv2d(3, 4, 3, 2, reference_depth=1.0, levels=levels)(x, torch.rand(2, 8, 9) * 4)
expected = F.conv2d(x, weight, padding=2, dilation=2)
torch.testing.assert_close(out, expected, rtol=1e-4, atol=1e-4)
wanted = torch.autograd.grad(expected.square().sum(), (x, weight))
for ours, theirs in zip(grads, wanted):
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-3)
ours = [str(w.message) for w in caught]
assert len(ours) == 1, ours
assert "install" in ours[0] and "reference" in ours[0], ours
"""


@pytest.fixture
def bare(tmp_path: Path) -> dict[str, str]:
    """An environment whose only surfconv_ops is a copy without a binary."""
    source = Path(surfconv_ops.__file__).parent
    shutil.copytree(
        source, tmp_path / "surfconv_ops", ignore=shutil.ignore_patterns("*.so", "__pycache__")
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    environment.pop("SURFCONV_LIBRARY", None)
    return environment


def run(
    command: list[str], environment: dict[str, str], folder: Path
) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *command], env=environment, cwd=folder, timeout=300,
                          capture_output=True, text=True, check=False)  # fmt: skip


def test_one_warning_and_right_results(bare: dict[str, str], tmp_path: Path) -> None:
    result = run(["-c", CODE], bare, tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]


def test_the_same_tests_pass(bare: dict[str, str], tmp_path: Path) -> None:
    """A spread of the suite, run on the fallback behind the public function."""
    files = [str(HERE / f"test_{name}.py") for name in ("forward", "gradients", "layouts")]
    selection = ["-k", "(test_geometry or test_dtype or test_output) and not reference"]
    result = run(["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist",
                  "-c", os.devnull,
                  "--rootdir", str(tmp_path), *files, *selection], bare, tmp_path)  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:]
    assert "warning" in result.stdout, "the fallback's warning shows which implementation ran"


def test_a_named_library_that_is_not_there(bare: dict[str, str], tmp_path: Path) -> None:
    missing = str(tmp_path / "nowhere.so")
    environment = bare | {"SURFCONV_LIBRARY": missing}
    result = run(["-c", "import surfconv_ops"], environment, tmp_path)
    assert result.returncode != 0 and missing in result.stderr


def test_a_library_that_does_not_load(bare: dict[str, str], tmp_path: Path) -> None:
    """As on another platform: the reference serves, and the warning says why."""
    (tmp_path / "surfconv_ops" / "_C.so").write_bytes(b"no library")
    result = run(["-c", CODE], bare, tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
