"""The pyramid in plain loops over NumPy arrays, in float64: resize, run, read back, choose."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from oracle_depth import assign_level

Array = NDArray[np.float64]
Net = Callable[[Array], Array]


def shares(position: float, size: int, reach: float) -> dict[int, float]:
    """Pixels that a position reads and their shares: a triangle of this half-width."""
    if reach <= 1:
        position = min(max(position, 0.0), size - 1.0)
        low = math.floor(position)
        weights = {low: 1 - (position - low), low + 1: position - low}
    else:
        weights = {q: 1 - abs(q - position) / reach for q in range(size)}
    weights = {q: weight for q, weight in weights.items() if weight > 0 and q < size}
    total = math.fsum(weights.values())
    return {q: weight / total for q, weight in weights.items()}


def read(image: Array, rows: list[float], columns: list[float], reach: float = 1.0) -> Array:
    """(C, rows, columns) of an image (C, H, W)."""
    out = np.zeros((image.shape[0], len(rows), len(columns)))
    across = [shares(x, image.shape[2], reach) for x in columns]
    for i, y in enumerate(rows):
        for row, weight_y in shares(y, image.shape[1], reach).items():
            for j, seen in enumerate(across):
                for column, weight_x in seen.items():
                    out[:, i, j] += weight_y * weight_x * image[:, row, column]
    return out


def at_scale(net: Net, image: Array, scale: float, antialias: bool) -> Array:
    """The net's output for one image on the frame of one level, at the original pixels."""
    height, width = image.shape[1:]
    rows = [r * scale for r in range(math.floor((height - 1) / scale) + 1)]
    columns = [r * scale for r in range(math.floor((width - 1) / scale) + 1)]
    result = net(read(image, rows, columns, scale if antialias and scale > 1 else 1.0))
    return read(result, [p / scale for p in range(height)], [p / scale for p in range(width)])


def pyramid(
    net: Net,
    image: Array,
    depth: Array,
    edges: list[float],
    centers: list[float],
    reference_depth: float,
    same_level_only: bool = False,
    antialias: bool = False,
    invalid_scale: float = 1.0,
) -> Array:
    """The pyramid's output (O, H, W) for one image (C, H, W) with depth (H, W)."""
    height, width = depth.shape
    level = np.array([[assign_level(float(z), edges) for z in row] for row in depth])
    out: Array | None = None
    for k in range(-1, len(centers)):
        scale = invalid_scale if k < 0 else reference_depth / centers[k]
        frame = np.where(level == k, image, 0.0) if same_level_only else image
        result = at_scale(net, frame, scale, antialias)
        if out is None:
            out = np.full((result.shape[0], height, width), np.nan)
        for y in range(height):
            for x in range(width):
                if level[y, x] == k:
                    out[:, y, x] = result[:, y, x]
    assert out is not None
    return out
