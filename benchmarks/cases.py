"""What is measured: the one list of layer shapes that every suite draws from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

LAYOUTS = {"contiguous": torch.contiguous_format, "channels_last": torch.channels_last}
#: Gradients of the layer's backward pass, depth being one more than nn.Conv2d has.
DIRECTIONS = ("forward", "backward")


@dataclass(frozen=True)
class Layer:
    """A square-kernel convolution, padded by half its kernel, on one size of input."""

    name: str
    batch: int
    channels_in: int
    height: int
    width: int
    channels_out: int
    kernel: int = 3
    stride: int = 1
    groups: int = 1

    @property
    def padding(self) -> int:
        return self.kernel // 2

    @property
    def output_size(self) -> tuple[int, int]:
        rest = 2 * self.padding - self.kernel
        return (self.height + rest) // self.stride + 1, (self.width + rest) // self.stride + 1

    @property
    def pixels(self) -> int:
        """Output pixels of the whole batch."""
        rows, columns = self.output_size
        return self.batch * rows * columns

    @property
    def macs(self) -> int:
        """Multiplications of the convolution alone, bilinear interpolation not counted."""
        return self.pixels * self.channels_out * (self.channels_in // self.groups) * self.kernel**2

    def shrunk(self, factor: int) -> Layer:
        """The same layer on a frame smaller by `factor` a side."""
        return replace(
            self, height=max(8, self.height // factor), width=max(8, self.width // factor)
        )

    def __str__(self) -> str:
        size = f"{self.batch}x{self.channels_in}x{self.height}x{self.width}"
        parts = [f"{self.name} {size} -> {self.channels_out}", f"{self.kernel}x{self.kernel}"]
        if self.stride > 1:
            parts.append(f"stride {self.stride}")
        if self.groups > 1:
            parts.append(f"groups {self.groups}")
        return ", ".join(parts)


def _by_name(*layers: Layer) -> dict[str, Layer]:
    return {layer.name: layer for layer in layers}


MAIN = _by_name(
    Layer("A", 1, 64, 120, 160, 64),
    Layer("B", 1, 64, 240, 320, 64),
    Layer("C", 1, 128, 60, 80, 128),
    Layer("D", 1, 16, 480, 640, 16),
    Layer("E", 2, 256, 30, 40, 256),
)

#: The smallest net of the paper, layer by layer, at the sizes it has on a 240 x 960 frame.
NET_LAYERS = _by_name(
    Layer("stem", 1, 6, 240, 960, 4, kernel=7, stride=2),
    Layer("stage 1", 1, 4, 60, 240, 4),
    Layer("stage 2", 1, 8, 30, 120, 8),
    Layer("stage 3", 1, 16, 15, 60, 16),
    Layer("stage 4", 1, 32, 8, 30, 32),
)

#: Few and odd channels where a call's fixed cost hardly counts.
SMALL = _by_name(
    Layer("c4", 1, 4, 240, 320, 4),
    Layer("c8", 1, 8, 240, 320, 8),
    Layer("c16", 1, 16, 120, 160, 16),
    Layer("c32", 1, 32, 120, 160, 32),
    Layer("odd", 1, 17, 120, 160, 31),
)

POINTWISE = _by_name(
    Layer("1x1", 1, 64, 120, 160, 64, kernel=1),
    Layer("1x1 thin", 1, 16, 240, 320, 16, kernel=1),
)

GROUPED = _by_name(
    Layer("depthwise 7", 1, 96, 60, 80, 96, kernel=7, groups=96),
    Layer("depthwise 3", 1, 96, 60, 80, 96, groups=96),
    Layer("grouped", 1, 128, 60, 80, 128, groups=32),
)

#: nn's pools and ours; the first word says which.
POOLS = _by_name(
    Layer("max", 1, 64, 120, 160, 64, stride=2, groups=64),
    Layer("avg", 1, 64, 120, 160, 64, stride=2, groups=64),
    Layer("max large", 1, 16, 480, 640, 16, stride=2, groups=16),
)

#: Layers at the sizes and batches that a GPU trains on, one for each stage of a usual backbone.
GPU = _by_name(
    Layer("c64", 8, 64, 240, 320, 64),
    Layer("c128", 8, 128, 120, 160, 128),
    Layer("c256", 8, 256, 60, 80, 256),
    Layer("c512", 8, 512, 30, 40, 512),
)
#: What quick runs keep of them.
GPU_QUICK = ("c64", "c256")
#: Frames in a batch of the paper's net.
GPU_NET_BATCHES = (8, 1)

#: The frame that the paper's net sees: (channels, height, width).
NET_INPUT = (6, 240, 960)

#: The paper's voxel grid (depth, height, width), 2 cm a voxel: 4.8 m x 2.88 m x 4.8 m.
VOXEL_GRID = (240, 144, 240)
VOXEL_METRES = 0.02
VOXEL_CHANNELS = 16

LEVEL_COUNTS = (1, 2, 3, 4, 6, 8, 12, 16)

#: Frame heights and widths, channels and batch sizes of the scaling suite.
SCALING_SIZES = ((30, 40), (60, 80), (120, 160), (240, 320), (480, 640))
SCALING_CHANNELS = (4, 8, 16, 32, 64, 128, 256)
SCALING_BATCHES = (1, 2, 4, 8)
SCALING_BASE = Layer("base", 1, 64, 60, 80, 64)
