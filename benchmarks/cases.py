"""What is measured: shapes, a depth frame for them, and the candidates as ready modules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from surfconv_ops import DepthLevels, SurfConv2d, depth_to_scale, reference

KERNEL = 3
PADDING = 1
REFERENCE_DEPTH = 6.0
LAYOUTS = {"contiguous": torch.contiguous_format, "channels_last": torch.channels_last}
DEPTHS = ("smooth", "random")
BASELINE = "nn.Conv2d"
CONV3D = "nn.Conv3d"


@dataclass(frozen=True)
class Shape:
    """A 3 x 3 layer, stride 1, padding 1, float32."""

    name: str
    batch: int
    channels_in: int
    height: int
    width: int
    channels_out: int

    def __str__(self) -> str:
        size = f"{self.batch}x{self.channels_in}x{self.height}x{self.width}"
        return f"{self.name} {size} -> {self.channels_out}"


SHAPES = {
    shape.name: shape
    for shape in (Shape("A", 1, 64, 120, 160, 64), Shape("D", 1, 16, 480, 640, 16))
}


def make_depth(shape: Shape, kind: str) -> Tensor:
    """Depth (N, H, W) in metres with scale in 0.3 .. 6 at the reference depth and a few holes.

    `smooth`: a floor rising to a wall, with boxes standing on it. `random`: independent at every
    pixel, the worst case for caches.
    """
    size = (shape.batch, shape.height, shape.width)
    generator = torch.Generator().manual_seed(3)
    nearest, farthest = REFERENCE_DEPTH / 6.0, REFERENCE_DEPTH / 0.3
    if kind == "random":
        scale = torch.empty(size).uniform_(0.3, 6.0, generator=generator)
        return REFERENCE_DEPTH / scale
    rows = torch.linspace(0.0, 1.0, shape.height)[:, None]
    columns = torch.linspace(0.0, 1.0, shape.width)[None, :]
    floor = 1.2 / (rows - 0.35).clamp_min(1e-3)
    wall = 14.0 + 4.0 * columns
    depth = torch.minimum(floor, wall)
    for left, right, top, bottom, z in ((0.1, 0.3, 0.4, 0.8, 2.6), (0.45, 0.6, 0.3, 0.6, 5.1),
                                        (0.7, 0.78, 0.2, 0.5, 9.3)):  # fmt: skip
        inside = (columns > left) & (columns < right) & (rows > top) & (rows < bottom)
        depth = torch.where(inside, z + 0.6 * (columns - left), depth)
    depth = depth.clamp(nearest, farthest).expand(size).clone()
    depth[torch.rand(size, generator=generator) < 0.01] = 0.0
    return depth


def make_levels(depth: Tensor, count: int = 4) -> DepthLevels:
    """Levels of equally many valid pixels."""
    valid = depth[depth > 0].double().sort().values
    parts = torch.tensor_split(valid, count)
    edges = [float(part[-1]) for part in parts[:-1]]
    return DepthLevels(edges, [float(part.mean()) for part in parts])


class ReferenceConv2d(nn.Conv2d):
    """The readable PyTorch form of the operator, as a layer."""

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        scale = depth_to_scale(depth, REFERENCE_DEPTH)
        return reference.surf_conv2d(
            input, self.weight, self.bias, scale=scale, padding=self.padding
        )


@dataclass
class Candidate:
    """A module and its inputs; `uses_depth` tells whether depth is one of them."""

    name: str
    module: nn.Module
    input: Tensor
    depth: Tensor | None = None

    def forward(self) -> Tensor:
        if self.depth is None:
            return self.module(self.input)
        return self.module(self.input, self.depth)

    def leaves(self) -> list[Tensor]:
        """Everything that can receive a gradient: input, weight, bias and depth."""
        depth = [] if self.depth is None else [self.depth]
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
        generator = torch.Generator().manual_seed(5)
        # randn_like would draw in memory order, so that layouts got different gradients.
        gradient = torch.empty_like(output).copy_(torch.randn(output.shape, generator=generator))

        def call() -> object:
            return torch.autograd.grad(
                output, self.leaves(), gradient, retain_graph=True, allow_unused=True
            )

        return call


def make_candidate(
    name: str, shape: Shape, layout: str, depth: Tensor, slices: int = 16
) -> Candidate:
    """Build one candidate by name, the weights of all 2D ones being equal.

    Args:
        name: one of `CANDIDATES`.
        shape: the layer.
        layout: a key of `LAYOUTS`, for input and weight.
        depth: (N, H, W) metres.
        slices: depth slices of nn.Conv3d's voxel grid over the same H x W.

    Returns:
        The candidate, with tensors of its own.
    """
    torch.manual_seed(1)
    memory_format = LAYOUTS[layout]
    channels = (shape.channels_in, shape.channels_out)
    if name == CONV3D:
        grid = torch.randn(shape.batch, shape.channels_in, slices, shape.height, shape.width)
        volume_format = torch.channels_last_3d if layout == "channels_last" else memory_format
        conv3d = nn.Conv3d(*channels, KERNEL, padding=PADDING).to(memory_format=volume_format)
        return Candidate(name, conv3d, grid.contiguous(memory_format=volume_format))
    levels = make_levels(depth)
    options: dict[str, dict[str, object]] = {
        "SurfConv2d continuous": {},
        "SurfConv2d 4 levels": {"levels": levels},
        "SurfConv2d 4 levels, same level only": {"levels": levels, "same_level_only": True},
    }
    module: nn.Module
    if name == BASELINE:
        module = nn.Conv2d(*channels, KERNEL, padding=PADDING)
    elif name == "reference":
        module = ReferenceConv2d(*channels, KERNEL, padding=PADDING)
    else:
        module = SurfConv2d(
            *channels, KERNEL, padding=PADDING, reference_depth=REFERENCE_DEPTH, **options[name]
        )
    module = module.to(memory_format=memory_format)
    generator = torch.Generator().manual_seed(2)
    size = (shape.batch, shape.channels_in, shape.height, shape.width)
    input = torch.randn(size, generator=generator).contiguous(memory_format=memory_format)
    return Candidate(name, module, input, None if name == BASELINE else depth.clone())


SURF_NAMES = (
    "SurfConv2d continuous",
    "SurfConv2d 4 levels",
    "SurfConv2d 4 levels, same level only",
)
CANDIDATES = (BASELINE, *SURF_NAMES, "reference", CONV3D)
