"""The backward's launches: in passes over images, so that its sums take little memory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import triton
from torch import Tensor

from .accumulate import Sums
from .backward_data import backward_data_kernel
from .backward_weight import backward_weight_kernel
from .conv import Conv, tensor_float32
from .tiles import Tiles, data_tiles, fastest, weight_tiles

#: Programs that sum the gradient of the weight. Not the device's own number: where torch asks for
#: deterministic algorithms, what is added to what is to depend on the shapes alone.
_WEIGHT_PROGRAMS = 1024
#: Sums that are wider than the gradient they become may take this share of input and output, or
#: what is so little that more launches cost more than it, or one image's.
_SUM_SHARE, _LEAST_SUM_BYTES = 1 / 32, 2 * 2**20


@dataclass(frozen=True)
class Operands:
    """What both gradients are made of: grad_output and input with their channels innermost."""

    outer: Tensor  # (N, Ho, Wo, O)
    image: Tensor  # (N, H, W, C)
    scale: Tensor  # (N, 1 | 2, Ho, Wo)
    guide: Tensor | None  # (N, H, W)
    tolerance: Tensor | None

    def of_images(self, part: slice) -> Operands:
        """The same of some of the images, without a copy."""
        guide = None if self.guide is None else self.guide[part]
        return Operands(self.outer[part], self.image[part], self.scale[part], guide, self.tolerance)


def gradients_of_data(
    conv: Conv, operands: Operands, weight: Tensor, need_input: bool, need_scale: bool
) -> tuple[Tensor, Tensor]:
    """Gradients of input, (N, H, W, C), and of scale; where one is not needed, anything."""
    image, scale = operands.image, operands.scale
    if not conv.pixels:
        return torch.zeros_like(image), torch.zeros_like(scale)
    factors = weight.permute(2, 3, 0, 1).contiguous()
    images = _images_of_a_pass(conv) if need_input else conv.batch
    if images == conv.batch:
        sums, scale_sums = _pass(conv, operands, factors, need_input, need_scale)
        return image if sums is None else sums.result(conv.dtype), scale_sums
    grad_image = torch.empty_like(image)
    grad_scale = torch.empty_like(scale, dtype=conv.compute_dtype)
    for first in range(0, conv.batch, images):
        part = slice(first, min(first + images, conv.batch))
        some = replace(conv, batch=part.stop - first)
        sums, scale_sums = _pass(some, operands.of_images(part), factors, need_input, need_scale)
        assert sums is not None
        sums.write(grad_image[part])
        if need_scale:
            grad_scale[part] = scale_sums
        # Else they would outlive the making of the next ones.
        del sums, scale_sums
    return grad_image, grad_scale


def _images_of_a_pass(conv: Conv) -> int:
    deterministic = torch.are_deterministic_algorithms_enabled()
    if conv.dtype == conv.compute_dtype and not deterministic:
        # The sums are the gradient itself.
        return conv.batch
    width = _words(conv) * 8 if deterministic else 4
    image = conv.channels * conv.size[0] * conv.size[1]
    elements = conv.batch * image + conv.pixels * conv.out_channels
    most = max(int(elements * conv.dtype.itemsize * _SUM_SHARE), _LEAST_SUM_BYTES)
    return min(conv.batch, max(1, most // (image * width)))


def _words(conv: Conv) -> int:
    """64-bit words of an exact sum."""
    return 2 if conv.dtype == torch.float64 else 1


def _sums_of_input(conv: Conv, operands: Operands, factors: Tensor) -> Sums:
    shape, device = tuple(operands.image.shape), operands.image.device
    if not torch.are_deterministic_algorithms_enabled():
        return Sums.floating(shape, conv.compute_dtype, device)
    # No sample gets more than a pixel's gradients times the largest factor.
    outer = operands.outer.abs().sum(-1, dtype=torch.float64).amax()
    bound = outer * factors.abs().amax()
    return Sums.exact(shape, bound, conv.pixels * conv.taps, _words(conv))


def _pass(
    conv: Conv,
    operands: Operands,
    factors: Tensor,
    need_input: bool,
    need_scale: bool,
) -> tuple[Sums | None, Tensor]:
    """Sums of the gradient of input, and the gradient of scale in the compute dtype."""
    sums = _sums_of_input(conv, operands, factors) if need_input else None
    scale = operands.scale

    def parts(tiles: Tiles) -> int:
        width, groups = (conv.channels, 1) if conv.lanes else (conv.group_channels, conv.groups)
        blocks: int = triton.cdiv(width, tiles.channels_in)
        return blocks * groups

    def run(tiles: Tiles) -> Tensor:
        if sums is not None:
            sums.zero_()
        shape = (parts(tiles) if need_scale else 0, *scale.shape)
        partial = torch.empty(shape, dtype=conv.compute_dtype, device=scale.device)
        backward_data_kernel[(triton.cdiv(conv.pixels, tiles.pixels) * parts(tiles),)](
            partial if sums is None else sums.totals,
            None if sums is None else sums.factors,
            partial,
            operands.outer,
            operands.image,
            factors,
            scale,
            operands.guide,
            operands.tolerance,
            operands.image.numel(),
            scale.numel(),
            *conv.places(),
            *conv.channel_counts(),
            *conv.centres(),
            **conv.constants(),
            NEED_INPUT=need_input,
            NEED_SCALE=need_scale,
            WORDS=0 if sums is None else sums.words,
            **tiles.constants(),
        )
        return partial

    variant = (operands.guide is not None, tensor_float32(), need_input, need_scale)
    tiles = fastest("backward_data", conv, variant, data_tiles(conv), run, scale.device)
    return sums, run(tiles).sum(0)


def gradient_of_weight(conv: Conv, operands: Operands) -> Tensor:
    """The gradient of the weight, (O, C/groups, kH, kW)."""
    scale = operands.scale
    grad = torch.empty(
        (conv.out_channels, conv.group_channels, *conv.kernel),
        dtype=conv.dtype,
        device=scale.device,
    )
    if not conv.pixels:
        return grad.zero_()

    def run(tiles: Tiles) -> Tensor | None:
        """Sums of the gradient; None where it was written in place."""
        if conv.lanes:
            blocks = triton.cdiv(conv.out_channels, tiles.channels_out) * conv.group_channels
        else:
            blocks = triton.cdiv(conv.group_out, tiles.channels_out) * conv.groups
            blocks *= triton.cdiv(conv.group_channels, tiles.channels_in)
        steps = triton.cdiv(conv.pixels, tiles.pixels)
        splits = max(1, min(steps, _WEIGHT_PROGRAMS // (blocks * conv.taps)))
        # A weight of so many blocks that all pixels are one share is large: no sums beside it.
        sums = None if splits == 1 else _sums_of_weight(conv, splits, scale.device)
        backward_weight_kernel[(splits * blocks * conv.taps,)](
            grad if sums is None else sums,
            operands.outer,
            operands.image,
            scale,
            operands.guide,
            operands.tolerance,
            *_strides_of_weight(conv, sums),
            splits,
            steps,
            *conv.places(),
            *conv.channel_counts(),
            *conv.centres(),
            **conv.constants(),
            ADDS=sums is not None and len(sums) < splits,
            **tiles.constants(),
        )
        return sums

    variant = (operands.guide is not None, tensor_float32())
    tiles = fastest("backward_weight", conv, variant, weight_tiles(conv), run, scale.device)
    sums = run(tiles)
    if sums is not None:
        grad.copy_((sums[0] if len(sums) == 1 else sums.sum(0)).permute(3, 2, 0, 1))
    return grad


def _sums_of_weight(conv: Conv, splits: int, device: torch.device) -> Tensor:
    """(1, kH, kW, C/groups, O) that all shares are added to, or one each for a fixed order."""
    deterministic = torch.are_deterministic_algorithms_enabled()
    shape = (splits if deterministic else 1, *conv.kernel, conv.group_channels, conv.out_channels)
    make = torch.empty if deterministic else torch.zeros
    return make(shape, dtype=conv.compute_dtype, device=device)


def _strides_of_weight(conv: Conv, sums: Tensor | None) -> tuple[int, int, int, int]:
    """From share to share, tap, channel and output of what the kernel writes."""
    if sums is None:
        return 0, 1, conv.taps, conv.taps * conv.group_channels
    share, _, tap, channel, output = sums.stride()
    return share if len(sums) > 1 else 0, tap, channel, output
