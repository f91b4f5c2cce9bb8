"""How the learning rate falls."""

from __future__ import annotations

import math
from typing import Any

from torch.optim import Optimizer

SCHEDULES = ("cosine", "paper")
DEFAULT_RATES = {"cosine": 0.01, "paper": 0.001}

PATIENCE = 10
FIRST_EPOCHS = 100
FACTOR = 0.1


class Cosine:
    """Half a cosine from the first rate to 0, batch by batch."""

    def __init__(self, optimizer: Optimizer, batches: int) -> None:
        self._optimizer, self._batches, self._done = optimizer, batches, 0
        self._first = optimizer.param_groups[0]["lr"]

    def after_batch(self) -> None:
        """Lower the rate."""
        self._done += 1
        share = min(self._done / self._batches, 1.0)
        rate = 0.5 * self._first * (1 + math.cos(math.pi * share))
        for group in self._optimizer.param_groups:
            group["lr"] = rate

    def after_epoch(self, epoch: int, figure: float | None) -> None:
        """Nothing: the rate depends on the batches alone."""

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {"done": self._done, "first": self._first}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._done, self._first = state["done"], state["first"]


class Paper:
    """x 0.1 when the validation IOU_surf has not improved for 10 epochs after the 100th.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, section 4.
    """

    def __init__(self, optimizer: Optimizer) -> None:
        self._optimizer, self._best, self._waited = optimizer, -math.inf, 0

    def after_batch(self) -> None:
        """Nothing: the rate changes between epochs."""

    def after_epoch(self, epoch: int, figure: float | None) -> None:
        """Lower the rate where the figure has stopped rising."""
        if figure is None or figure > self._best:
            self._best = -math.inf if figure is None else figure
            self._waited = 0
            return
        if epoch <= FIRST_EPOCHS:
            return
        self._waited += 1
        if self._waited >= PATIENCE:
            self._waited = 0
            for group in self._optimizer.param_groups:
                group["lr"] *= FACTOR

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return {"best": self._best, "waited": self._waited}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._best, self._waited = state["best"], state["waited"]


def make_schedule(
    name: str, optimizer: Optimizer, epochs: int, batches_an_epoch: int
) -> Cosine | Paper:
    """The schedule of a run.

    Raises:
        ValueError: `name` is not one of SCHEDULES.
    """
    if name == "cosine":
        return Cosine(optimizer, epochs * batches_an_epoch)
    if name == "paper":
        return Paper(optimizer)
    raise ValueError(f"schedule: expected one of {SCHEDULES}, got {name!r}")
