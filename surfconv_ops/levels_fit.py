"""Levels of equal importance from a table of depths."""

from __future__ import annotations

import math
import warnings

import numpy as np
from numpy.typing import NDArray

from .depth_table import DepthTable, row_importance
from .levels import DepthLevels

#: A sum short of a level's share by this much of it is taken to reach it. Depths that part evenly
#: would otherwise have their edge across the next gap whenever their powers round.
ROUNDING = 1e-12


def fit_table(table: DepthTable, pixels: int, num_levels: int, gamma: float) -> DepthLevels:
    """:meth:`D4.fit` of a table, which holds the valid ones of ``pixels`` pixels."""
    if not len(table.pixels):
        reason = f"none of {pixels} pixels is positive and finite" if pixels else "there are none"
        raise ValueError(f"depths: expected at least one valid depth, but {reason}")
    cumulative = np.cumsum(row_importance(table, gamma))
    shares = np.arange(1, num_levels) * cumulative[-1]
    reached = np.searchsorted(cumulative * num_levels, shares * (1 - ROUNDING))
    last = len(table.pixels) - 1
    ends = np.unique(reached[reached < last])
    if len(ends) < num_levels - 1:
        _warn_of_fewer_levels(table, reached, num_levels, len(ends) + 1)
    starts = [0, *(ends + 1).tolist()]
    stops = [*starts[1:], last + 1]
    centers = [_center(table, gamma, *rows) for rows in zip(starts, stops, strict=True)]
    return DepthLevels(tuple(table.high[ends].tolist()), tuple(centers), gamma)


def _center(table: DepthTable, gamma: float, start: int, stop: int) -> float:
    """Importance-weighted mean depth of some rows."""
    rows = table.rows(start, stop)
    weight = row_importance(rows, gamma)
    low, high = float(rows.low[0]), float(rows.high[-1])
    # The product of a depth and a weight could overflow; a power of two divides without rounding.
    unit = math.ldexp(1.0, math.frexp(high)[1] - 1)
    mean = float(np.sum(weight * (rows.mean / unit)) / np.sum(weight)) * unit
    return min(max(mean, low), high)


def _warn_of_fewer_levels(
    table: DepthTable, reached: NDArray[np.intp], num_levels: int, made: int
) -> None:
    distinct = len(table.pixels)
    if made == distinct and (table.low == table.high).all():
        reason = "that is how many distinct depths there are"
    else:
        row = int(np.bincount([*reached, distinct - 1]).argmax())
        low, high = (f"{end[row]:.6g}" for end in (table.low, table.high))
        share = table.pixels[row] / table.pixels.sum()
        reason = (
            f"{low if low == high else f'{low} to {high}'} m alone, {share:.1%} of the valid"
            " pixels, holds at least one level's share of the importance; saturated pixels that"
            " should be holes?"
        )
    warnings.warn(
        f"depth levels: asked for {num_levels}, made {made}, because {reason}",
        UserWarning,
        stacklevel=4,
    )
