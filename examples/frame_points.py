"""Which pixels to explain, and the square that a layer looks at around each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frame_net import KERNEL, DrawnLayer
from synthetic_scene import Frame

NAMES = ("near", "middle", "far")
QUANTILES = (0.06, 0.5, 0.93)
# Registered frames are black where either camera saw nothing.
BLACK = 4.0


@dataclass(frozen=True)
class Footprint:
    """The k x k cells of one output pixel, in pixels of the frame."""

    row: int
    column: int
    depth: float
    scale: float
    layer: DrawnLayer

    @property
    def width(self) -> float:
        return self.layer.footprint * self.scale

    def meters(self, focal: float) -> float:
        """Width on a surface at this pixel's depth that faces the camera."""
        return self.width * self.depth / focal

    def taps(self) -> NDArray[np.float64]:
        """(k*k, 2) tap positions as (row, column)."""
        offsets = (np.arange(KERNEL) - (KERNEL - 1) / 2) * self.layer.tap_spacing * self.scale
        rows, columns = np.meshgrid(offsets, offsets, indexing="ij")
        return np.stack([rows.ravel() + self.row, columns.ravel() + self.column], axis=1)


def snap(pixel: tuple[int, int], shape: tuple[int, int], layer: DrawnLayer) -> tuple[int, int]:
    """The frame pixel under the layer's nearest output pixel."""
    last_row, last_column = ((size - 1) // layer.stride for size in shape)
    row = min(round(pixel[0] / layer.stride), last_row)
    column = min(round(pixel[1] / layer.stride), last_column)
    return row * layer.stride, column * layer.stride


def choose_points(frame: Frame, reference_depth: float, layer: DrawnLayer) -> list[tuple[int, int]]:
    """A near, a middle and a far pixel worth looking at, with squares that stay apart.

    Candidates are the layer's own output pixels whose squares lie inside the frame. The best of
    those at about the wanted depth has a flat square with few holes and something to see in it.
    """
    depth, gray = frame.depth, frame.rgb.mean(axis=2)
    height, width = depth.shape
    wanted = np.quantile(depth[depth > 0], QUANTILES)
    chosen: list[tuple[int, int, float]] = []
    for target in wanted:
        best, best_cost = None, np.inf
        for row in range(0, height, layer.stride):
            for column in range(0, width, layer.stride):
                z = float(depth[row, column])
                if z <= 0 or not 0.5 < z / target < 2.0:
                    continue
                half = layer.footprint * max(1.0, reference_depth / z) / 2 + 1
                top, left = int(row - half), int(column - half)
                bottom, right = int(row + half) + 1, int(column + half) + 1
                if top < 0 or left < 0 or bottom > height or right > width:
                    continue
                window = depth[top:bottom:2, left:right:2]
                seen = window[window > 0]
                spread = float(np.std(seen) / z)
                shade = gray[top:bottom:2, left:right:2]
                holes = 1.0 - float(np.mean((window > 0) & (shade > BLACK)))
                dullness = 1.0 - min(float(shade.std()) / 40.0, 1.0)
                crowded = sum(
                    max(abs(row - r), abs(column - c)) < half + h + 0.1 * width
                    for r, c, h in chosen
                )
                cost = spread + 2 * holes + 0.5 * dullness + abs(np.log(z / target)) + 5 * crowded
                if cost < best_cost:
                    best, best_cost = (row, column, half), cost
        if best is not None:
            chosen.append(best)
    return [(row, column) for row, column, _ in chosen]
