"""Nets and depth that the tests of DepthGuided and of conversion share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from surfconv_ops import DepthGuided, convert_conv2d
from surfconv_ops.depth_layer import DepthLayer


class Probe(DepthLayer):
    """A layer whose output is the depth that it was given."""

    def forward(self, input: Tensor, depth: Tensor | None = None) -> Tensor:
        return self._resolve_depth(input, depth)


class Residual(nn.Module):
    """A block with a strided path and a 1 x 1 shortcut."""

    def __init__(self, channels: int, out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, out, 3, stride, 1, bias=False)
        self.norm1 = nn.BatchNorm2d(out)
        self.conv2 = nn.Conv2d(out, out, 3, 1, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(out)
        self.shortcut = nn.Conv2d(channels, out, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.norm1(self.conv1(x)))
        return torch.relu(self.norm2(self.conv2(y)) + self.shortcut(x))


class EncoderDecoder(nn.Module):
    """Skip connections, upsampling, and one layer that runs at two resolutions."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, 4, 5, stride=2, padding=2)
        self.down = Residual(4, 6, 2)
        self.shared = nn.Conv2d(4, 4, 3, padding=1)
        self.up = nn.ConvTranspose2d(6, 4, 2, stride=2)
        self.head = nn.Sequential(nn.Conv2d(4, 4, 3, padding=1), nn.ReLU(), nn.Conv2d(4, 2, 1))

    def forward(self, x: Tensor) -> Tensor:
        fine = self.shared(torch.relu(self.stem(x)))
        coarse = self.up(self.down(fine))
        coarse = nn.functional.interpolate(coarse, fine.shape[-2:], mode="nearest")
        once = self.shared(nn.functional.max_pool2d(fine + coarse, 2))
        out: Tensor = self.head(nn.functional.interpolate(once, x.shape[-2:]))
        return out


def sequential() -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(3, 6, 3, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(6, 6, 3, padding=2, dilation=2, groups=2),
        nn.ReLU(),
        nn.Conv2d(6, 2, (1, 3)),
    )


NETS = {
    "sequential": sequential,
    "residual": lambda: nn.Sequential(Residual(3, 6, 2), Residual(6, 4, 1)),
    "encoder-decoder": EncoderDecoder,
}


def guided(name: str = "encoder-decoder", **options: Any) -> DepthGuided:
    return DepthGuided(convert_conv2d(NETS[name](), **({"reference_depth": 2.0} | options)))


def frames(batch: int = 2, height: int = 20, width: int = 26) -> tuple[Tensor, Tensor]:
    """Images, and depth with holes around 2 m."""
    depth = torch.rand(batch, height, width) * 3 + 0.6
    depth[torch.rand(batch, height, width) < 0.2] = 0.0
    return torch.randn(batch, 3, height, width), depth
