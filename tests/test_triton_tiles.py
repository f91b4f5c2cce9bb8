"""Which tiles a kernel gets: tried once on a GPU, taken untried everywhere else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton")

from triton.runtime.errors import OutOfResources

from surfconv_ops.triton import tiles
from surfconv_ops.triton.conv import Conv
from surfconv_ops.triton.tiles import Tiles, data_tiles, fastest, forward_tiles, weight_tiles

CONV = Conv(batch=2, channels=64, size=(24, 32), kernel=(3, 3), stride=(1, 1), padding=(1, 1),
            dilation=(1, 1), output=(24, 32), axes=1, dtype=torch.float32, out_channels=48,
            groups=1)  # fmt: skip
SLOW, FAST, LARGE = (Tiles(pixels, 32, 32, 4, 2) for pixels in (16, 32, 64))
GPU = torch.device("cuda", 0)


class Clock:
    """Stands in for torch.cuda: tiles of 16 pixels take 3 ms, of 32 pixels 1 ms.

    A launch takes as long as the slowest of them, unless the device was busy before it.
    """

    def __init__(self) -> None:
        self.now = 0.0
        self.busy = False
        self.calls: list[Tiles] = []
        self.capturing = False

    def run(self, chosen: Tiles) -> None:
        self.calls.append(chosen)
        if chosen == LARGE:
            raise OutOfResources(300_000, 200_000, "shared memory")
        self.now += 3.0 if chosen == SLOW or not self.busy else 1.0
        self.busy = False

    def occupy(self, device: torch.device) -> None:
        assert device == GPU
        self.busy = True
        self.now += 10.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    clock = Clock()

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self) -> None:
            self.at = clock.now

        def synchronize(self) -> None: ...

        def elapsed_time(self, end: Event) -> float:
            return end.at - self.at

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: clock.capturing)
    monkeypatch.setattr(tiles, "_chosen", {})
    monkeypatch.setattr(tiles, "_occupy", clock.occupy)
    yield clock
    torch.use_deterministic_algorithms(False)


def choose(clock: Clock, conv: Conv = CONV, device: torch.device = GPU) -> Tiles:
    return fastest("forward", conv, None, [SLOW, LARGE, FAST], clock.run, device)


def test_the_fastest_that_fits_is_found_once(clock: Clock) -> None:
    assert choose(clock) == FAST
    assert set(clock.calls) == {SLOW, LARGE, FAST}
    calls = len(clock.calls)
    assert choose(clock) == FAST and len(clock.calls) == calls
    # A frame of nearly the same size does not try again, another layer does.
    assert choose(clock, replace(CONV, size=(24, 30), output=(24, 30))) == FAST
    assert len(clock.calls) == calls
    choose(clock, replace(CONV, dilation=(2, 2)))
    assert len(clock.calls) == 2 * calls


def test_the_first_is_taken_untried_where_nothing_may_be_timed(clock: Clock) -> None:
    assert choose(clock, device=torch.device("cpu")) == SLOW
    clock.capturing = True
    assert choose(clock) == SLOW
    clock.capturing = False
    torch.use_deterministic_algorithms(True)
    assert choose(clock) == SLOW
    assert clock.calls == [] and tiles._chosen == {}


@pytest.mark.parametrize("channels", [1, 3, 16, 48, 512])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
def test_candidates_are_few_and_fit_the_tensor_cores(channels: int, dtype: torch.dtype) -> None:
    conv = replace(CONV, channels=channels, out_channels=channels, dtype=dtype)
    for candidates in (forward_tiles(conv), data_tiles(conv), weight_tiles(conv)):
        assert 1 <= len(candidates) == len(set(candidates)) <= 4
        for each in candidates:
            lanes = (each.pixels, each.channels_in, each.channels_out)
            assert all(size & (size - 1) == 0 for size in lanes)
            assert conv.lanes or min(lanes) >= 16
