"""Builds surfconv_ops/_C.so, the compiled operator, against LibTorch's stable ABI.

Everything else about the package is in pyproject.toml. Environment variables:

SURFCONV_NO_BINARY=1      install without the compiled operator (the PyTorch reference serves)
SURFCONV_TORCH_ROOT=DIR   the torch to build against: the folder holding include/ and lib/
SURFCONV_SANITIZE=1       build with AddressSanitizer and UBSan (give --build-lib a path of its own)
CXX, CXXFLAGS, LDFLAGS    the compiler, and flags added after the project's own
MAX_JOBS=N                compile at most N files at once
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import site
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py
from setuptools.command.dist_info import dist_info

ROOT = Path(__file__).resolve().parent
LIBRARY = ROOT / "surfconv_ops" / "_C.so"


def switched_on(name: str) -> bool:
    return os.environ.get(name, "0") not in ("", "0")


NO_BINARY = switched_on("SURFCONV_NO_BINARY")
SANITIZE = switched_on("SURFCONV_SANITIZE")

COMPILE_FLAGS = [
    "-std=c++17",
    "-fPIC",
    "-fvisibility=hidden",
    "-fvisibility-inlines-hidden",
    "-Wall",
    "-Wextra",
    "-Wno-psabi",  # vectors are passed within one object file only
    "-DTORCH_TARGET_VERSION=0x020a000000000000",
    "-D_GLIBCXX_USE_CXX11_ABI=1",
]
# No rpath: torch is loaded before this library, which then finds torch's own by name.
LINK_FLAGS = ["-shared"]
LIBRARIES = ["-Wl,--as-needed", "-ltorch_cpu", "-lc10", "-ltorch"]
if SANITIZE:
    SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    COMPILE_FLAGS += ["-O1", "-g", "-fno-omit-frame-pointer", *SANITIZERS]
    LINK_FLAGS += SANITIZERS
else:
    # The kernels read neither errno nor the exception flags; saying so lets loops vectorise.
    COMPILE_FLAGS += ["-O3", "-fno-math-errno", "-fno-trapping-math"]
    # Where loops lie in cache lines, worth 7 % of a product, is then no matter of luck.
    COMPILE_FLAGS += ["-falign-functions=64", "-falign-loops=64"]
    LINK_FLAGS += ["-Wl,-z,defs"]


def find_compiler() -> list[str] | None:
    """The C++ compiler as a command line, or None where there is none."""
    asked = os.environ.get("CXX")
    for command in [asked] if asked else ["g++", "c++", "clang++"]:
        words = shlex.split(command)
        if words and shutil.which(words[0]):
            return words
    return None


def why_no_binary() -> str | None:
    """Why this install goes on without the compiled operator; None where it is built."""
    if NO_BINARY:
        return "SURFCONV_NO_BINARY is set"
    if not sys.platform.startswith("linux"):
        return "it is built on Linux only"
    if find_compiler() is None:
        return f"no C++ compiler was found (looked for {os.environ.get('CXX') or 'g++'})"
    return None


WHY_NO_BINARY = why_no_binary()


def say_if_no_binary() -> None:
    if WHY_NO_BINARY:
        print(
            f"surfconv_ops: installing without the compiled operator: {WHY_NO_BINARY}. "
            "The slower PyTorch reference serves instead.",
            file=sys.stderr,
        )


def torch_folders() -> Iterator[Path]:
    """Where the torch package may lie, the surrounding environment's own places first.

    An isolated build runs this environment's interpreter with its packages hidden from sys.path,
    so torch is looked up by path and not imported.
    """
    paths = sysconfig.get_paths()
    places = [paths["purelib"], paths["platlib"], *site.getsitepackages()]
    places += [site.getusersitepackages(), *sys.path]
    # Front ends that build in an environment of their own leave no other trace of the real one.
    # Should this torch not be the one used later, nothing is lost: its binary serves any.
    if venv := os.environ.get("VIRTUAL_ENV"):
        places.append(f"{venv}/lib/python{sysconfig.get_python_version()}/site-packages")
    base = {"base": sys.base_prefix, "platbase": sys.base_exec_prefix}
    places.append(sysconfig.get_path("purelib", vars=base))
    for place in dict.fromkeys(filter(None, places)):
        yield Path(place) / "torch"


def find_torch() -> Path:
    """The folder with torch's include/ and lib/."""
    asked = os.environ.get("SURFCONV_TORCH_ROOT")
    too_old = ""
    for root in [Path(asked)] if asked else torch_folders():
        if not (root / "lib" / "libtorch_cpu.so").is_file():
            continue
        version = root / "include" / "torch" / "headeronly" / "version.h"
        numbers = re.findall(
            r"define TORCH_VERSION_M(?:AJOR|INOR) (\d+)",
            version.read_text(encoding="utf-8") if version.is_file() else "",
        )
        if tuple(map(int, numbers)) >= (2, 10):
            return root.resolve()
        too_old = f"; the one in {root} is too old"
    where = f"in SURFCONV_TORCH_ROOT={asked}" if asked else "in this environment"
    raise SystemExit(
        f"\nsurfconv_ops: no torch of version 2.10 or later was found {where}{too_old}.\n"
        "The compiled operator is built against an installed torch; the build downloads none.\n"
        "Do one of these, then install again:\n"
        "  - install torch into this environment first (pip install torch==2.13.0);\n"
        "  - set SURFCONV_TORCH_ROOT to the torch folder that holds include/ and lib/;\n"
        "  - set SURFCONV_NO_BINARY=1 to install without the compiled operator.\n"
    )


