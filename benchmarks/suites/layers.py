"""Ordinary 3x3 layers: both modes, both layouts, forward and backward, with and without a guide."""

from __future__ import annotations

import cases
import targets
from candidates import CONTINUOUS, GUIDED, LEVELS
from frames import RANDOM, smooth_kinds
from plan import Plan
from suites.job import Job, Suite
from suites.price import price_jobs


def jobs(plan: Plan) -> list[Job]:
    """One thread with every depth and guide; more threads with the main frame only."""
    chosen = [cases.MAIN[name] for name in ("A", "D")] if plan.quick else list(cases.MAIN.values())
    layers = [layer.shrunk(plan.shrink) for layer in chosen]
    kinds = smooth_kinds()
    subjects = [(CONTINUOUS, kinds[0]), (LEVELS, kinds[0]), (CONTINUOUS, RANDOM)]
    every = [*subjects, (LEVELS, RANDOM), *((guided, kinds[0]) for guided in GUIDED)]
    every += [(CONTINUOUS, kind) for kind in kinds[1:]]
    if plan.quick:
        every = [*subjects, *((guided, kinds[0]) for guided in GUIDED)]
    guides = {layer.name: targets.GUIDE_BY_LAYER.get(layer.name, targets.GUIDE) for layer in layers}
    first, *more = plan.threads[:1] if plan.quick else plan.threads
    options = {"prices": targets.MAIN, "guides": guides}
    return [
        *price_jobs("layers", "price", layers, threads=[first], subjects=every, **options),
        *price_jobs("layers", "price", layers, threads=more, subjects=subjects[:2], **options),
    ]


SUITE = Suite(
    "layers",
    "Price of SurfConv2d on ordinary layers",
    "3x3, stride 1, padding 1, float32. The price is SurfConv2d's time, from depth to output, in "
    "times of nn.Conv2d's: forward in the same layout, backward (input, weight, bias and depth) "
    "against the faster of nn.Conv2d's two layouts (input, weight and bias). The table `guide` "
    "holds what a guide adds to the mode that it is used with.",
    jobs,
    pivot="prices",
)
