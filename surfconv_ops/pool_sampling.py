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
    """What one corner adds to its tap's sample; every tensor has shape (N, Ho*Wo)."""

    corner: Corner
    weight: Tensor  # 0 where the corner is not seen
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

    def seen(self, corner: Corner) -> Tensor:
        """Corners in the image that the guide shows, whatever their weight."""
        if self._guide is None:
            return corner.visible
        return corner.visible & self._guide.visible(corner.place)

    def share(self, tap: Tap, corner: Corner, seen: Tensor) -> Share:
        """A corner's weight and slopes, 0 where it is not seen."""
        weight = torch.where(seen, corner.weight_y * corner.weight_x, 0.0)
        slope_y = tap.offset_y * corner.slope_y * corner.weight_x
        slope_x = tap.offset_x * corner.slope_x * corner.weight_y
        nothing = torch.zeros_like(weight)
        return Share(
            corner._replace(visible=seen),
            weight,
            torch.where(seen, slope_y, nothing),
            torch.where(seen, slope_x, nothing),
        )


def _in_steps(corner: Corner) -> Corner:
    """Weights in steps of what 1 - weight can tell, so that a quotient of weights keeps its
    precision where the guide leaves nothing but a corner that is all but at its end."""
    return corner._replace(weight_y=1 - (1 - corner.weight_y), weight_x=1 - (1 - corner.weight_x))


class MaxSampler(Sampler):
    """Samples that are interpolated over what the guide shows of their corners."""

    def __init__(self, input: Tensor, place: Place) -> None:
        super().__init__(input, place, clamped=True)
        if self._guide is None:
            return
        # Where the guide would hide every tap it does not apply.
        sees = torch.zeros((), dtype=torch.bool, device=input.device)
        for tap in self.taps():
            for corner in tap.corners:
                sees = sees | (super().seen(corner) & _weighs(corner))
        self._blind = ~sees

    def seen(self, corner: Corner) -> Tensor:
        if self._guide is None:
            return corner.visible
        return corner.visible & (self._guide.visible(corner.place) | self._blind)

    def shares(self, tap: Tap) -> tuple[list[Share], Tensor]:
        """The tap's corners, their weights adding up to 1, and whether any of them is seen."""
        shares = [self.share(tap, corner, self.seen(corner)) for corner in tap.corners]
        present = torch.stack([share.weight.detach() != 0 for share in shares]).any(0)
        if self._guide is None:
            return shares, present
        hidden = torch.stack(
            [
                corner.visible & _weighs(corner) & ~share.corner.visible
                for corner, share in zip(tap.corners, shares, strict=True)
            ]
        ).any(0)
        uneven = hidden & present
        total = torch.where(uneven, torch.stack([s.weight for s in shares]).sum(0), 1.0)
        drift_y = torch.where(uneven, torch.stack([s.slope_y for s in shares]).sum(0), 0.0)
        drift_x = torch.where(uneven, torch.stack([s.slope_x for s in shares]).sum(0), 0.0)
        evened = []
        for share in shares:
            weight = share.weight / total
            slopes = (share.slope_y - weight * drift_y, share.slope_x - weight * drift_x)
            evened.append(Share(share.corner, weight, slopes[0] / total, slopes[1] / total))
        return evened, present

    def value(self, shares: list[Share]) -> Tensor:
        """(N, C, Ho*Wo) samples."""
        total = self.image.new_zeros(())
        for share in shares:
            total = total + share.weight[:, None] * pixels(self.image, share.corner)
        return total


def _weighs(corner: Corner) -> Tensor:
    return (corner.weight_y * corner.weight_x).detach() != 0
