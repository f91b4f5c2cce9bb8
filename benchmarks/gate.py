"""Correctness at the very shapes that are timed; a speed of a wrong result is not reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d

import cases
from candidates import (
    BASELINE,
    CONTINUOUS,
    LEVELS,
    SAME_LEVEL,
    WINDOW,
    Candidate,
    make_candidate,
    make_conv,
    make_input,
    random_like,
    scene_of,
)
from cases import LAYOUTS, Layer
from frames import RANDOM, Scene, make_scene, smooth_kinds
from peers import DEFORM, DeformConv2d, DepthConv2d, GridSampleConv2d, unavailable
from plan import Plan
from points import at_points, choose_points, off_kinks
from surfconv_ops import SurfConv2d, at_output_centers, depth_to_scale, pool_reference, surf_conv2d
from timing import thread_count

#: Relative RMS of float32 sums of up to H * W terms; a wrong tap is off by 1e-2 and more.
TOLERANCE = 2e-5
#: grid_sample and deform_conv2d round a position in the image, not an offset from its centre.
PEER_TOLERANCE = 2e-4
#: One rounding at the end of a float32 result, plus the rounding of what the peers share.
HALF_TOLERANCES = {torch.bfloat16: 2.0**-8, torch.float16: 2.0**-11}
#: Closer than this to a pixel, float32 and float64 may take derivatives on different sides of it.
KINK = 1e-4
PARTS = ("input", "weight", "bias", "scale")


@dataclass(frozen=True)
class Check:
    """One comparison: relative RMS error against what is allowed."""

    what: str
    error: float
    allowed: float = TOLERANCE

    @property
    def passed(self) -> bool:
        return self.error <= self.allowed


def relative_rms(actual: Tensor, expected: Tensor) -> float:
    """RMS of the difference over RMS of what is expected; infinite for NaN."""
    got, want = actual.detach().double(), expected.detach().double()
    difference = (got - want).square().mean().sqrt()
    error = float(difference / want.square().mean().sqrt().clamp_min(1e-30))
    return error if error == error else float("inf")


@dataclass
class Operands:
    """A layer's arguments to the operator, scale and guide exactly as the layer makes them."""

    layer: Layer
    leaves: tuple[Tensor, ...]
    guide: Tensor | None
    tolerance: float

    def cast(self, dtype: torch.dtype, layout: str = "contiguous") -> Operands:
        leaves = [leaf.detach().to(dtype, copy=True) for leaf in self.leaves]
        leaves[:2] = [leaf.contiguous(memory_format=LAYOUTS[layout]) for leaf in leaves[:2]]
        guide = None if self.guide is None else self.guide.to(dtype)
        return Operands(
            self.layer, tuple(leaf.requires_grad_() for leaf in leaves), guide, self.tolerance
        )

    def output(self) -> Tensor:
        input, weight, bias, scale = self.leaves
        return surf_conv2d(
            input,
            weight,
            bias,
            scale=scale,
            guide=self.guide,
            guide_tolerance=self.tolerance,
            stride=self.layer.stride,
            padding=self.layer.padding,
            groups=self.layer.groups,
        )

    def at(self, points: Tensor) -> Tensor:
        return at_points(self.layer, points, *self.leaves, self.guide, self.tolerance)


def make_operands(
    layer: Layer, subject: str, scene: Scene, device: torch.device | str = "cpu"
) -> Operands:
    """The operands of SurfConv2d in one of its modes, in float32."""
    module = make_candidate(subject, layer, "contiguous", scene, device=device).module
    assert isinstance(module, SurfConv2d) and module.bias is not None
    depth, levels = scene.depth.to(device), module.levels
    centres = at_output_centers(depth, layer.kernel, layer.stride, layer.padding)
    scale = depth_to_scale(centres, scene.reference_depth, levels=levels)
    guide, tolerance = None, 0.0
    if subject == SAME_LEVEL:
        assert levels is not None
        guide = levels.assign(depth).float()
    elif subject == WINDOW:
        guide, tolerance = depth.clone(), scene.window
    if guide is not None:
        guide[~(depth > 0)] = float("nan")
    leaves = (make_input(layer, "contiguous", device=device), module.weight, module.bias, scale)
    return Operands(layer, leaves, guide, tolerance)


