"""The machine and the software that a result belongs to."""

from __future__ import annotations

import importlib
import os
import platform
import subprocess
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch

import instructions
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


def _version(package: str) -> str:
    """A package's version, or why it cannot be imported."""
    try:
        return str(importlib.import_module(package).__version__)
    except (ImportError, OSError, RuntimeError) as error:
        return f"none ({type(error).__name__}: {error})"


def _driver() -> str:
    try:
        done = subprocess.run(
            ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            check=True,
            timeout=20,
        )
        return done.stdout.split()[0]
    except (OSError, IndexError, subprocess.SubprocessError):
        return "unknown"


def gpu(device: torch.device) -> dict[str, Any]:
    """A CUDA device, and the software between it and torch."""
    about = torch.cuda.get_device_properties(device)
    return {
        "gpu": about.name,
        "gpu_compute_capability": f"{about.major}.{about.minor}",
        "gpu_multiprocessors": about.multi_processor_count,
        "gpu_memory_mib": about.total_memory // 2**20,
        "gpu_l2_mib": about.L2_cache_size / 2**20,
        "driver": _driver(),
        "cuda": torch.version.cuda,
        "cudnn": torch.backends.cudnn.version(),
        "triton": _version("triton"),
        "torchvision": _version("torchvision"),
    }


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
        "instructions_held_to": instructions.held_to(),
        "commit": _commit(),
        "command": " ".join(["python", "benchmarks/run.py", *sys.argv[1:]]),
        "depth": source(),
    }
