"""Checking of the pools' arguments, with every backend's messages."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from . import geometry
from .checks import PairArgument, check_not_negative, check_optional_integer, check_pair
from .geometry import Pair
from .validation import Window, as_batch, check_guide, check_scale, check_tensors


class PoolArguments(NamedTuple):
    """What both pools' operators begin with, checked and in their form."""

    input: Tensor  # (N, C, H, W)
    scale: Tensor  # (N, 1 | 2, Ho, Wo)
    guide: Tensor | None  # (N, H, W)
    guide_tolerance: float


class PoolWindow(Window):
    """A pool's window; its output may be a pixel larger than a convolution's."""

    __slots__ = ()

    def explain(self, size: Pair) -> str:
        return (
            f"output size {self.output} of kernel_size {self.kernel}, stride {self.stride},"
            f" padding {self.padding_before}, dilation {self.dilation} on {size}"
        )


def check_divisor(divisor_override: Any) -> int | None:
    """An integer other than zero, or None."""
    divisor = check_optional_integer(divisor_override, "divisor_override")
    if divisor == 0:
        raise ValueError("divisor_override: expected an integer other than zero, got 0")
    return divisor


def check_pool_window(
    size: Pair,
    kernel_size: PairArgument,
    stride: PairArgument | None,
    padding: PairArgument,
    dilation: PairArgument,
    ceil_mode: bool,
) -> PoolWindow:
    """Normal form of a pool's window on an image of ``size``."""
    kernel = check_pair(kernel_size, "kernel_size", 1)
    steps = kernel if stride is None else check_pair(stride, "stride", 1)
    before = check_pair(padding, "padding", 0)
    spacing = check_pair(dilation, "dilation", 1)
    if before[0] > kernel[0] // 2 or before[1] > kernel[1] // 2:
        raise ValueError(
            f"padding: expected at most half the kernel_size {kernel}, so at most"
            f" {(kernel[0] // 2, kernel[1] // 2)}, got {before}"
        )
    if size[0] < 1 or size[1] < 1:
        raise ValueError(f"input: expected at least one row and column, got {size}")
    output = tuple(
        geometry.pool_output_size(
            size[i], kernel[i], steps[i], before[i], spacing[i], bool(ceil_mode)
        )
        for i in (0, 1)
    )
    sides = (before[0], before[0]), (before[1], before[1])
    window = PoolWindow(kernel, steps, sides, spacing, (output[0], output[1]))
    if output[0] < 1 or output[1] < 1:
        raise ValueError(
            f"input: the output would be empty ({window.explain(size)}); expected a larger image,"
            " more padding, or a smaller kernel_size or dilation"
        )
    return window


def check_pool(
    input: Any, scale: Any, guide: Any, guide_tolerance: Any, window: PoolWindow
) -> PoolArguments:
    """The pools' tensors, with a batch."""
    check_scale(scale, input, window)
    if guide is not None:
        check_guide(guide, input)
    tolerance = check_not_negative(guide_tolerance, "guide_tolerance")
    return PoolArguments(*as_batch(input, scale, guide), tolerance)


def check_pool_input(input: Any, scale: Any, guide: Any) -> bool:
    """Types, dtypes, devices and dimensions; whether input has a batch."""
    check_tensors(input, {"scale": scale, "guide": guide}, optional=("guide",))
    if input.ndim not in (3, 4):
        raise ValueError(f"input: expected (N, C, H, W) or (C, H, W), got {tuple(input.shape)}")
    if input.shape[-3] < 1:
        raise ValueError(f"input: expected at least one channel, got {tuple(input.shape)}")
    return bool(input.ndim == 4)


def check_max_pool(
    input: Any,
    kernel_size: PairArgument,
    stride: PairArgument | None,
    padding: PairArgument,
    dilation: PairArgument,
    ceil_mode: bool,
    scale: Any,
    guide: Any,
    guide_tolerance: Any,
) -> tuple[tuple[Any, ...], bool]:
    """Arguments of the registered maximum, and whether input has a batch."""
    batched = check_pool_input(input, scale, guide)
    size = (input.shape[-2], input.shape[-1])
    window = check_pool_window(size, kernel_size, stride, padding, dilation, ceil_mode)
    tensors = check_pool(input, scale, guide, guide_tolerance, window)
    options = (window.kernel, window.stride, window.padding_before, window.dilation)
    return (*tensors, *options), batched


def check_avg_pool(
    input: Any,
    kernel_size: PairArgument,
    stride: PairArgument | None,
    padding: PairArgument,
    ceil_mode: bool,
    count_include_pad: bool,
    divisor_override: int | None,
    scale: Any,
    guide: Any,
    guide_tolerance: Any,
) -> tuple[tuple[Any, ...], bool]:
    """Arguments of the registered average, and whether input has a batch."""
    batched = check_pool_input(input, scale, guide)
    size = (input.shape[-2], input.shape[-1])
    window = check_pool_window(size, kernel_size, stride, padding, 1, ceil_mode)
    divisor = check_divisor(divisor_override)
    tensors = check_pool(input, scale, guide, guide_tolerance, window)
    options = (window.kernel, window.stride, window.padding_before)
    return (*tensors, *options, bool(count_include_pad), divisor or 0), batched
