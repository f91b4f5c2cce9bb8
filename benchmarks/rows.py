"""One measured number with all that a reader needs to know about it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from statistics import median
from typing import Any

from targets import Target
from timing import Timing, quartiles

#: What every column of results.json and results.csv means.
COLUMNS = {
    "suite": "suite that measured the row",
    "table": "table within the suite",
    "case": "layer, net or setting that was run",
    "subject": "what was run",
    "direction": "forward, backward (its gradients alone) or both together",
    "layout": "memory format of input and weight",
    "depth": "depth map: frames named kitti and indoor are real, random is a scale in 0.3 .. 6; "
    "in the invariance suite the distance, in times of the nearest view's",
    "dtype": "dtype of input and weight; tf32 is float32 whose products may be taken in tf32",
    "threads": "torch.set_num_threads; 0 where a GPU did the work",
    "unit": "unit of value, low and high; spreads are standard deviations of the features over the "
    "surface in the nearest view",
    "value": "median, or the only value",
    "low": "first quartile",
    "high": "third quartile",
    "samples": "number of timed calls, or of what else the median is over",
    "pixels": "output pixels of the batch, 0 where the row is no single layer",
    "macs": "multiplications of the convolution, 0 where the row is no single layer",
    "baseline": "what ratio compares with",
    "ratio": "value / baseline's value; where target_sense is 'at least', the factor of the lead",
    "ratio_low": "first quartile of the ratio over the rounds that both took part in",
    "ratio_high": "third quartile of the ratio over those rounds",
    "target": "limit of the ratio",
    "target_sense": "whether target is the most or the least that is wanted",
    "verdict": "met or missed; empty without a target",
    "note": "what else to know",
}


@dataclass(frozen=True)
class Key:
    """What identifies a row from one run to the next."""

    suite: str
    table: str
    case: str
    subject: str
    direction: str
    layout: str = ""
    depth: str = ""
    dtype: str = "float32"
    threads: int = 1


@dataclass(frozen=True)
class Row(Key):
    """A key and what was measured; `COLUMNS` explains each field."""

    unit: str = "ms"
    value: float = 0.0
    low: float = 0.0
    high: float = 0.0
    samples: int = 1
    pixels: int = 0
    macs: int = 0
    baseline: str = ""
    ratio: float | None = None
    ratio_low: float | None = None
    ratio_high: float | None = None
    target: float | None = None
    target_sense: str = ""
    verdict: str = ""
    note: str = ""

    @property
    def key(self) -> tuple[object, ...]:
        return tuple(getattr(self, field.name) for field in fields(Key))


def make_row(
    key: Key,
    timing: Timing,
    *,
    baseline: tuple[str, Timing] | None = None,
    target: Target | None = None,
    inverse: bool = False,
    pixels: int = 0,
    macs: int = 0,
    note: str = "",
) -> Row:
    """A row of milliseconds.

    Args:
        key: what was run.
        timing: its times.
        baseline: name and times of what it is compared with.
        target: limit of the ratio.
        inverse: the ratio is baseline / value: how many times faster than the baseline.
        pixels: output pixels.
        macs: multiplications.
        note: what else to know.

    Returns:
        The row, with the ratio of medians and the quartiles of the rounds' own ratios.
    """
    low, high = timing.quartiles
    ratio = ratio_low = ratio_high = None
    if baseline is not None:
        pairs = list(zip(timing.seconds, baseline[1].seconds, strict=False))
        each = [other / own if inverse else own / other for own, other in pairs]
        ratio = timing.median / baseline[1].median
        ratio = 1 / ratio if inverse else ratio
        ratio_low, ratio_high = quartiles(each)
    return Row(
        **asdict(key),
        value=1e3 * timing.median,
        low=1e3 * low,
        high=1e3 * high,
        samples=len(timing.seconds),
        pixels=pixels,
        macs=macs,
        baseline="" if baseline is None else baseline[0],
        ratio=ratio,
        ratio_low=ratio_low,
        ratio_high=ratio_high,
        note=note,
        **judge(ratio, target),
    )


def judge(ratio: float | None, target: Target | None) -> dict[str, Any]:
    """The three fields that hold a ratio against its target."""
    if ratio is None or target is None:
        return {"target": None, "target_sense": "", "verdict": ""}
    return {
        "target": target.limit,
        "target_sense": target.sense,
        "verdict": "met" if target.met(ratio) else "missed",
    }


def fastest(timings: dict[str, Timing]) -> tuple[str, Timing]:
    """Name and timing of the smallest median."""
    return min(timings.items(), key=lambda item: median(item[1].seconds))
