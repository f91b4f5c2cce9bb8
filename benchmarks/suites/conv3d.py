"""nn.Conv3d on a voxelised scene beside SurfConv2d on the frame that the scene was made from."""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from torch import nn

import cases
import targets
from candidates import Candidate
from frames import FOCAL_LENGTHS, SYNTHETIC, make_scene, smooth_kinds
from peers import CONV3D
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.job import Job, Suite, work_of
from surfconv_ops import SurfConv2d
from timing import Timing, interleave, thread_count
from voxels import voxelise

#: Size of the indoor frame.
FRAME = (424, 512)
OURS = "SurfConv2d continuous"
KERNEL = 3
#: nn.Conv3d takes seconds a call.
ROUNDS = 2


def jobs(plan: Plan) -> list[Job]:
    """Forward and backward; a grid of half the size a side in quick runs."""
    divisor = (2 if plan.quick else 1) * plan.shrink

    def job(direction: str) -> Job:
        return Job(
            direction,
            work_of(1, direction, 1),
            lambda limits: _measure(direction, divisor, plan, limits),
        )

    return [job("forward")] if plan.quick else [job("forward"), job("backward")]


def make_pair(divisor: int, shrink: int) -> tuple[Candidate, Candidate, str]:
    """SurfConv2d and nn.Conv3d, both three voxels wide, and the kind of depth."""
    kind = "indoor" if "indoor" in smooth_kinds() else SYNTHETIC
    height, width = (side // shrink for side in FRAME)
    focal = FOCAL_LENGTHS[kind] / shrink
    depth = make_scene(kind, 1, height, width).depth
    channels = cases.VOXEL_CHANNELS
    features = torch.randn(1, channels, height, width, generator=torch.Generator().manual_seed(2))
    x, y, z = (side // divisor for side in cases.VOXEL_GRID)
    metres = cases.VOXEL_METRES * divisor
    volume = voxelise(features[0], depth[0], focal, (x, y, z), metres)
    torch.manual_seed(1)
    surf = SurfConv2d.from_radius(
        channels,
        channels,
        KERNEL,
        padding=1,
        radius=KERNEL * cases.VOXEL_METRES / 2,
        focal_length=focal,
    )
    conv3d = nn.Conv3d(channels, channels, KERNEL, padding=1)
    # The faster layout of both.
    surf = surf.to(memory_format=torch.channels_last)
    conv3d = conv3d.to(memory_format=torch.channels_last_3d)
    return (
        Candidate(surf, features.contiguous(memory_format=torch.channels_last), depth.clone()),
        Candidate(conv3d, volume.contiguous(memory_format=torch.channels_last_3d)),
        kind,
    )


def _measure(direction: str, divisor: int, plan: Plan, limits: Limits) -> list[Row]:
    started = time.perf_counter()
    threads = max(plan.threads)
    with thread_count(threads):
        ours, theirs, kind = make_pair(divisor, plan.shrink)
        calls = {OURS: ours.call(direction), CONV3D: theirs.call(direction)}
        few = replace(limits, minimum=min(ROUNDS, limits.minimum), maximum=2 * ROUNDS)
        timings = interleave(calls, few, started)
    full = "x".join(map(str, cases.VOXEL_GRID))
    note = ""
    if divisor > 1:
        measured = "x".join(str(side // divisor) for side in cases.VOXEL_GRID)
        timings[CONV3D] = Timing([divisor**3 * each for each in timings[CONV3D].seconds])
        note = f"extrapolated: measured on {measured}, times {divisor**3}"
    frame = "x".join(map(str, ours.input.shape[-2:]))
    centimetres = round(100 * KERNEL * cases.VOXEL_METRES)
    rows = []
    for name, timing in timings.items():
        where = f"frame {frame}" if name == OURS else f"grid {full}"
        baseline = None if name == OURS else (OURS, timings[OURS])
        key = Key(
            "conv3d",
            f"{cases.VOXEL_CHANNELS} channels, {centimetres} cm wide",
            where,
            name,
            direction,
            "channels_last",
            kind,
            threads=threads,
        )
        rows.append(
            make_row(
                key,
                timing,
                baseline=baseline,
                target=targets.PEERS.get(name),
                note="" if name == OURS else note,
            )
        )
    return rows


SUITE = Suite(
    "conv3d",
    "Beside nn.Conv3d on a voxelised scene",
    "nn.Conv3d, 3x3x3, on the paper's grid of 2 cm voxels (4.8 m x 2.88 m x 4.8 m) filled from the "
    "frame, beside SurfConv2d on the frame itself with a footprint of the same 6 cm, 16 channels "
    "each. The ratio is nn.Conv3d's time in times of SurfConv2d's. All threads, channels_last "
    "(channels_last_3d), the faster layout of both.",
    jobs,
)
