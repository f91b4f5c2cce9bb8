"""Depthwise and grouped layers."""

from __future__ import annotations

import cases
import targets
from candidates import CONTINUOUS, LEVELS
from frames import smooth_kinds
from plan import Plan
from suites.job import Job, Suite
from suites.price import price_jobs


def jobs(plan: Plan) -> list[Job]:
    """One table, single-threaded."""
    return price_jobs(
        "grouped",
        "price",
        [layer.shrunk(plan.shrink) for layer in cases.GROUPED.values()],
        threads=plan.threads[:1],
        subjects=[(mode, smooth_kinds()[0]) for mode in (CONTINUOUS, LEVELS)],
        prices=dict.fromkeys(cases.GROUPED, targets.GROUPED),
    )


SUITE = Suite(
    "grouped",
    "Depthwise and grouped layers",
    "Prices as above, for layers in which each channel sees only a few others.",
    jobs,
    pivot="prices",
)
