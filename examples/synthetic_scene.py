"""A yard with three equal crates, ray-cast with NumPy: an RGB-D frame whose depth is exact.

Everything is an axis-aligned box (floor and walls too), so one slab test serves the whole scene.
The crates are the same size at three distances, which is what a scale-aware convolution is about.
Camera axes: x right, y down, z forward, metres; depth is z, not the length of the ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CRATE_SIZE = 1.2
CAMERA_HEIGHT = 1.5
SUN = np.array([0.42, -0.75, -0.5]) / np.linalg.norm([0.42, -0.75, -0.5])
# The sensor's emitter sits beside its camera: what the emitter cannot light has no depth.
EMITTER = np.array([0.12, 0.0, 0.0])
DROPOUT = 0.006
SEED = 7


class Box(NamedTuple):
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    material: str


class Frame(NamedTuple):
    """An RGB-D frame: rgb (H, W, 3), depth (H, W) in metres with 0 in holes, focal in pixels."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    focal: float


@dataclass(frozen=True)
class Hits:
    """Nearest hits of a bundle of rays: ray parameter (inf = none), box index, axis of the face."""

    distance: Array
    box: NDArray[np.int64]
    axis: NDArray[np.int64]


def _crate(x: float, z: float) -> Box:
    top = CAMERA_HEIGHT - CRATE_SIZE
    return Box((x, top, z), (x + CRATE_SIZE, CAMERA_HEIGHT, z + CRATE_SIZE), "crate")


# The middles of the crates' faces fall on pixels that a layer of stride 8 keeps.
CRATES = (_crate(-2.200, 3.510), _crate(-0.313, 7.311), _crate(3.576, 13.646))
SCENE = (
    Box((-60.0, CAMERA_HEIGHT, -1.0), (60.0, 2.0, 60.0), "floor"),
    Box((-60.0, -1.9, 25.0), (60.0, 2.0, 25.5), "brick"),
    Box((-7.5, -1.9, 2.0), (-7.0, 2.0, 25.0), "brick"),
    Box((2.6, -3.0, 6.2), (3.0, 2.0, 6.6), "post"),
    Box((-4.3, -3.0, 11.0), (-3.9, 2.0, 11.4), "post"),
    Box((9.0, 0.2, 9.0), (12.0, 2.0, 23.0), "hedge"),
    Box((-2.5, -1.0, 24.95), (-0.1, 0.6, 25.0), "glass"),
    *CRATES,
)


def _cast(origin: Array, direction: Array) -> Hits:
    """Slab test of rays (M, 3) against every box; the nearest entry in front of the origin wins."""
    count = len(direction)
    best = np.full(count, np.inf)
    box_of = np.full(count, -1)
    axis_of = np.zeros(count, dtype=np.int64)
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    for index, box in enumerate(SCENE):
        first = (np.asarray(box.low) - origin) / safe
        second = (np.asarray(box.high) - origin) / safe
        entries = np.minimum(first, second)
        entry = entries.max(axis=1)
        leave = np.maximum(first, second).min(axis=1)
        hit = (entry <= leave) & (entry > 1e-6) & (entry < best)
        best[hit] = entry[hit]
        box_of[hit] = index
        axis_of[hit] = entries[hit].argmax(axis=1)
    return Hits(best, box_of, axis_of)


def _noise(u: Array, v: Array, size: float) -> Array:
    """A value in 0 .. 1 for each cell of a grid of the given size, the same on every run."""
    cell_u = np.floor(u / size).astype(np.int64).astype(np.uint64)
    cell_v = np.floor(v / size).astype(np.int64).astype(np.uint64)
    mixed = cell_u * np.uint64(0x9E3779B97F4A7C15) ^ cell_v * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return ((mixed >> np.uint64(40)) & np.uint64(0xFFFF)).astype(np.float64) / 65535.0


def _mix(mask: Array, inside: tuple[float, ...], outside: tuple[float, ...]) -> Array:
    return mask[:, None] * np.array(inside) + (1.0 - mask[:, None]) * np.array(outside)


def _crate_color(u: Array, v: Array) -> Array:
    """Planks in a frame, and a white label with an arrow; u, v run over the face in metres."""
    planks = np.floor(u / 0.24)
    from_edge = np.minimum(np.minimum(u, CRATE_SIZE - u), np.minimum(v, CRATE_SIZE - v))
    color = _mix((from_edge < 0.15).astype(float), (0.80, 0.58, 0.33), (0.66, 0.44, 0.23))
    color *= (0.92 + 0.16 * _noise(planks, v, 0.05))[:, None]
    color[(np.abs(u % 0.24 - 0.12) > 0.108) & (from_edge > 0.15)] *= 0.55
    color[np.abs(from_edge - 0.15) < 0.013] *= 0.55
    x, y = u - CRATE_SIZE / 2, v - CRATE_SIZE / 2
    label = np.maximum(np.abs(x), np.abs(y)) < 0.27
    head = (y > -0.20) & (y < 0.0) & (np.abs(x) < 0.9 * (y + 0.20))
    shaft = (y >= -0.01) & (y < 0.20) & (np.abs(x) < 0.065)
    color[label] = (0.97, 0.96, 0.93)
    color[label & (head | shaft)] = (0.80, 0.10, 0.12)
    return color


def _brick_color(u: Array, v: Array) -> Array:
    row = np.floor(v / 0.3)
    shifted = u + 0.35 * (row % 2)
    joint = (shifted % 0.7 < 0.05) | (v % 0.3 < 0.05)
    color = _mix(joint.astype(float), (0.78, 0.75, 0.71), (0.60, 0.33, 0.27))
    return color * (0.86 + 0.28 * _noise(np.floor(shifted / 0.7), row, 1.0))[:, None]


