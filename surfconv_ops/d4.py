"""Data-driven depth discretisation (D4): depth levels of equal importance."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .checks import check_finite, check_integer, type_name
from .depth_table import DepthTable, add_tables, distinct_depths, into_bins, valid_values
from .gathering import gather_parts
from .levels import DepthLevels
from .levels_fit import fit_table

#: Distinct depths that D4 keeps one by one before it gathers them in bins. A 16-bit sensor has
#: at most half as many.
EXACT_LIMIT = 2**17


class D4:
    """Fits depth levels of equal importance to a stream of depth maps, in bounded memory.

    The importance of a pixel at depth z is ``z**gamma``: with 0 each level holds as many pixels,
    with 2 as much surface area. ``edges[k]`` is the smallest depth at which the importance of all
    pixels up to it reaches the share ``(k + 1) / num_levels``; ``centers[k]`` is the
    importance-weighted mean depth of level k.

    Depths are counted one by one until more than 131,072 distinct ones were seen: until then,
    and so for any one 16-bit sensor, the levels are exact. After that they are counted in bins
    at most 0.025 % wide; each edge is then the largest depth of its bin that was seen, which is
    at most 0.025 % above the exact edge. Memory grows with the range of depth (at most 4096 bins
    for each doubling), not with the number of pixels. Which of the two it is, and the result,
    depend on the depths alone, not on their order nor on how they were split before
    :meth:`merge` (to float rounding). Instances can be pickled.

    Args:
        num_levels: Number of levels, from 1.
        gamma: Exponent of the importance; any finite number.

    Attributes:
        num_levels: As given.
        gamma: As given.

    Raises:
        ValueError: ``num_levels`` is less than 1, or ``gamma`` is not finite.
        TypeError: An argument is of the wrong type.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, section 3.3 (data-driven depth discretisation).

    Example:
        >>> import torch
        >>> from surfconv_ops import D4
        >>> d4 = D4(num_levels=2, gamma=1.0)
        >>> for depth in (torch.tensor([1.0, 2.0, 0.0]), torch.tensor([3.0, 6.0])):
        ...     d4 = d4.update(depth)
        >>> d4.fit()
        DepthLevels(edges=(3.0,), centers=(2.3333333333333335, 6.0), gamma=1.0)
    """

    def __init__(self, num_levels: int, gamma: float = 1.0) -> None:
        self.num_levels = check_integer(num_levels, "num_levels", 1)
        self.gamma = check_finite(gamma, "gamma")
        self._table = distinct_depths(np.empty(0))
        self._exact = True
        self._pixels = 0

    @property
    def exact(self) -> bool:
        """Whether :meth:`fit` is exact: every distinct depth is still counted by itself."""
        return self._exact

    @property
    def pixels(self) -> int:
        """Number of pixels seen, invalid ones included."""
        return self._pixels

    @property
    def valid_pixels(self) -> int:
        """Number of pixels seen that have a valid depth."""
        return int(self._table.pixels.sum())

    @property
    def table(self) -> DepthTable:
        """The pixels by depth: a row for each distinct one, or for each bin."""
        return self._table

    def __repr__(self) -> str:
        return (
            f"D4(num_levels={self.num_levels}, gamma={self.gamma}): {self.valid_pixels} valid of"
            f" {self.pixels} pixels, {'exact' if self.exact else 'in bins'}"
        )

    def update(self, depth: Tensor | NDArray[Any]) -> D4:
        """Add the pixels of a depth map, or of a batch of them.

        Args:
            depth: Metres, floating point, any shape, tensor (on any device) or array. Zero,
                negative, NaN and infinite depths are invalid and count for nothing.

        Returns:
            This object.

        Raises:
            TypeError: ``depth`` is not a floating-point tensor or array.

        Example:
            >>> D4(4).update(torch.tensor([[1.0, 2.0], [0.0, 4.0]])).valid_pixels
            3
        """
        values, pixels = valid_values(depth)
        self._add(distinct_depths(values), True, pixels)
        return self

    def merge(self, other: D4) -> D4:
        """Add the pixels that another one has seen.

        Args:
            other: One with the same ``num_levels`` and ``gamma``; it is left as it is.

        Returns:
            This object.

        Raises:
            ValueError: ``num_levels`` or ``gamma`` differ.
            TypeError: ``other`` is not a D4.

        Example:
            >>> one, two = D4(4).update(torch.ones(3)), D4(4).update(torch.ones(5))
            >>> one.merge(two).valid_pixels
            8
        """
        if not isinstance(other, D4):
            raise TypeError(f"other: expected D4, got {type_name(other)}")
        for name in ("num_levels", "gamma"):
            mine, its = getattr(self, name), getattr(other, name)
            if mine != its:
                raise ValueError(f"other: expected one with {name} = {mine}, got {its}")
        self._add(other._table, other._exact, other._pixels)
        return self

    def all_reduce(self, group: torch.distributed.ProcessGroup | None = None) -> D4:
        """Add what the other processes have seen, so that all of them hold the whole.

        To be called by every process of the group, once the last :meth:`update` is done: a
        second call adds everything once more. All processes get the same bits. The tables travel
        as objects; with NCCL that takes ``torch.cuda.set_device`` beforehand.

        Args:
            group: Process group of torch.distributed; None for the default one.

        Returns:
            This object.

        Raises:
            RuntimeError: torch.distributed is not initialised.
            ValueError: This process is not in the group, or ``num_levels`` or ``gamma`` differ
                between processes.

        Example:
            >>> d4 = D4(4).update(torch.ones(3))
            >>> d4.all_reduce()
            Traceback (most recent call last):
            RuntimeError: all_reduce: torch.distributed is not initialised; call ...
        """
        parts = gather_parts(self, group)
        whole = parts[0]
        for part in parts[1:]:
            whole.merge(part)
        self.__dict__.update(whole.__dict__)
        return self

    def fit(self) -> DepthLevels:
        """Levels of equal importance for all pixels so far.

        Where one depth holds more than a level's share of the importance, and so always where
        there are fewer distinct depths than levels, edges coincide. They are merged into one, an
        edge above which there is no pixel is left out, and a warning tells the smaller number of
        levels.

        Returns:
            At most ``num_levels`` levels, each holding at least one pixel, with ``gamma`` kept
            as a record.

        Raises:
            ValueError: No pixel has a valid depth.

        Example:
            >>> D4(2, gamma=0.0).update(torch.tensor([1.0, 2.0, 3.0, 5.0])).fit()
            DepthLevels(edges=(2.0,), centers=(1.5, 4.0), gamma=0.0)
        """
        return fit_table(self._table, self._pixels, self.num_levels, self.gamma)

    def _add(self, table: DepthTable, exact: bool, pixels: int) -> None:
        ours = self._table
        if self._exact and not exact:
            ours = into_bins(ours, self.gamma)
        if exact and not self._exact:
            table = into_bins(table, self.gamma)
        self._exact = self._exact and exact
        self._table = add_tables(ours, table)
        self._pixels += pixels
        if self._exact and len(self._table.pixels) > EXACT_LIMIT:
            self._exact = False
            self._table = into_bins(self._table, self.gamma)


def fit_depth_levels(
    depths: Tensor | NDArray[Any] | Iterable[Tensor | NDArray[Any]],
    num_levels: int,
    gamma: float = 1.0,
) -> DepthLevels:
    """Fit depth levels of equal importance ``z**gamma`` to depth maps.

    A tensor, an array, and a list or tuple of them are in memory, and their levels are exact. Any
    other iterable, such as a generator that reads files or a data loader, is gone through once
    with :class:`D4`, which says what its edges are worth.

    Args:
        depths: Metres, floating point, of any shape; zero, negative, NaN and infinite ones are
            invalid and count for nothing.
        num_levels: Number of levels, from 1.
        gamma: Exponent of the importance; any finite number. 0: as many pixels in each level; 2:
            as much surface area.

    Returns:
        The levels; see :meth:`D4.fit`, also for when they are fewer than ``num_levels``.

    Raises:
        ValueError: No pixel has a valid depth, or a number is out of its range.
        TypeError: ``depths`` holds something else, such as integers.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, section 3.3 (data-driven depth discretisation).

    Example:
        >>> import torch
        >>> from surfconv_ops import fit_depth_levels
        >>> fit_depth_levels(torch.tensor([1.0, 2.0, 3.0, 6.0]), num_levels=2)
        DepthLevels(edges=(3.0,), centers=(2.3333333333333335, 6.0), gamma=1.0)
        >>> frames = (torch.full((2, 2), z) for z in (1.0, 2.0, 4.0, 8.0))
        >>> fit_depth_levels(frames, num_levels=2, gamma=0.0)
        DepthLevels(edges=(2.0,), centers=(1.5, 6.0), gamma=0.0)
    """
    d4 = D4(num_levels, gamma)
    if isinstance(depths, (Tensor, np.ndarray)):
        depths = (depths,)
        names = ["depths"]
    elif isinstance(depths, (list, tuple)):
        names = [f"depths[{i}]" for i in range(len(depths))]
    elif isinstance(depths, Iterable):
        for depth in depths:
            d4.update(depth)
        return fit_table(d4.table, d4.pixels, d4.num_levels, d4.gamma)
    else:
        raise TypeError(
            f"depths: expected a tensor, an array, or an iterable of them, got {type_name(depths)}"
        )
    parts = [valid_values(depth, name) for depth, name in zip(depths, names, strict=True)]
    values = np.concatenate([np.empty(0, np.float32), *(part for part, _ in parts)])
    pixels = sum(count for _, count in parts)
    return fit_table(distinct_depths(values), pixels, d4.num_levels, d4.gamma)
