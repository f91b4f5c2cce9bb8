"""Everything that can be measured, one file a suite, in the order of the report."""

from __future__ import annotations

from suites import (
    channels,
    conv3d,
    dtypes,
    grouped,
    invariance,
    layers,
    levels,
    memory,
    net,
    peers,
    scaling,
)
from suites.job import Suite

SUITES: dict[str, Suite] = {
    module.SUITE.name: module.SUITE
    for module in (
        layers,
        channels,
        grouped,
        dtypes,
        levels,
        peers,
        conv3d,
        scaling,
        memory,
        net,
        invariance,
    )
}
