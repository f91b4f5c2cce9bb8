"""What autocast does to the operator: input, weight and bias follow it, scale and guide never."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

import torch
from torch import Tensor

OptionalTensor = TypeVar("OptionalTensor", Tensor, Tensor | None)


def autocast_active(device_type: str) -> bool:
    """Whether an autocast region for ``device_type`` is open."""
    # is_autocast_enabled raises for devices that know no autocast, such as meta.
    return torch.amp.is_autocast_available(device_type) and torch.is_autocast_enabled(device_type)


def autocast_disabled(device_type: str) -> AbstractContextManager[None]:
    """A region in which matrix products keep the dtype they are given."""
    if autocast_active(device_type):
        return torch.autocast(device_type, enabled=False)
    return nullcontext()


def cast_to_autocast_dtype(
    input: Tensor, weight: Tensor, bias: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """The arguments as ``torch.nn.functional.conv2d`` would see them under autocast."""
    # What is no tensor is left to the validator.
    device_type = input.device.type if isinstance(input, Tensor) else "meta"
    if not autocast_active(device_type):
        return input, weight, bias
    dtype = torch.get_autocast_dtype(device_type)
    return _cast(input, dtype), _cast(weight, dtype), _cast(bias, dtype)


def _cast(tensor: OptionalTensor, dtype: torch.dtype) -> OptionalTensor:
    if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
        return tensor
    return tensor if tensor.dtype == torch.float64 else tensor.to(dtype)
