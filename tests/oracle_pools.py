"""The pools and their gradients in plain loops over NumPy arrays, in float64.

Written from the relation and from nn's rules alone, importing nothing that it judges. One function
says what a tap sees and how that changes with the scale; everything else is the chain rule.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pair = tuple[int, int]
FAR = 1e15  # pixels; beyond any image, and small enough to floor safely


@dataclass(frozen=True)
class Pool:
    """A pool's arguments; `average` holds those that only averages have."""

    kernel: Pair
    stride: Pair
    padding: Pair = (0, 0)
    dilation: Pair = (1, 1)
    average: bool = False
    count_include_pad: bool = True
    divisor_override: int = 0

    def centre(self, axis: int, output: int) -> float:
        reach = self.dilation[axis] * (self.kernel[axis] - 1) / 2
        return self.stride[axis] * output - self.padding[axis] + reach

    def tap(self, axis: int, index: int) -> float:
        return self.dilation[axis] * (index - (self.kernel[axis] - 1) / 2)

    def window(self, axis: int, output: int, size: int) -> int:
        """Pixels of an axis that nn counts in window `output`, padding included."""
        start = output * self.stride[axis] - self.padding[axis]
        end = min(start + self.kernel[axis], size + self.padding[axis])
        return end - start


class Ends(NamedTuple):
    """A sample on one axis: a pixel, its weight, and the weight's derivative by the scale.

    Exactly on a pixel it is the derivative towards larger scales.
    """

    pixel: int
    weight: float
    slope: float


def ends(pool: Pool, axis: int, output: int, index: int, scale: float, size: int) -> list[Ends]:
    """What tap `index` of window `output` sees along an axis; empty where nothing."""
    centre, tap = pool.centre(axis, output), pool.tap(axis, index)
    base = math.floor(centre)
    if tap != 0 and not math.isfinite(scale):
        return []
    offset = centre - base + (scale * tap if tap != 0 else 0.0)
    limited = max(min(offset, FAR), -FAR)
    low = math.floor(limited) if tap >= 0 else math.ceil(limited) - 1
    fraction = 1.0 - (1.0 - (limited - low))  # all but on a pixel is on it
    low += base
    pair = [Ends(low, 1.0 - fraction, -tap), Ends(low + 1, fraction, tap)]
    if pool.average:
        return [end for end in pair if 0 <= end.pixel < size and limited == offset]
    if scale == 1 and not 0 <= low + fraction <= size - 1:
        return []
    if low < 0 or low >= size - 1:
        return [Ends(0 if low < 0 else size - 1, 1.0, 0.0)]
    return pair


class Corner(NamedTuple):
    y: int
    x: int
    weight: float
    slopes: tuple[float, float]  # by scale_y and by scale_x
    seen: bool  # a hidden one counts as zero


class Frame:
    """One image, its scale and what its windows may see."""

    def __init__(
        self,
        pool: Pool,
        image: Array,
        scale: Array,
        guide: Array | None,
        tolerance: float,
        single: bool = False,
    ) -> None:
        self.pool, self.image, self.scale = pool, image, scale
        compute = np.float32 if single else np.float64
        self.guide = None if guide is None else guide.astype(compute)
        self.tolerance = compute(tolerance)
        self.size = image.shape[1:]

    def visible(self, oy: int, ox: int, y: int, x: int) -> bool:
        if self.guide is None:
            return True
        at = []
        for axis, output in enumerate((oy, ox)):
            nearest = math.ceil(self.pool.centre(axis, output) - 0.5)
            at.append(min(max(nearest, 0), self.size[axis] - 1))
        centre = self.guide[at[0], at[1]]
        if not np.isfinite(centre):
            return True
        with np.errstate(over="ignore"):
            return bool(np.abs(self.guide[y, x] - centre) <= self.tolerance)

    def corners(self, oy: int, ox: int, ty: int, tx: int) -> list[Corner]:
        """Corners of a tap in the image."""
        rows = ends(self.pool, 0, oy, ty, float(self.scale[0, oy, ox]), self.size[0])
        columns = ends(self.pool, 1, ox, tx, float(self.scale[-1, oy, ox]), self.size[1])
        return [
            Corner(
                y=y.pixel,
                x=x.pixel,
                weight=y.weight * x.weight,
                slopes=(y.slope * x.weight, y.weight * x.slope),
                seen=self.visible(oy, ox, y.pixel, x.pixel),
            )
            for y in rows
            for x in columns
        ]

    def taps(self, oy: int, ox: int) -> Iterator[tuple[int, list[Corner]]]:
        """Number of every tap, and its corners."""
        for number, (ty, tx) in enumerate(np.ndindex(*self.pool.kernel)):
            yield number, self.corners(oy, ox, ty, tx)


