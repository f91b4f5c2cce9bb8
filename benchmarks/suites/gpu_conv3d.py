"""nn.Conv3d on a voxelised scene beside SurfConv2d on the frame itself, on the GPU."""

from __future__ import annotations

import copy
from functools import lru_cache

import torch

import cases
from candidates import Candidate
from devices import Device, numerics
from peers import CONV3D
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.conv3d import OURS, make_pair
from suites.job import Job, Suite, work_of
from suites.series import FORWARD, STEP, host_note, joined, numerics_of
from timing import Timing, interleave

NAME = "gpu_conv3d"


# The grid takes a second or more to fill.
_pair = lru_cache(maxsize=1)(make_pair)


def _on(candidate: Candidate, dtype: torch.dtype, device: Device) -> Candidate:
    """A copy on the device, the original being shared."""
    depth = None if candidate.depth is None else candidate.depth.to(device.where, copy=True)
    module = copy.deepcopy(candidate.module).to(device=device.where, dtype=dtype)
    return Candidate(module, candidate.input.to(device.where, dtype, copy=True), depth)


def _measure(name: str, direction: str, plan: Plan, device: Device, limits: Limits) -> list[Row]:
    ours, theirs, kind = _pair(plan.shrink, plan.shrink)
    with numerics(name) as dtype:
        candidates = {OURS: _on(ours, dtype, device), CONV3D: _on(theirs, dtype, device)}
        calls = {
            subject: candidate.inference() if direction == FORWARD else candidate.both()
            for subject, candidate in candidates.items()
        }
        for call in calls.values():
            call()
        timings = interleave(calls, limits, clock=device)
        peaks = {subject: device.peak(call) for subject, call in calls.items()}
    device.forget()
    return [
        _row(name, direction, kind, candidates[subject], subject, timings, peaks[subject])
        for subject in timings
    ]


def _row(
    name: str,
    direction: str,
    kind: str,
    candidate: Candidate,
    subject: str,
    timings: dict[str, Timing],
    peak: int,
) -> Row:
    size = "x".join(map(str, candidate.input.shape[2:]))
    where = f"frame {size}" if subject == OURS else f"grid {size}"
    table = f"{cases.VOXEL_CHANNELS} channels"
    key = Key(NAME, table, where, subject, direction, "channels_last", kind, name, threads=0)
    note = joined(f"peak memory {peak / 2**20:.0f} MiB", host_note(timings[subject]))
    base = None if subject == OURS else (OURS, timings[OURS])
    return make_row(key, timings[subject], baseline=base, note=note)


def suite(device: Device) -> Suite:
    """The suite on a device."""

    def job(name: str, direction: str, plan: Plan) -> Job:
        return Job(
            f"{name} {direction}",
            work_of(0, direction, 1),
            lambda limits: _measure(name, direction, plan, device, limits),
        )

    def jobs(plan: Plan) -> list[Job]:
        return [
            job(name, direction, plan)
            for name in numerics_of(plan)
            for direction in ((FORWARD,) if plan.quick else (FORWARD, STEP))
        ]

    return Suite(
        NAME,
        "Beside nn.Conv3d on a voxelised scene, on the GPU",
        "nn.Conv3d, 3x3x3, on the paper's grid of 2 cm voxels (4.8 m x 2.88 m x 4.8 m) filled from "
        "the frame, beside SurfConv2d on the frame itself with a footprint of the same 6 cm, 16 "
        "channels each, channels_last (channels_last_3d). The ratio is nn.Conv3d's time in times "
        "of SurfConv2d's; filling the grid is not in it. There is no target.",
        jobs,
    )
