"""How a pool's work is cut into tiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import triton

from .layer import Layer

#: Lanes of a tile: so many of a thread's fit its registers.
_FORWARD_LANES = 1024
_BACKWARD_LANES = 512
_MOST_CHANNELS = 64


@dataclass(frozen=True)
class PoolTiles:
    """Lanes of a tile along pixels and channels; warps."""

    pixels: int
    channels: int
    warps: int

    def grid(self, layer: Layer) -> tuple[int]:
        blocks = triton.cdiv(layer.channels, self.channels)
        return (triton.cdiv(layer.pixels, self.pixels) * blocks,)

    def constants(self) -> dict[str, Any]:
        """As the kernels and their launch take them."""
        return {
            "BLOCK_PIXELS": self.pixels,
            "BLOCK_CHANNELS": self.channels,
            "num_warps": self.warps,
            "num_stages": 1,
        }


def pool_tiles(layer: Layer, backward: bool) -> list[PoolTiles]:
    """Ways to cut a pool, the one to take without a choice first."""
    power: int = triton.next_power_of_2(layer.channels)
    channels = min(_MOST_CHANNELS, power)
    lanes = _BACKWARD_LANES if backward else _FORWARD_LANES
    pixels = lanes // channels // (2 if layer.dtype == torch.float64 else 1)
    return [PoolTiles(pixels, channels, 4), PoolTiles(pixels // 2, channels, 4)]
