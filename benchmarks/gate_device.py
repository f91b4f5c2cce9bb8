"""The device suites' gate: the timed shapes, on the device, against the reference in float64.

The reference runs on the device as well, one image at a time, and is itself held at chosen output
pixels to the relation that `points` writes out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

import cases
from candidates import BASELINE, CONTINUOUS, SAME_LEVEL, make_candidate, random_like, scene_of
from cases import LAYOUTS, Layer
from devices import Device, numerics
from frames import RANDOM, Scene, make_scene, smooth_kinds
from gate import (
    KINK,
    PARTS,
    Check,
    Operands,
    at_scale_one,
    make_operands,
    peers_agree,
    pick,
    relative_rms,
)
from plan import Plan
from points import choose_points, off_kinks
from suites.conv3d import FRAME
from suites.gpu_net import nets_on, scene_of_net
from suites.net import make_nets
from suites.series import LAYOUT, layers_of, numerics_of
from surfconv_ops import reference

#: Relative RMS. float32: sums of as many terms as the batch has pixels, 2**-24 times the root of
#: 614,400 where they come one after another. The others: two operands cut to tf32's 10 bits; two
#: roundings, of a sample and of the result, to a half type. A wrong tap is off by 1e-2 and more.
TOLERANCES = {
    "float32": 5e-5,
    "tf32": 2.0**-9,
    "bfloat16": 2.0**-7,
    "float16": 2.0**-10,
}
#: The reference and the relation at points are both float64.
EXACT = 1e-10
#: Numerics that more kinds of depth, and guides, are checked in: the truth takes its time.
WITH_AND_WITHOUT_TENSOR_CORES = ("float32", "bfloat16")
#: Dozens of layers, one after the other.
NET_TOLERANCE = 1e-3


def _output(operands: Operands, image: slice = slice(None)) -> Tensor:
    """The reference's output of some of the images."""
    input, weight, bias, scale = operands.leaves
    return reference.surf_conv2d(
        input[image],
        weight,
        bias,
        scale=scale[image],
        guide=None if operands.guide is None else operands.guide[image],
        guide_tolerance=operands.tolerance,
        stride=operands.layer.stride,
        padding=operands.layer.padding,
        groups=operands.layer.groups,
    )


