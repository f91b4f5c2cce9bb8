"""Argument checking that every backend shares, done before any work.

Every message names the argument, what came, and what was expected. Shapes and values raise
ValueError; types, dtypes raise TypeError.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import geometry
from .checks import (
    PaddingArgument,
    PairArgument,
    check_integer,
    check_not_negative,
    check_pair,
    type_name,
)
from .geometry import Pair

FLOAT_DTYPES = (torch.float32, torch.float64, torch.bfloat16, torch.float16)
_AXES = ("rows", "columns")


class SurfConv2dArguments(NamedTuple):
    """Checked arguments in the operators' own order and form."""

    input: Tensor  # (N, C, H, W)
    weight: Tensor
    bias: Tensor | None
    scale: Tensor  # (N, 1 | 2, Ho, Wo)
    guide: Tensor | None  # (N, H, W)
    guide_tolerance: float
    stride: Pair
    padding: Pair  # before the first row and column
    dilation: Pair
    groups: int


class Window(NamedTuple):
    """A convolution's window in normal form, and the output size that follows from it."""

    kernel: Pair
    stride: Pair
    padding: tuple[Pair, Pair]  # before and after, per axis
    dilation: Pair
    output: Pair

    @property
    def padding_before(self) -> Pair:
        return self.padding[0][0], self.padding[1][0]

    def explain(self, size: Pair) -> str:
        """The output size formula with this window's numbers, for error messages."""
        parts = [
            f"{_AXES[i]}: ({size[i]} + {self.padding[i][0]} + {self.padding[i][1]}"
            f" - {self.dilation[i]}*({self.kernel[i]} - 1) - 1) // {self.stride[i]} + 1"
            f" = {self.output[i]}"
            for i in (0, 1)
        ]
        return (
            "output size = (size + padding before + padding after - dilation*(kernel - 1) - 1)"
            f" // stride + 1; {'; '.join(parts)}"
        )


def check_window(
    size: Pair,
    kernel: PairArgument,
    stride: PairArgument,
    padding: PaddingArgument,
    dilation: PairArgument,
    *,
    kernel_name: str = "kernel_size",
    size_name: str = "input",
) -> Window:
    """Normal form of kernel, stride, padding and dilation on an image of ``size``."""
    kernel = check_pair(kernel, kernel_name, 1)
    stride = check_pair(stride, "stride", 1)
    dilation = check_pair(dilation, "dilation", 1)
    pads = _check_padding(padding, kernel, stride, dilation)
    if size[0] < 1 or size[1] < 1:
        raise ValueError(f"{size_name}: expected at least one row and column, got {_by(size)}")
    output = (
        geometry.output_size(size[0], kernel[0], stride[0], pads[0], dilation[0]),
        geometry.output_size(size[1], kernel[1], stride[1], pads[1], dilation[1]),
    )
    window = Window(kernel, stride, pads, dilation, output)
    if output[0] < 1 or output[1] < 1:
        raise ValueError(
            f"{size_name}: {_by(size)} is too small for a {_by(kernel)} kernel with dilation"
            f" {dilation}: the output would be empty ({window.explain(size)});"
            " expected a larger image, more padding, or a smaller kernel or dilation"
        )
    return window


def _check_padding(padding: Any, kernel: Pair, stride: Pair, dilation: Pair) -> tuple[Pair, Pair]:
    if isinstance(padding, str):
        if padding == "valid":
            return (0, 0), (0, 0)
        if padding != "same":
            raise ValueError(
                f"padding: expected an integer, a (y, x) pair, 'same' or 'valid', got {padding!r}"
            )
        if stride != (1, 1):
            raise ValueError(
                f"padding: 'same' keeps the input's size and needs stride 1, got stride {stride}"
            )
        before_after = [geometry.same_padding(kernel[i], dilation[i]) for i in (0, 1)]
        return before_after[0], before_after[1]
    top, left = check_pair(padding, "padding", 0)
    return (top, top), (left, left)


def check_surf_conv2d(
    input: Any,
    weight: Any,
    bias: Any,
    scale: Any,
    guide: Any,
    guide_tolerance: Any,
    stride: Any,
    padding: Any,
    dilation: Any,
    groups: Any,
    window: Window | None = None,
) -> tuple[SurfConv2dArguments, bool]:
    """Arguments of :func:`surfconv_ops.surf_conv2d` in the operators' form, and if input had N.

    ``window`` is what :func:`check_window` gave for the input's size, where that is known already.
    """
    others = {"weight": weight, "scale": scale, "bias": bias, "guide": guide}
    check_tensors(input, others, optional=("bias", "guide"))
    groups = check_integer(groups, "groups", 1)
    if input.ndim not in (3, 4):
        raise ValueError(f"input: expected (N, C, H, W) or (C, H, W), got {_shape(input)}")
    batched = input.ndim == 4
    _check_channels(input, weight, bias, groups)
    kernel = tuple(weight.shape[2:])
    if window is None or window.kernel != kernel:
        size = (input.shape[-2], input.shape[-1])
        window = check_window(size, kernel, stride, padding, dilation, kernel_name="weight")
    check_scale(scale, input, window)
    if guide is not None:
        check_guide(guide, input)
    tolerance = check_not_negative(guide_tolerance, "guide_tolerance")
    input, scale, guide = as_batch(input, scale, guide)
    arguments = SurfConv2dArguments(
        input,
        weight,
        bias,
        scale,
        guide,
        tolerance,
        window.stride,
        window.padding_before,
        window.dilation,
        groups,
    )
    return arguments, batched