class Step(NamedTuple):
    """One command of the build; inputs beyond the command's own come from its depfile."""

    rule: str
    inputs: list[Path]
    output: Path
    command: list[str]


def build_steps(sources: list[Path], folder: Path) -> list[Step]:
    """The compile steps, then the link step."""
    compiler, torch = find_compiler(), find_torch()
    assert compiler is not None
    include = [f"-I{ROOT / 'csrc'}", "-isystem", str(torch / "include")]
    flags = [*COMPILE_FLAGS, *include, *shlex.split(os.environ.get("CXXFLAGS", ""))]
    steps = []
    for source in sources:
        output = folder / source.relative_to(ROOT).with_suffix(".o")
        depfile = ["-MD", "-MF", f"{output}.d"]
        command = [*compiler, *flags, *depfile, "-c", str(source), "-o", str(output)]
        steps.append(Step("compile", [source], output, command))
    objects = [step.output for step in steps]
    library = folder / LIBRARY.name
    command = [*compiler, *LINK_FLAGS, *map(str, objects), f"-L{torch / 'lib'}", *LIBRARIES]
    command += [*shlex.split(os.environ.get("LDFLAGS", "")), "-o", str(library)]
    return [*steps, Step("link", objects, library, command)]


def run_with_ninja(ninja: str, steps: list[Step], folder: Path) -> None:
    """Runs what is out of date, in parallel."""

    def escaped(path: Path) -> str:
        return re.sub(r"([$ :])", r"$\1", str(path))

    rule = "rule {0}\n  command = $command\n  description = {0} $out\n"
    lines = [rule.format("link"), rule.format("compile") + "  depfile = $out.d\n  deps = gcc\n"]
    for step in steps:
        inputs = " ".join(map(escaped, step.inputs))
        command = shlex.join(step.command).replace("$", "$$")
        lines.append(f"build {escaped(step.output)}: {step.rule} {inputs}\n  command = {command}\n")
    (folder / "build.ninja").write_text("\n".join(lines), encoding="utf-8")
    jobs = ["-j", os.environ["MAX_JOBS"]] if os.environ.get("MAX_JOBS") else []
    run_command([ninja, *jobs], folder)


def run_with_threads(steps: list[Step]) -> None:
    """Runs everything: an environment used without build isolation may lack ninja."""
    for step in steps:
        step.output.parent.mkdir(parents=True, exist_ok=True)
    *compiles, link = steps
    with ThreadPoolExecutor(int(os.environ.get("MAX_JOBS") or os.cpu_count() or 1)) as pool:
        list(pool.map(run_command, [step.command for step in compiles]))
    run_command(link.command)


def run_command(command: list[str], folder: Path = ROOT) -> None:
    if subprocess.run(command, check=False, cwd=folder).returncode != 0:
        raise SystemExit(
            f"\nsurfconv_ops: building the compiled operator failed: {shlex.join(command)}\n"
            "SURFCONV_NO_BINARY=1 installs without it.\n"
        )


def replace_file(source: Path, target: Path) -> None:
    """Copies by rename, so that a process using the old library keeps its file."""
    if target.is_file() and target.read_bytes() == source.read_bytes():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.{os.getpid()}")
    shutil.copyfile(source, partial)
    partial.replace(target)


class CheckedMetadata(dist_info):
    def run(self) -> None:
        # pip asks for the metadata, then downloads what is missing (torch too), and only then
        # builds: failing here saves the download.
        if not WHY_NO_BINARY:
            find_torch()
        super().run()


class BuildNative(build_ext):
    """Keeps objects in build/ of the source tree, so that a rebuild is incremental."""

    def get_ext_filename(self, fullname: str) -> str:
        # No Python ABI tag: the library does not use Python's C API.
        return str(Path(*fullname.split(".")).with_suffix(".so"))

    def run(self) -> None:
        say_if_no_binary()
        if NO_BINARY and self.inplace:
            LIBRARY.unlink(missing_ok=True)
        super().run()

    def build_extension(self, ext: Extension) -> None:
        import fcntl  # absent on Windows, where the pure-Python install must still work

        folder = ROOT / "build" / ("native-sanitize" if SANITIZE else "native")
        folder.mkdir(parents=True, exist_ok=True)
        steps = build_steps([ROOT / source for source in ext.sources], folder)
        # The ninja package's first, so that installs with and without isolation share one log.
        beside = str(Path(sys.executable).parent)
        ninja = shutil.which("ninja", path=beside) or shutil.which("ninja")
        with (folder / "lock").open("w", encoding="utf-8") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if ninja:
                run_with_ninja(ninja, steps, folder)
            else:
                run_with_threads(steps)
            replace_file(steps[-1].output, Path(self.get_ext_fullpath(ext.name)))

    def copy_extensions_to_source(self) -> None:
        for ext in self.extensions:
            replace_file(Path(self.build_lib) / self.get_ext_filename(ext.name), LIBRARY)


class BuildPython(build_py):
    def run(self) -> None:
        say_if_no_binary()
        if NO_BINARY and self.editable_mode:
            LIBRARY.unlink(missing_ok=True)
        super().run()


class UniversalWheel(bdist_wheel):
    """Tags the wheel for every Python 3 of this platform."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


def extensions() -> list[Extension]:
    if WHY_NO_BINARY:
        return []
    sources = sorted(ROOT.glob("csrc/**/*.cpp"))
    return [Extension("surfconv_ops._C", [str(path.relative_to(ROOT)) for path in sources])]


setup(
    ext_modules=extensions(),
    cmdclass={
        "bdist_wheel": UniversalWheel,
        "build_ext": BuildNative,
        "build_py": BuildPython,
        "dist_info": CheckedMetadata,
    },
)