def against_relation(layer: Layer, subject: str, scene: Scene) -> list[Check]:
    """Operator and layer against the relation at chosen pixels, and against float64 everywhere.

    The relation in float64 settles chosen output pixels and all gradients that flow from them. The
    operator's own float64, held to the same relation, settles the dense output and gradients.
    """
    operands = make_operands(layer, subject, scene)
    points = choose_points(layer)
    image, row, column = points.unbind(1)
    exact = operands.cast(torch.float64)
    wanted = exact.at(points)
    sparse = random_like(wanted)
    wanted_grads = torch.autograd.grad(wanted, exact.leaves, sparse)
    dense_output = exact.output()
    dense = random_like(dense_output)
    dense_grads = torch.autograd.grad(dense_output, exact.leaves, dense)
    smooth = off_kinks(layer, exact.leaves[3].detach(), KINK)
    shown = f"{layer}, {subject}, {scene.kind} depth"
    checks = [Check(f"{shown}, float64: output", relative_rms(pick(dense_output, points), wanted))]
    for layout, memory_format in LAYOUTS.items():
        own = operands.cast(torch.float32, layout)
        output = own.output()
        here = f"{shown}, {layout}"
        checks += [
            Check(f"{here}: output at points", relative_rms(pick(output, points), wanted)),
            Check(f"{here}: output", relative_rms(output, dense_output)),
        ]
        scattered = torch.zeros_like(output)
        scattered[image, :, row, column] = sparse.float()
        pairs = (("from points", scattered, wanted_grads), ("dense", dense.float(), dense_grads))
        for how, gradient, expected in pairs:
            gradient = gradient.contiguous(memory_format=memory_format)
            grads = torch.autograd.grad(output, own.leaves, gradient, retain_graph=True)
            for part, grad, want in zip(PARTS, grads, expected, strict=True):
                if part == "scale":
                    grad, want = grad[smooth], want[smooth]
                checks.append(Check(f"{here}: gradient of {part}, {how}", relative_rms(grad, want)))
        candidate = make_candidate(subject, layer, layout, scene)
        checks.append(Check(f"{here}: layer", relative_rms(candidate.forward(), output)))
    return checks


def pick(output: Tensor, points: Tensor) -> Tensor:
    image, row, column = points.unbind(1)
    return output[image, :, row, column]


def at_scale_one(
    layer: Layer, device: torch.device | str = "cpu", allowed: float = TOLERANCE
) -> list[Check]:
    """At scale 1 the operator is F.conv2d, output and gradients."""
    candidate = make_candidate(BASELINE, layer, "contiguous", device=device)
    leaves = [leaf.detach().requires_grad_() for leaf in candidate.leaves()]
    # conv2d's float32 gradients of weight and bias are themselves off by half the tolerance.
    exact = [leaf.detach().double().requires_grad_() for leaf in leaves]
    options = {"stride": layer.stride, "padding": layer.padding, "groups": layer.groups}
    scale = torch.ones(layer.batch, *layer.output_size, device=device)
    results = []
    for inputs, output in (
        (exact, conv2d(*exact, **options)),
        (leaves, surf_conv2d(*leaves, scale=scale, **options)),
    ):
        gradient = random_like(output.float()).to(output.dtype)
        results.append((output, *torch.autograd.grad(output, inputs, gradient)))
    return [
        Check(f"{layer}: at scale 1 conv2d's {what}", relative_rms(got, want), allowed)
        for what, want, got in zip(
            ("output", *(f"gradient of {part}" for part in PARTS[:3])), *results, strict=True
        )
    ]


def same_bits(layer: Layer, scene: Scene, threads: Sequence[int]) -> list[Check]:
    """Every thread count gives the same bits."""
    results = []
    for count in threads:
        with thread_count(count):
            candidate = make_candidate(CONTINUOUS, layer, "contiguous", scene)
            gradients = candidate.backward()()
            assert isinstance(gradients, tuple)
            results.append([candidate.forward().detach(), *gradients])
    equal = all(
        torch.equal(one, other)
        for result in results[1:]
        for one, other in zip(results[0], result, strict=True)
    )
    shown = ", ".join(str(count) for count in threads)
    return [Check(f"{layer}: same bits with {shown} threads", 0.0 if equal else float("inf"))]


def half_types(layer: Layer, scene: Scene) -> list[Check]:
    """bfloat16 and float16 are the float32 result of the rounded operands, rounded once."""
    checks = []
    for dtype, allowed in HALF_TOLERANCES.items():
        rounded = make_candidate(CONTINUOUS, layer, "contiguous", scene, dtype)
        wide = Candidate(
            make_candidate(CONTINUOUS, layer, "contiguous", scene, dtype).module.float(),
            rounded.input.float(),
            scene.depth,
        )
        error = relative_rms(rounded.forward(), wide.forward())
        checks.append(Check(f"{layer}: {str(dtype).removeprefix('torch.')}", error, allowed))
    return checks


