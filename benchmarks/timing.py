"""Interleaved timing: every candidate runs once a round, so that drift hits all alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import torch

from plan import Limits

#: Past the common rounds, a call sits out once it has used this many times its equal share.
LARGEST_SHARE = 3.0


def quartiles(values: list[float]) -> tuple[float, float]:
    """First and third quartile; of a single value, that value."""
    if len(values) < 2:
        return values[0], values[0]
    first, _, third = statistics.quantiles(values, n=4, method="inclusive")
    return first, third


@dataclass
class Timing:
    """Seconds of each timed call, in the order of the rounds it took part in.

    Attributes:
        seconds: what the calls took.
        host: how long each kept the processor, which a call that a GPU works on does not wait for.
    """

    seconds: list[float] = field(default_factory=list)
    host: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    @property
    def quartiles(self) -> tuple[float, float]:
        return quartiles(self.seconds)


@contextmanager
def thread_count(threads: int) -> Iterator[None]:
    """torch's thread count for the duration."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class Call:
    """Something to time; `prepare` runs before every call, untimed."""

    run: Callable[[], object]
    prepare: Callable[[], object] = lambda: None


class Clock(Protocol):
    """How long a call takes."""

    def time(self, run: Callable[[], object]) -> tuple[float, float]:
        """Seconds of the call, and seconds that it kept the processor."""
        ...


class HostClock:
    """A clock for calls that are over when they return."""

    def time(self, run: Callable[[], object]) -> tuple[float, float]:
        start = time.perf_counter()
        run()
        seconds = time.perf_counter() - start
        return seconds, seconds


def interleave(
    calls: Mapping[str, Call | Callable[[], object]],
    limits: Limits,
    started: float | None = None,
    clock: Clock | None = None,
) -> dict[str, Timing]:
    """Time every call once a round, after one untimed call each.

    A call that is much slower than the others takes part in the first `limits.minimum` rounds and
    then sits out when it has used up its share, so that a peer a hundred times slower does not
    decide how long the run takes.

    Args:
        calls: what to time, by name.
        limits: rounds and seconds.
        started: `time.perf_counter()` when the job began, so that what it took to set it up counts
            as well; None: now.
        clock: what times a call; None: a `HostClock`.

    Returns:
        The timings by name; the slow ones have fewer.
    """
    begin = time.perf_counter() if started is None else started
    clock = HostClock() if clock is None else clock
    ready = {name: call if isinstance(call, Call) else Call(call) for name, call in calls.items()}
    results = {name: Timing() for name in ready}
    share = LARGEST_SHARE * limits.seconds / len(ready)
    for call in ready.values():
        call.prepare()
        call.run()
    for number in range(limits.maximum):
        if number >= limits.minimum and time.perf_counter() - begin > limits.seconds:
            break
        for name, call in ready.items():
            result = results[name]
            if number >= limits.minimum and sum(result.seconds) > share:
                continue
            call.prepare()
            seconds, host = clock.time(call.run)
            result.seconds.append(seconds)
            result.host.append(host)
    return results
