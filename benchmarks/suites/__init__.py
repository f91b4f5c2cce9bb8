"""Everything that can be measured, one file a suite, in the order of the report."""

from __future__ import annotations

from devices import Device
from suites import (
    channels,
    conv3d,
    dtypes,
    gpu_conv3d,
    gpu_first,
    gpu_layers,
    gpu_memory,
    gpu_net,
    grouped,
    invariance,
    layers,
    levels,
    memory,
    net,
    peers,
    pools,
    scaling,
)
from suites.job import Suite

SUITES: dict[str, Suite] = {
    module.SUITE.name: module.SUITE
    for module in (
        layers,
        channels,
        grouped,
        pools,
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

_ON_DEVICE = (gpu_layers, gpu_memory, gpu_net, gpu_conv3d, gpu_first)
#: Names of what --device cuda measures.
DEVICE_SUITES = tuple(module.NAME for module in _ON_DEVICE)


def device_suites(device: Device) -> dict[str, Suite]:
    """The suites that run on a device."""
    return {module.NAME: module.suite(device) for module in _ON_DEVICE}
