"""Segmentation figures from their definitions, pixel by pixel, in plain Python."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from typing import NamedTuple


class Pixel(NamedTuple):
    """One pixel: its predicted class, its label and its depth in metres."""

    prediction: int
    target: int
    depth: float


def is_valid(depth: float) -> bool:
    return math.isfinite(depth) and depth > 0


def weight_of(pixel: Pixel, surface: bool) -> Fraction:
    """Weight without any rounding: 1, or the square of a valid depth."""
    if not surface:
        return Fraction(1)
    return Fraction(pixel.depth) ** 2 if is_valid(pixel.depth) else Fraction(0)


def ratio(part: Fraction, whole: Fraction) -> float:
    return float(part / whole) if whole else math.nan


def accuracy(pixels: Iterable[Pixel], ignore: int | None, surface: bool) -> float:
    counted = [pixel for pixel in pixels if pixel.target != ignore]
    correct = sum(weight_of(p, surface) for p in counted if p.prediction == p.target)
    return ratio(Fraction(correct), Fraction(sum(weight_of(p, surface) for p in counted)))


def class_iou(pixels: Iterable[Pixel], ignore: int | None, surface: bool, label: int) -> float:
    both = either = Fraction(0)
    for pixel in pixels:
        if pixel.target == ignore:
            continue
        has, says = pixel.target == label, pixel.prediction == label
        both += weight_of(pixel, surface) * (has and says)
        either += weight_of(pixel, surface) * (has or says)
    return ratio(both, either)


def class_accuracy(pixels: Iterable[Pixel], ignore: int | None, surface: bool, label: int) -> float:
    own = [pixel for pixel in pixels if pixel.target == label]
    return accuracy(own, ignore, surface)


def mean_iou(pixels: list[Pixel], ignore: int | None, surface: bool, classes: int) -> float:
    each = [class_iou(pixels, ignore, surface, c) for c in range(classes) if c != ignore]
    present = [iou for iou in each if not math.isnan(iou)]
    return sum(present) / len(present) if present else math.nan


def four(pixels: list[Pixel], ignore: int | None, classes: int) -> dict[str, float]:
    """The paper's four figures."""
    figures = {}
    for name, surface in (("img", False), ("surf", True)):
        figures[f"acc_{name}"] = accuracy(pixels, ignore, surface)
        figures[f"iou_{name}"] = mean_iou(pixels, ignore, surface, classes)
    return figures


def within(pixels: list[Pixel], low: float, high: float) -> list[Pixel]:
    """Pixels with low < depth <= high."""
    return [p for p in pixels if is_valid(p.depth) and low < p.depth <= high]
