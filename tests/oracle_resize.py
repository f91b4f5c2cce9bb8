"""Depth at another resolution, pixel by pixel in loops, from the contract's words alone."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np


def resize(depth: np.ndarray, height: int, width: int) -> np.ndarray:
    """(H, W) -> (height, width): the pixel picked, or the nearest valid one of its footprint."""
    out = np.empty((height, width), dtype=depth.dtype)
    for i in range(height):
        rows = _footprint(i, depth.shape[0], height)
        for j in range(width):
            columns = _footprint(j, depth.shape[1], width)
            out[i, j] = _nearest(depth, rows, columns)
    return out


def _footprint(pixel: int, size: int, wanted: int) -> range:
    first = math.floor(Fraction(pixel * size, wanted))
    return range(first, math.ceil(Fraction((pixel + 1) * size, wanted)))


def _nearest(depth: np.ndarray, rows: range, columns: range) -> float:
    best, least = (rows[0], columns[0]), math.inf
    for row in rows:
        for column in columns:
            value = float(depth[row, column])
            distance = math.hypot(row - rows[0], column - columns[0])
            # Rows and columns ascend, so that of two as near the earlier one stays.
            if 0 < value < math.inf and distance < least:
                best, least = (row, column), distance
    return depth[best]
