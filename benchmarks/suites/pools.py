"""Pools whose window follows depth, beside nn's."""

from __future__ import annotations

import time

from torch import nn

import cases
import targets
from candidates import Candidate, make_input, scene_of
from cases import DIRECTIONS, LAYOUTS, Layer
from frames import make_scene, smooth_kinds
from plan import Limits, Plan
from rows import Key, Row, fastest, make_row
from suites.job import Job, Suite
from surfconv_ops import SurfAvgPool2d, SurfMaxPool2d
from timing import interleave, thread_count

NAME = "pools"
BASELINES = {"max": nn.MaxPool2d, "avg": nn.AvgPool2d}
SUBJECTS = {"max": SurfMaxPool2d, "avg": SurfAvgPool2d}
#: A pool reads as much as a convolution of one output channel multiplies.
READS = 1e-6


def _candidates(layer: Layer, kind: str) -> dict[tuple[str, str], Candidate]:
    """By name and layout: nn's pool and ours, which gets its depth with every call."""
    which = layer.name.split()[0]
    arguments = (layer.kernel, layer.stride, layer.padding)
    scene = scene_of(layer, make_scene, kind)
    made = {}
    for layout in LAYOUTS:
        plain, ours = BASELINES[which], SUBJECTS[which]
        made[f"nn.{plain.__name__}", layout] = Candidate(
            plain(*arguments), make_input(layer, layout)
        )
        module = ours(*arguments, reference_depth=scene.reference_depth)
        made[ours.__name__, layout] = Candidate(
            module, make_input(layer, layout), scene.depth.clone()
        )
    return made


def _case(layer: Layer) -> str:
    size = f"{layer.batch}x{layer.channels_in}x{layer.height}x{layer.width}"
    return f"{layer.name} {size}, {layer.kernel}x{layer.kernel}, stride {layer.stride}"


def _measure(layer: Layer, direction: str, threads: int, limits: Limits) -> list[Row]:
    started = time.perf_counter()
    kind = smooth_kinds()[0]
    with thread_count(threads):
        candidates = _candidates(layer, kind)
        calls = {"/".join(key): each.call(direction) for key, each in candidates.items()}
        timings = dict(zip(candidates, interleave(calls, limits, started).values(), strict=True))
    plain = {f"{n}, {layout}": t for (n, layout), t in timings.items() if n.startswith("nn.")}
    rows = []
    for (name, layout), timing in timings.items():
        ours = not name.startswith("nn.")
        if direction == "forward":
            base = next(each for each in plain if each.endswith(layout))
            baseline = (f"{base.split(',')[0]}, same layout", plain[base])
        else:
            base, best = fastest(plain)
            baseline = (f"{base} (its faster layout)", best)
        key = Key(NAME, "price", _case(layer), name, direction, layout, kind if ours else "",
                  threads=threads)  # fmt: skip
        rows.append(
            make_row(
                key,
                timing,
                baseline=baseline,
                target=targets.POOLS if ours else None,
                pixels=layer.pixels,
            )
        )
    return rows


def jobs(plan: Plan) -> list[Job]:
    """One table, single-threaded."""

    def job(layer: Layer, direction: str) -> Job:
        work = layer.macs * READS
        return Job(
            f"{layer.name} {direction}",
            work,
            lambda limits: _measure(layer, direction, plan.threads[0], limits),
        )

    chosen = list(cases.POOLS.values())[: 2 if plan.quick else None]
    layers = [layer.shrunk(plan.shrink) for layer in chosen]
    return [job(layer, direction) for layer in layers for direction in DIRECTIONS]


SUITE = Suite(
    NAME,
    "Pools",
    "SurfMaxPool2d and SurfAvgPool2d in times of nn's pools: forward, from depth to output, in the "
    "same layout; backward (input and depth) against the faster of nn's two layouts (input). The "
    "limit is the one that depthwise layers have.",
    jobs,
    pivot="prices",
)
