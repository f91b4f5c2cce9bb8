"""Interleaved timing: every candidate runs once a round, so that drift hits all alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field


@dataclass
class Timing:
    """Seconds of each timed call."""

    seconds: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    @property
    def quartiles(self) -> tuple[float, float]:
        if len(self.seconds) < 2:
            return self.median, self.median
        first, _, third = statistics.quantiles(self.seconds, n=4, method="inclusive")
        return first, third


def interleave(
    calls: Mapping[str, Callable[[], object]],
    *,
    rounds: int,
    budget: float,
    minimum: int = 3,
    tick: Callable[[], None] = lambda: None,
) -> dict[str, Timing]:
    """Time every call once a round, after one untimed call each.

    Args:
        calls: what to time, by name.
        rounds: rounds at most.
        budget: seconds that one candidate may use; past it, it sits out the rounds after `minimum`,
            so that a peer a hundred times slower does not decide how long the run takes.
        minimum: rounds in which everybody takes part.
        tick: called after each round.

    Returns:
        The timings by name; the slow ones have fewer.
    """
    results = {name: Timing() for name in calls}
    for call in calls.values():
        call()
    for number in range(rounds):
        for name, call in calls.items():
            seconds = results[name].seconds
            if number >= minimum and sum(seconds) > budget:
                continue
            start = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - start)
        tick()
    return results
