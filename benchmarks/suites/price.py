"""The price of a layer in times of nn.Conv2d: what several suites measure on their own shapes."""

from __future__ import annotations

import time
from collections.abc import Sequence

from candidates import BASELINE, GUIDED, make_candidate, scene_of
from cases import DIRECTIONS, LAYOUTS, Layer
from frames import make_scene
from plan import Limits
from rows import Key, Row, fastest, make_row
from suites.job import Job, work_of
from targets import Price, Target
from timing import Timing, interleave, thread_count

Subject = tuple[str, str]


def price_jobs(
    suite: str,
    table: str,
    layers: Sequence[Layer],
    *,
    threads: Sequence[int],
    subjects: Sequence[Subject],
    prices: dict[str, Price],
    guides: dict[str, Target] | None = None,
) -> list[Job]:
    """Forward and backward of each layer, everything in both layouts.

    Args:
        suite: name of the suite.
        table: name of the table.
        layers: the layers.
        threads: thread counts.
        subjects: pairs of a SurfConv2d mode and a kind of depth.
        prices: targets by name of layer; a layer that is not in it has none.
        guides: targets by name of layer for what a guide adds to its own mode.

    Returns:
        One job for each layer, thread count and direction: its calls are interleaved.
    """

    def job(layer: Layer, count: int, direction: str) -> Job:
        calls = len(LAYOUTS) * (1 + len(subjects))
        return Job(
            f"{layer.name} {direction}, {count} thread{'s' if count > 1 else ''}",
            work_of(layer.macs, direction, calls, count),
            lambda limits: _measure(
                suite, table, layer, count, direction, subjects, prices, guides or {}, limits
            ),
        )

    return [
        job(layer, count, direction)
        for layer in layers
        for count in threads
        for direction in DIRECTIONS
    ]


def _measure(
    suite: str,
    table: str,
    layer: Layer,
    threads: int,
    direction: str,
    subjects: Sequence[Subject],
    prices: dict[str, Price],
    guides: dict[str, Target],
    limits: Limits,
) -> list[Row]:
    started = time.perf_counter()
    cells = [(BASELINE, "", layout) for layout in LAYOUTS]
    cells += [(*subject, layout) for subject in subjects for layout in LAYOUTS]
    with thread_count(threads):
        calls = {}
        for subject, kind, layout in cells:
            scene = scene_of(layer, make_scene, kind) if kind else None
            candidate = make_candidate(subject, layer, layout, scene)
            calls["/".join((subject, kind, layout))] = candidate.call(direction)
        timings = interleave(calls, limits, started)
    by_cell = dict(zip(cells, timings.values(), strict=True))
    plain = {f"{BASELINE}, {layout}": by_cell[BASELINE, "", layout] for layout in LAYOUTS}
    price = prices.get(layer.name)
    rows = []
    for (subject, kind, layout), timing in by_cell.items():
        target: Target | None = None
        baseline: tuple[str, Timing]
        if subject in GUIDED:
            mode = GUIDED[subject]
            baseline = (f"{mode}, same layout", by_cell[mode, kind, layout])
            target = guides.get(layer.name)
        elif direction == "forward":
            baseline = (f"{BASELINE}, same layout", plain[f"{BASELINE}, {layout}"])
        else:
            name, best = fastest(plain)
            baseline = (f"{name} (its faster layout)", best)
        if price is not None and kind and subject not in GUIDED:
            target = price.of(direction, layout)
        key = Key(
            suite,
            "guide" if subject in GUIDED else table,
            str(layer),
            subject,
            direction,
            layout,
            kind,
            threads=threads,
        )
        rows.append(
            make_row(
                key,
                timing,
                baseline=baseline,
                target=target,
                pixels=layer.pixels,
                macs=layer.macs,
            )
        )
    return rows
