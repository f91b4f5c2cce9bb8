"""The pools on one device, forward and backward, as ``torch.ops.surfconv`` has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import triton
from torch import Tensor

from ..geometry import Pair
from ..layout import lay_out, memory_format_of
from ..pool_reference import winner_dtype
from .accumulate import Sums
from .avg_pool import BY_NUMBER, BY_WEIGHT, BY_WINDOW, avg_backward_kernel, avg_forward_kernel
from .interpreter import in_float32, needs_float32
from .launch import on_device
from .layer import (
    Layer,
    channels_innermost,
    check_grad_output,
    check_maps,
    layer_of,
    limits_of_view,
    refuse,
)
from .max_pool import max_backward_kernel, max_forward_kernel
from .pool_tiles import PoolTiles, pool_tiles
from .tiles import fastest


def max_pool2d(
    input: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    kernel: Pair,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
) -> tuple[Tensor, Tensor]:
    """``surf_max_pool2d``: maxima, and the numbers of their taps as (N, Ho, Wo, C)."""
    if needs_float32(input):
        options = (guide_tolerance, kernel, stride, padding, dilation)
        wide, winner = in_float32(max_pool2d, (input, scale, guide, *options))
        return wide.to(input.dtype), winner
    check_maps("surf_max_pool2d", input, scale, guide)
    layer = layer_of(input, scale, kernel, stride, padding, dilation)
    output = _output(layer, input)
    winner = torch.empty_like(output, dtype=winner_dtype(layer.taps))
    view = limits_of_view(guide, guide_tolerance, layer.compute_dtype)
    arguments = (output, winner, channels_innermost(input), scale.contiguous(), *view)

    def run(tiles: PoolTiles) -> None:
        max_forward_kernel[tiles.grid(layer)](
            *arguments,
            *layer.places(),
            *layer.centres(),
            **layer.constants(),
            **tiles.constants(),
        )

    _launch("max_forward", layer, guide is not None, run, input)
    return lay_out(output.permute(0, 3, 1, 2), memory_format_of(input)), winner


def max_pool2d_backward(
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
    """``surf_max_pool2d_backward``; what is not needed has shape (0,)."""
    if needs_float32(input):
        tensors = (grad_output, input, scale, guide, winner, guide_tolerance)
        others = (kernel, stride, padding, dilation, need_input, need_scale)
        return _narrowed(in_float32(max_pool2d_backward, (*tensors, *others)), input, scale)
    check_maps("surf_max_pool2d_backward", input, scale, guide)
    layer = layer_of(input, scale, kernel, stride, padding, dilation)
    check_grad_output("surf_max_pool2d_backward", grad_output, input, layer.output_shape)
    shape = (layer.batch, *layer.output, layer.channels)
    refuse(
        (
            winner.shape == shape
            and winner.dtype == winner_dtype(layer.taps)
            and winner.device == input.device,
            "surf_max_pool2d_backward: winner must be what the forward returned",
        )
    )
    # At most one tap of every output pixel sends a channel's gradient on, divided up.
    bound = (layer.pixels, 1.0)
    gradients = _Gradients(layer, grad_output, input, scale, bound, need_input, need_scale)
    view = limits_of_view(guide, guide_tolerance, layer.compute_dtype)
    winners = winner.contiguous()

    def run(tiles: PoolTiles) -> None:
        max_backward_kernel[tiles.grid(layer)](
            *gradients.targets(tiles),
            gradients.outer,
            winners,
            gradients.image,
            gradients.scale,
            *view,
            *gradients.extents(),
            *layer.places(),
            *layer.centres(),
            **layer.constants(),
            **gradients.constants(),
            **tiles.constants(),
        )

    variant = (guide is not None, *gradients.constants().values())
    _launch("max_backward", layer, variant, run, input)
    return gradients.result(input, scale)


def avg_pool2d(
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
    """``surf_avg_pool2d``; a ``divisor_override`` of 0 means none."""
    if needs_float32(input):
        options = (kernel, stride, padding, count_include_pad, divisor_override)
        tensors = (input, scale, guide, guide_tolerance)
        wide: Tensor = in_float32(avg_pool2d, (*tensors, *options))
        return wide.to(input.dtype)
    check_maps("surf_avg_pool2d", input, scale, guide)
    layer = layer_of(input, scale, kernel, stride, padding, (1, 1))
    output = _output(layer, input)
    view = limits_of_view(guide, guide_tolerance, layer.compute_dtype)
    arguments = (output, channels_innermost(input), scale.contiguous(), *view)
    divisor = _divisor(count_include_pad, divisor_override)

    def run(tiles: PoolTiles) -> None:
        avg_forward_kernel[tiles.grid(layer)](
            *arguments,
            divisor_override,
            *layer.padding,
            *layer.places(),
            *layer.centres(),
            **layer.constants(),
            DIVISOR=divisor,
            **tiles.constants(),
        )

    _launch("avg_forward", layer, (guide is not None, divisor), run, input)
    return lay_out(output.permute(0, 3, 1, 2), memory_format_of(input))


def avg_pool2d_backward(
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
    """``surf_avg_pool2d_backward``; what is not needed has shape (0,)."""
    if needs_float32(input):
        tensors = (grad_output, input, scale, guide, guide_tolerance, kernel, stride, padding)
        others = (count_include_pad, divisor_override, need_input, need_scale)
        return _narrowed(in_float32(avg_pool2d_backward, (*tensors, *others)), input, scale)
    check_maps("surf_avg_pool2d_backward", input, scale, guide)
    layer = layer_of(input, scale, kernel, stride, padding, (1, 1))
    check_grad_output("surf_avg_pool2d_backward", grad_output, input, layer.output_shape)
    # No tap weighs more than 1, nor more than a divisor that its weight is a part of.
    bound = (layer.pixels * layer.taps, 1.0 / abs(divisor_override or 1))
    gradients = _Gradients(layer, grad_output, input, scale, bound, need_input, need_scale)
    view = limits_of_view(guide, guide_tolerance, layer.compute_dtype)
    divisor = _divisor(count_include_pad, divisor_override)

    def run(tiles: PoolTiles) -> None:
        avg_backward_kernel[tiles.grid(layer)](
            *gradients.targets(tiles),
            gradients.outer,
            gradients.image,
            gradients.scale,
            *view,
            divisor_override,
            *layer.padding,
            *gradients.extents(),
            *layer.places(),
            *layer.centres(),
            **layer.constants(),
            DIVISOR=divisor,
            **gradients.constants(),
            **tiles.constants(),
        )

    variant = (guide is not None, divisor, *gradients.constants().values())
    _launch("avg_backward", layer, variant, run, input)
    return gradients.result(input, scale)


class _Gradients:
    """What a pool's backward reads, and where the gradients of input and scale go."""

    def __init__(
        self,
        layer: Layer,
        grad_output: Tensor,
        input: Tensor,
        scale: Tensor,
        bound: tuple[int, float],
        need_input: bool,
        need_scale: bool,
    ) -> None:
        """``bound``: how many gradients a pixel may get, and how much of one at most."""
        self._layer = layer
        self._needs = (need_input, need_scale)
        self.outer = channels_innermost(grad_output)
        self.image = channels_innermost(input)
        self.scale = scale.contiguous()
        self._sums = self._sums_of_input(bound) if need_input else None
        self._partial = scale.new_empty((0, *scale.shape), dtype=layer.compute_dtype)

    def _sums_of_input(self, bound: tuple[int, float]) -> Sums:
        layer, shape = self._layer, tuple(self.image.shape)
        if not torch.are_deterministic_algorithms_enabled() or not layer.pixels:
            return Sums.floating(shape, layer.compute_dtype, self.image.device)
        terms, share = bound
        words = 2 if layer.dtype == torch.float64 else 1
        return Sums.exact(shape, self.outer.abs().amax().double() * share, terms, words)

    def targets(self, tiles: PoolTiles) -> tuple[Tensor, Tensor | None, Tensor]:
        """The kernels' first arguments, forgetting what an earlier run added."""
        parts = triton.cdiv(self._layer.channels, tiles.channels) if self._needs[1] else 0
        self._partial = self._partial.new_empty((parts, *self.scale.shape))
        if self._sums is None:
            return self._partial, None, self._partial
        self._sums.zero_()
        return self._sums.totals, self._sums.factors, self._partial

    def extents(self) -> tuple[int, int]:
        return self.image.numel(), self.scale.numel()

    def constants(self) -> dict[str, Any]:
        words = 0 if self._sums is None else self._sums.words
        return {"NEED_INPUT": self._needs[0], "NEED_SCALE": self._needs[1], "WORDS": words}

    def result(self, input: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """In the tensors' dtypes and memory formats."""
        grad_input, grad_scale = input.new_empty(0), scale.new_empty(0)
        if self._sums is not None:
            total = self._sums.result(self._layer.dtype).permute(0, 3, 1, 2)
            grad_input = lay_out(total, memory_format_of(input))
        if self._needs[1]:
            total = self._partial.sum(0).reshape(scale.shape).to(scale.dtype)
            grad_scale = lay_out(total, memory_format_of(scale))
        return grad_input, grad_scale


def _output(layer: Layer, input: Tensor) -> Tensor:
    shape = (layer.batch, *layer.output, layer.channels)
    return torch.empty(shape, dtype=layer.dtype, device=input.device)


def _divisor(count_include_pad: bool, divisor_override: int) -> int:
    if divisor_override:
        return int(BY_NUMBER.value)
    return int((BY_WINDOW if count_include_pad else BY_WEIGHT).value)


def _launch(
    name: str, layer: Layer, variant: object, run: Callable[[PoolTiles], None], input: Tensor
) -> None:
    if not layer.pixels:
        return
    candidates = pool_tiles(layer, "backward" in name)
    with on_device(input):
        run(fastest(name, layer, variant, candidates, run, input.device))


def _narrowed(grads: tuple[Tensor, Tensor], input: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    return grads[0].to(input.dtype), grads[1].to(scale.dtype)
