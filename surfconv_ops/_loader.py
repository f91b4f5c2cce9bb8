"""Loads the compiled operators, or defines them in Python where no build of them is found.

``torch.ops.surfconv`` has the same operators either way. With the compiled library, the CPU runs
its kernels and every other device the reference; without it, everything runs the reference.
"""

from __future__ import annotations

import os
from pathlib import Path

import torch

#: Names another build of the library to load instead of the installed one.
LIBRARY_VARIABLE = "SURFCONV_LIBRARY"
_INSTALLED = Path(__file__).with_name("_C.so")


def _load() -> str | None:
    """Load the library; the reason why not where there is none that loads."""
    named = os.environ.get(LIBRARY_VARIABLE)
    if named:
        # Whoever names a build wants that one: failing is better than measuring something else.
        if not Path(named).is_file():
            raise ImportError(f"{LIBRARY_VARIABLE}={named} names no file")
        torch.ops.load_library(named)
        return None
    if not _INSTALLED.is_file():
        return "no compiled library is installed"
    try:
        torch.ops.load_library(str(_INSTALLED))
    except OSError as error:
        return f"the compiled library does not load with torch {torch.__version__} ({error})"
    return None


#: Why no compiled library is in use; None where one is.
missing_library_reason: str | None = _load()
