"""Few channels, odd channels and 1x1 kernels."""

from __future__ import annotations

import cases
import targets
from candidates import CONTINUOUS, LEVELS
from cases import Layer
from frames import smooth_kinds
from plan import Plan
from suites.job import Job, Suite
from suites.price import price_jobs


def jobs(plan: Plan) -> list[Job]:
    """Three tables, single-threaded."""
    tables: dict[str, dict[str, Layer]] = {
        "layers of the paper's net": cases.NET_LAYERS,
        "small and odd channels": cases.SMALL,
        "1x1 kernels": cases.POINTWISE,
    }
    if plan.quick:
        del tables["small and odd channels"]
    subjects = [(mode, smooth_kinds()[0]) for mode in (CONTINUOUS, LEVELS)]
    result = []
    for table, layers in tables.items():
        # A 1x1 kernel has no spacing of taps to change, hence no target of its own.
        limits = {} if layers is cases.POINTWISE else dict.fromkeys(layers, targets.SMALL_CHANNELS)
        result += price_jobs(
            "channels",
            table,
            [layer.shrunk(plan.shrink) for layer in layers.values()],
            threads=plan.threads[:1],
            subjects=subjects,
            prices=limits,
        )
    return result


SUITE = Suite(
    "channels",
    "Few and odd channels, 1x1 kernels",
    "Prices as above. The paper's smallest net has layers of 4 to 32 channels, on small frames "
    "after its strides: there the fixed cost of a call counts. 1x1 kernels are plain convolutions "
    "at any scale and have no target.",
    jobs,
    pivot="prices",
)
