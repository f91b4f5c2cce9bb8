"""Peak extra memory of one call, each in a process of its own.

`python memory.py NAME SHAPE LAYOUT DIRECTION SLICES` measures one call and prints it as JSON. The
child makes its inputs, runs the same call once at a tiny shape (libraries, thread pools), and then
measures the first call at the real shape: the peak of the process's resident memory during it, less
the resident memory before it. Outputs and gradients are part of it for every candidate alike.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from cases import SHAPES, Shape, make_candidate, make_depth

HOW = {
    "VmHWM": "peak resident memory (VmHWM, reset just before the call) less resident memory before",
    "ru_maxrss": "growth of the process's peak resident memory (ru_maxrss): a lower bound",
}


@dataclass(frozen=True)
class Row:
    """Peak extra memory in MiB of one call; backward is a forward and backward together."""

    shape: str
    layout: str
    direction: str
    candidate: str
    extra_mib: float
    method: str


def _status_mib(key: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return int(line.split()[1]) / 1024
    raise KeyError(key)


def _peak_of(call: Callable[[], object]) -> tuple[float, str]:
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before = _status_mib("VmRSS:")
    except OSError:
        import resource

        unit = 1024 * 1024 if sys.platform == "darwin" else 1024
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
        call()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit - before, "ru_maxrss"
    kept = call()
    peak = _status_mib("VmHWM:")
    del kept
    return peak - before, "VmHWM"


def _child(name: str, shape_name: str, layout: str, direction: str, slices: int) -> None:
    torch.set_num_threads(1)
    shape = SHAPES[shape_name]
    tiny = replace(shape, height=8, width=8)

    def prepare(at: Shape) -> Callable[[], object]:
        candidate = make_candidate(name, at, layout, make_depth(at, "smooth"), slices)
        if direction == "forward":
            return candidate.inference()
        return lambda: candidate.backward()()

    prepare(tiny)()
    extra, method = _peak_of(prepare(shape))
    print(json.dumps({"extra_mib": extra, "method": method}))


def measure(name: str, shape: Shape, layout: str, direction: str, slices: int) -> Row:
    """Measure one call in a child process.

    Raises:
        RuntimeError: the child failed; its last line is in the message.
    """
    # Freed blocks go straight back to the system, so that resident memory is memory in use.
    environment = {
        **os.environ,
        "MALLOC_MMAP_THRESHOLD_": "65536",
        "MALLOC_TRIM_THRESHOLD_": "65536",
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]),
    }
    command: Sequence[str] = (
        sys.executable, __file__, name, shape.name, layout, direction, str(slices),
    )  # fmt: skip
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise RuntimeError(f"memory of {name} at {shape}: {last}")
    result = json.loads(done.stdout.strip().splitlines()[-1])
    return Row(str(shape), layout, direction, name, result["extra_mib"], result["method"])


if __name__ == "__main__":
    _child(*sys.argv[1:5], int(sys.argv[5]))
