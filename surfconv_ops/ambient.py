"""The depth of the call that is running: DepthGuided sets it, layers that were given none read it.

In eager execution every thread has its own call, so that threads never see one another's. Dynamo
cannot trace an assignment to a thread's attribute (2.13). While it traces, ``trace.call`` serves,
which is never anything but None when a program really runs.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from .checks import check_depth_tensor
from .depth_resize import resize_depth


class _Resized(NamedTuple):
    """A map and what it was made for."""

    height: int
    width: int
    dtype: torch.dtype
    mode: tuple[bool, bool]
    depth: Tensor


class DepthCall:
    """One call of DepthGuided: its depth, at every resolution that a layer has asked for.

    Args:
        depth: Metres: ``(N, H, W)``, ``(N, 1, H, W)``, or ``(H, W)``.
        module: The module called, in which layers have their names.
    """

    def __init__(self, depth: Tensor, module: nn.Module) -> None:
        self.depth = _as_maps(depth)
        self.module = module
        self.layers_run: set[nn.Module] = set()
        self._resized: list[_Resized] = []
        self._backward_pass = -1

    def begin(self) -> DepthCall | None:
        """Make this the call that is running; returns the one before, which is to be put back."""
        self._backward_pass = _backward_pass()
        before, _thread.call = _thread.call, self
        return before

    def for_recomputation(self) -> DepthCall:
        """The same call as it stands now, to be taken up by a backward pass."""
        call = DepthCall(self.depth, self.module)
        call._resized = list(self._resized)
        return call

    def check_backward_pass(self, layer: nn.Module) -> None:
        """A backward pass that began within this call may recompute layers of another."""
        if self._backward_pass != _backward_pass():
            raise RuntimeError(
                f"depth: {self._name(layer)} was run by a backward pass, probably to recompute a"
                " checkpoint, and the depth at hand may be another call's; put the checkpoint"
                " around the DepthGuided, or give it"
                " context_fn=surfconv_ops.DepthGuided.checkpoint_contexts"
            )

    def depth_for(self, layer: nn.Module, input: Tensor) -> Tensor:
        """The depth at the resolution of a layer's input, ``(N, h, w)`` or ``(h, w)``."""
        if not isinstance(input, Tensor) or input.ndim not in (3, 4):
            # The layer's own message says what is wrong with such an input.
            return self.depth
        images = input.shape[0] if input.ndim == 4 else 1
        if images != self.depth.shape[0]:
            raise ValueError(
                f"depth: expected as many maps as layer {self._name(layer)} has images in its"
                f" input {tuple(input.shape)}, got {tuple(self.depth.shape)}; a layer that has"
                " time, views or patches in the batch needs its depth by hand: layer(input, depth)"
            )
        if input.device != self.depth.device:
            raise ValueError(
                f"depth: expected the device {input.device} of the input of layer"
                f" {self._name(layer)}, got {self.depth.device}"
            )
        dtype = torch.float64 if input.dtype == torch.float64 else torch.float32
        depth = self._resize(input.shape[-2], input.shape[-1], dtype)
        return depth if input.ndim == 4 else depth[0]

    def _resize(self, height: int, width: int, dtype: torch.dtype) -> Tensor:
        tracing = torch.compiler.is_dynamo_compiling()
        # A map made without a graph, or in inference mode, is no use to a layer that wants one.
        with_graph = self.depth.requires_grad and torch.is_grad_enabled()
        mode = with_graph, False if tracing else torch.is_inference_mode_enabled()
        for known in self._resized:
            if (
                known.dtype == dtype
                and known.mode == mode
                and _same(known.height, height)
                and _same(known.width, width)
            ):
                return known.depth
        depth = self.depth.to(dtype)
        if not (_same(depth.shape[-2], height) and _same(depth.shape[-1], width)):
            depth = resize_depth(depth, height, width)
        # A graph for training may be a checkpoint's part, which nothing may leave; there the
        # compiler itself removes what is computed twice.
        if not tracing or torch.compiler.is_exporting() or not torch.is_grad_enabled():
            self._resized.append(_Resized(height, width, dtype, mode, depth))
        return depth

    def _name(self, layer: nn.Module) -> str:
        for name, module in self.module.named_modules():
            if module is layer and name:
                return f"'{name}' ({type(layer).__name__})"
        return type(layer).__name__


class _ThreadState(threading.local):
    call: DepthCall | None = None


class _TraceState:
    def __init__(self) -> None:
        # Not the class's attribute: that the object has one of its own is part of what compiled
        # code is guarded by.
        self.call: DepthCall | None = None


class _Eager:
    #: Calls a function; hidden from compilers as soon as there is one.
    run: Callable[..., Any] = staticmethod(lambda function, *args: function(*args))
    is_hidden = False


_thread = _ThreadState()
_eager = _Eager()
trace = _TraceState()


def eager_runner() -> Callable[..., Any]:
    """What calls a function so that no compiler looks into it, as ``runner(function, *args)``.

    Importing the compiler, which takes seconds, is left to whoever compiles.
    """
    if not _eager.is_hidden and "torch._dynamo" in sys.modules:
        reason = "compile the DepthGuided, not the net inside it"
        _eager.run = torch.compiler.disable(_eager.run, reason=reason)
        _eager.is_hidden = True
    return _eager.run


def end_call(before: DepthCall | None) -> None:
    """Put back what :meth:`DepthCall.begin` returned."""
    _thread.call = before


def ambient_depth(layer: nn.Module, input: Tensor, depth: Tensor | None) -> Tensor:
    """``depth``, or if that is None, what the running call has for a layer's input."""
    if torch.compiler.is_dynamo_compiling() and trace.call is not None:
        return depth if depth is not None else trace.call.depth_for(layer, input)
    if _thread.call is not None:
        # Where a compiler traces this, the call began outside, and is another one next time.
        resolved: Tensor = _eager.run(_look_up, layer, input, depth)
        return resolved
    if depth is None:
        raise ValueError(
            f"depth: {type(layer).__name__} needs the depth of its input, got None; call"
            " layer(input, depth) with metres at the input's resolution, or wrap the whole net in"
            " surfconv_ops.DepthGuided and call that with depth=..."
        )
    return depth


def _look_up(layer: nn.Module, input: Tensor, depth: Tensor | None) -> Tensor:
    call = _thread.call
    assert call is not None
    call.layers_run.add(layer)
    if depth is not None:
        return depth
    call.check_backward_pass(layer)
    return call.depth_for(layer, input)


def checkpoint_contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
    """See :meth:`surfconv_ops.DepthGuided.checkpoint_contexts`."""
    call = _thread.call
    return nullcontext(), nullcontext() if call is None else _resume(call.for_recomputation())


@contextmanager
def _resume(call: DepthCall) -> Iterator[None]:
    before = call.begin()
    try:
        yield
    finally:
        end_call(before)


def _backward_pass() -> int:
    """Which backward pass this thread is working on; -1 for none."""
    number: int = torch._C._current_graph_task_id()
    return number


def _same(size: int, other: int) -> bool:
    if torch.compiler.is_compiling():
        # A plain comparison would tie the program to sizes that happen to be equal. The import
        # is slow, and the compiler has made it.
        from torch.fx.experimental.symbolic_shapes import statically_known_true

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
