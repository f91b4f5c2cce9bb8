"""The pools in plain PyTorch: the readable specification, and the kernel of last resort.

At the level of the registered operators: no argument checking, pairs for pairs. Everything is
built from differentiable operations, so that the backward's own derivative is the double backward.
All of them walk over the taps one at a time and never unfold the image.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from . import geometry
from .geometry import Pair
from .sampling import Corner, Guide, Tap, centres, pixels, seen, taps

#: Kernels of up to this many taps have their winners counted in 8 bits; one number means none.
MOST_SHORT_TAPS = 255


class Place(NamedTuple):
    """Where a pool looks: everything but its input and what it makes of it."""

    scale: Tensor  # (N, 1 | 2, Ho, Wo)
    guide: Tensor | None  # (N, H, W)
    guide_tolerance: float
    kernel: Pair
    stride: Pair
    padding: Pair
    dilation: Pair


def winner_dtype(taps: int) -> torch.dtype:
    """What the numbers of a kernel's winning taps are stored in."""
    return torch.uint8 if taps <= MOST_SHORT_TAPS else torch.int32


def _compute_dtype(input: Tensor) -> torch.dtype:
    return torch.float64 if input.dtype == torch.float64 else torch.float32


class _Share(NamedTuple):
    """What one corner adds to its tap's sample; every tensor has shape (N, Ho*Wo)."""

    corner: Corner
    weight: Tensor  # 0 where the corner is not seen
    slope_y: Tensor  # derivative of the weight with respect to scale_y
    slope_x: Tensor


class _Sampler:
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

    def share(self, tap: Tap, corner: Corner, seen: Tensor) -> _Share:
        """A corner's weight and slopes, 0 where it is not seen."""
        weight = torch.where(seen, corner.weight_y * corner.weight_x, 0.0)
        slope_y = tap.offset_y * corner.slope_y * corner.weight_x
        slope_x = tap.offset_x * corner.slope_x * corner.weight_y
        nothing = torch.zeros_like(weight)
        return _Share(
            corner._replace(visible=seen),
            weight,
            torch.where(seen, slope_y, nothing),
            torch.where(seen, slope_x, nothing),
        )


def _in_steps(corner: Corner) -> Corner:
    """Weights in steps of what 1 - weight can tell, so that a quotient of weights keeps its
    precision where the guide leaves nothing but a corner that is all but at its end."""
    return corner._replace(weight_y=1 - (1 - corner.weight_y), weight_x=1 - (1 - corner.weight_x))


class _MaxSampler(_Sampler):
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

    def shares(self, tap: Tap) -> tuple[list[_Share], Tensor]:
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
            evened.append(_Share(share.corner, weight, slopes[0] / total, slopes[1] / total))
        return evened, present

    def value(self, shares: list[_Share]) -> Tensor:
        """(N, C, Ho*Wo) samples."""
        total = self.image.new_zeros(())
        for share in shares:
            total = total + share.weight[:, None] * pixels(self.image, share.corner)
        return total


def _weighs(corner: Corner) -> Tensor:
    return (corner.weight_y * corner.weight_x).detach() != 0


def max_forward(
    input: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    kernel: Pair,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
) -> tuple[Tensor, Tensor]:
    """``torch.ops.surfconv.surf_max_pool2d``: the maximum, and the number of the tap it is from.

    The winners are (N, Ho, Wo, C), and the number of taps where a window has none.
    """
    place = Place(scale, guide, guide_tolerance, kernel, stride, padding, dilation)
    sampler = _MaxSampler(input, place)
    none = kernel[0] * kernel[1]
    batch, channels = input.shape[:2]
    shape = (batch, channels, scale.shape[2] * scale.shape[3])
    best = torch.zeros_like(sampler.image[:, :, :1]).expand(shape)
    winner = torch.full(shape, none, dtype=torch.int32, device=input.device)
    for number, tap in enumerate(sampler.taps()):
        shares, present = sampler.shares(tap)
        value = sampler.value(shares)
        wins = present[:, None] & ((winner == none) | (value > best) | value.isnan())
        best = torch.where(wins, value, best)
        winner = torch.where(wins, number, winner)
    output = best.reshape(batch, channels, *scale.shape[2:]).to(input.dtype)
    winner = winner.reshape(output.shape).permute(0, 2, 3, 1).contiguous()
    return output, winner.to(winner_dtype(none))


def max_backward(
    grad_output: Tensor,
    input: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    winner: Tensor,
    guide_tolerance: float,
    kernel: Pair,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
    need_input: bool,
    need_scale: bool,
) -> tuple[Tensor, Tensor]:
    """``torch.ops.surfconv.surf_max_pool2d_backward``: gradients of input and scale."""
    place = Place(scale, guide, guide_tolerance, kernel, stride, padding, dilation)
    sampler = _MaxSampler(input, place)
    outer = grad_output.to(sampler.dtype).flatten(2)
    winners = winner.permute(0, 3, 1, 2).flatten(2)
    sums = _Gradients(sampler.image, need_input, need_scale)
    for number, tap in enumerate(sampler.taps()):
        chosen = winners == number
        pulled = torch.where(chosen, outer, 0.0)
        for share in sampler.shares(tap)[0]:
            # A pixel that is not finite concerns no channel but those that it has won.
            sums.add(share, pulled, torch.where(chosen, pixels(sampler.image, share.corner), 0.0))
    return sums.result(input, scale)


