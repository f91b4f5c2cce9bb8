"""A call's geometry and tensors in the form that the kernels take them."""

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
#: Groups narrower than this on both sides are computed channel by channel: padded to what a
#: matrix product takes, most of it would be padding.
LEAST_PRODUCT = 16


@dataclass(frozen=True)
class Conv:
    """One call's sizes; the output has the scale's size."""

    batch: int
    channels: int
    size: Pair
    out_channels: int
    kernel: Pair
    stride: Pair
    padding: Pair
    dilation: Pair
    groups: int
    output: Pair
    axes: int
    dtype: torch.dtype

    @classmethod
    def of(
        cls,
        input: Tensor,
        weight: Tensor,
        scale: Tensor,
        stride: Pair,
        padding: Pair,
        dilation: Pair,
        groups: int,
    ) -> Conv:
        """The sizes of checked arguments in the registered operator's form."""
        batch, channels, height, width = input.shape
        out_channels, _, kernel_y, kernel_x = weight.shape
        _, axes, rows, columns = scale.shape
        return cls(
            batch,
            channels,
            (height, width),
            out_channels,
            (kernel_y, kernel_x),
            (stride[0], stride[1]),
            (padding[0], padding[1]),
            (dilation[0], dilation[1]),
            groups,
            (rows, columns),
            axes,
            input.dtype,
        )

    @property
    def plane(self) -> int:
        return self.output[0] * self.output[1]

    @property
    def pixels(self) -> int:
        """Output pixels of the whole batch."""
        return self.batch * self.plane

    @property
    def taps(self) -> int:
        return self.kernel[0] * self.kernel[1]

    @property
    def group_channels(self) -> int:
        return self.channels // self.groups

    @property
    def group_out(self) -> int:
        return self.out_channels // self.groups

    @property
    def compute_dtype(self) -> torch.dtype:
        return torch.float64 if self.dtype == torch.float64 else torch.float32

    @property
    def lanes(self) -> bool:
        """Whether channels are multiplied one by one: tensor cores have no use for them."""
        narrow = max(self.group_channels, self.group_out) < LEAST_PRODUCT
        return self.dtype == torch.float64 or (self.groups > 1 and narrow)

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

    def channel_counts(self) -> tuple[int, ...]:
        """The kernels' arguments from ``out_channels`` to ``group_out``."""
        return (self.out_channels, self.group_channels, self.group_out)

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
            "LANES": self.lanes,
            "PRECISION": "tf32" if tensor_float32() else "ieee",
        }


def tensor_float32() -> bool:
    """torch's own setting for products of float32 matrices."""
    matmul = torch.backends.cuda.matmul
    # Where torch has the newer setting, reading the older one raises once the newer was used.
    if hasattr(matmul, "fp32_precision"):
        return str(matmul.fp32_precision) == "tf32"
    return bool(matmul.allow_tf32)


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
