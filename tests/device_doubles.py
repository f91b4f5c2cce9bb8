"""Stand-ins for a GPU: a device that is the processor, and torchvision's deformable convolution."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample
from torch.utils._python_dispatch import TorchDispatchMode

import cases
import peers
from cases import Layer
from plan import Plan
from timing import HostClock

#: Divisor of the sides of the net's and of nn.Conv3d's frames.
SHRINK = 6


class _Largest(TorchDispatchMode):
    """Counts the bytes of every result that does not share an operand's memory."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        results = func(*args, **(kwargs or {}))
        known = {each.data_ptr() for each in args if isinstance(each, Tensor)}
        for each in results if isinstance(results, (tuple, list)) else (results,):
            if isinstance(each, Tensor) and each.data_ptr() not in known:
                self.bytes += each.nbytes
        return results


class Processor:
    """The processor, behind what the device suites ask of a GPU."""

    where = torch.device("cpu")

    def __init__(self) -> None:
        self.timed = 0
        self._clock = HostClock()

    def time(self, run: Callable[[], object]) -> tuple[float, float]:
        self.timed += 1
        return self._clock.time(run)

    def peak(self, run: Callable[[], object]) -> int:
        """Bytes of all that is made, as if nothing were freed."""
        with _Largest() as made:
            run()
        return made.bytes

    def forget(self) -> None:
        pass

    def facts(self) -> dict[str, Any]:
        return {"gpu": "none, a double", "cudnn": "none", "triton": "none"}


def deform_conv2d(
    input: Tensor,
    offset: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: tuple[int, int] = (1, 1),
    padding: tuple[int, int] | int = (0, 0),
) -> Tensor:
    """torchvision's function by its documentation, for odd kernels without stride; no bfloat16."""
    if input.dtype == torch.bfloat16:
        raise NotImplementedError('"deformable_im2col" not implemented for BFloat16')
    assert input.dtype == offset.dtype == weight.dtype
    height, width = input.shape[2:]
    kernel = weight.shape[-1]
    pad = (padding, padding) if isinstance(padding, int) else padding
    rows, columns = offset.shape[2:]
    total: Tensor | float = 0.0
    for tap in range(kernel**2):
        y = torch.arange(rows)[:, None] * stride[0] - pad[0] + tap // kernel + offset[:, 2 * tap]
        x = torch.arange(columns) * stride[1] - pad[1] + tap % kernel + offset[:, 2 * tap + 1]
        grid = torch.stack((2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1), -1)
        sampled = grid_sample(input, grid.to(input.dtype), align_corners=True)
        total = total + conv2d(sampled, weight[:, :, tap // kernel, tap % kernel, None, None])
    assert isinstance(total, Tensor)
    return total if bias is None else total + bias[:, None, None]


def tiny_plan(*names: str, quick: bool = True) -> Plan:
    """Two rounds of some device suites."""
    return Plan(quick, (1,), dict.fromkeys(("gate", *names), 0.0), 2, 2, shrink=SHRINK)


@contextmanager
def tiny(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Device suites of layers of a few channels, and a torchvision."""
    layers = (Layer("c4", 2, 4, 9, 12, 4), Layer("c8", 1, 8, 8, 10, 8))
    monkeypatch.setattr(cases, "GPU", {layer.name: layer for layer in layers})
    monkeypatch.setattr(cases, "GPU_QUICK", ("c8",))
    monkeypatch.setattr(cases, "GPU_NET_BATCHES", (2, 1))
    package, operators = ModuleType("torchvision"), ModuleType("torchvision.ops")
    operators.deform_conv2d = deform_conv2d  # type: ignore[attr-defined]
    package.__version__ = "a double's"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torchvision", package)
    monkeypatch.setitem(sys.modules, "torchvision.ops", operators)
    functions = (peers.deform_conv2d, peers.deform_dtype)
    for function in functions:
        function.cache_clear()
    try:
        yield
    finally:
        for function in functions:
            function.cache_clear()
