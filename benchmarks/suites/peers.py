"""SurfConv2d beside what else a user could pick for one layer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import nn

import peers
import targets
from candidates import (
    CONTINUOUS,
    LEVELS,
    Candidate,
    make_candidate,
    make_conv,
    make_input,
    scene_of,
)
from cases import LAYOUTS, Layer
from frames import Scene, make_scene, smooth_kinds
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.job import Job, Suite, jobs_of_extremes
from surfconv_ops import SurfConvPyramid
from timing import interleave, thread_count

LAYOUT = "contiguous"
#: The mode of SurfConv2d that does what each peer does.
COUNTERPARTS = {
    peers.GRID_SAMPLE: CONTINUOUS,
    peers.DEFORM: CONTINUOUS,
    peers.REFERENCE: CONTINUOUS,
    peers.PYRAMID: LEVELS,
}
#: The slowest peers take seconds a call.
ROUNDS = 3
#: About how many forward passes of nn.Conv2d all calls together take, for the budget alone.
WORK = 60


def make_peer(
    name: str,
    layer: Layer,
    scene: Scene,
    layout: str = LAYOUT,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Candidate:
    """One of the peers with the weights and inputs that SurfConv2d has."""

    def pyramid() -> nn.Module:
        return SurfConvPyramid(make_conv(layer), scene.levels, scene.reference_depth)

    def of(kind: type[peers.DepthConv2d]) -> Callable[[], nn.Module]:
        return lambda: make_conv(layer, kind, reference_depth=scene.reference_depth)

    make: dict[str, Callable[[], nn.Module]] = {
        peers.GRID_SAMPLE: of(peers.GridSampleConv2d),
        peers.DEFORM: of(peers.DeformConv2d),
        peers.DEFORM_ALONE: of(peers.OffsetConv2d),
        peers.REFERENCE: of(peers.ReferenceConv2d),
        peers.PYRAMID: pyramid,
    }
    module = make[name]().to(device=device, dtype=dtype, memory_format=LAYOUTS[layout])
    input = make_input(layer, layout, dtype, device)
    return Candidate(module, input, scene.depth.to(device, copy=True))


def jobs(plan: Plan) -> list[Job]:
    """Shapes A and D, or A alone."""
    return jobs_of_extremes(plan, WORK, _measure)


def _measure(layer: Layer, direction: str, threads: int, limits: Limits) -> list[Row]:
    started = time.perf_counter()
    kind = smooth_kinds()[0]
    scene = scene_of(layer, make_scene, kind)
    names = [name for name in COUNTERPARTS if name not in peers.unavailable()]
    if layer.name != "A":
        # The readable reference is no peer that one would pick: one layer shows what it takes.
        names.remove(peers.REFERENCE)
    candidates = {mode: make_candidate(mode, layer, LAYOUT, scene) for mode in (CONTINUOUS, LEVELS)}
    candidates |= {name: make_peer(name, layer, scene) for name in names}
    with thread_count(threads):
        calls = {name: candidate.call(direction) for name, candidate in candidates.items()}
        few = replace(limits, minimum=min(ROUNDS, limits.minimum))
        timings = interleave(calls, few, started)
    rows = []
    for name, timing in timings.items():
        counterpart = COUNTERPARTS.get(name)
        baseline = None if counterpart is None else (counterpart, timings[counterpart])
        key = Key("peers", "peers", str(layer), name, direction, LAYOUT, kind, threads=threads)
        rows.append(
            make_row(
                key,
                timing,
                baseline=baseline,
                target=targets.PEERS.get(name),
                pixels=layer.pixels,
                macs=layer.macs,
                note=_frames(candidates[name].module),
            )
        )
    return rows


def _frames(module: nn.Module) -> str:
    """How much the pyramid has to look at, which its cost follows."""
    if not isinstance(module, SurfConvPyramid):
        return ""
    pixels = sum(scale**-2 for scale in module.scales)
    return f"its {len(module.scales)} frames have {pixels:.1f} times the pixels of the original"


SUITE = Suite(
    "peers",
    "Beside other ways to do it",
    "The ratio is the peer's time in times of SurfConv2d's in the mode that does the same: more "
    "than 1 is a lead. Contiguous, smooth depth, from depth to output. Backward is the gradients "
    "of input, weight, bias and, where the peer has one, depth.",
    jobs,
)
