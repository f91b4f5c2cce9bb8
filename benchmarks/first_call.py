"""The first calls of a new process on a device, as JSON: what suites/gpu_first.py starts.

    python benchmarks/first_call.py --device cuda --numerics tf32

Each call is timed from an idle device to an idle device. Where TRITON_CACHE_DIR names an empty
folder, kernels are compiled in these calls.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from candidates import BASELINE, CONTINUOUS, Candidate, make_candidate, scene_of
from cases import GPU, Layer
from devices import NUMERICS, numerics
from frames import make_scene, smooth_kinds
from suites.series import FORWARD, LAYOUT, STEP


def seconds_of(call: Callable[[], object], where: torch.device) -> float:
    """Wall time of one call, the device being idle before and after it."""

    def wait() -> None:
        if where.type == "cuda":
            torch.cuda.synchronize(where)

    wait()
    start = time.perf_counter()
    call()
    wait()
    return time.perf_counter() - start


def first_calls(layer: Layer, name: str, where: torch.device) -> dict[str, dict[str, list[float]]]:
    """Seconds of the first and the second call, by subject and direction."""
    scene = scene_of(layer, make_scene, smooth_kinds()[0])
    found: dict[str, dict[str, list[float]]] = {}
    with numerics(name) as dtype:
        # The device's context and its libraries' loading belong to neither subject.
        tiny = make_candidate(
            BASELINE, replace(layer, height=8, width=8), LAYOUT, None, dtype, where
        )
        tiny.both()()
        for subject in (BASELINE, CONTINUOUS):
            candidate = make_candidate(subject, layer, LAYOUT, scene, dtype, where)
            for leaf in candidate.leaves():
                leaf.requires_grad_()

            def step(candidate: Candidate = candidate) -> object:
                output = candidate.forward()
                return torch.autograd.grad(output.sum(), candidate.leaves(), allow_unused=True)

            found[subject] = {
                direction: [seconds_of(call, where) for _ in range(2)]
                for direction, call in ((FORWARD, candidate.inference()), (STEP, step))
            }
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print the seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--numerics", choices=list(NUMERICS), default="tf32")
    parser.add_argument("--layer", choices=list(GPU), default=next(iter(GPU)))
    parser.add_argument("--shrink", type=int, default=1, help="divisor of the frame's sides")
    chosen = parser.parse_args(arguments)
    layer = GPU[chosen.layer].shrunk(chosen.shrink)
    print(json.dumps(first_calls(layer, chosen.numerics, torch.device(chosen.device))))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
