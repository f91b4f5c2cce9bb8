"""Modules with inputs, ready to be timed: nn.Conv2d, SurfConv2d in its modes, and peers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from cases import LAYOUTS, Layer
from frames import Scene
from surfconv_ops import SurfConv2d

BASELINE = "nn.Conv2d"
CONTINUOUS = "SurfConv2d continuous"
LEVELS = "SurfConv2d 4 levels"
WINDOW = "SurfConv2d continuous, depth window"
SAME_LEVEL = "SurfConv2d 4 levels, same level only"
#: Modes without a guide, and each mode with one beside the mode it is added to.
MODES = (CONTINUOUS, LEVELS)
GUIDED = {WINDOW: CONTINUOUS, SAME_LEVEL: LEVELS}


def surf_options(subject: str, scene: Scene) -> dict[str, Any]:
    """SurfConv2d's depth arguments for one of the modes."""
    options: dict[str, Any] = {"reference_depth": scene.reference_depth}
    if subject in (LEVELS, SAME_LEVEL):
        options["levels"] = scene.levels
    if subject == SAME_LEVEL:
        options["same_level_only"] = True
    if subject == WINDOW:
        options["depth_window"] = scene.window
    return options


@dataclass
class Candidate:
    """A module and its inputs; `depth` is None where the module takes none.

    `fixed_depth` is depth that nobody asks a gradient of.
    """

    module: nn.Module
    input: Tensor
    depth: Tensor | None = None
    fixed_depth: bool = False

    def forward(self) -> Tensor:
        output: Tensor = (
            self.module(self.input) if self.depth is None else self.module(self.input, self.depth)
        )
        return output

    def leaves(self) -> list[Tensor]:
        """Everything that is to receive a gradient: input, weight, bias and depth."""
        depth = [] if self.depth is None or self.fixed_depth else [self.depth]
        return [self.input, *self.module.parameters(), *depth]

    def inference(self) -> Callable[[], object]:
        def call() -> object:
            with torch.no_grad():
                return self.forward()

        return call

    def backward(self) -> Callable[[], object]:
        """The backward pass alone, of a graph built here once."""
        for leaf in self.leaves():
            leaf.requires_grad_()
        output = self.forward()
        gradient = torch.empty_like(output).copy_(random_like(output))

        def call() -> object:
            return torch.autograd.grad(
                output, self.leaves(), gradient, retain_graph=True, allow_unused=True
            )

        return call

    def both(self) -> Callable[[], object]:
        """Forward and backward, the graph being built anew in every call."""
        for leaf in self.leaves():
            leaf.requires_grad_()
        with torch.no_grad():
            output = self.forward()
        gradient = torch.empty_like(output).copy_(random_like(output))
        del output

        def call() -> object:
            output = self.forward()
            return output, torch.autograd.grad(output, self.leaves(), gradient, allow_unused=True)

        return call

    def call(self, direction: str) -> Callable[[], object]:
        return self.inference() if direction == "forward" else self.backward()


def random_like(tensor: Tensor) -> Tensor:
    """Normal numbers of a tensor's shape, the same ones whatever its layout and dtype."""
    # randn_like draws in memory order, which would give layouts different numbers.
    return normal(tensor.shape, 5, tensor.device).to(tensor.dtype)


def normal(size: Sequence[int], seed: int, device: torch.device | str) -> Tensor:
    """Normal float32 numbers, drawn on the device."""
    generator = torch.Generator(device).manual_seed(seed)
    return torch.randn(size, generator=generator, device=device)


def make_input(
    layer: Layer,
    layout: str,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    """The layer's input, the same numbers in every layout."""
    values = normal((layer.batch, layer.channels_in, layer.height, layer.width), 2, device)
    return values.to(dtype).contiguous(memory_format=LAYOUTS[layout])


def make_conv(
    layer: Layer, make: Callable[..., nn.Conv2d] = nn.Conv2d, **options: Any
) -> nn.Conv2d:
    """The layer as any class with nn.Conv2d's arguments; the weights are always the same."""
    torch.manual_seed(1)
    return make(
        layer.channels_in,
        layer.channels_out,
        layer.kernel,
        layer.stride,
        layer.padding,
        groups=layer.groups,
        **options,
    )


def scene_of(layer: Layer, make: Callable[..., Scene], kind: str, levels: int = 4) -> Scene:
    """Depth of one kind at the layer's input size."""
    return make(kind, layer.batch, layer.height, layer.width, levels)


def make_candidate(
    subject: str,
    layer: Layer,
    layout: str,
    scene: Scene | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Candidate:
    """nn.Conv2d or SurfConv2d in one of its modes, all with equal weights and inputs.

    Args:
        subject: `BASELINE`, one of `MODES` or of `GUIDED`.
        layer: the layer.
        layout: a key of `LAYOUTS`, for input and weight.
        scene: depth; only `BASELINE` goes without.
        dtype: of input and weight.
        device: of all tensors.

    Returns:
        The candidate, with tensors of its own.
    """
    if subject == BASELINE:
        module, depth = make_conv(layer), None
    else:
        assert scene is not None
        module = make_conv(layer, SurfConv2d, **surf_options(subject, scene))
        depth = scene.depth.to(device, copy=True)
    module = module.to(device=device, dtype=dtype, memory_format=LAYOUTS[layout])
    return Candidate(module, make_input(layer, layout, dtype, device), depth)
