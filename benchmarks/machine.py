"""The machine and the software that a result belongs to."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch

import surfconv_ops
from frames import source


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _commit() -> str:
    """The commit of the checkout, with + where files differ from it; 'unknown' outside one."""
    root = Path(__file__).parents[1]

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    try:
        changed = "+" if git("status", "--porcelain") else ""
        return git("rev-parse", "--short=12", "HEAD") + changed
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def load() -> float | None:
    """Mean number of running processes over the last minute, where the system tells."""
    try:
        return round(os.getloadavg()[0], 2)
    except (OSError, AttributeError):
        return None


def describe(threads: tuple[int, ...]) -> dict[str, Any]:
    """Everything about this run that its numbers depend on."""
    try:
        capability = str(torch.ops.surfconv.cpu_capability())
    except (AttributeError, RuntimeError):
        capability = "no compiled operator"
    return {
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "threads": list(threads),
        "load_before": load(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torch_cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "surfconv_ops": surfconv_ops.__version__,
        "surfconv_cpu_capability": capability,
        "commit": _commit(),
        "command": " ".join(["python", "benchmarks/run.py", *sys.argv[1:]]),
        "depth": source(),
    }