def truth(operands: Operands, gradient: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The reference's output and gradients in the operands' dtype, one image at a time.

    Under autograd the reference keeps every tap's samples, which a whole batch has no room for.
    """
    outputs, grads = [], [torch.zeros_like(leaf) for leaf in operands.leaves]
    for number in range(operands.layer.batch):
        output = _output(operands, slice(number, number + 1))
        found = torch.autograd.grad(output, operands.leaves, gradient[number : number + 1])
        for total, each in zip(grads, found, strict=True):
            total += each
        outputs.append(output.detach())
    return torch.cat(outputs), tuple(grads)


def against_reference(
    layer: Layer, subject: str, scene: Scene, name: str, layouts: list[str], device: Device
) -> list[Check]:
    """Operator and layer in one of `devices.NUMERICS` against the reference in float64."""
    shown = f"{layer}, {subject}, {scene.kind} depth"
    allowed = TOLERANCES[name]
    checks = []
    with numerics(name) as dtype:
        operands = make_operands(layer, subject, scene, device.where)
        rounded = operands.cast(dtype)
        # Scale and guide are float32 in a layer, whatever its dtype.
        scale = operands.leaves[3].detach()
        exact = replace(rounded, leaves=(*rounded.leaves[:3], scale), guide=operands.guide)
        exact = exact.cast(torch.float64)
        gradient = random_like(scale.new_empty(layer.batch, layer.channels_out, *layer.output_size))
        gradient = gradient.to(dtype)
        wanted, wanted_grads = truth(exact, gradient.double())
        smooth = off_kinks(layer, scale, KINK)
        points = choose_points(layer).to(device.where)
        with torch.no_grad():
            checks.append(
                Check(
                    f"{shown}, float64: reference at points",
                    relative_rms(pick(wanted, points), exact.at(points)),
                    EXACT,
                )
            )
        for layout in layouts:
            here = f"{shown}, {layout}, {name}"
            own = operands.cast(dtype, layout)
            own = replace(
                own, leaves=(*own.leaves[:3], scale.clone().requires_grad_()), guide=operands.guide
            )
            output = own.output()
            checks.append(Check(f"{here}: output", relative_rms(output, wanted), allowed))
            outer = gradient.contiguous(memory_format=LAYOUTS[layout])
            grads = torch.autograd.grad(output, own.leaves, outer)
            for part, grad, want in zip(PARTS, grads, wanted_grads, strict=True):
                if part == "scale":
                    grad, want = grad[smooth], want[smooth]
                error = relative_rms(grad, want)
                checks.append(Check(f"{here}: gradient of {part}", error, allowed))
            candidate = make_candidate(subject, layer, layout, scene, dtype, device.where)
            with torch.no_grad():
                error = relative_rms(candidate.forward(), wanted)
            checks.append(Check(f"{here}: layer", error, allowed))
    device.forget()
    return checks


def exactly(function: Callable[[], list[Check]]) -> list[Check]:
    """Checks in true float32."""
    with numerics("float32"):
        return function()


def nets_agree(shrink: int, device: Device) -> list[Check]:
    """The nets on the device are the nets on the processor."""
    scene = scene_of_net(1, shrink)
    image = torch.randn(
        1, cases.NET_INPUT[0], *scene.depth.shape[1:], generator=torch.Generator().manual_seed(2)
    )
    there = nets_on(device, scene, torch.float32)
    checks = []
    with torch.no_grad():
        for name, net in make_nets(scene).items():
            results = []
            for each, where in ((net, torch.device("cpu")), (there[name], device.where)):
                depth = () if name == BASELINE else (scene.depth.to(where),)
                results.append(each.eval()(image.to(where), *depth).cpu())
            error = relative_rms(results[1], results[0])
            checks.append(Check(f"the paper's net, {name}: on the device", error, NET_TOLERANCE))
    return checks


def gate(plan: Plan, device: Device) -> list[tuple[str, Callable[[], list[Check]]]]:
    """All checks of a plan, as (label, function) in the order in which they are to run."""
    jobs: list[tuple[str, Callable[[], list[Check]]]] = []

    def add(label: str, function: Callable[..., list[Check]], *arguments: object) -> None:
        jobs.append((label, lambda: function(*arguments)))

    smooth = smooth_kinds()[0]
    every = numerics_of(plan)
    pairs = [(CONTINUOUS, smooth, every)]
    if not plan.quick:
        pairs += [(CONTINUOUS, RANDOM, WITH_AND_WITHOUT_TENSOR_CORES)]
        pairs += [(SAME_LEVEL, smooth, WITH_AND_WITHOUT_TENSOR_CORES)]
    layouts = [LAYOUT] if plan.quick else list(LAYOUTS)
    channels = cases.VOXEL_CHANNELS
    frame = Layer("frame", 1, channels, *FRAME, channels).shrunk(plan.shrink)
    layers = layers_of(plan)
    for layer in (*layers, frame):
        add(
            layer.name,
            lambda layer=layer: exactly(
                lambda: at_scale_one(layer, device.where, TOLERANCES["float32"])
            ),
        )
        for subject, kind, names in pairs:
            scene = scene_of(layer, make_scene, kind)
            for name in names:
                add(
                    f"{layer.name} {name}, {subject}, {kind} depth",
                    against_reference, layer, subject, scene, name, layouts, device,
                )  # fmt: skip
    first = layers[-1]
    scene = scene_of(first, make_scene, smooth)
    add("peers", lambda: exactly(lambda: peers_agree(first, scene, device.where)))
    add("net", lambda: exactly(lambda: nets_agree(plan.shrink, device)))
    return jobs
