"""The paper's net on the GPU: time and peak memory of inference and of a training step."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

import cases
import targets
from candidates import BASELINE, CONTINUOUS, LEVELS, normal
from cases import LAYOUTS
from devices import Device, numerics
from frames import Scene, make_scene, smooth_kinds
from net import PARAMETERS
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.job import BACKWARD_WORK, Job, Suite
from suites.net import make_call, make_nets
from suites.series import FORWARD, STEP, host_note, memory_row, numerics_of
from timing import interleave

NAME = "gpu_net"


def layout_on(device: Device) -> str:
    """The faster memory format, but for the processor.

    torch 2.13's CPU weight gradient of the net's 1x1 stride-2 shortcut with 4 channels corrupts the
    heap in channels_last.
    """
    return "channels_last" if device.where.type == "cuda" else "contiguous"


def scene_of_net(batch: int, shrink: int) -> Scene:
    """Depth at the net's size."""
    _, height, width = cases.NET_INPUT
    return make_scene(smooth_kinds()[0], batch, height // shrink, width // shrink)


def nets_on(device: Device, scene: Scene, dtype: torch.dtype) -> dict[str, nn.Module]:
    """The nets by subject, with equal weights."""
    form = LAYOUTS[layout_on(device)]
    return {
        name: net.to(device=device.where, dtype=dtype, memory_format=form)
        for name, net in make_nets(scene).items()
    }


def _measure(
    batch: int, name: str, direction: str, shrink: int, device: Device, limits: Limits
) -> list[Row]:
    scene = scene_of_net(batch, shrink)
    size = (batch, cases.NET_INPUT[0], *scene.depth.shape[1:])
    case = "x".join(map(str, size)) + f", {PARAMETERS:,} parameters"
    layout = layout_on(device)
    with numerics(name) as dtype:
        image = normal(size, 2, device.where).to(dtype).contiguous(memory_format=LAYOUTS[layout])
        depth = scene.depth.to(device.where)
        calls: dict[str, Callable[[], object]] = {
            subject: make_call(net, image, None if subject == BASELINE else depth, direction)
            for subject, net in nets_on(device, scene, dtype).items()
        }
        for call in calls.values():
            call()
        timings = interleave(calls, limits, clock=device)
        peaks = {subject: device.peak(call) for subject, call in calls.items()}
    device.forget()
    rows = []
    for subject, timing in timings.items():
        kind = "" if subject == BASELINE else scene.kind
        ours = subject in (CONTINUOUS, LEVELS)

        def key(table: str, subject: str = subject, kind: str = kind) -> Key:
            return Key(NAME, table, case, subject, direction, layout, kind, name, threads=0)

        judged = ours and name in targets.GPU_NUMERICS
        rows.append(
            make_row(
                key("the paper's net"),
                timing,
                baseline=None if subject == BASELINE else (BASELINE, timings[BASELINE]),
                target=targets.GPU_PRICES[direction] if judged else None,
                note=host_note(timing),
            )
        )
        rows.append(memory_row(key("its peak memory"), peaks[subject], peaks[BASELINE], ""))
    return rows


def suite(device: Device) -> Suite:
    """The suite on a device."""

    def job(batch: int, name: str, direction: str, shrink: int) -> Job:
        work = (1 + batch / 8) * (1.0 if direction == FORWARD else BACKWARD_WORK)
        return Job(
            f"batch {batch} {name} {direction}",
            work,
            lambda limits: _measure(batch, name, direction, shrink, device, limits),
        )

    def jobs(plan: Plan) -> list[Job]:
        batches = cases.GPU_NET_BATCHES[:1] if plan.quick else cases.GPU_NET_BATCHES
        return [
            job(batch, name, direction, plan.shrink)
            for batch in batches
            for name in numerics_of(plan)
            for direction in (FORWARD, STEP)
        ]

    return Suite(
        NAME,
        "The paper's net on the GPU",
        "FCN-8s on ResNet-18 with basic blocks of widths 4 to 32 (the paper's smallest): "
        "nn.Conv2d, SurfConv2d in every layer larger than 1x1, and the paper's own way, the plain "
        "net run once per depth level. Ratios against nn.Conv2d. forward + backward is a training "
        "step to the gradients of all parameters; depth is data. A net this small keeps a GPU "
        "waiting for Python: 'processor' in the notes is how long a call takes to be launched.",
        jobs,
    )
