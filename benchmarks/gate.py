"""Correctness at the very shapes that are timed; a speed of a wrong result is not reported."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cases import (
    BASELINE,
    DEPTHS,
    LAYOUTS,
    PADDING,
    REFERENCE_DEPTH,
    SURF_NAMES,
    Candidate,
    Shape,
    make_candidate,
    make_depth,
)
from surfconv_ops import SurfConv2d, depth_to_scale, reference, surf_conv2d

# Rounding of a float32 sum of up to H*W terms; a wrong tap is off by 1e-2 and more.
TOLERANCE = 2e-5
# Closer than this to a pixel, float32 and float64 may take derivatives on different sides of it.
KINK = 1e-4


@dataclass(frozen=True)
class Check:
    """One comparison: relative RMS error against its tolerance."""

    what: str
    error: float

    @property
    def passed(self) -> bool:
        return self.error <= TOLERANCE


def _error(actual: Tensor, expected: Tensor) -> float:
    got, want = actual.detach().double(), expected.detach().double()
    difference = (got - want).square().mean().sqrt()
    error = float(difference / want.square().mean().sqrt().clamp_min(1e-30))
    return error if error == error else float("inf")


def _off_kinks(scale: Tensor) -> Tensor:
    """True where no tap of a 3 x 3 kernel lies on a pixel: its offsets are 0 and +-scale."""
    return (scale - scale.round()).abs() > KINK


def _arguments(candidate: Candidate) -> dict[str, Tensor | None]:
    """scale and guide exactly as the layer makes them."""
    module, depth = candidate.module, candidate.depth
    assert isinstance(module, SurfConv2d)
    assert depth is not None
    levels = module.levels
    guide = levels.assign(depth).float() if module.same_level_only else None
    if guide is not None:
        guide[guide < 0] = float("nan")
    return {"scale": depth_to_scale(depth, REFERENCE_DEPTH, levels=levels), "guide": guide}


def _against_reference(shape: Shape, name: str, kind: str) -> list[Check]:
    """Outputs and all gradients in both layouts against the reference in float64."""
    base = make_candidate(name, shape, "contiguous", make_depth(shape, kind))
    extra = _arguments(base)
    parameters = list(base.module.parameters())
    inputs = [base.input, *parameters, extra["scale"]]
    exact = [tensor.detach().double().requires_grad_() for tensor in inputs if tensor is not None]
    guide = extra["guide"]
    expected = reference.surf_conv2d(
        *exact[:3],
        scale=exact[3],
        guide=None if guide is None else guide.double(),
        padding=PADDING,
    )
    gradient = torch.randn(expected.shape, generator=torch.Generator().manual_seed(5))
    wanted = torch.autograd.grad(expected, exact, gradient.double())
    smooth = _off_kinks(exact[3].detach())
    checks = []
    for layout, memory_format in LAYOUTS.items():
        leaves = [tensor.detach().float() for tensor in exact]
        leaves[:2] = [leaf.contiguous(memory_format=memory_format) for leaf in leaves[:2]]
        for leaf in leaves:
            leaf.requires_grad_()
        output = surf_conv2d(*leaves[:3], scale=leaves[3], guide=guide, padding=PADDING)
        shown = f"{shape.name} {name}, {kind} depth, {layout}"
        checks.append(Check(f"{shown}: output", _error(output, expected.detach())))
        grads = torch.autograd.grad(
            output, leaves, gradient.contiguous(memory_format=memory_format)
        )
        for part, grad, want in zip(("input", "weight", "bias"), grads, wanted, strict=False):
            checks.append(Check(f"{shown}: gradient of {part}", _error(grad, want)))
        checks.append(
            Check(f"{shown}: gradient of scale", _error(grads[3][smooth], wanted[3][smooth]))
        )
        with torch.no_grad():
            module = make_candidate(name, shape, layout, make_depth(shape, kind))
            checks.append(Check(f"{shown}: layer", _error(module.forward(), expected.detach())))
    return checks


def _at_scale_one(shape: Shape) -> list[Check]:
    """At scale 1 the operator is F.conv2d."""
    candidate = make_candidate(BASELINE, shape, "contiguous", make_depth(shape, "smooth"))
    weight, bias = candidate.module.parameters()
    scale = torch.ones(shape.batch, shape.height, shape.width)
    with torch.no_grad():
        expected = torch.nn.functional.conv2d(
            candidate.input.double(), weight.double(), bias.double(), padding=PADDING
        )
        actual = surf_conv2d(candidate.input, weight, bias, scale=scale, padding=PADDING)
    return [Check(f"{shape.name} scale 1 is conv2d", _error(actual, expected))]


def _same_bits(shape: Shape, threads: tuple[int, ...]) -> list[Check]:
    """Every thread count gives the same bits."""
    before = torch.get_num_threads()
    results = []
    try:
        for count in threads:
            torch.set_num_threads(count)
            candidate = make_candidate(
                SURF_NAMES[0], shape, "contiguous", make_depth(shape, "smooth")
            )
            gradients = candidate.backward()()
            assert isinstance(gradients, tuple)
            results.append([candidate.forward().detach(), *gradients])
    finally:
        torch.set_num_threads(before)
    equal = all(
        torch.equal(one, other)
        for result in results[1:]
        for one, other in zip(results[0], result, strict=True)
    )
    shown = ", ".join(str(count) for count in threads)
    return [Check(f"{shape.name} same bits with {shown} threads", 0.0 if equal else float("inf"))]


def gate(shape: Shape, threads: tuple[int, ...], quick: bool) -> list[Check]:
    """All checks of one shape.

    Args:
        shape: the timed shape.
        threads: the timed thread counts.
        quick: leave out the random depth, and the levels mode that has no guide.

    Returns:
        The checks, passed or not.
    """
    checks = _at_scale_one(shape) + _same_bits(shape, threads)
    # Levels without a guide differ from continuous mode by the numbers in scale alone.
    names = (SURF_NAMES[0], SURF_NAMES[-1]) if quick else SURF_NAMES
    for kind in DEPTHS[:1] if quick else DEPTHS:
        for name in names:
            checks += _against_reference(shape, name, kind)
    return checks