def _value(image: Array, corners: list[Corner]) -> Array:
    total = np.zeros(image.shape[0])
    for c in corners:
        if c.weight != 0 and c.seen:
            total = total + c.weight * image[:, c.y, c.x]
    return total


def _winners(frame: Frame, oy: int, ox: int) -> tuple[Array, list[list[Corner]]]:
    """Per channel the maximum and the corners of the tap it is from."""
    channels = frame.image.shape[0]
    best = np.zeros(channels)
    corners: list[list[Corner]] = [[] for _ in range(channels)]
    taken = np.zeros(channels, dtype=bool)
    for _, tap in frame.taps(oy, ox):
        if not any(c.weight != 0 for c in tap):
            continue
        value = _value(frame.image, tap)
        for k in range(channels):
            if not taken[k] or value[k] > best[k] or math.isnan(value[k]):
                best[k], corners[k], taken[k] = value[k], tap, True
    return best, corners


def _divisor(frame: Frame, oy: int, ox: int, corners: list[Corner]) -> float:
    pool = frame.pool
    if pool.divisor_override:
        return float(pool.divisor_override)
    if not pool.count_include_pad:
        return sum(c.weight for c in corners)
    return float(pool.window(0, oy, frame.size[0]) * pool.window(1, ox, frame.size[1]))


def _output(frame: Frame, oy: int, ox: int) -> Array:
    if not frame.pool.average:
        return _winners(frame, oy, ox)[0]
    corners = [c for _, tap in frame.taps(oy, ox) for c in tap]
    divisor = _divisor(frame, oy, ox, corners)
    if divisor == 0:
        return np.zeros(frame.image.shape[0])
    return _value(frame.image, corners) / divisor


def _frames(
    pool: Pool, x: Array, scale: Array, guide: Array | None, tolerance: float, single: bool
) -> list[Frame]:
    return [
        Frame(pool, x[n], scale[n], None if guide is None else guide[n], tolerance, single)
        for n in range(x.shape[0])
    ]


def forward(
    pool: Pool,
    x: Array,
    scale: Array,
    guide: Array | None = None,
    tolerance: float = 0.0,
    single: bool = False,
) -> Array:
    """x (N, C, H, W), scale (N, 1 | 2, Ho, Wo), guide (N, H, W)."""
    out = np.zeros((*x.shape[:2], *scale.shape[2:]))
    for n, frame in enumerate(_frames(pool, x, scale, guide, tolerance, single)):
        for oy, ox in np.ndindex(*scale.shape[2:]):
            out[n, :, oy, ox] = _output(frame, oy, ox)
    return out


class Gradients(NamedTuple):
    input: Array
    scale: Array


def backward(
    pool: Pool,
    grad: Array,
    x: Array,
    scale: Array,
    guide: Array | None = None,
    tolerance: float = 0.0,
    single: bool = False,
) -> Gradients:
    """Gradients of sum(grad * forward(...)); on a pixel the scale's is that of a growing scale."""
    grad_x, grad_s = np.zeros_like(x), np.zeros(scale.shape)
    for n, frame in enumerate(_frames(pool, x, scale, guide, tolerance, single)):
        for oy, ox in np.ndindex(*scale.shape[2:]):
            g, slopes = grad[n, :, oy, ox], [0.0, 0.0]
            if pool.average:
                corners = [c for _, tap in frame.taps(oy, ox) for c in tap]
                divisor = _divisor(frame, oy, ox, corners)
                if divisor == 0:
                    continue
                floats = not pool.count_include_pad and not pool.divisor_override
                mean = _value(frame.image, corners) / divisor if floats else 0.0
                for c in corners:
                    grad_x[n, :, c.y, c.x] += c.weight * g / divisor if c.seen else 0.0
                    value = frame.image[:, c.y, c.x] if c.seen else 0.0
                    part = float(np.sum(g * (value - mean))) / divisor
                    slopes = [slopes[i] + c.slopes[i] * part for i in (0, 1)]
            else:
                for k, tap in enumerate(_winners(frame, oy, ox)[1]):
                    for c in tap:
                        if not c.seen:
                            continue
                        grad_x[n, k, c.y, c.x] += c.weight * g[k]
                        part = float(g[k] * frame.image[k, c.y, c.x])
                        slopes = [slopes[i] + c.slopes[i] * part for i in (0, 1)]
            if scale.shape[1] == 1:
                slopes = [slopes[0] + slopes[1]]
            grad_s[n, :, oy, ox] = slopes
    return Gradients(grad_x, grad_s)
