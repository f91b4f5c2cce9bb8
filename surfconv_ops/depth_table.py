"""Depths counted and weighed in a table of bounded size: what :class:`~surfconv_ops.D4` keeps.

A row stands for one distinct depth, or for one narrow bin of depths. Tables are merged by adding
rows, and what they hold depends on the depths alone: neither on their order nor on how they were
parted before merging (sums of many powers apart, which round).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from .checks import check_depth_tensor, type_name, valid_depth

#: A bin shares its depths' exponent and this many bits of the mantissa: it is 2**-12 wide
#: (0.024 %) or narrower, relative to the depths in it, and the range is that of float64.
BIN_BITS = 12
_DROPPED_BITS = 52 - BIN_BITS
# Powers leave this range within one bin only for |gamma| > 1e6, where one depth has it all.
_LARGEST_POWER = 1e100

Floats = NDArray[np.float64]


class DepthTable(NamedTuple):
    """Rows in ascending order of depth, which do not overlap.

    ``importance`` and ``moment`` are relative to ``anchor``, which is what keeps them finite:
    the sums over the row's depths z of ``(z / anchor)**gamma`` and ``(z / anchor)**(gamma + 1)``.
    """

    low: Floats
    """Smallest depth of the row, in metres."""
    high: Floats
    """Largest depth of the row, in metres."""
    anchor: Floats
    """The depth itself, or the middle of the bin: rows of equal anchor are one row."""
    pixels: NDArray[np.int64]
    """Number of pixels."""
    importance: Floats
    moment: Floats

    @property
    def mean(self) -> Floats:
        """The importance-weighted mean depth of each row, in metres."""
        return np.clip(self.anchor * (self.moment / self.importance), self.low, self.high)

    def rows(self, start: int, stop: int) -> DepthTable:
        """The rows from ``start`` up to, not including, ``stop``."""
        return DepthTable._make(column[start:stop] for column in self)


def distinct_depths(values: NDArray[Any]) -> DepthTable:
    """One row for each distinct depth; the depths are all valid."""
    distinct, count = np.unique(values, return_counts=True)
    depth = distinct.astype(np.float64)
    weight = count.astype(np.float64)
    return DepthTable(depth, depth, depth, count.astype(np.int64), weight, weight)


def into_bins(table: DepthTable, gamma: float) -> DepthTable:
    """The table with its rows gathered into bins."""
    bits = table.anchor.view(np.int64) >> _DROPPED_BITS
    # The middle of a bin, unlike its ends, is never 0 nor infinite.
    middle = ((bits << _DROPPED_BITS) | (1 << (_DROPPED_BITS - 1))).view(np.float64)
    ratio = table.anchor / middle
    with np.errstate(over="ignore", under="ignore"):
        power = np.clip(ratio**gamma, 1 / _LARGEST_POWER, _LARGEST_POWER)
    importance = table.importance * power
    moment = table.moment * power * ratio
    return _gathered(table._replace(anchor=middle, importance=importance, moment=moment))


def add_tables(first: DepthTable, second: DepthTable) -> DepthTable:
    """The rows of both tables, which are both of distinct depths or both of bins."""
    pairs = zip(first, second, strict=True)
    return _gathered(DepthTable._make(np.concatenate(pair) for pair in pairs))


def _gathered(table: DepthTable) -> DepthTable:
    """The table in order, rows of one anchor added up."""
    order = np.argsort(table.anchor, kind="stable")
    anchor = table.anchor[order]
    if not len(anchor):
        return table
    starts = np.flatnonzero(np.concatenate(([True], anchor[1:] != anchor[:-1])))
    return DepthTable(
        np.minimum.reduceat(table.low[order], starts),
        np.maximum.reduceat(table.high[order], starts),
        anchor[starts],
        np.add.reduceat(table.pixels[order], starts),
        np.add.reduceat(table.importance[order], starts),
        np.add.reduceat(table.moment[order], starts),
    )


def row_importance(table: DepthTable, gamma: float) -> Floats:
    """Importance of each row, up to a factor that all rows share."""
    logarithm = np.log2(table.anchor)
    with np.errstate(over="ignore", under="ignore"):
        if np.abs(gamma * logarithm).max() < 512:
            # Without a factor, so that sums of whole numbers stay exact and ties stay ties.
            powers = table.anchor**gamma
        else:
            largest = logarithm.max() if gamma > 0 else logarithm.min()
            powers = np.exp2(gamma * (logarithm - largest))
    importance: Floats = table.importance * powers
    return importance


def valid_values(depth: Any, name: str = "depth") -> tuple[NDArray[Any], int]:
    """The valid depths of a tensor or array in one dimension, and its number of pixels."""
    if isinstance(depth, Tensor):
        tensor = check_depth_tensor(depth, name).detach()
        kept = tensor[valid_depth(tensor)]
        return (kept if kept.itemsize >= 4 else kept.float()).cpu().numpy(), tensor.numel()
    if not isinstance(depth, np.ndarray):
        raise TypeError(f"{name}: expected a tensor or an array, got {type_name(depth)}")
    if depth.dtype.kind != "f":
        raise TypeError(
            f"{name}: expected floating-point metres, got {depth.dtype}; sensors often store"
            f" integer millimetres: convert with {name}.astype('float32') / 1000 (or by your"
            " sensor's unit)"
        )
    if isinstance(depth, np.ma.MaskedArray):
        depth = depth.filled(np.nan)
    return depth[valid_depth(depth)].astype(np.result_type(depth, np.float32)), depth.size
