"""bfloat16 and float16 beside float32."""

from __future__ import annotations

import time

import torch

import targets
from candidates import BASELINE, CONTINUOUS, make_candidate, scene_of
from cases import Layer
from frames import make_scene, smooth_kinds
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.job import Job, Suite, jobs_of_extremes
from timing import interleave, thread_count

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
LAYOUT = "contiguous"


def jobs(plan: Plan) -> list[Job]:
    """Shapes A and D, or A alone."""
    return jobs_of_extremes(plan, 2 * len(DTYPES), _measure)


def _measure(layer: Layer, direction: str, threads: int, limits: Limits) -> list[Row]:
    started = time.perf_counter()
    kind = smooth_kinds()[0]
    scene = scene_of(layer, make_scene, kind)
    subjects = (CONTINUOUS, BASELINE)
    with thread_count(threads):
        timings = interleave(
            {
                f"{subject}/{name}": make_candidate(subject, layer, LAYOUT, scene, dtype).call(
                    direction
                )
                for subject in subjects
                for name, dtype in DTYPES.items()
            },
            limits,
            started,
        )
    rows = []
    for name, timing in timings.items():
        subject, dtype = name.split("/")
        own = subject == CONTINUOUS and dtype != "float32"
        key = Key(
            "dtypes",
            "dtypes",
            str(layer),
            subject,
            direction,
            LAYOUT,
            kind if subject == CONTINUOUS else "",
            dtype,
            threads,
        )
        rows.append(
            make_row(
                key,
                timing,
                baseline=(f"{subject}, float32", timings[f"{subject}/float32"]),
                target=targets.HALF_TYPES if own else None,
                pixels=layer.pixels,
                macs=layer.macs,
            )
        )
    return rows


SUITE = Suite(
    "dtypes",
    "bfloat16 and float16",
    "Time in times of the same module's float32 time, contiguous. nn.Conv2d's own is listed "
    "because torch leaves some processors without a fast half-precision convolution.",
    jobs,
)
