"""How a kernel's work is cut into tiles, and which of a few ways is the fastest here."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any, TypeVar

import torch
import triton

from .conv import LEAST_PRODUCT, Conv, tensor_float32
from .layer import Layer

#: Kernels of up to this many taps are written out tap by tap.
MOST_UNROLLED_TAPS = 9
_ROUNDS = 5


@dataclass(frozen=True)
class Tiles:
    """Lanes of a tile along pixels, input channels and output channels; warps; loads in flight.

    ``unrolled``: the forward's taps are written out, so that those on pixels cost fewer loads.
    """

    pixels: int
    channels_in: int
    channels_out: int
    warps: int
    stages: int
    unrolled: bool = False

    def constants(self) -> dict[str, Any]:
        """As the kernels and their launch take them."""
        return {
            "BLOCK_PIXELS": self.pixels,
            "BLOCK_IN": self.channels_in,
            "BLOCK_OUT": self.channels_out,
            "num_warps": self.warps,
            "num_stages": self.stages,
        }


def _block(channels: int, most: int) -> int:
    power: int = triton.next_power_of_2(channels)
    return max(LEAST_PRODUCT, min(most, power))


def _is_exact_float32(conv: Conv) -> bool:
    """Whether the tensor cores cannot multiply: threads then hold more, and spill first."""
    return conv.dtype == torch.float32 and not tensor_float32()


def forward_tiles(conv: Conv) -> list[Tiles]:
    """Ways to cut the forward, the one to take without a choice first."""
    if conv.lanes:
        return [Tiles(32, 1, _block(conv.out_channels, 64), 4, 2)]
    inner, outer = _block(conv.group_channels, 64), _block(conv.group_out, 128)
    first = Tiles(64, min(inner, 32), min(outer, 64), 4, 3)
    if _is_exact_float32(conv):
        first = replace(first, warps=8, stages=2)
        others = [replace(first, channels_in=min(inner, 16))]
    else:
        others = [replace(first, pixels=128, channels_out=outer, warps=8)]
        if conv.dtype != torch.float32:
            others.append(replace(others[0], channels_in=inner))
    if conv.taps <= MOST_UNROLLED_TAPS:
        others.append(replace(first, unrolled=True))
    return list(dict.fromkeys([first, *others]))


def data_tiles(conv: Conv) -> list[Tiles]:
    """Ways to cut the gradients of input and scale, which take many registers."""
    if conv.lanes:
        first = Tiles(16, _block(conv.channels, 64), 1, 4, 2)
        return list(dict.fromkeys([first, replace(first, channels_in=_block(conv.channels, 32))]))
    inner, outer = _block(conv.group_channels, 32), _block(conv.group_out, 64)
    first = Tiles(64, inner, outer, 8, 2)
    return [first, replace(first, pixels=32, warps=4)]


def weight_tiles(conv: Conv) -> list[Tiles]:
    """Ways to cut the gradient of the weight."""
    if conv.lanes:
        return [Tiles(32, 1, _block(conv.out_channels, 64), 4, 2)]
    inner, outer = _block(conv.group_channels, 64), _block(conv.group_out, 64)
    first = Tiles(64, inner, outer, 8, 2)
    tiles = [first, Tiles(32, inner, outer, 4, 3)]
    if conv.dtype == torch.float32:
        # Twice as wide: less of it at a time.
        tiles = [replace(first, pixels=32), first]
    return list(dict.fromkeys(tiles))


_T = TypeVar("_T")
_chosen: dict[Hashable, Any] = {}


def fastest(
    name: str,
    layer: Layer,
    variant: Hashable,
    candidates: Sequence[_T],
    run: Callable[[_T], object],
    device: torch.device,
) -> _T:
    """The candidate that ``run`` takes least time with, found once per kernel and layer.

    ``run`` may be called any number of times. The first candidate is taken untried off the GPU,
    while a graph is captured, which must not wait for the device, and where torch asks for
    deterministic algorithms, because sums of other tiles round differently.
    """
    if (
        len(candidates) == 1
        or device.type != "cuda"
        or torch.are_deterministic_algorithms_enabled()
    ):
        return candidates[0]
    # Batches of nearby sizes share a choice: a net that sees many sizes is not tuned for each.
    size = layer.pixels.bit_length()
    kind = replace(layer, batch=0, size=(0, 0), output=(0, 0), padding=(0, 0))
    key = (name, device.index, kind, size, variant)
    if key not in _chosen:
        if torch.cuda.is_current_stream_capturing():
            return candidates[0]
        _chosen[key] = min(candidates, key=lambda tiles: _seconds(run, tiles, device))
    best: _T = _chosen[key]
    return best


def _seconds(run: Callable[[_T], object], tiles: _T, device: torch.device) -> float:
    try:
        run(tiles)
    except (triton.runtime.errors.OutOfResources, triton.runtime.errors.PTXASError):
        return float("inf")
    times: list[float] = []
    for _ in range(_ROUNDS):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        # Meanwhile the launches queue up: what is timed is the device's work alone.
        _occupy(device)
        start.record()
        run(tiles)
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return median(times)


def _occupy(device: torch.device) -> None:
    """Give a device work for longer than the launches of a layer take."""
    # On an H100 a quarter of a millisecond.
    buffer = torch.empty(64 * 2**20, dtype=torch.int8, device=device)
    for _ in range(10):
        buffer.zero_()
