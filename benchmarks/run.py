"""Measure SurfConv2d beside nn.Conv2d and beside what else a user could pick.

    python benchmarks/run.py                          about 5 minutes
    python benchmarks/run.py --quick                  under 1 minute, rough
    python benchmarks/run.py --suites layers net      some of it
    python benchmarks/run.py --compare old.json       and what changed since
    python benchmarks/run.py --instructions avx2      as on a processor without AVX-512
    python benchmarks/run.py --device cuda            on a GPU, suites of its own: about 6 minutes

First a gate checks correctness at the timed shapes; if it fails, nothing is timed and the exit
status is 1. Writes results.json, results.csv, results.md and charts.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import torch

import allocator
import charts
import compare
import devices
import document
import gate_device
import instructions
import machine
import peers
from devices import Device
from gate import Check, gate
from plan import Limits, Plan, make_plan
from report import Report, read_rows, write_data
from rows import Row
from suites import DEVICE_SUITES, SUITES, device_suites
from suites.job import Job, Suite
from surfconv_ops.cli.common import count
from timing import thread_count

#: Largest thread counts that are measured unless others are asked for.
DEFAULT_THREADS = 2
#: A job's share of its suite's seconds is no smaller than this.
LEAST_SECONDS = 0.05


class Bar(Protocol):
    """What is used of tqdm."""

    def update(self, n: int = 1) -> object: ...
    def set_description(self, desc: str) -> object: ...


class _NoBar:
    """Where tqdm is missing: nothing."""

    def update(self, n: int = 1) -> None: ...
    def set_description(self, desc: str) -> None: ...


@contextmanager
def _bar(total: int) -> Iterator[Bar]:
    try:
        from tqdm import tqdm  # type: ignore[import-untyped]
    except ImportError:
        print("Measuring (tqdm would show a progress bar) ...", file=sys.stderr)
        yield _NoBar()
        return
    with tqdm(total=total, dynamic_ncols=True, bar_format="{l_bar}{bar}| {elapsed}") as bar:
        yield bar


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--quick", action="store_true", help="few rounds, fewer shapes")
    add("--out", type=Path, default=Path("out/benchmark"), metavar="DIR",
        help="folder for everything that is written (default: %(default)s)")  # fmt: skip
    cores = os.cpu_count() or 1
    add("--threads", type=count, nargs="+", metavar="N",
        default=list(range(1, min(cores, DEFAULT_THREADS) + 1)),
        help="CPU thread counts; single runs use the first (default: %(default)s)")  # fmt: skip
    add("--instructions", choices=list(instructions.VARIABLES),
        help="hold torch, its libraries and the kernels to this instruction set (default: what "
        "the processor has)")  # fmt: skip
    add("--device", choices=["cpu", "cuda"], default="cpu",
        help="where to measure; cuda is the current GPU (default: %(default)s)")  # fmt: skip
    add("--suites", nargs="+", choices=[*SUITES, *DEVICE_SUITES], metavar="NAME",
        help=f"what to measure: {', '.join(SUITES)}; with --device cuda: "
        f"{', '.join(DEVICE_SUITES)} (default: all of the device's)")  # fmt: skip
    add("--compare", type=Path, metavar="FILE", help="an earlier results.json; writes compare.md")
    add("--no-charts", action="store_true", help="write no PNG files")
    chosen = parser.parse_args(arguments)
    own = SUITES if chosen.device == "cpu" else DEVICE_SUITES
    chosen.suites = list(own) if chosen.suites is None else chosen.suites
    wrong = [name for name in chosen.suites if name not in own]
    if wrong:
        parser.error(
            f"--suites: {', '.join(wrong)} is not measured with --device {chosen.device}, which "
            f"has {', '.join(own)}"
        )
    return chosen


def check(
    plan: Plan, jobs: Sequence[tuple[str, Callable[[], list[Check]]]], bar: Bar
) -> list[Check]:
    """Run the gate to its end, red or not."""
    checks: list[Check] = []
    with thread_count(max(plan.threads)):
        for label, function in jobs:
            bar.set_description(f"gate: {label}")
            checks += function()
            bar.update()
    return checks


def measure(
    plan: Plan, name: str, jobs: Sequence[Job], bar: Bar, unavailable: dict[str, str]
) -> list[Row]:
    """Run a suite's jobs, each with its share of the suite's seconds.

    A job for which the device has too little memory is entered in `unavailable` instead.
    """
    rows: list[Row] = []
    total = sum(job.work for job in jobs)
    for job in jobs:
        bar.set_description(f"{name}: {job.label}")
        share = max(LEAST_SECONDS, plan.seconds[name] * job.work / total)
        try:
            rows += job.measure(Limits(share, plan.minimum, plan.maximum))
        except torch.OutOfMemoryError:
            unavailable[f"{name} {job.label}"] = "the device has too little memory"
        bar.update()
    return rows


def run(plan: Plan, device: Device | None = None) -> Report:
    """Gate, then the plan's suites.

    Args:
        plan: what and how long.
        device: where the device suites run; None for the processor's own suites.

    Returns:
        The report; without rows where the gate is red.
    """
    suites: dict[str, Suite] = SUITES if device is None else device_suites(device)
    names = [name for name in suites if name in plan.seconds]
    about = machine.describe(plan.threads)
    if device is None:
        about["allocator"] = allocator.keep_freed_blocks()
    else:
        about |= device.facts()
    jobs = {name: suites[name].jobs(plan) for name in names}
    checks = gate(plan) if device is None else gate_device.gate(plan, device)
    with _bar(len(checks) + sum(map(len, jobs.values()))) as bar:
        start = time.perf_counter()
        report = Report(about, plan, check(plan, checks, bar), [suites[name] for name in names])
        report.elapsed["gate"] = time.perf_counter() - start
        if not report.green:
            return report
        if {"peers", "gpu_layers"} & set(names):
            report.unavailable = peers.unavailable("cpu" if device is None else device.where.type)
        for name in names:
            start = time.perf_counter()
            report.rows += measure(plan, name, jobs[name], bar, report.unavailable)
            report.elapsed[name] = time.perf_counter() - start
    about["load_after"] = machine.load()
    return report


def write(folder: Path, report: Report, draw: bool) -> list[Path]:
    """Write every file of a report and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = write_data(folder, report)
    drawn: dict[str, list[str]] = {}
    if draw and report.green:
        reason = charts.missing()
        if reason:
            print(f"No charts: {reason}", file=sys.stderr)
        else:
            drawn = charts.draw(folder, report.rows, report.machine)
    text = folder / "results.md"
    text.write_text(document.render(report, drawn))
    return [*paths, text, *(folder / name for names in drawn.values() for name in names)]


