"""Cost against the number of depth levels."""

from __future__ import annotations

import time

import cases
import targets
from candidates import CONTINUOUS, LEVELS, Candidate, make_candidate, scene_of
from cases import DIRECTIONS, Layer
from frames import make_scene, smooth_kinds
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.job import Job, Suite, work_of
from timing import interleave, thread_count

LAYOUT = "contiguous"
FROM_LEVELS = 4
MOST_LEVELS = 16


def name_of(count: int) -> str:
    """Subject of a row."""
    return f"{count} level{'' if count == 1 else 's'}"


def jobs(plan: Plan) -> list[Job]:
    """Shapes A and D."""
    counts = (1, FROM_LEVELS, MOST_LEVELS) if plan.quick else cases.LEVEL_COUNTS

    def job(layer: Layer, direction: str) -> Job:
        return Job(
            f"{layer.name} {direction}",
            work_of(layer.macs, direction, 1 + len(counts)),
            lambda limits: _measure(layer, direction, counts, plan.threads[0], limits),
        )

    chosen = ("A",) if plan.quick else ("A", "D")
    layers = [cases.MAIN[name].shrunk(plan.shrink) for name in chosen]
    return [job(layer, direction) for layer in layers for direction in DIRECTIONS]


def _measure(
    layer: Layer, direction: str, counts: tuple[int, ...], threads: int, limits: Limits
) -> list[Row]:
    started = time.perf_counter()
    kind = smooth_kinds()[0]
    candidates: dict[str, Candidate] = {
        name_of(count): make_candidate(
            LEVELS, layer, LAYOUT, scene_of(layer, make_scene, kind, count)
        )
        for count in counts
    }
    scene = scene_of(layer, make_scene, kind)
    candidates["continuous"] = make_candidate(CONTINUOUS, layer, LAYOUT, scene)
    calls = {name: candidate.call(direction) for name, candidate in candidates.items()}
    with thread_count(threads):
        timings = interleave(calls, limits, started)

    def row(table: str, name: str, base: str, target: targets.Target | None) -> Row:
        key = Key("levels", table, str(layer), name, direction, LAYOUT, kind, threads=threads)
        return make_row(
            key,
            timings[name],
            baseline=(base, timings[base]),
            target=target,
            pixels=layer.pixels,
            macs=layer.macs,
        )

    rows = [row("cost of N levels", name, name_of(1), None) for name in timings]
    most = name_of(MOST_LEVELS)
    return [*rows, row("16 against 4", most, name_of(FROM_LEVELS), targets.SIXTEEN_LEVELS)]


SUITE = Suite(
    "levels",
    "Cost against the number of levels",
    "SurfConv2d with N depth levels, and with continuous depth, in times of its time with one "
    "level. Contiguous, smooth depth.",
    jobs,
)
