"""The memory format of results: that of the tensor they belong to."""

from __future__ import annotations

import torch
from torch import Tensor


def memory_format_of(model: Tensor) -> torch.memory_format:
    """Memory format of a result that follows the 4-D tensor ``model``.

    channels_last only where ``model`` is contiguous so and not in the ordinary order as well: a
    net that runs contiguous is never handed channels_last. Read off the strides, because
    ``is_contiguous`` with a memory format is refused under vmap.
    """
    if model.is_contiguous():
        return torch.contiguous_format
    _, channels, height, width = model.shape
    wanted = (height * width * channels, 1, width * channels, channels)
    for size, stride, expected in zip(model.shape, model.stride(), wanted, strict=True):
        if size != 1 and stride != expected:
            return torch.contiguous_format
    return torch.channels_last


def lay_out(tensor: Tensor, memory_format: torch.memory_format) -> Tensor:
    """The 4-D ``tensor`` in ``memory_format``, by operations that vmap knows."""
    if memory_format == torch.channels_last:
        return tensor.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
    return tensor.contiguous()


def with_own_gradient(tensor: Tensor) -> Tensor:
    """The same 4-D tensor, whose gradient autograd will hand back in its memory format.

    A detour through its memory's order, which costs nothing forward.
    """
    if memory_format_of(tensor) == torch.contiguous_format:
        return tensor
    batch, channels, height, width = tensor.shape
    flat = tensor.permute(0, 2, 3, 1).reshape(-1)
    return flat.reshape(batch, height, width, channels).permute(0, 3, 1, 2)
