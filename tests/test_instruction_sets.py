"""The core tests once more for each instruction set that this processor can run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).parent
ALL = ["default", "avx2", "avx512"]
BEST = torch.backends.cpu.get_cpu_capability().lower()
AVAILABLE = ALL[: ALL.index(BEST) + 1] if BEST in ALL else ["default"]
FILES = ["forward", "gradients", "channels", "paths"]


def environment(capability: str) -> dict[str, str]:
    return os.environ | {"ATEN_CPU_CAPABILITY": capability}


@pytest.mark.parametrize("capability", ALL)
def test_core(capability: str, compiled: None) -> None:
    if capability not in AVAILABLE:
        pytest.skip(f"this processor has no {capability}")
    files = [str(HERE / f"test_{name}.py") for name in FILES]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist",
               *files, "-m", "core", "-k", "not reference"]  # fmt: skip
    result = subprocess.run(command, cwd=HERE.parent, env=environment(capability), timeout=400,
                            capture_output=True, text=True, check=False)  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-1000:]


@pytest.mark.parametrize("capability", ALL)
def test_the_variable_is_honoured(capability: str, compiled: None) -> None:
    """An instruction set that the processor lacks falls back to one that it has."""
    code = "import torch, surfconv_ops; print(torch.ops.surfconv.cpu_capability())"
    result = subprocess.run([sys.executable, "-c", code], cwd=HERE.parent,
                            env=environment(capability), capture_output=True, text=True,
                            check=True, timeout=120)  # fmt: skip
    used = result.stdout.strip()
    assert used == capability if capability in AVAILABLE else used in AVAILABLE


def test_the_best_is_the_default(compiled: None) -> None:
    code = "import torch, surfconv_ops; print(torch.ops.surfconv.cpu_capability())"
    plain = {k: v for k, v in os.environ.items() if k != "ATEN_CPU_CAPABILITY"}
    result = subprocess.run([sys.executable, "-c", code], cwd=HERE.parent, env=plain,
                            capture_output=True, text=True, check=True, timeout=120)  # fmt: skip
    assert result.stdout.strip() == AVAILABLE[-1]
