"""Nets, levels and frames for the pyramid's tests."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from surfconv_ops import DepthLevels

double = torch.float64
#: Levels by their number, and what they are with reference_depth 4: scales from 0.4 to 4.
LEVELS = {
    1: DepthLevels([], [4.0]),
    2: DepthLevels([2.5], [2.0, 8.0]),
    3: DepthLevels([2.0, 5.0], [1.5, 3.3, 7.0]),
    4: DepthLevels([1.5, 3.0, 6.0], [1.0, 2.2, 4.0, 9.0]),
    5: DepthLevels([1.0, 2.0, 3.0, 6.0], [0.9, 1.6, 2.7, 4.4, 10.0]),
}
ODD = (0.0, -1.0, math.nan, math.inf, -math.inf)


def make_net(channels: int = 2, dtype: torch.dtype = double) -> nn.Module:
    """Two layers and a kink between them, with outputs of the input's size."""
    return nn.Sequential(
        nn.Conv2d(channels, 4, 3, padding=1), nn.LeakyReLU(0.3), nn.Conv2d(4, 3, 3, padding=1)
    ).to(dtype)


def make_frame(
    batch: int = 2, height: int = 11, width: int = 14, channels: int = 2
) -> tuple[Tensor, Tensor]:
    """Image and depth in float64; a fifth of the depths is invalid, each in its own way."""
    image = torch.randn(batch, channels, height, width, dtype=double)
    depth = torch.rand(batch, height, width, dtype=double) * 10 + 0.2
    odd = torch.tensor(ODD, dtype=double)[torch.randint(0, len(ODD), depth.shape)]
    return image, torch.where(torch.rand(depth.shape) < 0.2, odd, depth)