def _old(path: Path | None) -> tuple[dict[str, Any], list[Row]] | None:
    return None if path is None else read_rows(path)


def main(arguments: list[str] | None = None) -> int:
    """The program; returns its exit status."""
    start = time.perf_counter()
    chosen = parse_arguments(arguments)
    if chosen.instructions not in {None, instructions.held_to()}:
        return instructions.start_again(chosen.instructions)
    try:
        old = _old(chosen.compare)
    except ValueError as error:
        print(f"--compare: {error}", file=sys.stderr)
        return 2
    if chosen.device == "cpu":
        threads = tuple(dict.fromkeys(chosen.threads))
        report = run(make_plan(chosen.quick, threads, tuple(chosen.suites)))
    else:
        why = devices.missing()
        if why:
            print(f"--device cuda: {why}", file=sys.stderr)
            return 2
        threads = (torch.get_num_threads(),)
        plan = make_plan(chosen.quick, threads, tuple(chosen.suites), chosen.device)
        report = run(plan, devices.Cuda())
    paths = write(chosen.out, report, not chosen.no_charts)
    if not report.green:
        for failed in (check for check in report.checks if not check.passed):
            print(f"FAILED {failed.what}: relative error {failed.error:.2e}", file=sys.stderr)
        print("The gate is red: no speed is reported.", file=sys.stderr)
        return 1
    if old is not None:
        paths.append(chosen.out / "compare.md")
        paths[-1].write_text(compare.render(old, (report.to_dict(), report.rows)))
    for name, why in report.unavailable.items():
        print(f"Not measured: {name}, because {why}")
    judged = [row for row in report.rows if row.verdict]
    met = sum(row.verdict == "met" for row in judged)
    print(f"Targets: {met} met, {len(judged) - met} missed of {len(judged)}.")
    print("Wrote " + ", ".join(map(str, paths)))
    seconds = time.perf_counter() - start
    print(f"Took {seconds:.0f} s; the plan was {report.plan.total:.0f} s of measuring.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
