"""What every layer that takes depth has in common."""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from .ambient import ambient_depth
from .checks import check_depth_tensor, check_not_negative, type_name, valid_depth
from .depth import (
    check_levels,
    check_reference_depth,
    check_scale_limits,
    depth_to_scale,
    read_at_centers,
)
from .geometry import FloatPair
from .levels import DepthLevels
from .validation import Window


class DepthOptions(NamedTuple):
    """A layer's depth arguments, checked."""

    reference_depth: float | FloatPair
    levels: DepthLevels | None
    depth_window: float | None
    same_level_only: bool
    invalid_scale: float
    min_scale: float
    max_scale: float


def check_depth_options(
    reference_depth: Any,
    levels: Any,
    depth_window: Any,
    same_level_only: bool,
    invalid_scale: Any,
    min_scale: Any,
    max_scale: Any,
) -> DepthOptions:
    """The depth arguments, after checking each of them and that they fit together."""
    reference = check_reference_depth(reference_depth)
    limits = check_scale_limits(invalid_scale, min_scale, max_scale)
    check_levels(levels)
    if same_level_only and levels is None:
        raise ValueError("same_level_only: True needs levels, got levels=None")
    if depth_window is not None:
        if levels is not None:
            raise ValueError(
                f"depth_window: expected None with levels, got {depth_window}; in levels mode use"
                " same_level_only=True"
            )
        depth_window = check_not_negative(depth_window, "depth_window")
    return DepthOptions(reference, levels, depth_window, bool(same_level_only), *limits)


class DepthLayer(nn.Module):
    """Base of layers that read depth: their options, what depth turns into, their checkpoints.

    Comes before the nn layer among a class's bases. It has no ``__init__``: the layer calls
    :meth:`_set_depth_options` in its own.
    """

    reference_depth: float | FloatPair
    levels: DepthLevels | None
    depth_window: float | None
    same_level_only: bool
    invalid_scale: float
    min_scale: float
    max_scale: float

    def _set_depth_options(self, options: DepthOptions) -> None:
        for name, value in options._asdict().items():
            setattr(self, name, value)

    def _resolve_depth(self, input: Tensor, depth: Tensor | None) -> Tensor:
        """The depth this call works with: ``(N, H, W)`` or ``(H, W)``, in its compute dtype."""
        return _match_depth(ambient_depth(self, input, depth), input)

    def _scale(self, depth: Tensor, window: Window) -> Tensor:
        """Scale of every output pixel, from the depth at its centre."""
        # A single tap stays at the centre: its scale changes nothing, nor is it worth computing
        # where nobody asks for the depth's gradient, which is zero.
        if window.kernel == (1, 1) and not (depth.requires_grad and torch.is_grad_enabled()):
            shape = (*depth.shape[:-2], 1, *window.output)
            if torch.compiler.is_compiling():
                return depth.new_ones(shape)
            return depth.new_ones(1).expand(shape)
        if not isinstance(self.reference_depth, tuple):
            # The scale's channel, made here rather than later: TorchInductor 2.13 fails on dynamic
            # sizes where a view of a computed map goes into an operator.
            depth = depth.unsqueeze(-3)
        return depth_to_scale(
            read_at_centers(depth, window),
            self.reference_depth,
            levels=self.levels,
            invalid_scale=self.invalid_scale,
            min_scale=self.min_scale,
            max_scale=self.max_scale,
        )

    def _guide(self, depth: Tensor) -> tuple[Tensor | None, float]:
        """What a tap may see, NaN where the depth is invalid, and the guide's tolerance."""
        if self.levels is not None and self.same_level_only:
            return self.levels.look_up(depth, range(len(self.levels)), math.nan), 0.0
        if self.depth_window is not None:
            depth = depth.detach()
            return torch.where(valid_depth(depth), depth, math.nan), self.depth_window
        return None, 0.0

    def extra_repr(self) -> str:
        """The nn layer's description, followed by the depth options that are in use."""
        return ", ".join([super().extra_repr(), self.describe_options()])

    def describe_options(self) -> str:
        """The depth options that are in use."""
        parts = [f"reference_depth={self.reference_depth}"]
        if self.levels is not None:
            parts.append(f"levels={len(self.levels)}")
        if self.depth_window is not None:
            parts.append(f"depth_window={self.depth_window}")
        if self.same_level_only:
            parts.append("same_level_only=True")
        if self.invalid_scale != 1.0:
            parts.append(f"invalid_scale={self.invalid_scale}")
        if self.min_scale > 0.0:
            parts.append(f"min_scale={self.min_scale}")
        if self.max_scale < math.inf:
            parts.append(f"max_scale={self.max_scale}")
        return ", ".join(parts)

    def _checkpoint_metadata(self) -> dict[str, Any]:
        """What the layer's filters were trained for, in types that torch.load trusts."""
        levels = None if self.levels is None else self.levels.to_dict()
        return {"reference_depth": self.reference_depth, "levels": levels}

    def _save_to_state_dict(
        self, destination: dict[str, Any], prefix: str, keep_vars: bool
    ) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        # A caller's own dict has no metadata to ride in.
        metadata = getattr(destination, "_metadata", None)
        if metadata is not None:
            metadata.setdefault(prefix[:-1], {}).update(self._checkpoint_metadata())

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        local_metadata: dict[str, Any],
        *rest: Any,
    ) -> None:
        super()._load_from_state_dict(state_dict, prefix, local_metadata, *rest)
        for name, own in self._checkpoint_metadata().items():
            # A checkpoint of the plain nn layer has neither entry and loads silently.
            if name in local_metadata and local_metadata[name] != own:
                warnings.warn(
                    f"{prefix[:-1] or type(self).__name__}: the checkpoint was made with"
                    f" {name}={local_metadata[name]}, this layer has {name}={own}: its filters"
                    " were trained for another footprint",
                    UserWarning,
                    stacklevel=2,
                )


def _match_depth(depth: Tensor, input: Tensor) -> Tensor:
    """Depth as (N, H, W), or (H, W) where input has no N, in the layer's compute dtype."""
    check_depth_tensor(depth)
    if not isinstance(input, Tensor):
        raise TypeError(f"input: expected a tensor, got {type_name(input)}")
    if input.ndim not in (3, 4):
        raise ValueError(f"input: expected (N, C, H, W) or (C, H, W), got {tuple(input.shape)}")
    batch, size = tuple(input.shape[:-3]), tuple(input.shape[-2:])
    shapes = ((*batch, *size), (*batch, 1, *size))
    if tuple(depth.shape) not in shapes:
        raise ValueError(
            f"depth: expected {shapes[0]} or {shapes[1]}, one depth per pixel of input"
            f" {tuple(input.shape)}, got {tuple(depth.shape)}"
        )
    if depth.device != input.device:
        raise ValueError(f"depth: expected the input's device {input.device}, got {depth.device}")
    if depth.ndim != len(shapes[0]):
        depth = depth.squeeze(-3)
    return depth.to(torch.float64 if input.dtype == torch.float64 else torch.float32)