def _floor_color(u: Array, v: Array) -> Array:
    checker = (np.floor(u) + np.floor(v)) % 2
    joint = (u % 1 < 0.03) | (v % 1 < 0.03)
    color = _mix(checker, (0.74, 0.74, 0.72), (0.62, 0.64, 0.65))
    color *= (0.95 + 0.1 * _noise(u, v, 0.06))[:, None]
    color[joint] *= 0.72
    return color


def _hedge_color(u: Array, v: Array) -> Array:
    leaf = 0.55 * _noise(u, v, 0.11) + 0.45 * _noise(u + 7, v + 3, 0.27)
    return np.array([0.25, 0.42, 0.17]) * (0.6 + 0.8 * leaf)[:, None]


def _material_color(material: str, u: Array, v: Array) -> Array:
    if material == "crate":
        return _crate_color(u, v)
    if material == "brick":
        return _brick_color(u, v)
    if material == "floor":
        return _floor_color(u, v)
    if material == "hedge":
        return _hedge_color(u, v)
    if material == "post":
        stripe = ((v / 0.5) % 1 < 0.5).astype(float)
        return _mix(stripe, (0.90, 0.86, 0.80), (0.20, 0.36, 0.52))
    pane = ((u * 2.5) % 1 < 0.08) | ((v * 2.5) % 1 < 0.08)
    return _mix(pane.astype(float), (0.85, 0.85, 0.83), (0.55, 0.69, 0.78))


def _shade(direction: Array, hits: Hits) -> Array:
    """Colour of each ray: material x (ambient + sun where nothing is in its way), or sky."""
    upward = np.clip(-direction[:, 1] / np.linalg.norm(direction, axis=1), 0.0, 1.0)[:, None]
    color = np.array([0.80, 0.87, 0.93]) - upward * np.array([0.55, 0.40, 0.16])
    struck = hits.box >= 0
    point = direction[struck] * hits.distance[struck, None]
    axis, index = hits.axis[struck], hits.box[struck]
    normal = np.zeros_like(point)
    rows = np.arange(len(point))
    normal[rows, axis] = -np.sign(direction[struck][rows, axis])
    low = np.array([box.low for box in SCENE])[index]
    plane = np.array([[2, 1], [0, 2], [0, 1]])[axis]
    on_face = (point - low)[rows[:, None], plane]
    base = np.zeros_like(point)
    for number, box in enumerate(SCENE):
        chosen = index == number
        if chosen.any():
            base[chosen] = _material_color(box.material, on_face[chosen, 0], on_face[chosen, 1])
    lit = np.isinf(_cast(point + 1e-4 * normal, np.broadcast_to(SUN, point.shape)).distance)
    light = 0.52 + 0.62 * lit * np.clip(normal @ SUN, 0.0, 1.0)
    color[struck] = base * light[:, None]
    return color


def _holes(direction: Array, hits: Hits, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Where a real sensor returns nothing: sky, glass, the emitter's shadow, stray dropouts."""
    missing = hits.box < 0
    material = np.array([box.material == "glass" for box in SCENE])
    missing |= material[hits.box] & ~missing
    struck = ~np.isinf(hits.distance)
    point = direction[struck] * hits.distance[struck, None]
    seen = _cast(np.broadcast_to(EMITTER, point.shape), point - EMITTER).distance
    missing[struck] |= seen < 1.0 - 1e-6
    missing |= np.random.default_rng(SEED).random(shape).ravel() < DROPOUT
    return missing


def make_frame(height: int = 320, width: int = 640) -> Frame:
    """Ray-cast the yard.

    Args:
        height, width: image size in pixels; the field of view stays the same.

    Returns:
        The frame: colours from 2 x 2 rays a pixel, depth exact at the pixel's centre.

    Example:
        >>> frame = make_frame(80, 160)
        >>> frame.rgb.shape, frame.depth.dtype, frame.focal
        ((80, 160, 3), dtype('float32'), 105.0)
    """
    focal = 0.65625 * width

    def rays(shift_y: float, shift_x: float) -> Array:
        rows, columns = np.mgrid[:height, :width].astype(np.float64)
        y = (rows + shift_y - (0.34 * height - 0.5)) / focal
        x = (columns + shift_x - (width - 1) / 2) / focal
        return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)

    camera = np.zeros(3)
    color = np.zeros((height * width, 3))
    for shift_y in (-0.25, 0.25):
        for shift_x in (-0.25, 0.25):
            direction = rays(shift_y, shift_x)
            color += _shade(direction, _cast(camera, direction)) / 4
    direction = rays(0.0, 0.0)
    hits = _cast(camera, direction)
    # A ray's z component is 1, so the ray parameter of the hit is the depth itself.
    depth = np.where(_holes(direction, hits, (height, width)), 0.0, hits.distance)
    rgb = np.round(np.clip(color, 0.0, 1.0) * 255).astype(np.uint8)
    return Frame(
        rgb.reshape(height, width, 3), depth.reshape(height, width).astype(np.float32), focal
    )


def crate_centers(frame: Frame) -> list[tuple[int, int]]:
    """Pixels (row, column) at the middle of each crate's front face, nearest crate first."""
    height, width = frame.depth.shape
    pixels = []
    for box in CRATES:
        depth = box.low[2]
        x, y = (box.low[0] + box.high[0]) / 2, (box.low[1] + box.high[1]) / 2
        row = frame.focal * y / depth + 0.34 * height - 0.5
        column = frame.focal * x / depth + (width - 1) / 2
        pixels.append((round(row), round(column)))
    return pixels