def avg_forward(
    input: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    kernel: Pair,
    stride: Pair,
    padding: Pair,
    count_include_pad: bool,
    divisor_override: int,
) -> Tensor:
    """``torch.ops.surfconv.surf_avg_pool2d``; a ``divisor_override`` of 0 means none."""
    place = Place(scale, guide, guide_tolerance, kernel, stride, padding, (1, 1))
    sampler = _Sampler(input, place, clamped=False)
    divisor = None
    if divisor_override or count_include_pad:
        divisor = _fixed_divisor(input, sampler.dtype, place, divisor_override)
    total, weight = _window_sums(sampler)
    mean = _divide(total, weight if divisor is None else divisor)
    return mean.reshape(*input.shape[:2], *scale.shape[2:]).to(input.dtype)


def avg_backward(
    grad_output: Tensor,
    input: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    kernel: Pair,
    stride: Pair,
    padding: Pair,
    count_include_pad: bool,
    divisor_override: int,
    need_input: bool,
    need_scale: bool,
) -> tuple[Tensor, Tensor]:
    """``torch.ops.surfconv.surf_avg_pool2d_backward``: gradients of input and scale."""
    place = Place(scale, guide, guide_tolerance, kernel, stride, padding, (1, 1))
    sampler = _Sampler(input, place, clamped=False)
    outer = grad_output.to(sampler.dtype).flatten(2)
    if divisor_override or count_include_pad:
        mean = outer.new_zeros(())
        divisor = _fixed_divisor(input, sampler.dtype, place, divisor_override)
    else:
        total, divisor = _window_sums(sampler)
        mean = _divide(total, divisor)
    outer = _divide(outer, divisor)
    sums = _Gradients(sampler.image, need_input, need_scale)
    for tap in sampler.taps():
        for corner in tap.corners:
            share = sampler.share(tap, corner, sampler.seen(corner))
            # Where a corner's weight is a part of the divisor, the mean comes off its value.
            value = torch.where(share.corner.visible[:, None], pixels(sampler.image, corner), mean)
            sums.add(share, outer, value - mean)
    return sums.result(input, scale)


def _fixed_divisor(input: Tensor, dtype: torch.dtype, place: Place, override: int) -> Tensor:
    """(1, Ho*Wo) divisors that do not depend on the scale."""
    counts = [
        geometry.pool_window_sizes(
            input.shape[i + 2],
            place.scale.shape[i + 2],
            place.kernel[i],
            place.stride[i],
            place.padding[i],
            input.device,
        )
        for i in (0, 1)
    ]
    areas = (counts[0][:, None] * counts[1]).reshape(1, -1).to(dtype)
    return torch.full_like(areas, override) if override else areas


def _window_sums(sampler: _Sampler) -> tuple[Tensor, Tensor]:
    """(N, C, Ho*Wo) sums of what the taps see, and (N, Ho*Wo) sums of the weights."""
    total = sampler.image.new_zeros(())
    weight = sampler.image.new_zeros(())
    for tap in sampler.taps():
        for corner in tap.corners:
            share = sampler.share(tap, corner, sampler.seen(corner))
            total = total + share.weight[:, None] * pixels(sampler.image, share.corner)
            weight = weight + share.weight
    return total, weight


def _divide(total: Tensor, divisor: Tensor) -> Tensor:
    """(N, C, P) by (N | 1, P), 0 where the divisor is."""
    # Replaced before it is used: masking the result would leave 0 * inf in the gradient.
    safe = torch.where(divisor != 0, divisor, 1.0)[:, None]
    return torch.where((divisor != 0)[:, None], total / safe, 0.0)


class _Gradients:
    """Sums over corners of what flows to the input and to the scale."""

    def __init__(self, image: Tensor, need_input: bool, need_scale: bool) -> None:
        self._image = image
        self._need_input, self._need_scale = need_input, need_scale
        self._grad_image = torch.zeros_like(image)
        self._grad_y = self._grad_x = image.new_zeros(())

    def add(self, share: _Share, pulled: Tensor, value: Tensor) -> None:
        """One corner: ``pulled`` is the gradient of its sample, ``value`` what its weight times;
        both are (N, C, Ho*Wo)."""
        if self._need_input:
            index = share.corner.place[:, None].expand_as(pulled)
            flow = share.weight[:, None] * seen(pulled, share.corner)
            self._grad_image = self._grad_image.scatter_add(2, index, flow)
        if self._need_scale:
            along = (value * pulled).sum(1)
            self._grad_y = self._grad_y + share.slope_y * along
            self._grad_x = self._grad_x + share.slope_x * along

    def result(self, input: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """The gradients in their tensors' dtypes; what is not needed has shape (0,)."""
        grad_input = grad_scale = input.new_empty(0)
        if self._need_input:
            grad_input = self._grad_image.reshape(input.shape).to(input.dtype)
        if self._need_scale:
            both = torch.stack((self._grad_y, self._grad_x), 1)
            if scale.shape[1] == 1:
                both = both.sum(1, keepdim=True)
            grad_scale = both.reshape(scale.shape).to(scale.dtype)
        return grad_input, grad_scale