def as_batch(
    input: Tensor, scale: Tensor, guide: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """(N, C, H, W), (N, 1 | 2, Ho, Wo) and (N, H, W), of checked tensors that may lack N or 1."""
    if input.ndim == 3:
        input, scale = input.unsqueeze(0), scale.unsqueeze(0)
        guide = None if guide is None else guide.unsqueeze(0)
    return input, scale if scale.ndim == 4 else scale.unsqueeze(1), guide


def check_tensors(input: Any, others: dict[str, Any], optional: tuple[str, ...] = ()) -> None:
    """Types, dtypes and devices of input and of the arguments that go with it, by name."""
    named = {"input": input, **others}
    for name, tensor in named.items():
        if not isinstance(tensor, Tensor) and not (tensor is None and name in optional):
            raise TypeError(f"{name}: expected a tensor, got {type_name(tensor)}")
    dtype, device = input.dtype, input.device
    if dtype not in FLOAT_DTYPES:
        raise TypeError(f"input: expected one of {_names(FLOAT_DTYPES)}, got {dtype}")
    for name, tensor in named.items():
        if tensor is None:
            continue
        if tensor.dtype != dtype:
            if name in ("weight", "bias"):
                raise TypeError(f"{name}: expected the input's dtype {dtype}, got {tensor.dtype}")
            if tensor.dtype != torch.float32:
                raise TypeError(
                    f"{name}: expected {_names(dict.fromkeys((torch.float32, dtype)))} (float32 or"
                    f" the input's dtype), got {tensor.dtype}"
                )
        if tensor.device != device:
            raise ValueError(f"{name}: expected the input's device {device}, got {tensor.device}")


def _check_channels(input: Tensor, weight: Tensor, bias: Tensor | None, groups: int) -> None:
    if weight.ndim != 4:
        raise ValueError(f"weight: expected (O, C/groups, kH, kW), got {_shape(weight)}")
    channels, out_channels = input.shape[-3], weight.shape[0]
    if channels < 1:
        raise ValueError(f"input: expected at least one channel, got {_shape(input)}")
    if out_channels < 1 or out_channels % groups:
        raise ValueError(
            f"weight: expected a positive number of output channels divisible by groups={groups},"
            f" got {out_channels} in {_shape(weight)}"
        )
    if channels % groups:
        raise ValueError(
            f"input: expected a number of channels divisible by groups={groups},"
            f" got {channels} in {_shape(input)}"
        )
    if weight.shape[1] != channels // groups:
        raise ValueError(
            f"weight: expected {channels // groups} channels per group, because input"
            f" {_shape(input)} has {channels} and groups={groups}; got {weight.shape[1]}"
            f" in {_shape(weight)}"
        )
    if bias is not None and tuple(bias.shape) != (out_channels,):
        raise ValueError(
            f"bias: expected ({out_channels},), one value per output channel of weight"
            f" {_shape(weight)}, got {_shape(bias)}"
        )


def check_scale(scale: Tensor, input: Tensor, window: Window) -> None:
    lead = tuple(input.shape[:-3])
    if tuple(scale.shape) == (*lead, 1, *window.output):
        return
    shapes = [(*lead, *channels, *window.output) for channels in ((), (1,), (2,))]
    if tuple(scale.shape) not in shapes:
        raise ValueError(
            f"scale: expected {shapes[0]}, {shapes[1]} or, for (y, x), {shapes[2]}: one factor"
            f" per output pixel of input {_shape(input)}; got {_shape(scale)};"
            f" {window.explain((input.shape[-2], input.shape[-1]))}"
        )


def check_guide(guide: Tensor, input: Tensor) -> None:
    expected = (*input.shape[:-3], *input.shape[-2:])
    if tuple(guide.shape) != expected:
        raise ValueError(
            f"guide: expected {expected}, one value per pixel of input {_shape(input)},"
            f" got {_shape(guide)}"
        )


def _shape(tensor: Tensor) -> str:
    return str(tuple(tensor.shape))


def _by(size: Sequence[int]) -> str:
    return f"{size[0]} x {size[1]}"


def _names(dtypes: Any) -> str:
    return " or ".join(str(dtype) for dtype in dtypes)
