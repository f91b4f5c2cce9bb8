"""How a pool's work is cut into tiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import triton

from .layer import Layer

#: Lanes of a tile of which every thread has eight.
_LANES = 1024
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


def pool_tiles(layer: Layer) -> list[PoolTiles]:
    """Ways to cut a pool, the one to take without a choice first."""
    channels = min(_MOST_CHANNELS, triton.next_power_of_2(layer.channels))
    pixels = _LANES // channels
    return [PoolTiles(pixels, channels, 4), PoolTiles(pixels // 2, channels, 4)]
