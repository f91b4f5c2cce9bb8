"""The layer table: forward and backward of every candidate, both layouts, each thread count."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from cases import (
    BASELINE,
    CANDIDATES,
    CONV3D,
    DEPTHS,
    LAYOUTS,
    SURF_NAMES,
    Shape,
    make_candidate,
    make_depth,
)
from timing import interleave


@dataclass(frozen=True)
class Plan:
    """How long to measure; `slices` is the depth of nn.Conv3d's grid."""

    rounds: int
    budget: float
    minimum: int
    slices: int
    depths: tuple[str, ...]
    passes: tuple[str, ...] = ("forward", "backward")


FULL = Plan(rounds=25, budget=1.5, minimum=3, slices=8, depths=DEPTHS)
QUICK = Plan(rounds=3, budget=0.3, minimum=1, slices=2, depths=DEPTHS[:1])


@dataclass(frozen=True)
class Row:
    """One measured cell; times in milliseconds. `fastest_ratio` is against the faster layout."""

    shape: str
    threads: int
    layout: str
    direction: str
    depth: str
    candidate: str
    median_ms: float
    low_ms: float
    high_ms: float
    samples: int
    ratio: float
    fastest_ratio: float


def count_rounds(plan: Plan, shapes: Sequence[Shape], threads: Sequence[int]) -> int:
    """Rounds in the whole suite, for a progress bar."""
    return len(shapes) * len(threads) * len(plan.passes) * len(plan.depths) * plan.rounds


def candidate_names(layout: str, first_depth: bool) -> tuple[str, ...]:
    """The peers are timed with one depth only, and nn.Conv3d in one layout only."""
    if not first_depth:
        return (BASELINE, *SURF_NAMES)
    if layout != next(iter(LAYOUTS)):
        return tuple(name for name in CANDIDATES if name != CONV3D)
    return CANDIDATES


def measure(
    plan: Plan, shape: Shape, threads: int, tick: Callable[[], None] = lambda: None
) -> list[Row]:
    """Time one shape at one thread count; both layouts of everything share the rounds."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    rows = []
    try:
        for direction in plan.passes:
            for kind in plan.depths:
                depth = make_depth(shape, kind)
                calls = {}
                for layout in LAYOUTS:
                    for name in candidate_names(layout, kind == plan.depths[0]):
                        candidate = make_candidate(name, shape, layout, depth, plan.slices)
                        inference = direction == "forward"
                        calls[f"{layout}/{name}"] = (
                            candidate.inference() if inference else candidate.backward()
                        )
                timings = interleave(
                    calls,
                    rounds=plan.rounds,
                    budget=plan.budget,
                    minimum=plan.minimum,
                    tick=tick,
                )
                fastest = min(timings[f"{layout}/{BASELINE}"].median for layout in LAYOUTS)
                for key, timing in timings.items():
                    layout, name = key.split("/")
                    low, high = timing.quartiles
                    rows.append(
                        Row(
                            shape=str(shape),
                            threads=threads,
                            layout=layout,
                            direction=direction,
                            depth=kind,
                            candidate=name,
                            median_ms=1e3 * timing.median,
                            low_ms=1e3 * low,
                            high_ms=1e3 * high,
                            samples=len(timing.seconds),
                            ratio=timing.median / timings[f"{layout}/{BASELINE}"].median,
                            fastest_ratio=timing.median / fastest,
                        )
                    )
    finally:
        torch.set_num_threads(before)
    return rows
