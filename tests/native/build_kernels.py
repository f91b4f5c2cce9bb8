"""Links the kernels' objects that `make build` left into a Python module for the native tests."""

from __future__ import annotations

import fcntl
import importlib.util
import os
import shlex
import subprocess
import sysconfig
from pathlib import Path
from types import ModuleType

NAME = "surfconv_kernels"
ROOT = Path(__file__).resolve().parents[2]
SOURCE = Path(__file__).with_name("kernels.cpp")
SANITIZE = os.environ.get("SURFCONV_SANITIZE", "0") not in ("", "0")
# The objects, and so the code under test, are the very ones that went into the library.
FOLDER = ROOT / "build" / ("native-sanitize" if SANITIZE else "native")


def objects() -> list[Path]:
    """One of each source of the kernels."""
    sources = sorted(path.relative_to(ROOT) for path in ROOT.glob("csrc/cpu/**/*.cpp"))
    return [(FOLDER / path).with_suffix(".o") for path in sources]


def why_not() -> str | None:
    """What is missing to build the module."""
    if not all(path.is_file() for path in objects()):
        return "no compiled operator was built in this source tree: run make build"
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        return "Python's C headers are not installed"
    return None


def build() -> Path:
    """The module's path, built anew where an object or the binding changed."""
    import pybind11

    module = FOLDER / f"{NAME}{sysconfig.get_config_var('EXT_SUFFIX')}"
    newest = max(path.stat().st_mtime for path in [SOURCE, *objects()])
    with (FOLDER / "tests.lock").open("w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if module.is_file() and module.stat().st_mtime > newest:
            return module
        flags = ["-std=c++17", "-O1", "-shared", "-fPIC", "-fvisibility=hidden", "-pthread"]
        if SANITIZE:
            flags += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
        includes = [ROOT / "csrc", pybind11.get_include(), sysconfig.get_path("include")]
        command = [
            *shlex.split(os.environ.get("CXX", "g++")),
            *flags,
            *(f"-I{folder}" for folder in includes),
            str(SOURCE),
            *map(str, objects()),
            "-o",
            str(module),
        ]
        # A sanitizer preloaded for the tests is not for the compiler.
        environment = {key: value for key, value in os.environ.items() if key != "LD_PRELOAD"}
        subprocess.run(command, check=True, env=environment)
    return module


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location(NAME, build())
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
