"""The operator, its gradients and the depth rules in plain loops over NumPy arrays, in float64.

Written from the relation alone and importing nothing that it judges. Channels are the only
thing handled as vectors; samples, output pixels, taps and corners are loops.
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
FAR = 1e9  # pixels; beyond any image, and small enough to floor safely


@dataclass(frozen=True)
class Geometry:
    """Everything of a convolution but its tensors; padding is (top, left, bottom, right)."""

    kernel: Pair
    stride: Pair = (1, 1)
    padding: tuple[int, int, int, int] = (0, 0, 0, 0)
    dilation: Pair = (1, 1)
    groups: int = 1

    def output_size(self, height: int, width: int) -> Pair:
        sizes = []
        for axis, size in enumerate((height, width)):
            span = self.dilation[axis] * (self.kernel[axis] - 1) + 1
            room = size + self.padding[axis] + self.padding[axis + 2] - span
            sizes.append(room // self.stride[axis] + 1)
        return sizes[0], sizes[1]

    def centre(self, axis: int, position: int) -> float:
        reach = self.dilation[axis] * (self.kernel[axis] - 1) / 2
        return self.stride[axis] * position - self.padding[axis] + reach

    def tap(self, axis: int, index: int) -> float:
        return self.dilation[axis] * (index - (self.kernel[axis] - 1) / 2)

    def centre_pixel(self, axis: int, position: int, size: int) -> int:
        return min(max(math.ceil(self.centre(axis, position) - 0.5), 0), size - 1)


class Axis(NamedTuple):
    """One axis of a sample: it lies `fraction` of the way from pixel `low` to `low + 1`."""

    low: int
    fraction: float

    @property
    def ends(self) -> tuple[tuple[int, float], tuple[int, float]]:
        return (self.low, 1.0 - self.fraction), (self.low + 1, self.fraction)


class Sample(NamedTuple):
    """Tap (ty, tx) of output pixel (oy, ox)."""

    oy: int
    ox: int
    ty: int
    tx: int
    y: Axis
    x: Axis


def sample_axis(centre: float, tap: float, scale: float) -> Axis | None:
    """Where a tap falls along one axis; None where it sees nothing."""
    base = math.floor(centre)
    offset = centre - base
    if tap != 0.0:
        if not math.isfinite(scale):
            return None
        offset += scale * tap
        if not abs(offset) < FAR:
            return None
    low = math.floor(offset)
    return Axis(base + low, offset - low)


def samples(geometry: Geometry, scale: Array) -> Iterator[Sample]:
    """Every tap of every output pixel of one image that sees anything; scale is (1 | 2, Ho, Wo)."""
    _, out_h, out_w = scale.shape
    for oy in range(out_h):
        for ox in range(out_w):
            scale_y, scale_x = float(scale[0, oy, ox]), float(scale[-1, oy, ox])
            for ty in range(geometry.kernel[0]):
                y = sample_axis(geometry.centre(0, oy), geometry.tap(0, ty), scale_y)
                for tx in range(geometry.kernel[1]):
                    x = sample_axis(geometry.centre(1, ox), geometry.tap(1, tx), scale_x)
                    if y is not None and x is not None:
                        yield Sample(oy, ox, ty, tx, y, x)


class Image:
    """One image and what its taps may see of it."""

    def __init__(
        self,
        pixels: Array,
        guide: NDArray[np.floating] | None,
        tolerance: float,
        geometry: Geometry,
        compute: type[np.floating],
    ) -> None:
        self.pixels = pixels
        self.height, self.width = pixels.shape[1:]
        self.guide = None if guide is None else guide.astype(compute)
        self.tolerance = compute(tolerance)
        self.geometry = geometry

    def sees(self, oy: int, ox: int, y: int, x: int) -> bool:
        if not (0 <= y < self.height and 0 <= x < self.width):
            return False
        if self.guide is None:
            return True
        centre_y = self.geometry.centre_pixel(0, oy, self.height)
        centre_x = self.geometry.centre_pixel(1, ox, self.width)
        centre = self.guide[centre_y, centre_x]
        if not np.isfinite(centre):
            return True
        with np.errstate(over="ignore"):
            return bool(np.abs(self.guide[y, x] - centre) <= self.tolerance)

    def value(self, sample: Sample, y: int, x: int) -> Array:
        if self.sees(sample.oy, sample.ox, y, x):
            return self.pixels[:, y, x]
        return np.zeros(self.pixels.shape[0])

    def corners(self, sample: Sample) -> Iterator[tuple[int, int, float]]:
        """Visible corners and their non-zero weights."""
        for y, weight_y in sample.y.ends:
            for x, weight_x in sample.x.ends:
                weight = weight_y * weight_x
                if weight != 0.0 and self.sees(sample.oy, sample.ox, y, x):
                    yield y, x, weight


class Checked(NamedTuple):
    """A result, and the sum of absolute terms that rounding errors are measured against."""

    value: Array
    magnitude: Array


def _images(
    x: Array, guide: NDArray[np.floating] | None, tolerance: float, geometry: Geometry, single: bool
) -> list[Image]:
    compute = np.float32 if single else np.float64
    return [
        Image(x[n], None if guide is None else guide[n], tolerance, geometry, compute)
        for n in range(x.shape[0])
    ]


def forward(
    x: Array,
    weight: Array,
    bias: Array | None,
    scale: Array,
    geometry: Geometry,
    guide: NDArray[np.floating] | None = None,
    tolerance: float = 0.0,
    single: bool = False,
) -> Checked:
    """x (N, C, H, W), weight (O, C/groups, kH, kW), scale (N, 1 | 2, Ho, Wo), guide (N, H, W).

    `single` compares the guide in float32, as an operator that computes in float32 does.
    """
    batch, channels = x.shape[:2]
    out_channels, groups = weight.shape[0], geometry.groups
    out = np.zeros((batch, out_channels, *scale.shape[2:]))
    magnitude = np.zeros_like(out)
    if bias is not None:
        out += bias[None, :, None, None]
        magnitude += np.abs(bias)[None, :, None, None]
    blocks = weight.reshape(groups, out_channels // groups, channels // groups, *geometry.kernel)
    for n, image in enumerate(_images(x, guide, tolerance, geometry, single)):
        for s in samples(geometry, scale[n]):
            seen = np.zeros(channels)
            bound = np.zeros(channels)
            for y, column, share in image.corners(s):
                seen += share * x[n, :, y, column]
                bound += np.abs(x[n, :, y, column])
            block = blocks[..., s.ty, s.tx]
            seen, bound = seen.reshape(groups, -1, 1), bound.reshape(groups, -1, 1)
            out[n, :, s.oy, s.ox] += (block @ seen).reshape(-1)
            magnitude[n, :, s.oy, s.ox] += (np.abs(block) @ bound).reshape(-1)
    return Checked(out, magnitude)


@dataclass
class Gradients:
    """Every gradient; on a kink grad_scale may be anything from scale_low to scale_high."""

    input: Checked
    weight: Checked
    bias: Checked
    scale: Checked
    scale_low: Array
    scale_high: Array


def _kink_cells(axis: Axis, kink: float) -> list[int]:
    """Lower pixels of the cells that a sample within `kink` of a pixel may count as lying in."""
    cells = [axis.low]
    if axis.fraction <= kink:
        cells.append(axis.low - 1)
    if axis.fraction >= 1.0 - kink:
        cells.append(axis.low + 1)
    return cells


def _slopes(image: Image, s: Sample, axis: int, kink: float) -> list[tuple[Array, Array]]:
    """Derivative of the sampled value along one axis, per side of a kink, and its magnitude."""
    along, across = (s.y, s.x) if axis == 0 else (s.x, s.y)
    results = []
    for low in _kink_cells(along, kink):
        slope = np.zeros(image.pixels.shape[0])
        size = np.zeros_like(slope)
        for other, share in across.ends:
            if share == 0.0:
                continue
            ends = (
                [(low, other), (low + 1, other)] if axis == 0 else [(other, low), (other, low + 1)]
            )
            first, second = (image.value(s, *end) for end in ends)
            slope += share * (second - first)
            size += np.abs(first) + np.abs(second)
        results.append((slope, size))
    return results


def backward(
    grad: Array,
    x: Array,
    weight: Array,
    scale: Array,
    geometry: Geometry,
    guide: NDArray[np.floating] | None = None,
    tolerance: float = 0.0,
    single: bool = False,
    kink: float = 0.0,
) -> Gradients:
    """Every gradient of sum(grad * forward(...)). `kink`: distance that counts as on a kink."""
    channels, out_channels, groups = x.shape[1], weight.shape[0], geometry.groups
    grad_x, size_x = np.zeros_like(x), np.zeros_like(x)
    shape = (groups, out_channels // groups, channels // groups, *geometry.kernel)
    blocks = weight.reshape(shape)
    grad_w, size_w = np.zeros(shape), np.zeros(shape)
    grad_s, low_s, high_s, size_s = (np.zeros(scale.shape) for _ in range(4))
    for n, image in enumerate(_images(x, guide, tolerance, geometry, single)):
        for s in samples(geometry, scale[n]):
            g = grad[n, :, s.oy, s.ox].reshape(groups, -1, 1)
            block = blocks[..., s.ty, s.tx]
            pulled = (block.transpose(0, 2, 1) @ g).reshape(-1)
            pulled_size = (np.abs(block).transpose(0, 2, 1) @ np.abs(g)).reshape(-1)
            seen, bound = np.zeros(channels), np.zeros(channels)
            for y, column, share in image.corners(s):
                seen += share * x[n, :, y, column]
                bound += np.abs(x[n, :, y, column])
                grad_x[n, :, y, column] += share * pulled
                size_x[n, :, y, column] += pulled_size
            grad_w[..., s.ty, s.tx] += g * seen.reshape(groups, 1, -1)
            size_w[..., s.ty, s.tx] += np.abs(g) * bound.reshape(groups, 1, -1)
            for axis, index in enumerate((s.ty, s.tx)):
                tap = geometry.tap(axis, index)
                part = min(axis, scale.shape[1] - 1)
                if tap == 0.0 or not math.isfinite(scale[n, part, s.oy, s.ox]):
                    continue
                slopes = _slopes(image, s, axis, kink)
                sides = [tap * float(pulled @ slope) for slope, _ in slopes]
                at = (n, part, s.oy, s.ox)
                grad_s[at] += sides[0]
                low_s[at] += min(sides)
                high_s[at] += max(sides)
                size_s[at] += abs(tap) * max(float(pulled_size @ size) for _, size in slopes)
    return Gradients(
        input=Checked(grad_x, size_x),
        weight=Checked(grad_w.reshape(weight.shape), size_w.reshape(weight.shape)),
        bias=Checked(grad.sum((0, 2, 3)), np.abs(grad).sum((0, 2, 3))),
        scale=Checked(grad_s, size_s),
        scale_low=low_s,
        scale_high=high_s,
    )
