"""Depth levels: a partition of depth into intervals, each with a depth that stands for it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import _fallback, direct
from .checks import check_depth_tensor, check_finite, check_positive

_FORMAT = "surfconv_ops.DepthLevels"
_VERSION = 1


@dataclass(frozen=True)
class DepthLevels:
    """N depth levels: level k holds ``edges[k-1] < z <= edges[k]`` and stands at ``centers[k]``.

    The first level reaches down to 0, the last one has no upper end. Depths that are zero,
    negative, NaN or infinite are invalid and belong to no level. Instances do not change, compare
    by value, and can be hashed, pickled and stored as JSON.

    Args:
        edges: The N-1 inner boundaries in metres, ascending; a sequence, tensor or array.
        centers: The N representative depths in metres, ascending.
        gamma: Exponent of the importance z**gamma that the levels were chosen by, kept as a
            record; None where they were chosen otherwise.

    Raises:
        ValueError: A depth is not positive and finite, the order is not ascending, or the numbers
            of edges and centers do not match.
        TypeError: An argument is of the wrong type.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, section 3.3 (data-driven depth discretisation).

    Example:
        >>> import torch
        >>> from surfconv_ops import DepthLevels
        >>> levels = DepthLevels(edges=[2.0, 4.0], centers=[1.5, 3.0, 6.0])
        >>> levels.assign(torch.tensor([0.0, 1.0, 2.0, 3.0, 9.0]))
        tensor([-1,  0,  0,  1,  2])
        >>> levels.quantize(torch.tensor([0.0, 1.0, 9.0]))
        tensor([   nan, 1.5000, 6.0000])
    """

    edges: tuple[float, ...]
    centers: tuple[float, ...]
    gamma: float | None = None
    # The edges as float32 depths meet them, once for all calls.
    _single_edges: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        edges = _ascending(self.edges, "edges")
        centers = _ascending(self.centers, "centers")
        if not centers:
            raise ValueError("centers: expected at least one depth, got none")
        if len(edges) != len(centers) - 1:
            raise ValueError(
                f"edges: expected {len(centers) - 1} inner boundaries for {len(centers)} centers,"
                f" got {len(edges)}"
            )
        object.__setattr__(self, "edges", edges)
        object.__setattr__(self, "_single_edges", _round_down(edges))
        object.__setattr__(self, "centers", centers)
        if self.gamma is not None:
            object.__setattr__(self, "gamma", check_finite(self.gamma, "gamma"))

    def __len__(self) -> int:
        """Number of levels."""
        return len(self.centers)

    def assign(self, depth: Tensor) -> Tensor:
        """Level of every pixel.

        Args:
            depth: Depth in metres, floating point, any shape.

        Returns:
            int64 of the same shape: 0 .. N-1, or -1 where the depth is invalid.

        Raises:
            TypeError: ``depth`` is not a floating-point tensor.

        Example:
            >>> DepthLevels([2.0], [1.0, 3.0]).assign(torch.tensor([1.0, 5.0]))
            tensor([0, 1])
        """
        return self.look_up(depth, range(len(self)), -1).to(torch.int64)

    def look_up(self, depth: Tensor, values: Iterable[float], invalid: float) -> Tensor:
        """A number for every pixel by its level.

        Args:
            depth: Depth in metres, floating point, any shape.
            values: One number a level.
            invalid: The number where the depth is invalid.

        Returns:
            The numbers, of the same shape: float64 for float64 depth, float32 for all others.
            They carry no gradient.

        Raises:
            TypeError: ``depth`` is not a floating-point tensor.

        Example:
            >>> DepthLevels([2.0], [1.0, 3.0]).look_up(torch.tensor([1.5, 5.0, 0.0]), (7, 8), 9)
            tensor([7., 8., 9.])
        """
        depth = check_depth_tensor(depth).detach()
        double = depth.dtype == torch.float64
        wide = depth if double else depth.to(torch.float32)
        edges = self.edges if double else self._single_edges
        # What is watched must not meet tensors from outside, nor leave its own in the cache.
        tensor = _new_tensor if direct.watched() else _kept_tensor
        boundaries = tensor(edges, wide.dtype, wide.device)
        table = tensor((*values, invalid), wide.dtype, wide.device)
        # A compiler fuses the plain form with what surrounds it.
        plain = torch.compiler.is_compiling()
        call = _fallback.level_values if plain else torch.ops.surfconv.level_values
        return call(wide, boundaries, table)

    def quantize(self, depth: Tensor) -> Tensor:
        """The representative depth of every pixel's level.

        Args:
            depth: Depth in metres, floating point, any shape.

        Returns:
            Metres, of the same shape: NaN where the depth is invalid; float64 for float64 depth,
            float32 for all others. It carries no gradient.

        Raises:
            TypeError: ``depth`` is not a floating-point tensor.

        Example:
            >>> DepthLevels([2.0], [1.0, 3.0]).quantize(torch.tensor([1.5, 5.0]))
            tensor([1., 3.])
        """
        return self.look_up(depth, self.centers, math.nan)

    def to_dict(self) -> dict[str, Any]:
        """Edges, centers and gamma as plain numbers and lists."""
        return {"edges": list(self.edges), "centers": list(self.centers), "gamma": self.gamma}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the levels to ``path`` as JSON; :meth:`load` gives back exactly the same numbers.

        Args:
            path: File to write; an existing one is replaced.
        """
        content = {"format": _FORMAT, "version": _VERSION, **self.to_dict()}
        Path(path).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> DepthLevels:
        """Levels from a file that :meth:`save` wrote.

        Args:
            path: File to read.

        Returns:
            Levels equal to those saved.

        Raises:
            ValueError: The file does not hold depth levels.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"path: {os.fspath(path)} is not JSON: {error}") from error
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise ValueError(f"path: {os.fspath(path)} does not hold depth levels")
        if content.get("version") != _VERSION:
            raise ValueError(
                f"path: {os.fspath(path)} has version {content.get('version')}, expected {_VERSION}"
            )
        try:
            return cls(content["edges"], content["centers"], content.get("gamma"))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"path: {os.fspath(path)} holds no valid levels: {error}") from error


def _new_tensor(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)


@lru_cache(maxsize=256)
def _kept_tensor(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """The same tensor every time: a copy to a GPU costs more than looking up, and none may be
    made while a graph is captured."""
    with torch.inference_mode(False):
        return _new_tensor(values, dtype, device)


def _round_down(edges: tuple[float, ...]) -> tuple[float, ...]:
    """float32 edges that part float32 depths just as the exact ones do."""
    with np.errstate(over="ignore"):
        nearest = np.asarray(edges, dtype=np.float32)
    below = np.nextafter(nearest, np.float32(0))
    return tuple(np.where(nearest.astype(np.float64) > edges, below, nearest).tolist())


def _ascending(values: Any, name: str) -> tuple[float, ...]:
    """Positive, finite, strictly ascending depths as a tuple of floats."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise TypeError(f"{name}: expected a sequence of depths in metres, got {values!r}")
    depths = tuple(check_positive(v, f"{name}[{i}]", "metres") for i, v in enumerate(values))
    for i in range(1, len(depths)):
        if depths[i] <= depths[i - 1]:
            raise ValueError(
                f"{name}: expected strictly ascending depths, got {depths[i]} after"
                f" {depths[i - 1]} at position {i} of {list(depths)}"
            )
    return depths
