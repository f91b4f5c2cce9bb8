"""DepthGuided: a net whose layers find their depth by themselves."""

from __future__ import annotations

import warnings
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn

from . import ambient
from .checks import type_name
from .depth_layer import DepthLayer

_PREFIX = "module."


class DepthGuided(nn.Module):
    """A net that is called with depth, which it hands to every SurfConv2d and pool inside.

    The net keeps its own forward, which knows nothing of depth. While it runs, a layer that takes
    depth and was given none gets the call's depth at the resolution of the layer's own input. The
    depth may have any size; what counts are sizes alone: pixel i of h takes the depth at row
    ``floor(i * H / h)`` of H, columns likewise, which are the pixels that 'same'-padded kernels of
    odd size keep. Where that depth is invalid, it is the nearest valid one (Euclidean distance;
    ties go to the lower row, then the lower column) in the pixel's footprint
    ``[floor(i * H / h), ceil((i + 1) * H / h))``. Each resolution is computed once a call, and
    nothing is kept when the call ends.

    Gradients flow to a depth that requires one. Calls nest, the innermost one's depth counting;
    calls in several Python threads, also of one module, do not see one another. A layer inside
    that did not run in a call is named in a warning, once for each set of such layers (not while
    compiling).

    torch.compile and torch.export take the DepthGuided, not the net inside it. Where the compiler
    breaks the graph the result is right, but every such layer breaks it once more.
    Checkpointing around the DepthGuided needs nothing; a checkpoint inside it raises in backward
    unless it is given :meth:`checkpoint_contexts`.

    The keys of :meth:`state_dict` start with ``module.``. :meth:`load_state_dict` also takes the
    net's own keys, so a checkpoint of the net that was converted loads as it is;
    ``guided.module.state_dict()`` makes one.

    Args:
        module: The net, with SurfConv2d layers in it (:func:`surfconv_ops.convert_conv2d` puts
            them there).

    Raises:
        TypeError: ``module`` is not an nn.Module.

    Example:
        >>> import torch
        >>> from torch import nn
        >>> from surfconv_ops import DepthGuided, convert_conv2d
        >>> net = nn.Sequential(nn.Conv2d(3, 8, 3, stride=2, padding=1), nn.Conv2d(8, 4, 3))
        >>> net = DepthGuided(convert_conv2d(net, reference_depth=2.0))
        >>> net(torch.randn(1, 3, 24, 32), depth=torch.rand(1, 24, 32) + 1).shape
        torch.Size([1, 4, 10, 14])
    """

    module: nn.Module

    def __init__(self, module: nn.Module) -> None:
        if not isinstance(module, nn.Module):
            raise TypeError(f"module: expected an nn.Module, got {type_name(module)}")
        super().__init__()
        self.module = module
        self._warned_of: set[frozenset[str]] = set()

    def forward(self, *inputs: Any, depth: Tensor, **kwargs: Any) -> Any:
        """What the net returns.

        Args:
            *inputs: The net's positional arguments.
            depth: Depth in metres, floating point, of any size: ``(N, H, W)`` or
                ``(N, 1, H, W)``, ``(H, W)`` or ``(1, H, W)`` for images without N. Used as
                float32 by layers whose input is not float64. Invalid depth (zero, negative, NaN,
                infinite) is allowed anywhere. An argument of this name of the net's own can only
                be given by position.
            **kwargs: The net's keyword arguments.

        Raises:
            ValueError: The depth's shape is none of these, or its N or device is not that of a
                layer's input; the message names the layer.
            TypeError: ``depth`` is not a floating-point tensor.
            RuntimeError: A checkpoint inside the net is recomputed.
        """
        tracing = False
        outer = call = None
        try:
            # The compiler gives up a function that breaks the graph within "try", and this
            # function then runs in eager from its start. So what it asks here holds to the end.
            tracing = torch.compiler.is_dynamo_compiling()
            call = ambient.DepthCall(depth, self.module)
            if tracing:
                outer, ambient.trace.call = ambient.trace.call, call
            else:
                outer = ambient.eager_runner()(call.begin)
            output = self.module(*inputs, **kwargs)
        finally:
            if tracing:
                ambient.trace.call = outer
            elif call is not None:
                ambient.eager_runner()(ambient.end_call, outer)
        if not torch.compiler.is_compiling():
            message = ambient.eager_runner()(self._finish, call, outer)
            if message is not None:
                # Past the two functions of nn.Module that call this one.
                warnings.warn(f"DepthGuided: {message}", UserWarning, stacklevel=4)
        return output

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """As in nn.Module; takes keys of the net inside as well as its own.

        Args:
            state_dict: From :meth:`state_dict` of this module, of the net inside, or of the net
                before its conversion.
            strict: As in nn.Module.
            assign: As in nn.Module.

        Returns:
            As in nn.Module: the missing and the unexpected keys.
        """
        names = self.module.state_dict(keep_vars=True).keys()
        own = sum(_PREFIX + name in state_dict for name in names)
        if sum(name in state_dict for name in names) > own:
            state_dict = _with_prefix(state_dict)
        return super().load_state_dict(state_dict, strict, assign)

    @staticmethod
    def checkpoint_contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
        """For ``context_fn`` of :func:`torch.utils.checkpoint.checkpoint` inside a net.

        A backward pass that recomputes a part of the net then finds the depth of the call that
        the part ran in. It is kept until that pass is over, as tensors saved for backward are.

        Returns:
            A context for the forward and one for the recomputation.

        Example:
            >>> from torch.utils.checkpoint import checkpoint
            >>> from surfconv_ops import DepthGuided, SurfConv2d
            >>> block = SurfConv2d(3, 8, 3, reference_depth=2.0)
            >>> contexts = DepthGuided.checkpoint_contexts
            >>> def net(x):
            ...     return checkpoint(block, x, use_reentrant=False, context_fn=contexts)
        """
        return ambient.checkpoint_contexts()

    def _finish(self, call: ambient.DepthCall, outer: ambient.DepthCall | None) -> str | None:
        if outer is not None:
            outer.layers_run |= call.layers_run
        return self._message_of_idle_layers(call.layers_run)

    def _message_of_idle_layers(self, layers_run: set[nn.Module]) -> str | None:
        takers = {n: m for n, m in self.module.named_modules() if isinstance(m, DepthLayer)}
        idle = frozenset(name for name, layer in takers.items() if layer not in layers_run)
        if (takers and not idle) or idle in self._warned_of:
            return None
        self._warned_of.add(idle)
        if not takers:
            return "no layer inside takes depth; convert_conv2d puts SurfConv2d layers there"
        return (
            f"{len(idle)} of {len(takers)} layers that take depth did not run in this call:"
            f" {', '.join(sorted(idle))}"
        )


def _with_prefix(state_dict: Mapping[str, Any]) -> OrderedDict[str, Any]:
    """A state dict of the net inside, as one of the DepthGuided around it."""
    renamed = OrderedDict((_PREFIX + name, value) for name, value in state_dict.items())
    metadata = getattr(state_dict, "_metadata", {})
    # The net's own entry has no name, and is found under the prefix without its dot.
    inner = {(_PREFIX + name).rstrip("."): value for name, value in metadata.items()}
    renamed._metadata = OrderedDict(inner)  # type: ignore[attr-defined]
    return renamed
