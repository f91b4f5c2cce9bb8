"""A suite is a list of jobs; a job measures some rows within limits that the runner gives it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cases
from cases import DIRECTIONS, Layer
from plan import Limits, Plan
from rows import Row

#: The gradients cost about this many forward passes.
BACKWARD_WORK = 2.2


@dataclass(frozen=True)
class Job:
    """Something to measure.

    Attributes:
        label: what the progress bar shows.
        work: its share of the suite's seconds, in any unit that all jobs of a suite share.
        measure: does it.
    """

    label: str
    work: float
    measure: Callable[[Limits], list[Row]]


@dataclass(frozen=True)
class Suite:
    """Jobs that belong together.

    Attributes:
        name: on the command line and in the results.
        title: heading of its part of the report.
        about: what the numbers mean, for a reader of the report.
        jobs: the jobs of a plan.
        pivot: what the report shows side by side: "" (one line a row), "prices" (layouts and
            directions), "distances" or "device" (everything on a layer beside nn.Conv2d).
        method: a sentence for the head of the report, where nothing is timed.
    """

    name: str
    title: str
    about: str
    jobs: Callable[[Plan], list[Job]]
    pivot: str = ""
    method: str = ""


def work_of(macs: int, direction: str, calls: int, threads: int = 1) -> float:
    """Estimated work of a round: multiplications, with a floor for what every call costs."""
    factor = 1.0 if direction == "forward" else BACKWARD_WORK
    return (macs / 1e6 + 10.0) * factor * calls / min(threads, 2)


def jobs_of_extremes(
    plan: Plan, calls: int, measure: Callable[[Layer, str, int, Limits], list[Row]]
) -> list[Job]:
    """Both directions of the layers with many channels (A) and with few (D), or of A alone."""

    def job(layer: Layer, direction: str) -> Job:
        return Job(
            f"{layer.name} {direction}",
            work_of(layer.macs, direction, calls),
            lambda limits: measure(layer, direction, plan.threads[0], limits),
        )

    chosen = ("A",) if plan.quick else ("A", "D")
    layers = [cases.MAIN[name].shrunk(plan.shrink) for name in chosen]
    return [job(layer, direction) for layer in layers for direction in DIRECTIONS]
