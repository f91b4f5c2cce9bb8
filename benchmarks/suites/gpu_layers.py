"""Ordinary layers at a GPU's sizes: SurfConv2d beside cuDNN's convolution and beside peers."""

from __future__ import annotations

from cases import Layer
from devices import FLUSHES, Device, numerics
from plan import Limits, Plan
from rows import Row, make_row
from suites.job import Job, Suite
from suites.series import (
    FORWARD,
    STEP,
    Series,
    host_note,
    joined,
    layers_of,
    note_of,
    numerics_of,
    ready,
    series_of,
    work_of_layer,
)
from timing import interleave

NAME = "gpu_layers"


def _measure(
    layer: Layer, name: str, direction: str, series: list[Series], device: Device, limits: Limits
) -> list[Row]:
    with numerics(name) as dtype:
        calls, lost = ready(series, layer, direction, dtype, device)
        names = {str(number): each for number, each in enumerate(calls)}
        timings = interleave({n: calls[each] for n, each in names.items()}, limits, clock=device)
        by_series = {each: timings[n] for n, each in names.items()}
    device.forget()
    rows = []
    for each, timing in by_series.items():
        base = each.baseline
        plain = base == each
        note = joined(note_of(each, dtype, device), host_note(timing), lost if plain else "")
        rows.append(
            make_row(
                each.key(NAME, "time on the GPU", str(layer), direction, name),
                timing,
                baseline=None if plain else (f"{base.subject}, {base.layout}", by_series[base]),
                target=each.time_target(direction, name),
                pixels=layer.pixels,
                macs=layer.macs,
                note=note,
            )
        )
    return rows


def suite(device: Device) -> Suite:
    """The suite on a device."""

    def job(layer: Layer, name: str, direction: str, plan: Plan) -> Job:
        series = series_of(direction, plan, device)
        return Job(
            f"{layer.name} {name} {direction}",
            work_of_layer(layer, name, direction),
            lambda limits: _measure(layer, name, direction, series, device, limits),
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
        "SurfConv2d beside cuDNN's convolution and beside peers, on the GPU",
        "3x3, stride 1, padding 1, channels_last unless a column says otherwise. SurfConv2d and "
        "the peers go from depth to output. forward + backward is one training step's: the output, "
        "then gradients of input, weight, bias and depth; nn.Conv2d has no depth, and 'no gradient "
        "of depth' is SurfConv2d where depth is data. SurfConv2d's ratio is its time in times of "
        "nn.Conv2d's (cuDNN) in the same memory format, and is to be low. A peer's ratio is its "
        "time in times of SurfConv2d's in the mode that does the same: more than 1 is a lead. "
        "deform_conv2d gets offsets made from depth, as SurfConv2d gets its scale; 'offsets given' "
        "is the bare function. The targets are for one H100, in tf32 and bfloat16.",
        jobs,
        pivot="device",
        method="GPU times are between CUDA events around a call. Before each, the device is idle, "
        f"then a buffer larger than the L2 cache is written {FLUSHES} times: nothing of the call's "
        "data is cached, and the processor can queue the call's kernels meanwhile. Where "
        "'processor' in the notes is more than that takes, the GPU waited for Python. cuDNN "
        "searches for its fastest algorithm (torch.backends.cudnn.benchmark).",
    )
