"""What else a user could pick for one layer, and whether it can be had here."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from surfconv_ops import at_output_centers, depth_to_scale, reference

GRID_SAMPLE = "grid_sample + einsum"
PYRAMID = "4-level pyramid"
DEFORM = "deform_conv2d"
DEFORM_ALONE = "deform_conv2d, offsets given"
CONV3D = "nn.Conv3d"
REFERENCE = "surfconv_ops.reference"


def _try_deform_conv2d(function: Any, device: str, dtype: torch.dtype) -> None:
    image, offset, weight = (
        torch.zeros(1, channels, 3, 3, device=device, dtype=dtype) for channels in (1, 18, 1)
    )
    function(image, offset, weight, padding=1)


@cache
def deform_conv2d(device: str = "cpu") -> tuple[Any, str]:
    """torchvision's function, or None and why it cannot be used on a type of device."""
    try:
        from torchvision.ops import deform_conv2d as function

        # The import alone also succeeds where its compiled operators are missing.
        _try_deform_conv2d(function, device, torch.float32)
    except (ImportError, RuntimeError, OSError, AttributeError) as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        return None, f"torchvision cannot be used: {type(error).__name__}: {reason}"
    return function, ""


@cache
def deform_dtype(device: str, dtype: torch.dtype) -> torch.dtype:
    """What deform_conv2d computes in: float32, as under autocast, where it lacks the dtype."""
    try:
        _try_deform_conv2d(deform_conv2d(device)[0], device, dtype)
    except RuntimeError:
        return torch.float32
    return dtype


def unavailable(device: str = "cpu") -> dict[str, str]:
    """Peers that cannot be measured on a type of device, and why."""
    function, reason = deform_conv2d(device)
    return {} if function is not None else {DEFORM: reason}


class DepthConv2d(nn.Conv2d):
    """A convolution with depth as its second input, in some form other than SurfConv2d's.

    Without groups. `reference_depth` is the depth at which it is nn.Conv2d.
    """

    def __init__(self, *arguments: Any, reference_depth: float, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.reference_depth = reference_depth

    def scale(self, depth: Tensor) -> Tensor:
        """Scale of the tap spacing (N, Ho, Wo) at the centre of every output pixel."""
        at_centers = at_output_centers(depth, self.kernel_size, self.stride, self.padding)  # type: ignore[arg-type]
        return depth_to_scale(at_centers, self.reference_depth)

    def taps(self) -> tuple[Tensor, Tensor]:
        """Row and column offsets of all taps from the centre, (K, 1, 1) each."""
        y, x = (
            torch.arange(size, device=self.weight.device) - (size - 1) / 2
            for size in self.kernel_size
        )
        tap_y, tap_x = torch.meshgrid(y, x, indexing="ij")
        return tap_y.reshape(-1, 1, 1), tap_x.reshape(-1, 1, 1)


class ReferenceConv2d(DepthConv2d):
    """The operator's readable definition, which the package carries, as a layer."""

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        return reference.surf_conv2d(
            input,
            self.weight,
            self.bias,
            scale=self.scale(depth),
            stride=self.stride,  # type: ignore[arg-type]
            padding=self.padding,  # type: ignore[arg-type]
        )


class GridSampleConv2d(DepthConv2d):
    """The pure PyTorch way: one grid_sample over all taps, one einsum with the weight."""

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        batch, channels, height, width = input.shape
        scale = self.scale(depth).unsqueeze(1)
        rows, columns = scale.shape[-2:]
        tap_y, tap_x = self.taps()
        y = self._centres(0, rows)[:, None] + scale * tap_y
        x = self._centres(1, columns) + scale * tap_x
        grid = torch.stack((x * (2 / (width - 1)) - 1, y * (2 / (height - 1)) - 1), -1)
        sampled = grid_sample(
            input, grid.reshape(batch, -1, columns, 2).to(input.dtype), align_corners=True
        )
        sampled = sampled.view(batch, channels, -1, rows, columns)
        output = torch.einsum("nckyx,ock->noyx", sampled, self.weight.flatten(2))
        return output if self.bias is None else output + self.bias[:, None, None]

    def _centres(self, axis: int, count: int) -> Tensor:
        first = (self.kernel_size[axis] - 1) / 2 - int(self.padding[axis])
        return torch.arange(count, device=self.weight.device) * self.stride[axis] + first


class DeformConv2d(DepthConv2d):
    """torchvision's deformable convolution with offsets made from depth."""

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        return self.deform(input, self.offset(depth))

    def offset(self, depth: Tensor) -> Tensor:
        """(y, x) of tap 0, (y, x) of tap 1, ... as the second dimension of (N, 2K, Ho, Wo)."""
        stretch = self.scale(depth).unsqueeze(1) - 1
        tap_y, tap_x = self.taps()
        return torch.stack((stretch * tap_y, stretch * tap_x), 2).flatten(1, 2)

    def deform(self, input: Tensor, offset: Tensor) -> Tensor:
        """torchvision's function at given offsets."""
        device = input.device.type
        dtype = deform_dtype(device, input.dtype)
        output: Tensor = deform_conv2d(device)[0](
            input.to(dtype),
            offset.to(dtype),
            self.weight.to(dtype),
            None if self.bias is None else self.bias.to(dtype),
            stride=self.stride,
            padding=self.padding,
        )
        return output.to(input.dtype)


class OffsetConv2d(DeformConv2d):
    """The same, its second input being the offsets: what torchvision's function alone takes."""

    def forward(self, input: Tensor, offset: Tensor) -> Tensor:
        return self.deform(input, offset)
