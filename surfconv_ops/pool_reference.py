"""The pools in plain PyTorch: the readable specification, and the kernel of last resort.

At the level of the registered operators: no argument checking, pairs for pairs. Everything is
built from differentiable operations, so that the backward's own derivative is the double backward.
All of them walk over the taps one at a time and never unfold the image.
"""

from __future__ import annotations

import torch
from torch import Tensor

from . import geometry
from .geometry import Pair
from .pool_sampling import Place, Sampler, Share
from .sampling import pixels, seen

#: Kernels of up to this many taps have their winners counted in 8 bits; one number means none.
MOST_SHORT_TAPS = 255


def winner_dtype(taps: int) -> torch.dtype:
    """What the numbers of a kernel's winning taps are stored in."""
    return torch.uint8 if taps <= MOST_SHORT_TAPS else torch.int32


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
    sampler = Sampler(input, place, clamped=True)
    none = kernel[0] * kernel[1]
    batch, channels = input.shape[:2]
    shape = (batch, channels, scale.shape[2] * scale.shape[3])
    best = torch.zeros_like(sampler.image[:, :, :1]).expand(shape)
    winner = torch.full(shape, none, dtype=torch.int32, device=input.device)
    for number, tap in enumerate(sampler.taps()):
        shares = sampler.shares(tap)
        # A tap that sees nothing is one of zeros; there is none where its scale is not finite.
        present = torch.stack([share.weight != 0 for share in shares]).any(0)
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
    sampler = Sampler(input, place, clamped=True)
    outer = grad_output.to(sampler.dtype).flatten(2)
    winners = winner.permute(0, 3, 1, 2).flatten(2)
    sums = _Gradients(sampler.image, need_input, need_scale)
    for number, tap in enumerate(sampler.taps()):
        chosen = winners == number
        pulled = torch.where(chosen, outer, 0.0)
        for share in sampler.shares(tap):
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
    sampler = Sampler(input, place, clamped=False)
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
    sampler = Sampler(input, place, clamped=False)
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
        for share, corner in zip(sampler.shares(tap), tap.corners, strict=True):
            # Where a corner's weight is a part of the divisor, the mean comes off its value.
            value = pixels(sampler.image, share.corner) - mean
            sums.add(share, outer, torch.where(corner.visible[:, None], value, 0.0))
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


def _window_sums(sampler: Sampler) -> tuple[Tensor, Tensor]:
    """(N, C, Ho*Wo) sums of what the taps see, and (N, Ho*Wo) of the weights in the image."""
    total = sampler.image.new_zeros(())
    weight = sampler.image.new_zeros(())
    for tap in sampler.taps():
        shares = sampler.shares(tap)
        total = total + sampler.value(shares)
        for share in shares:
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

    def add(self, share: Share, pulled: Tensor, value: Tensor) -> None:
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
