"""Measure SurfConv2d beside nn.Conv2d and beside what else a user could pick.

    python benchmarks/run.py                          about 5 minutes
    python benchmarks/run.py --quick                  under 1 minute, rough
    python benchmarks/run.py --suites layers net      some of it
    python benchmarks/run.py --compare old.json       and what changed since

First a gate checks correctness at the timed shapes; if it fails, nothing is timed and the exit
status is 1. Writes results.json, results.csv, results.md and charts.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import charts
import compare
import document
import machine
import peers
from gate import Check, gate
from plan import Limits, Plan, make_plan
from report import Report, read_rows, write_data
from rows import Row
from suites import SUITES
from suites.job import Job
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
        help="thread counts; single runs use the first (default: %(default)s)")  # fmt: skip
    add("--suites", nargs="+", choices=list(SUITES), default=list(SUITES), metavar="NAME",
        help=f"what to measure: {', '.join(SUITES)} (default: all)")  # fmt: skip
    add("--compare", type=Path, metavar="FILE", help="an earlier results.json; writes compare.md")
    add("--no-charts", action="store_true", help="write no PNG files")
    return parser.parse_args(arguments)


def check(plan: Plan, bar: Bar) -> list[Check]:
    """Run the gate to its end, red or not."""
    checks: list[Check] = []
    with thread_count(max(plan.threads)):
        for label, function in gate(plan):
            bar.set_description(f"gate: {label}")
            checks += function()
            bar.update()
    return checks


def measure(plan: Plan, name: str, jobs: Sequence[Job], bar: Bar) -> list[Row]:
    """Run a suite's jobs, each with its share of the suite's seconds."""
    rows: list[Row] = []
    total = sum(job.work for job in jobs)
    for job in jobs:
        bar.set_description(f"{name}: {job.label}")
        share = max(LEAST_SECONDS, plan.seconds[name] * job.work / total)
        rows += job.measure(Limits(share, plan.minimum, plan.maximum))
        bar.update()
    return rows


def run(plan: Plan) -> Report:
    """Gate, then the plan's suites.

    Args:
        plan: what and how long.

    Returns:
        The report; without rows where the gate is red.
    """
    names = [name for name in SUITES if name in plan.seconds]
    about = machine.describe(plan.threads)
    jobs = {name: SUITES[name].jobs(plan) for name in names}
    with _bar(len(gate(plan)) + sum(map(len, jobs.values()))) as bar:
        start = time.perf_counter()
        report = Report(about, plan, check(plan, bar), [SUITES[name] for name in names])
        report.elapsed["gate"] = time.perf_counter() - start
        if not report.green:
            return report
        report.unavailable = peers.unavailable() if "peers" in names else {}
        for name in names:
            start = time.perf_counter()
            report.rows += measure(plan, name, jobs[name], bar)
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
    try:
        old = _old(chosen.compare)
    except ValueError as error:
        print(f"--compare: {error}", file=sys.stderr)
        return 2
    threads = tuple(dict.fromkeys(chosen.threads))
    report = run(make_plan(chosen.quick, threads, tuple(chosen.suites)))
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
