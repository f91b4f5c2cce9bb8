"""How long the run takes: seconds for every suite, counted so that their sum is the run's length.

A suite shares its seconds among its jobs by the work in them (multiplications times calls), and a
job times its calls round after round until its share is used. So the sum below bounds the run,
except where `minimum` rounds of a slow peer do not fit.
"""

from __future__ import annotations

from dataclasses import dataclass, field

#: Adds up to about 5 minutes. The gate's is what it was seen to take: checks are never cut short.
FULL_SECONDS = {
    "gate": 35.0,
    "layers": 104.0,
    "channels": 20.0,
    "grouped": 12.0,
    "pools": 4.0,
    "dtypes": 14.0,
    "levels": 14.0,
    "peers": 27.0,
    "conv3d": 20.0,
    "scaling": 25.0,
    "memory": 14.0,
    "net": 14.0,
    "invariance": 7.0,
}
#: Adds up to less than a minute.
QUICK_SECONDS = {
    "gate": 8.0,
    "layers": 8.0,
    "channels": 3.0,
    "grouped": 2.0,
    "pools": 1.0,
    "dtypes": 3.0,
    "levels": 2.5,
    "peers": 5.0,
    "conv3d": 1.5,
    "scaling": 4.0,
    "memory": 3.0,
    "net": 4.0,
    "invariance": 2.0,
}
#: With --device cuda: adds up to about 6 minutes, kernels compiled on the way not counted.
DEVICE_FULL_SECONDS = {
    "gate": 60.0,
    "gpu_layers": 120.0,
    "gpu_memory": 25.0,
    "gpu_net": 30.0,
    "gpu_conv3d": 15.0,
    "gpu_first": 90.0,
}
#: Adds up to about a minute.
DEVICE_QUICK_SECONDS = {
    "gate": 10.0,
    "gpu_layers": 16.0,
    "gpu_memory": 3.0,
    "gpu_net": 5.0,
    "gpu_conv3d": 2.0,
    "gpu_first": 25.0,
}
SECONDS = {
    "cpu": (FULL_SECONDS, QUICK_SECONDS),
    "cuda": (DEVICE_FULL_SECONDS, DEVICE_QUICK_SECONDS),
}


@dataclass(frozen=True)
class Limits:
    """How long one job measures: rounds within the seconds, but never fewer than `minimum`."""

    seconds: float
    minimum: int
    maximum: int


@dataclass(frozen=True)
class Plan:
    """Budgets and breadth of a run.

    Attributes:
        quick: few rounds, fewer shapes and depths.
        threads: thread counts to measure with, the first one being what single runs use.
        seconds: budget of every suite, by name.
        minimum: rounds that everybody takes part in.
        maximum: rounds after which a fast job ends before its seconds do.
        shrink: divisor of all frame sizes; above 1 only where numbers do not matter (tests).
    """

    quick: bool
    threads: tuple[int, ...]
    seconds: dict[str, float] = field(repr=False)
    minimum: int
    maximum: int
    shrink: int = 1

    @property
    def total(self) -> float:
        return sum(self.seconds.values())


def make_plan(
    quick: bool, threads: tuple[int, ...], suites: tuple[str, ...], device: str = "cpu"
) -> Plan:
    """The plan of a full or a quick run over some of the suites of a kind of device."""
    table = SECONDS[device][quick]
    seconds = {name: table[name] for name in ("gate", *suites)}
    minimum, maximum = (2 if quick else 4, 60) if device == "cpu" else (5 if quick else 10, 200)
    return Plan(quick, threads, seconds, minimum, maximum)
