"""DepthGuided: a net whose SurfConv2d layers find their depth by themselves."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor, nn

from .ambient import DepthCall, exchange_call
from .checks import type_name
from .depth_layer import DepthLayer


class DepthGuided(nn.Module):
    """Calls a net with depth beside its inputs; every SurfConv2d inside gets the depth it needs."""

    def __init__(self, module: nn.Module) -> None:
        if not isinstance(module, nn.Module):
            raise TypeError(f"module: expected an nn.Module, got {type_name(module)}")
        super().__init__()
        self.module = module
        self._warned: set[frozenset[str]] = set()

    def forward(self, *inputs: Any, depth: Tensor, **kwargs: Any) -> Any:
        """The net's output."""
        call = DepthCall(depth, self.module)
        outer = exchange_call(call)
        try:
            output = self.module(*inputs, **kwargs)
        finally:
            exchange_call(outer)
        if not torch.compiler.is_compiling():
            if outer is not None:
                outer.ran |= call.ran
                outer.compiled |= call.compiled
            self._warn_of_idle_layers(call)
        return output

    def _warn_of_idle_layers(self, call: DepthCall) -> None:
        if call.compiled:
            return
        idle = frozenset(
            name
            for name, layer in self.module.named_modules()
            if isinstance(layer, DepthLayer) and layer not in call.ran
        )
        if not idle or idle in self._warned:
            return
        self._warned.add(idle)
        warnings.warn(
            f"DepthGuided: {len(idle)} layers that take depth did not run in this call:"
            f" {', '.join(sorted(idle))}",
            UserWarning,
            stacklevel=2,
        )
