"""Instruction sets that a run is held to, so that a newer processor stands for an older one."""

from __future__ import annotations

import os
import subprocess
import sys

#: What each of the libraries at work reads when it is loaded: torch and our kernels, oneDNN, MKL.
VARIABLES = {
    "avx2": {
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    }
}


def environment(name: str) -> dict[str, str]:
    """The environment of a process that is held to an instruction set."""
    return {**os.environ, **VARIABLES[name]}


def held_to() -> str:
    """What this process is held to: a name of VARIABLES or 'nothing'."""
    for name, variables in VARIABLES.items():
        if all(os.environ.get(key) == value for key, value in variables.items()):
            return name
    return "nothing"


def start_again(name: str) -> int:
    """Run this program's own command held to an instruction set, and return its exit status."""
    return subprocess.call([sys.executable, *sys.orig_argv[1:]], env=environment(name))
