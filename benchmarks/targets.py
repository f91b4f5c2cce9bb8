"""What the measurements are held against: the one list of limits, as ratios."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """A limit on a ratio: at most (a price) or at least (a lead)."""

    limit: float
    at_least: bool = False

    def met(self, ratio: float) -> bool:
        return ratio >= self.limit if self.at_least else ratio <= self.limit

    @property
    def sense(self) -> str:
        return "at least" if self.at_least else "at most"


@dataclass(frozen=True)
class Price:
    """Most that a layer may cost, in times of nn.Conv2d.

    Forward is against the same layout, backward (input, weight, bias and depth against input,
    weight and bias) against nn.Conv2d's faster layout.
    """

    contiguous: float
    channels_last: float
    backward: float

    def of(self, direction: str, layout: str) -> Target:
        if direction == "backward":
            return Target(self.backward)
        return Target(self.contiguous if layout == "contiguous" else self.channels_last)


def _flat(limit: float) -> Price:
    return Price(limit, limit, limit)


SMALL_CHANNELS = _flat(2.0)
GROUPED = _flat(2.5)
#: Our own limit: a pool samples as much for each output as a depthwise layer.
POOLS = Target(2.5)
MAIN = {
    "A": Price(1.12, 1.10, 1.10),
    "B": Price(1.18, 1.10, 1.10),
    "C": Price(1.08, 1.06, 1.05),
    "D": Price(1.30, 1.55, 1.40),
    "E": Price(1.05, 1.03, 1.00),
}

#: Most that a guide may add to its own mode: everywhere, and where channels are few (shape D).
GUIDE = Target(1.05)
GUIDE_BY_LAYER = {"D": Target(1.15)}

#: "16 levels cost what 4 cost", with the few percent by which equal medians differ.
SIXTEEN_LEVELS = Target(1.03)

TWO_THREADS = Target(1.7, at_least=True)
NET = Target(1.6)
MEMORY = Target(1.10)
HALF_TYPES = Target(1.5)

#: On one H100, in these numerics alone: by direction, the most in times of nn.Conv2d's time, how
#: many times as long deform_conv2d has to take, and the most in times of nn.Conv2d's peak memory.
GPU_NUMERICS = ("tf32", "bfloat16")
GPU_PRICES = {"forward": Target(1.6), "forward + backward": Target(2.0)}
GPU_LEADS = {
    "forward": Target(3.0, at_least=True),
    "forward + backward": Target(4.0, at_least=True),
}
GPU_MEMORY = Target(1.15)

#: Most that features may change with distance in continuous mode, in times of nn.Conv2d's change,
#: on a wall whose texture's wavelength is at least so many tap spacings.
INVARIANCE = Target(0.25)
COARSE_TAPS = 16

#: How many times as long as SurfConv2d each peer has to take.
PEERS = {
    "grid_sample + einsum": Target(3.0, at_least=True),
    "4-level pyramid": Target(6.0, at_least=True),
    "deform_conv2d": Target(10.0, at_least=True),
    "nn.Conv3d": Target(100.0, at_least=True),
}

#: The paper's Table 1 on its GPU: its 4-level SurfConv took 26 ms, its single-level net 5 ms.
PAPER_PYRAMID_RATIO = 26 / 5
