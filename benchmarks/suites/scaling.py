"""How cost grows: with pixels, channels, batch and threads."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

import cases
import targets
from candidates import BASELINE, CONTINUOUS, make_candidate, scene_of
from cases import DIRECTIONS, Layer
from frames import make_scene, smooth_kinds
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.job import Job, Suite, work_of
from timing import Call, interleave, thread_count

LAYOUT = "contiguous"
SUBJECTS = (BASELINE, CONTINUOUS)
#: Backward of the largest frame would take as much time as all the other jobs together.
MOST_BACKWARD_MACS = 3e9


def _series(plan: Plan) -> dict[str, list[Layer]]:
    base = cases.SCALING_BASE
    step = 2 if plan.quick else 1
    sizes, channels = cases.SCALING_SIZES, cases.SCALING_CHANNELS[::step]
    if plan.quick:
        sizes = sizes[:3]
    series = {
        "pixels": [replace(base, name="pixels", height=h, width=w) for h, w in sizes],
        "channels": [
            replace(base, name="channels", channels_in=c, channels_out=c) for c in channels
        ],
        "batch": [replace(base, name="batch", batch=n) for n in cases.SCALING_BATCHES[::step]],
    }
    return {
        name: [layer.shrunk(plan.shrink) for layer in layers] for name, layers in series.items()
    }


def jobs(plan: Plan) -> list[Job]:
    """One job for each size and direction, and one for each layer on all thread counts."""

    def growth(table: str, layer: Layer, direction: str) -> Job:
        return Job(
            f"{layer}, {direction}",
            work_of(layer.macs, direction, len(SUBJECTS)),
            lambda limits: _grow(table, layer, direction, plan.threads[0], limits),
        )

    def speedup(layer: Layer, direction: str) -> Job:
        return Job(
            f"threads, {layer.name} {direction}",
            work_of(layer.macs, direction, len(SUBJECTS) * len(plan.threads)),
            lambda limits: _speed_up(layer, direction, plan.threads, limits),
        )

    result = [
        growth(table, layer, direction)
        for table, layers in _series(plan).items()
        for layer in layers
        for direction in (DIRECTIONS[:1] if plan.quick else DIRECTIONS)
        if direction == "forward" or layer.macs <= MOST_BACKWARD_MACS
    ]
    if len(plan.threads) > 1:
        chosen = ("A", "D") if plan.quick else tuple(cases.MAIN)
        layers = [cases.MAIN[name].shrunk(plan.shrink) for name in chosen]
        result += [speedup(layer, direction) for layer in layers for direction in DIRECTIONS]
    return result


def _grow(table: str, layer: Layer, direction: str, threads: int, limits: Limits) -> list[Row]:
    started = time.perf_counter()
    kind = smooth_kinds()[0]
    scene = scene_of(layer, make_scene, kind)
    with thread_count(threads):
        calls = {
            subject: make_candidate(subject, layer, LAYOUT, scene).call(direction)
            for subject in SUBJECTS
        }
        timings = interleave(calls, limits, started)
    return [
        make_row(
            Key(
                "scaling",
                table,
                str(layer),
                subject,
                direction,
                LAYOUT,
                "" if subject == BASELINE else kind,
                threads=threads,
            ),
            timing,
            baseline=(BASELINE, timings[BASELINE]),
            pixels=layer.pixels,
            macs=layer.macs,
        )
        for subject, timing in timings.items()
    ]


def _threads(count: int) -> str:
    return f"{count} thread{'s' if count > 1 else ''}"


def _use(threads: int) -> None:
    """Switch the thread count and wake its pool, which torch fills at its next parallel call."""
    torch.set_num_threads(threads)
    torch.ones(1 << 17).add_(1)


def _speed_up(layer: Layer, direction: str, threads: tuple[int, ...], limits: Limits) -> list[Row]:
    started = time.perf_counter()
    kind = smooth_kinds()[0]
    scene = scene_of(layer, make_scene, kind)
    calls: dict[str, Call] = {}
    with thread_count(threads[0]):
        for subject in SUBJECTS:
            run = make_candidate(subject, layer, LAYOUT, scene).call(direction)
            for count in threads:
                calls[f"{subject}/{count}"] = Call(run, lambda count=count: _use(count))
        timings = interleave(calls, limits, started)
    rows = []
    for name, timing in timings.items():
        subject, count = name.split("/")
        own = subject == CONTINUOUS and (threads[0], int(count)) == (1, 2)
        key = Key(
            "scaling",
            "threads",
            str(layer),
            subject,
            direction,
            LAYOUT,
            "" if subject == BASELINE else kind,
            threads=int(count),
        )
        rows.append(
            make_row(
                key,
                timing,
                baseline=(_threads(threads[0]), timings[f"{subject}/{threads[0]}"]),
                inverse=True,
                target=targets.TWO_THREADS if own else None,
                pixels=layer.pixels,
                macs=layer.macs,
            )
        )
    return rows


SUITE = Suite(
    "scaling",
    "How cost grows",
    "3x3, stride 1, contiguous, smooth depth, continuous mode. Cost per output pixel and per "
    "multiplication of the convolution shows growth beyond the proportional. The ratio is against "
    "nn.Conv2d, and in the table `threads` the speed-up over one thread.",
    jobs,
)
