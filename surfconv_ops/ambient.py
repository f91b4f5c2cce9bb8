"""The depth that belongs to the call that is running: what DepthGuided sets and layers read."""

from __future__ import annotations

import threading
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx.experimental.symbolic_shapes import statically_known_true

from .checks import check_depth_tensor
from .depth_resize import resize_depth


class DepthCall:
    """One call of DepthGuided: its depth, that depth at every resolution asked for so far.

    Args:
        depth: ``(N, H, W)``, ``(N, 1, H, W)``, or ``(H, W)``, in metres.
        module: The module called, in which layers have their names.
    """

    def __init__(self, depth: Tensor, module: nn.Module) -> None:
        self.depth = _as_maps(depth)
        self.module = module
        self.ran: set[nn.Module] = set()
        # A compiler inside the call leaves no trace of which layers ran.
        self.compiled = False
        self.task = -1 if torch.compiler.is_dynamo_compiling() else _backward_task()
        self._resized: list[tuple[int, int, tuple[Any, ...], Tensor]] = []

    def at(self, layer: nn.Module, input: Tensor) -> Tensor:
        """The depth at the resolution of a layer's input, of the rank that fits it."""
        if not isinstance(input, Tensor) or input.ndim not in (3, 4):
            # The layer's own message says what is wrong with such an input.
            return self.depth
        batch = input.shape[0] if input.ndim == 4 else 1
        if batch != self.depth.shape[0]:
            raise ValueError(
                f"depth: layer {self._name(layer)} has input {tuple(input.shape)}, {batch} images,"
                f" and the call has depth {tuple(self.depth.shape)}, {self.depth.shape[0]} maps;"
                " DepthGuided serves nets whose layers keep the batch as it comes in"
            )
        if input.device != self.depth.device:
            raise ValueError(
                f"depth: expected the device {input.device} of the input of layer"
                f" {self._name(layer)}, got {self.depth.device}"
            )
        dtype = torch.float64 if input.dtype == torch.float64 else torch.float32
        resized = self._resize(input.shape[-2], input.shape[-1], dtype)
        return resized if input.ndim == 4 else resized[0]

    def _resize(self, height: int, width: int, dtype: torch.dtype) -> Tensor:
        depth = self.depth
        # A map made without a graph is no use to a layer that wants one.
        kind = (dtype, torch.is_grad_enabled() and depth.requires_grad)
        for h, w, known_kind, known in self._resized:
            if known_kind == kind and _same(h, height) and _same(w, width):
                return known
        depth = depth.to(dtype)
        if not (_same(height, depth.shape[-2]) and _same(width, depth.shape[-1])):
            depth = resize_depth(depth, height, width)
        self._resized.append((height, width, kind, depth))
        return depth

    def _name(self, layer: nn.Module) -> str:
        names = [name for name, module in self.module.named_modules() if module is layer]
        return f"'{names[0]}' ({type(layer).__name__})" if names else type(layer).__name__


class _ThreadState(threading.local):
    call: DepthCall | None = None


class _TraceState:
    call: DepthCall | None = None


# Dynamo cannot trace an assignment to a thread's own attribute, and traces one thread at a time.
_thread = _ThreadState()
_trace = _TraceState()


def current_call() -> DepthCall | None:
    """The innermost call that is running in this thread."""
    if torch.compiler.is_dynamo_compiling() and _trace.call is not None:
        return _trace.call
    return _thread.call


def exchange_call(call: DepthCall | None) -> DepthCall | None:
    """Make ``call`` the one that is running; returns the one before it, to be put back."""
    if torch.compiler.is_dynamo_compiling():
        before = _trace.call
        _trace.call = call
    else:
        before = _thread.call
        _thread.call = call
    return before


def depth_of_call(layer: nn.Module, input: Tensor) -> Tensor:
    """The depth that the running call has for a layer that was given none."""
    call = current_call()
    if call is None:
        raise ValueError(
            f"depth: {type(layer).__name__} needs the depth of its input, got None; call"
            " layer(input, depth) with metres at the input's resolution, or wrap the net in"
            " surfconv_ops.DepthGuided and call that with depth=..."
        )
    if not torch.compiler.is_dynamo_compiling() and call.task != _backward_task():
        raise RuntimeError(
            f"depth: {call._name(layer)} is run by a backward pass, to recompute a checkpoint of"
            " another call than the one whose depth is at hand; put the checkpoint around the"
            " DepthGuided, not inside it"
        )
    return call.at(layer, input)


def note_layer(layer: nn.Module) -> None:
    """Remember that a layer ran in the running call, if there is one."""
    call = current_call()
    if call is None:
        return
    if torch.compiler.is_dynamo_compiling():
        call.compiled = True
    else:
        call.ran.add(layer)


def _backward_task() -> int:
    """Which backward pass this thread is running a part of; -1 for none."""
    task: int = torch._C._current_graph_task_id()
    return task


def _same(size: int, other: int) -> bool:
    if torch.compiler.is_compiling():
        # A comparison of its own would tie the program to sizes that happen to be equal.
        known: bool = statically_known_true(size == other)
        return known
    return size == other


def _as_maps(depth: Tensor) -> Tensor:
    """Depth as (N, H, W)."""
    check_depth_tensor(depth)
    shape = tuple(depth.shape)
    if depth.ndim == 4 and shape[1] == 1:
        depth = depth.squeeze(1)
    elif depth.ndim == 2:
        depth = depth.unsqueeze(0)
    elif depth.ndim != 3:
        raise ValueError(f"depth: expected (N, H, W), (N, 1, H, W) or (H, W), got {shape}")
    if depth.shape[-2] == 0 or depth.shape[-1] == 0:
        raise ValueError(f"depth: expected at least one pixel, got {shape}")
    return depth
