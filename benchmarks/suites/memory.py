"""Peak extra memory of one call, each in a process of its own.

The process makes its inputs, runs the same call once at a tiny shape (libraries, thread pools), and
then measures the first call at the real shape: the peak of its resident memory during the call,
less the resident memory before it. Outputs and gradients are part of it for every candidate alike.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import torch

# torch.autograd.grad imports it in a process's first call, half a second that children inherit.
import torch.fx.experimental.symbolic_shapes

import cases
import targets
from candidates import (
    BASELINE,
    CONTINUOUS,
    LEVELS,
    SAME_LEVEL,
    make_candidate,
    scene_of,
)
from cases import LAYOUTS, Layer
from frames import make_scene, smooth_kinds
from plan import Plan
from rows import Row, judge
from suites.job import Job, Suite

FORWARD, STEP = "forward", "forward + backward"
#: glibc then gives freed blocks straight back, so that resident memory is memory in use.
ALLOCATOR = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
HOW = {
    "VmHWM": "peak resident memory, reset just before the call, less resident memory before",
    "ru_maxrss": "growth of the process's peak resident memory: a lower bound",
}


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


def _child(pipe: Connection, subject: str, layer: Layer, layout: str, direction: str) -> None:
    try:
        torch.set_num_threads(1)

        def prepare(at: Layer) -> Callable[[], object]:
            scene = scene_of(at, make_scene, smooth_kinds()[0])
            candidate = make_candidate(subject, at, layout, scene)
            return candidate.inference() if direction == FORWARD else candidate.both()

        prepare(replace(layer, height=8, width=8))()
        pipe.send(_peak_of(prepare(layer)))
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")


@contextmanager
def _environment() -> Iterator[None]:
    """What new processes start with."""
    # Python 3.11's fork server does not pass sys.path on to what it preloads.
    wanted = {**ALLOCATOR, "PYTHONPATH": os.pathsep.join(sys.path)}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def measure_peak(subject: str, layer: Layer, layout: str, direction: str) -> tuple[float, str]:
    """Peak extra MiB of one call in a new process, and how it was measured (a key of `HOW`).

    Raises:
        RuntimeError: the process failed.
    """
    # A server that has imported torch once, and started no thread, forks in milliseconds.
    methods = multiprocessing.get_all_start_methods()
    if "forkserver" in methods:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
    else:
        context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(sender, subject, layer, layout, direction))
    with _environment():
        process.start()
    sender.close()
    try:
        result = receiver.recv()
    except EOFError:
        result = "the process ended without a result"
    process.join()
    if isinstance(result, str):
        raise RuntimeError(f"memory of {subject} at {layer}: {result}")
    return result


def jobs(plan: Plan) -> list[Job]:
    """A layer's candidates in one layout and direction."""
    layers = [cases.MAIN["A"], cases.MAIN["D"]]
    layouts, subjects = list(LAYOUTS), [BASELINE, CONTINUOUS, LEVELS, SAME_LEVEL]
    if plan.quick:
        layouts, subjects = layouts[:1], subjects[:2]
    else:
        layers += [cases.MAIN["E"], cases.GROUPED["depthwise 7"]]

    def job(layer: Layer, layout: str, direction: str) -> Job:
        return Job(
            f"{layer.name} {layout} {direction}",
            1.0,
            lambda _: _measure(layer, layout, direction, subjects),
        )

    return [
        job(layer.shrunk(plan.shrink), layout, direction)
        for layer in layers
        for layout in layouts
        for direction in (FORWARD, STEP)
    ]


def _measure(layer: Layer, layout: str, direction: str, subjects: list[str]) -> list[Row]:
    rows: list[Row] = []
    base = 0.0
    for subject in subjects:
        extra, method = measure_peak(subject, layer, layout, direction)
        if subject == BASELINE:
            base = extra
        ratio = extra / base if base > 0 else None
        rows.append(
            Row(
                "memory",
                "peak extra memory",
                str(layer),
                subject,
                direction,
                layout,
                "" if subject == BASELINE else smooth_kinds()[0],
                unit="MiB",
                value=extra,
                low=extra,
                high=extra,
                pixels=layer.pixels,
                macs=layer.macs,
                baseline=f"{BASELINE}, same layout",
                ratio=ratio,
                note=HOW[method],
                **judge(ratio, None if subject == BASELINE else targets.MEMORY),
            )
        )
    return rows


SUITE = Suite(
    "memory",
    "Peak extra memory of one call",
    "Each call in a new process with one thread; outputs and gradients are included. Ratios "
    "against nn.Conv2d in the same layout.",
    jobs,
)
