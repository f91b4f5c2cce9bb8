"""A convolution's sizes in the form that its kernels take them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..geometry import Pair
from .layer import Layer, layer_of, refuse

#: Groups narrower than this on both sides are computed channel by channel: padded to what a
#: matrix product takes, most of it would be padding.
LEAST_PRODUCT = 16


@dataclass(frozen=True, kw_only=True)
class Conv(Layer):
    """One call's sizes."""

    out_channels: int
    groups: int

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
        refuse((weight.ndim == 4, "surf_conv2d: weight must have 4 dimensions"))
        out_channels, group_channels, kernel_y, kernel_x = weight.shape
        refuse(
            (
                groups > 0
                and out_channels % groups == 0
                and group_channels > 0
                and input.shape[1] == group_channels * groups,
                "surf_conv2d: channels of input and weight do not match groups",
            ),
            (
                weight.dtype == input.dtype and weight.device == input.device,
                "surf_conv2d: weight must have the input's dtype and device",
            ),
        )
        layer = layer_of(input, scale, (kernel_y, kernel_x), stride, padding, dilation)
        return cls(**vars(layer), out_channels=out_channels, groups=groups)

    @property
    def group_channels(self) -> int:
        return self.channels // self.groups

    @property
    def group_out(self) -> int:
        return self.out_channels // self.groups

    @property
    def lanes(self) -> bool:
        """Whether channels are multiplied one by one: tensor cores have no use for them."""
        narrow = max(self.group_channels, self.group_out) < LEAST_PRODUCT
        return self.dtype == torch.float64 or (self.groups > 1 and narrow)

    def channel_counts(self) -> tuple[int, ...]:
        """The kernels' arguments from ``out_channels`` to ``group_out``."""
        return (self.out_channels, self.group_channels, self.group_out)

    def constants(self) -> dict[str, Any]:
        products = {"LANES": self.lanes, "PRECISION": "tf32" if tensor_float32() else "ieee"}
        return super().constants() | products


def tensor_float32() -> bool:
    """torch's own setting for products of float32 matrices."""
    matmul = torch.backends.cuda.matmul
    # Where torch has the newer setting, reading the older one raises once the newer was used.
    if hasattr(matmul, "fp32_precision"):
        return str(matmul.fp32_precision) == "tf32"
    return bool(matmul.allow_tf32)
