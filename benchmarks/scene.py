"""Flat, textured surfaces seen by a pinhole camera: views whose depth and correspondence are exact.

A texture is a sum of plane waves in metres of surface, so the same point has the same colour from
any distance. A pixel holds the mean of the texture over its own footprint, as a sensor does: the
mean of a wave over a parallelogram has a closed form, and only pixels that an edge crosses need
more rays than one. Camera axes: x right, y down, z forward, metres; depth is z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

COLOURS = 3
#: Rays a side in pixels that an edge crosses.
EDGE_RAYS = 4
#: Points whose waves are summed at a time.
CHUNK = 8192
#: Moves the texture from one facet to the next, so that none repeats another's pattern.
SHIFT = (7.31, 4.57)

Vector = tuple[float, float, float]


class Texture(Protocol):
    """Means of a texture over parallelograms."""

    def __call__(self, place: Tensor, sides: Tensor) -> Tensor:
        """Colours (3, M) around places (M, 2) with sides (M, 2, 2), all in metres of surface."""
        ...


@dataclass(frozen=True)
class Waves:
    """A sum of plane waves.

    Attributes:
        waves: (K, 2) radians a metre.
        cosine: (3, K) amplitudes.
        sine: (3, K) amplitudes.
    """

    waves: Tensor
    cosine: Tensor
    sine: Tensor

    def __call__(self, place: Tensor, sides: Tensor) -> Tensor:
        parts = []
        for at, side in zip(place.split(CHUNK), sides.split(CHUNK), strict=True):
            # All pixels of a wall that faces the camera have the same footprint.
            side = side[:1] if bool((side == side[:1]).all()) else side
            # A wave's mean over a side of phase p is sin(p / 2) / (p / 2); torch.sinc holds a pi.
            kept = torch.sinc(side @ self.waves.T / (2 * math.pi)).prod(1)
            phase = at @ self.waves.T
            parts.append(self.cosine @ (kept * phase.cos()).T + self.sine @ (kept * phase.sin()).T)
        return torch.cat(parts, 1)


def make_waves(wavelengths: Sequence[float], seed: int, each: int = 12) -> Waves:
    """Waves of random direction and phase, `each` per wavelength, with unit variance a colour.

    Args:
        wavelengths: metres; every one has the same share of the variance, as the octaves of natural
            images do. Single waves are up to a fifth of an octave off.
        seed: of directions and phases.
        each: waves per wavelength.

    Returns:
        The texture.
    """
    random = torch.Generator().manual_seed(seed)
    count = each * len(wavelengths)
    # Directions are spread evenly, so that no texture is a grating by chance.
    turn = (torch.arange(each) + torch.rand(len(wavelengths), each, generator=random)) / each
    angle = (math.pi * turn).flatten().double()
    octaves = 0.4 * (torch.rand(count, generator=random).double() - 0.5)
    length = torch.tensor(wavelengths, dtype=torch.float64).repeat_interleave(each) * 2**octaves
    waves = (2 * math.pi / length)[:, None] * torch.stack((angle.cos(), angle.sin()), 1)
    amplitudes = torch.randn(2, COLOURS, count, generator=random).double()
    amplitudes *= (2 / amplitudes.square().sum((0, 2), keepdim=True)).sqrt()
    return Waves(waves, amplitudes[0], amplitudes[1])


class Facet(NamedTuple):
    """A rectangle: its middle, two unit vectors at right angles in it, and half its sides."""

    middle: Vector
    u: Vector
    v: Vector
    half: tuple[float, float] = (math.inf, math.inf)


def wall(distance: float) -> list[Facet]:
    """An endless wall that faces the camera."""
    return [Facet((0, 0, distance), (1, 0, 0), (0, 1, 0))]


def slant(distance: float, slope: float) -> list[Facet]:
    """An endless wall whose depth grows by `slope` metres a metre to the right."""
    length = math.hypot(1, slope)
    return [Facet((0, 0, distance), (1 / length, 0, slope / length), (0, 1, 0))]


def box(low: Vector, high: Vector) -> list[Facet]:
    """Front and sides of a box between two corners."""
    x, y, z = ((a + b) / 2 for a, b in zip(low, high, strict=True))
    wide, tall, deep = ((b - a) / 2 for a, b in zip(low, high, strict=True))
    right, down, forward = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    return [
        Facet((x, y, low[2]), right, down, (wide, tall)),
        *(Facet((side, y, z), forward, down, (deep, tall)) for side in (low[0], high[0])),
        *(Facet((x, side, z), right, forward, (wide, deep)) for side in (low[1], high[1])),
    ]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks along z.

    Attributes:
        size: rows and columns; the axis goes through the centre of pixel (size // 2, size // 2).
        focal: focal length in pixels.
        back: metres that the camera has moved back from the origin.
    """

    size: int
    focal: float
    back: float = 0.0

    def grid(self) -> Tensor:
        """Centres of all pixels, (size * size, 2) as (x, y)."""
        pixels = torch.arange(self.size, dtype=torch.float64)
        y, x = torch.meshgrid(pixels, pixels, indexing="ij")
        return torch.stack((x, y), -1).reshape(-1, 2)

    def rays(self, pixels: Tensor) -> Tensor:
        """Directions (M, 3) of positions (M, 2), with z = 1."""
        slopes = (pixels - self.size // 2) / self.focal
        return torch.cat((slopes, torch.ones_like(slopes[:, :1])), 1)

    def project(self, points: Tensor) -> Tensor:
        """Positions (M, 2) in pixels of points (M, 3) in space."""
        depth = points[:, 2:] + self.back
        return self.focal * points[:, :2] / depth + self.size // 2


class Hits(NamedTuple):
    """Where rays meet facets: depth, facet, place on it, and the place's change with x and y."""

    depth: Tensor
    facet: Tensor
    place: Tensor
    sides: Tensor


@dataclass(frozen=True)
class View:
    """What a camera sees.

    Attributes:
        camera: the camera.
        image: (3, size, size) float32.
        depth: (size, size) metres, at the centre of each pixel.
        facet: (size, size) number of the facet seen there.
        facets: the scene.
    """

    camera: Camera
    image: Tensor
    depth: Tensor
    facet: Tensor
    facets: Sequence[Facet]

    def points(self) -> Tensor:
        """Points in space (size * size, 3) at the centres of all pixels."""
        at = self.camera.rays(self.camera.grid()) * self.depth.double().reshape(-1, 1)
        return at - torch.tensor((0.0, 0.0, self.camera.back), dtype=torch.float64)


def cast(facets: Sequence[Facet], camera: Camera, pixels: Tensor) -> Hits:
    """The nearest facet behind every position in the image.

    Args:
        facets: the scene.
        camera: the camera.
        pixels: (M, 2) positions (x, y).

    Returns:
        The hits; `sides[:, 0]` is the change of place for one pixel in x, `sides[:, 1]` in y.

    Raises:
        ValueError: a ray meets nothing.
    """
    rays = camera.rays(pixels)
    depth = torch.full((len(rays),), math.inf, dtype=torch.float64)
    facet = torch.full((len(rays),), -1)
    place = torch.zeros(len(rays), 2, dtype=torch.float64)
    sides = torch.zeros(len(rays), 2, 2, dtype=torch.float64)
    for number, face in enumerate(facets):
        frame = torch.tensor((face.u, face.v), dtype=torch.float64)
        middle = torch.tensor(face.middle, dtype=torch.float64)
        middle[2] += camera.back
        normal = torch.linalg.cross(frame[0], frame[1])
        towards = rays @ normal
        reach = torch.where(towards != 0, normal @ middle / towards, math.inf)
        at = (reach[:, None] * rays - middle) @ frame.T
        inside = (at.abs() <= torch.tensor(face.half, dtype=torch.float64)).all(1)
        nearer = inside & (reach > 0) & (reach < depth)
        # d(z r)/dx with z = n.m / n.r, in the facet's own axes.
        step = torch.eye(3, dtype=torch.float64)[:2] / camera.focal
        moved = step - rays[:, None, :] * (step @ normal)[None, :, None] / towards[:, None, None]
        change = reach[:, None, None] * moved @ frame.T
        shift = number * torch.tensor(SHIFT, dtype=torch.float64)
        depth = torch.where(nearer, reach, depth)
        facet = torch.where(nearer, number, facet)
        place = torch.where(nearer[:, None], at + shift, place)
        sides = torch.where(nearer[:, None, None], change, sides)
    if bool((facet < 0).any()):
        raise ValueError(f"facets: {int((facet < 0).sum())} rays meet none of them")
    return Hits(depth, facet, place, sides)


def uniform(facet: Tensor, radius: int) -> Tensor:
    """Where all pixels within `radius` rows and columns show the same facet."""
    numbers = facet[None].double()
    window = {"kernel_size": 2 * radius + 1, "stride": 1, "padding": radius}
    return (max_pool2d(numbers, **window) == -max_pool2d(-numbers, **window))[0]


def render(
    facets: Sequence[Facet], texture: Texture, camera: Camera, footprint: float = 1.0
) -> View:
    """The view of a scene.

    Args:
        facets: what is looked at.
        texture: its colours.
        camera: who looks.
        footprint: side of what a pixel averages, in pixels.

    Returns:
        The view.
    """
    pixels = camera.grid()
    hits = cast(facets, camera, pixels)
    colours = texture(hits.place, footprint * hits.sides)
    facet = hits.facet.reshape(camera.size, camera.size)
    edge = (~uniform(facet, 1)).flatten()
    if bool(edge.any()):
        colours[:, edge] = _of_many_rays(facets, texture, camera, pixels[edge], footprint)
    shape = (camera.size, camera.size)
    image = colours.reshape(COLOURS, *shape).float()
    return View(camera, image, hits.depth.reshape(shape).float(), facet, facets)


def _of_many_rays(
    facets: Sequence[Facet], texture: Texture, camera: Camera, pixels: Tensor, footprint: float
) -> Tensor:
    """Colours of pixels cut into EDGE_RAYS x EDGE_RAYS parts, each the mean over its footprint."""
    parts = (torch.arange(EDGE_RAYS, dtype=torch.float64) + 0.5) / EDGE_RAYS - 0.5
    shifts = torch.cartesian_prod(parts, parts)
    hits = cast(facets, camera, (pixels[:, None] + footprint * shifts).reshape(-1, 2))
    colours = texture(hits.place, footprint * hits.sides / EDGE_RAYS)
    return colours.reshape(COLOURS, len(pixels), -1).mean(2)
