"""Levels of equal importance in exact fractions, one pixel after another."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple


class Levels(NamedTuple):
    """`targets`: all N-1 edges, equal ones included; `edges`: those that part two pixels."""

    targets: list[float]
    edges: list[float]
    centers: list[float]


def fit(depths: Iterable[float], num_levels: int, gamma: int) -> Levels:
    """The definition with no rounding at all, so gamma is a whole number here."""
    valid = sorted(z for z in map(float, depths) if math.isfinite(z) and z > 0)
    weights = [Fraction(z) ** gamma for z in valid]
    total = sum(weights)
    targets = [reaches(valid, weights, Fraction(k, num_levels) * total) for k in
               range(1, num_levels)]  # fmt: skip
    edges = sorted({edge for edge in targets if edge < valid[-1]})
    centers = []
    bounds = [0.0, *edges, math.inf]
    for low, high in pairwise(bounds):
        pixels = [i for i, z in enumerate(valid) if low < z <= high]
        weight = sum(weights[i] for i in pixels)
        centers.append(float(sum(weights[i] * Fraction(valid[i]) for i in pixels) / weight))
    return Levels(targets, edges, centers)


def reaches(valid: list[float], weights: list[Fraction], share: Fraction) -> float:
    """The first depth up to which the importance adds up to the share."""
    seen = Fraction(0)
    for z, weight in zip(valid, weights, strict=True):
        seen += weight
        if seen >= share:
            return z
    raise AssertionError("the share is more than all")