def peers_agree(layer: Layer, scene: Scene, device: torch.device | str = "cpu") -> list[Check]:
    """The peers compute what SurfConv2d computes, so that their times can be compared."""
    ours = make_candidate(CONTINUOUS, layer, "contiguous", scene, device=device)
    expected = ours.forward()
    peers: list[type[DepthConv2d]] = [GridSampleConv2d]
    if DEFORM not in unavailable(torch.device(device).type):
        peers.append(DeformConv2d)
    checks = []
    for peer in peers:
        module = make_conv(layer, peer, reference_depth=scene.reference_depth).to(device)
        error = relative_rms(module(ours.input, ours.depth), expected)
        checks.append(Check(f"{layer}: {peer.__name__} agrees", error, PEER_TOLERANCE))
    return checks


def pool_agrees(layer: Layer, scene: Scene) -> list[Check]:
    """A pool against its readable definition in float64, and at scale 1 against nn's."""
    maximum = layer.name.startswith("max")
    window = ((layer.kernel,) * 2, (layer.stride,) * 2, (layer.padding,) * 2)
    options = (*window, (1, 1)) if maximum else (*window, True, 0)
    ops, name = torch.ops.surfconv, "surf_max_pool2d" if maximum else "surf_avg_pool2d"
    forward, backward = getattr(ops, name), getattr(ops, f"{name}_backward")
    centres = at_output_centers(scene.depth, layer.kernel, layer.stride, layer.padding)
    scale = depth_to_scale(centres, scene.reference_depth)[:, None]
    smooth = off_kinks(layer, scale.double(), KINK)
    checks = []
    for layout in LAYOUTS:
        here = f"{layer}, {layout}"
        input = make_input(layer, layout)
        output, *winner = forward(input, scale, None, 0.0, *options) if maximum else (
            forward(input, scale, None, 0.0, *options),
        )  # fmt: skip
        exact = (input.double(), scale.double(), None)
        truth = pool_reference.max_forward if maximum else pool_reference.avg_forward
        wanted = truth(*exact, 0.0, *options)
        wanted = wanted[0] if maximum else wanted
        checks.append(Check(f"{here}: output", relative_rms(output, wanted)))
        gradient = random_like(output)
        grads = backward(gradient, input, scale, None, *winner, 0.0, *options, True, True)
        derive = pool_reference.max_backward if maximum else pool_reference.avg_backward
        wants = derive(gradient.double(), *exact, *winner, 0.0, *options, True, True)
        checks.append(Check(f"{here}: gradient of input", relative_rms(grads[0], wants[0])))
        error = relative_rms(grads[1][smooth], wants[1][smooth])
        checks.append(Check(f"{here}: gradient of scale", error))
        ones = torch.ones_like(scale)
        unit = forward(input, ones, None, 0.0, *options)
        plain = max_pool2d if maximum else avg_pool2d
        error = relative_rms(unit[0] if maximum else unit, plain(input, *window))
        checks.append(Check(f"{here}: at scale 1 nn's", error))
    return checks


def gate(plan: Plan) -> list[tuple[str, Callable[[], list[Check]]]]:
    """All checks of a plan, as (label, function) in the order in which they are to run."""
    smooth = smooth_kinds()[0]
    main = [cases.MAIN[name] for name in ("A", "D")] if plan.quick else list(cases.MAIN.values())
    others = [*cases.NET_LAYERS.values(), *cases.GROUPED.values(), *cases.POINTWISE.values()]
    if not plan.quick:
        others += cases.SMALL.values()
    combinations = [(CONTINUOUS, smooth), (SAME_LEVEL, RANDOM)]
    if not plan.quick:
        combinations += [(WINDOW, smooth), (LEVELS, RANDOM)]
    threads = tuple(dict.fromkeys(plan.threads))
    jobs: list[tuple[str, Callable[[], list[Check]]]] = []

    def add(layer: Layer, function: Callable[..., list[Check]], *arguments: object) -> None:
        jobs.append((layer.name, lambda: function(layer, *arguments)))

    for layer in (shape.shrunk(plan.shrink) for shape in (*main, *others)):
        important = layer.name == "A" or (layer.name in cases.MAIN and not plan.quick)
        add(layer, at_scale_one)
        add(layer, same_bits, scene_of(layer, make_scene, smooth), threads)
        for subject, kind in combinations if important else combinations[: 1 if plan.quick else 2]:
            add(layer, against_relation, subject, scene_of(layer, make_scene, kind))
    pools = list(cases.POOLS.values())[: 2 if plan.quick else None]
    for layer in (shape.shrunk(plan.shrink) for shape in pools):
        add(layer, pool_agrees, scene_of(layer, make_scene, smooth))
    first = main[0].shrunk(plan.shrink)
    scene = scene_of(first, make_scene, smooth)
    add(first, half_types, scene)
    add(first, peers_agree, scene)
    return jobs
