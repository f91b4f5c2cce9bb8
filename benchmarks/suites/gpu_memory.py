"""Peak device memory of one call on the layers of gpu_layers."""

from __future__ import annotations

from dataclasses import replace

from candidates import BASELINE
from cases import Layer
from devices import Device, numerics
from plan import Plan
from rows import Row
from suites.job import Job, Suite
from suites.series import (
    FORWARD,
    STEP,
    Series,
    joined,
    layers_of,
    memory_row,
    note_of,
    numerics_of,
    ready,
    series_of,
)

NAME = "gpu_memory"


def _measure(
    layer: Layer, name: str, direction: str, series: list[Series], device: Device
) -> list[Row]:
    rows = []
    base = 0
    with numerics(name) as dtype:
        for each in series:
            calls, lost = ready([each], layer, direction, dtype, device)
            if lost:
                rows[0] = replace(rows[0], note=joined(rows[0].note, lost))
                continue
            peak = device.peak(calls[each])
            del calls
            device.forget()
            if each.subject == BASELINE:
                base = peak
            key = each.key(NAME, "peak device memory", str(layer), direction, name)
            rows.append(memory_row(key, peak, base, note_of(each, dtype, device)))
    return rows


def suite(device: Device) -> Suite:
    """The suite on a device."""

    def job(layer: Layer, name: str, direction: str, plan: Plan) -> Job:
        series = series_of(direction, plan, device, memory=True)
        return Job(
            f"{layer.name} {name} {direction}",
            1.0,
            lambda _: _measure(layer, name, direction, series, device),
        )

    def jobs(plan: Plan) -> list[Job]:
        return [
            job(layer, name, direction, plan)
            for layer in layers_of(plan)
            for name in numerics_of(plan)
            for direction in (FORWARD, STEP)
        ]

    return Suite(
        NAME,
        "Peak device memory of one call",
        "The most that torch's allocator held during a call, less what it held before: outputs, "
        "gradients and work memory, for every candidate alike; input, weight and depth are not in "
        "it. Ratios are against nn.Conv2d, peers' as well. The call comes after one that loaded "
        "libraries and chose algorithms, and is not a timed one.",
        jobs,
        pivot="device",
    )
