"""Where the device suites run, and how time, memory and arithmetic are handled there."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch

import machine

MEBIBYTE = 2**20
#: A buffer of this size, or of twice the L2 cache, is written before every timed call.
LEAST_FLUSH = 256 * MEBIBYTE
#: Written so often, on an H100 for close to a millisecond, it also lets the processor run ahead:
#: the launches of a layer's kernels are then queued before the first of them starts.
FLUSHES = 8


class Device(Protocol):
    """What the device suites need of the place that they run on; also a `timing.Clock`."""

    @property
    def where(self) -> torch.device:
        """Where tensors go."""
        ...

    def time(self, run: Callable[[], object]) -> tuple[float, float]:
        """Seconds that the device works on a call, and seconds that it keeps the processor."""
        ...

    def peak(self, run: Callable[[], object]) -> int:
        """Most bytes of device memory in use during a call, less those in use before it."""
        ...

    def forget(self) -> None:
        """Give back memory that no tensor uses, and wait until the device is idle."""
        ...

    def facts(self) -> dict[str, Any]:
        """What a reader needs to know about the device."""
        ...


class Cuda:
    """The current CUDA device."""

    def __init__(self) -> None:
        self.where = torch.device("cuda", torch.cuda.current_device())
        cache = torch.cuda.get_device_properties(self.where).L2_cache_size
        self._buffer = torch.empty(max(LEAST_FLUSH, 2 * cache), dtype=torch.int8, device=self.where)

    def time(self, run: Callable[[], object]) -> tuple[float, float]:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize(self.where)
        for _ in range(FLUSHES):
            self._buffer.zero_()
        start.record()
        before = time.perf_counter()
        kept = run()
        host = time.perf_counter() - before
        end.record()
        end.synchronize()
        del kept
        return start.elapsed_time(end) / 1e3, host

    def peak(self, run: Callable[[], object]) -> int:
        torch.cuda.synchronize(self.where)
        torch.cuda.reset_peak_memory_stats(self.where)
        before = torch.cuda.memory_allocated(self.where)
        kept = run()
        torch.cuda.synchronize(self.where)
        peak = torch.cuda.max_memory_allocated(self.where)
        del kept
        return peak - before

    def forget(self) -> None:
        torch.cuda.synchronize(self.where)
        torch.cuda.empty_cache()

    def facts(self) -> dict[str, Any]:
        return machine.gpu(self.where)


def missing() -> str:
    """Why there is no CUDA device; empty where there is one."""
    if torch.cuda.is_available():
        return ""
    if not torch.backends.cuda.is_built():
        return f"torch {torch.__version__} is built without CUDA"
    return f"torch {torch.__version__} finds no CUDA device (nvidia-smi shows what the system has)"


@dataclass(frozen=True)
class Numerics:
    """How a net's numbers are held, and whether products of float32 may be taken in tf32."""

    dtype: torch.dtype
    tf32: bool


#: tf32 makes no difference to half types, but to what a peer computes in float32 for them.
NUMERICS = {
    "float32": Numerics(torch.float32, False),
    "tf32": Numerics(torch.float32, True),
    "bfloat16": Numerics(torch.bfloat16, True),
    "float16": Numerics(torch.float16, True),
}


@contextmanager
def numerics(name: str) -> Iterator[torch.dtype]:
    """One of `NUMERICS` and cuDNN's search for its fastest algorithm; gives the dtype."""
    chosen = NUMERICS[name]
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    before = matmul.allow_tf32, cudnn.allow_tf32, cudnn.benchmark
    matmul.allow_tf32 = cudnn.allow_tf32 = chosen.tf32
    cudnn.benchmark = True
    try:
        yield chosen.dtype
    finally:
        matmul.allow_tf32, cudnn.allow_tf32, cudnn.benchmark = before
