"""The depth rules, pixel by pixel, from the relation alone: what oracle.py is for the operator."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from oracle import Geometry


def at_output_centers(values: NDArray[np.floating], geometry: Geometry) -> NDArray[np.floating]:
    """(..., H, W) read at the pixel nearest to every output's centre; a half rounds down."""
    height, width = values.shape[-2:]
    out_h, out_w = geometry.output_size(height, width)
    out = np.empty((*values.shape[:-2], out_h, out_w), values.dtype)
    for oy in range(out_h):
        for ox in range(out_w):
            y = geometry.centre_pixel(0, oy, height)
            out[..., oy, ox] = values[..., y, geometry.centre_pixel(1, ox, width)]
    return out


def assign_level(depth: float, edges: list[float]) -> int:
    """Level k holds edges[k-1] < depth <= edges[k]; -1 for an invalid depth."""
    if not math.isfinite(depth) or depth <= 0:
        return -1
    level = 0
    while level < len(edges) and depth > edges[level]:
        level += 1
    return level


def depth_to_scale(
    depth: float,
    reference_depth: float,
    levels: tuple[list[float], list[float]] | None = None,
    invalid_scale: float = 1.0,
    min_scale: float = 0.0,
    max_scale: float = math.inf,
) -> tuple[float, float]:
    """One pixel's scale and its derivative; levels is (edges, centers)."""
    if not math.isfinite(depth) or depth <= 0:
        return invalid_scale, 0.0
    used = depth
    if levels is not None:
        used = levels[1][assign_level(depth, levels[0])]
    scale = reference_depth / used
    if scale < min_scale:
        return min_scale, 0.0
    if scale > max_scale:
        return max_scale, 0.0
    return scale, 0.0 if levels is not None else -scale / depth
