"""Features of untrained layers at the same surface points of several views, and how they differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from scene import COLOURS, View, cast, uniform
from surfconv_ops import DepthLevels, SurfConv2d

#: Filters of a layer.
FILTERS = 16
#: Levels of equal width in log depth, together this many times as far at their end as at their
#: start: four of them are about as wide as the paper's on KITTI.
LEVEL_SPAN = 8.0
#: The scale of a level is off by at most about this factor.
WIDEST = LEVEL_SPAN ** (1 / 4)


@dataclass(frozen=True)
class Net:
    """Convolutions with a ReLU between each two, untrained.

    Attributes:
        name: in the report.
        kernel: size of every filter.
        stride: of a single layer.
        layers: how many; several have stride 1.
        zero_sum: every filter's weights add up to zero in each channel, as an edge filter's do.
    """

    name: str
    kernel: int = 3
    stride: int = 1
    layers: int = 1
    zero_sum: bool = False

    @property
    def reach(self) -> int:
        """Pixels of the input, at scale 1, from an output's centre to the end of what it sees."""
        return self.layers * (self.kernel // 2)

    def convolutions(self, seed: int) -> list[nn.Conv2d]:
        """The layers as nn.Conv2d initialises them."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            convs = [
                nn.Conv2d(
                    FILTERS if number else COLOURS,
                    FILTERS,
                    self.kernel,
                    stride=self.stride,
                    padding=self.kernel // 2,
                )
                for number in range(self.layers)
            ]
        if self.zero_sum:
            for conv in convs:
                conv.weight.data -= conv.weight.data.mean((2, 3), keepdim=True)
        return convs


def convert(convs: Sequence[nn.Conv2d], **options: Any) -> list[SurfConv2d]:
    """The same layers, with the same weights, as SurfConv2d."""
    return [SurfConv2d.from_conv2d(conv, **options) for conv in convs]


def equal_log_levels(count: int, middle: float, shift: float) -> DepthLevels:
    """Levels of equal width in log depth.

    Args:
        count: number of levels.
        middle: their geometric middle in metres.
        shift: moves them by this share of a level's width.

    Returns:
        Levels over a factor of `LEVEL_SPAN`; each stands at its geometric middle.
    """
    width = math.log(LEVEL_SPAN) / count
    places = [shift - count / 2 + number for number in range(count)]
    edges = [middle * math.exp(width * place) for place in places[1:]]
    return DepthLevels(edges, [middle * math.exp(width * (place + 0.5)) for place in places])


def features(convs: Sequence[nn.Conv2d], view: View) -> Tensor:
    """(FILTERS, H, W) responses to a view."""
    depth = view.depth[None]
    values = view.image[None]
    with torch.no_grad():
        for number, conv in enumerate(convs):
            values = values.relu() if number else values
            values = conv(values, depth) if isinstance(conv, SurfConv2d) else conv(values)
    return values[0]


def read(values: Tensor, positions: Tensor) -> Tensor:
    """(C, M) bilinear readings of a map (C, H, W) at positions (M, 2) as (x, y)."""
    size = torch.tensor((values.shape[2] - 1, values.shape[1] - 1), dtype=torch.float64)
    grid = (2 * positions / size - 1)[None, None]
    return grid_sample(values.double()[None], grid, align_corners=True)[0, :, 0]


class Matches(NamedTuple):
    """Surface points: where each view sees them, and which see one facet only in every view."""

    positions: list[Tensor]
    inside: Tensor


def match(views: Sequence[View], reach: int, stride: int, reference_depth: float) -> Matches:
    """Surface points that every view sees, the farthest view's pixel centres.

    Args:
        views: the same scene, the farthest view last.
        reach: `Net.reach`.
        stride: `Net.stride`; points lie on every stride-th pixel of the last view.
        reference_depth: metres at which SurfConv2d is nn.Conv2d.

    Returns:
        Points at which no layer, plain or not, reads across the border of a view.
    """
    far = views[-1]
    size = far.camera.size
    kept = torch.arange(size * size).reshape(size, size)[::stride, ::stride].flatten()
    points, facets = far.points()[kept], far.facet.flatten()[kept]
    seen = torch.ones(len(points), dtype=torch.bool)
    inside = seen.clone()
    positions = []
    for view in views:
        at = view.camera.project(points)
        depth = points[:, 2] + view.camera.back
        spacing = (WIDEST * reference_depth / depth).clamp_min(1.0)
        border = (spacing * reach + 1)[:, None]
        seen &= ((at >= border) & (at <= size - 1 - border)).all(1)
        nearest = at.round().long().clamp(0, size - 1)
        place = nearest[:, 1] * size + nearest[:, 0]
        seen[seen.clone()] = cast(view.facets, view.camera, at[seen]).facet == facets[seen]
        widest = math.ceil(WIDEST * reference_depth * reach / float(view.depth.min()))
        inside &= uniform(view.facet, max(reach, widest) + 1).flatten()[place]
        positions.append(at)
    return Matches([at[seen] for at in positions], inside[seen])


def changes(near: Tensor, far: Tensor) -> Tensor:
    """How far features (C, M) moved at each point, in times of their spread over the points.

    |far(p) - near(p)| / sqrt(mean over q of |near(q) - mean|^2), with the Euclidean norm over the
    channels: 0 for the same features, about sqrt(2) for features of the same spread that have
    nothing to do with each other.
    """
    spread = (near - near.mean(1, keepdim=True)).square().sum(0).mean().sqrt()
    return (far - near).square().sum(0).sqrt() / spread


def correlation(near: Tensor, far: Tensor) -> float:
    """Pearson's correlation over points and channels, each channel's own mean taken off."""
    a = near - near.mean(1, keepdim=True)
    b = far - far.mean(1, keepdim=True)
    return float((a * b).sum() / (a.square().sum() * b.square().sum()).sqrt())
