"""What the first call costs: kernels compiled and configurations tried, in new processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from candidates import BASELINE
from devices import Device
from frames import smooth_kinds
from plan import Plan
from rows import Row
from suites.job import Job, Suite
from suites.series import LAYOUT, layers_of, numerics_of

NAME = "gpu_first"
PROGRAM = Path(__file__).parents[1] / "first_call.py"
#: Seconds after which a process is stopped.
LONGEST = 180.0
CACHES = ("nothing compiled before", "compiled by an earlier process")


def run_process(arguments: list[str], cache: str, longest: float = LONGEST) -> dict[str, Any]:
    """What `first_call.py` prints, run with a folder of compiled kernels; empty if stopped.

    Raises:
        RuntimeError: the process failed.
    """
    path = os.pathsep.join([str(PROGRAM.parent), str(PROGRAM.parents[1])])
    path = os.pathsep.join(filter(None, (path, os.environ.get("PYTHONPATH"))))
    try:
        done = subprocess.run(
            [sys.executable, str(PROGRAM), *arguments],
            env={**os.environ, "TRITON_CACHE_DIR": cache, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            timeout=longest,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {}
    if done.returncode:
        raise RuntimeError(f"{PROGRAM.name} {' '.join(arguments)}: {done.stderr.strip()[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _measure(name: str, plan: Plan, device: Device) -> list[Row]:
    layer = layers_of(plan)[0]
    arguments = ["--device", str(device.where), "--numerics", name, "--layer", layer.name]
    arguments += ["--shrink", str(plan.shrink)]
    empty = Row(NAME, "first call", str(layer), "", "", LAYOUT, "", name, threads=0, unit="s")
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        for how in CACHES:
            found = run_process(arguments, cache)
            if not found:
                told = f"stopped after {LONGEST:.0f} s"
                rows.append(replace(empty, subject=f"a process, {how}", value=LONGEST,
                                    low=LONGEST, high=LONGEST, note=told))  # fmt: skip
                continue
            for subject, directions in found.items():
                if subject == BASELINE and how != CACHES[0]:
                    continue
                for direction, (first, second) in directions.items():
                    plain = subject == BASELINE
                    rows.append(
                        replace(
                            empty,
                            subject=subject if plain else f"{subject}, {how}",
                            direction=direction,
                            depth="" if plain else smooth_kinds()[0],
                            value=first,
                            low=first,
                            high=first,
                            note=f"second call {second:.4f} s",
                        )
                    )
    return rows


def suite(device: Device) -> Suite:
    """The suite on a device."""

    def job(name: str, plan: Plan) -> Job:
        return Job(name, 1.0, lambda _: _measure(name, plan, device))

    def jobs(plan: Plan) -> list[Job]:
        # tf32 and bfloat16 show it: the other two compile as many kernels.
        judged = numerics_of(replace(plan, quick=True))
        return [job(name, plan) for name in (judged[-1:] if plan.quick else judged)]

    return Suite(
        NAME,
        "What the first call takes",
        "Wall time of the first call in a new process, after an nn.Conv2d of the same dtype on a "
        "tiny frame has brought up the device: for SurfConv2d with an empty folder of compiled "
        "kernels (TRITON_CACHE_DIR), which is what an installation's very first call takes, and "
        "again with what that process left in it. forward + backward comes after forward. The "
        "second call's time stands beside it. There is no target.",
        jobs,
    )
