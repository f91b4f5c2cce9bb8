"""What the pools' taps see, and with which weights: the sampling side of their reference."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from .geometry import Pair
from .sampling import Corner, Guide, Tap, centres, pixels, taps


class Place(NamedTuple):
    """Where a pool looks: everything but its input and what it makes of it."""

    scale: Tensor  # (N, 1 | 2, Ho, Wo)
    guide: Tensor | None  # (N, H, W)
    guide_tolerance: float
    kernel: Pair
    stride: Pair
    padding: Pair
    dilation: Pair


def _compute_dtype(input: Tensor) -> torch.dtype:
    return torch.float64 if input.dtype == torch.float64 else torch.float32


class Share(NamedTuple):
    """What one corner weighs in its tap's sample; every tensor has shape (N, Ho*Wo)."""

    corner: Corner  # visible where the guide shows it
    weight: Tensor  # 0 outside the image
    slope_y: Tensor  # derivative of the weight with respect to scale_y
    slope_x: Tensor


class Sampler:
    """Samples of one call's taps, in the compute dtype."""

    def __init__(self, input: Tensor, place: Place, clamped: bool) -> None:
        self.dtype = _compute_dtype(input)
        self.image = input.to(self.dtype).flatten(2)
        self._size = (input.shape[2], input.shape[3])
        self._place = place._replace(scale=place.scale.to(self.dtype), guide=None)
        self._clamped = clamped
        self._guide = None
        if place.guide is not None:
            rows, columns = centres(place.scale, *place[3:])
            values = place.guide.detach().to(self.dtype)
            self._guide = Guide(values, place.guide_tolerance, rows, columns)

    def taps(self) -> Iterator[Tap]:
        """All taps in row order; visible are the corners that lie in the image."""
        place = self._place
        for tap in taps(self._size, place.kernel, place.scale, None, 0.0, place.stride,
                        place.padding, place.dilation, self._clamped):  # fmt: skip
            yield tap._replace(corners=[_in_steps(corner) for corner in tap.corners])

    def _seen(self, corner: Corner) -> Tensor:
        """Where a corner lies in the image and the guide shows it, whatever its weight."""
        if self._guide is None:
            return corner.visible
        return corner.visible & self._guide.visible(corner.place)

    def share(self, tap: Tap, corner: Corner) -> Share:
        """What a corner weighs in its tap, seen or hidden."""
        inside = corner.visible
        weight = torch.where(inside, corner.weight_y * corner.weight_x, 0.0)
        slope_y = tap.offset_y * corner.slope_y * corner.weight_x
        slope_x = tap.offset_x * corner.slope_x * corner.weight_y
        nothing = torch.zeros_like(weight)
        return Share(
            corner._replace(visible=self._seen(corner)),
            weight,
            torch.where(inside, slope_y, nothing),
            torch.where(inside, slope_x, nothing),
        )

    def shares(self, tap: Tap) -> list[Share]:
        """Those of all of a tap's corners."""
        return [self.share(tap, corner) for corner in tap.corners]

    def value(self, shares: list[Share]) -> Tensor:
        """(N, C, Ho*Wo) samples of a tap: a hidden corner counts as zero."""
        total = self.image.new_zeros(())
        for share in shares:
            total = total + share.weight[:, None] * pixels(self.image, share.corner)
        return total


def _in_steps(corner: Corner) -> Corner:
    """Weights in steps of what 1 - weight can tell, so that a quotient of weights keeps its
    precision where the image ends beside a corner that is all but at its end."""
    return corner._replace(weight_y=1 - (1 - corner.weight_y), weight_x=1 - (1 - corner.weight_x))
