"""A call's images and windows in the form that the kernels take them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import triton.language as tl
from torch import Tensor

from .. import geometry
from ..geometry import Pair

#: Beyond this many pixels along an axis positions need 64-bit integers.
NARROW_REACH = 2**30
#: Offsets beyond this reach no image and still convert to 64-bit integers exactly.
WIDE_REACH = 2**40


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One call's sizes, as far as a convolution and a pool have them both.

    The output has the scale's size.
    """

    batch: int
    channels: int
    size: Pair
    kernel: Pair
    stride: Pair
    padding: Pair
    dilation: Pair
    output: Pair
    axes: int
    dtype: torch.dtype

    @property
    def plane(self) -> int:
        return self.output[0] * self.output[1]

    @property
    def output_shape(self) -> tuple[int, ...]:
        """Of a pool."""
        return (self.batch, self.channels, *self.output)

    @property
    def pixels(self) -> int:
        """Output pixels of the whole batch."""
        return self.batch * self.plane

    @property
    def taps(self) -> int:
        return self.kernel[0] * self.kernel[1]

    @property
    def compute_dtype(self) -> torch.dtype:
        return torch.float64 if self.dtype == torch.float64 else torch.float32

    @property
    def wide(self) -> bool:
        """Whether positions need 64-bit integers."""
        axes = zip(
            self.size, self.stride, self.output, self.padding, self.dilation, self.kernel,
            strict=True,
        )  # fmt: skip
        return any(max(n, s * max(o, 1) + p + d * k) >= NARROW_REACH for n, s, o, p, d, k in axes)

    def places(self) -> tuple[int, ...]:
        """The kernels' arguments from ``count`` to ``width``."""
        return (self.pixels, self.plane, self.output[1], self.channels, *self.size)

    def centres(self) -> tuple[int, ...]:
        """The kernels' arguments from ``stride_y`` to ``first_x``."""
        first = [
            geometry.first_centre_pixel(k, p, d)
            for k, p, d in zip(self.kernel, self.padding, self.dilation, strict=True)
        ]
        return (*self.stride, *first)

    def constants(self) -> dict[str, Any]:
        """What the kernels are compiled for, but for the sizes of their tiles."""
        return {
            "KERNEL_Y": self.kernel[0],
            "KERNEL_X": self.kernel[1],
            "DILATION_Y": self.dilation[0],
            "DILATION_X": self.dilation[1],
            "AXES": self.axes,
            "LIMIT": float(WIDE_REACH if self.wide else NARROW_REACH),
            "INDEX": tl.int64 if self.wide else tl.int32,
            "ACC": tl.float64 if self.dtype == torch.float64 else tl.float32,
        }


def layer_of(
    input: Tensor, scale: Tensor, kernel: Pair, stride: Pair, padding: Pair, dilation: Pair
) -> Layer:
    """The sizes of checked arguments in the registered operators' form."""
    batch, channels, height, width = input.shape
    _, axes, rows, columns = scale.shape
    return Layer(
        batch=batch,
        channels=channels,
        size=(height, width),
        kernel=(kernel[0], kernel[1]),
        stride=(stride[0], stride[1]),
        padding=(padding[0], padding[1]),
        dilation=(dilation[0], dilation[1]),
        output=(rows, columns),
        axes=axes,
        dtype=input.dtype,
    )


def refuse(*conditions: tuple[bool, str]) -> None:
    """Raise RuntimeError for the first condition that does not hold.

    Messages for users come from the Python validator; here is what memory safety needs where an
    operator is called directly.
    """
    for holds, message in conditions:
        if not holds:
            raise RuntimeError(message)


def check_maps(name: str, input: Tensor, scale: Tensor, guide: Tensor | None) -> None:
    """What operator ``name`` needs of its maps."""
    batch = input.shape[0]
    maps = (scale,) if guide is None else (scale, guide)
    refuse(
        (input.ndim == 4 and scale.ndim == 4, f"{name}: input and scale must have 4 dimensions"),
        (
            scale.ndim == 4 and scale.shape[0] == batch and scale.shape[1] in (1, 2),
            f"{name}: scale must be (N, 1 or 2, Ho, Wo)",
        ),
        (
            guide is None or guide.shape == (batch, *input.shape[2:]),
            f"{name}: guide must be (N, H, W)",
        ),
        (
            all(m.device == input.device for m in maps),
            f"{name}: scale and guide must be on the input's device",
        ),
        (
            all(m.dtype in (torch.float32, input.dtype) for m in maps),
            f"{name}: scale and guide must be float32 or have the input's dtype",
        ),
    )


def check_grad_output(
    name: str, grad_output: Tensor, input: Tensor, shape: tuple[int, ...]
) -> None:
    """What operator ``name`` needs of its output's gradient."""
    same = grad_output.dtype == input.dtype and grad_output.device == input.device
    refuse(
        (
            grad_output.shape == shape and same,
            f"{name}: grad_output must have the output's shape, dtype and device",
        )
    )


def channels_innermost(tensor: Tensor) -> Tensor:
    """(N, C, H, W) in the memory order (N, H, W, C), copied only where it is not so already."""
    return tensor.permute(0, 2, 3, 1).contiguous()


def limits_of_view(
    guide: Tensor | None, tolerance: float, dtype: torch.dtype
) -> tuple[Tensor | None, Tensor | None]:
    """Guide and tolerance as the kernels read them."""
    if guide is None:
        return None, None
    # A kernel takes a Python number as float32, which is not the tolerance of a float64 call.
    return guide.contiguous(), torch.full((1,), tolerance, dtype=dtype, device=guide.device)
