"""What the device suites run on one layer: SurfConv2d in its modes, nn.Conv2d, and peers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median

import torch

import cases
import peers
import targets
from candidates import (
    BASELINE,
    CONTINUOUS,
    LEVELS,
    SAME_LEVEL,
    Candidate,
    make_candidate,
    scene_of,
)
from cases import Layer
from devices import NUMERICS, Device
from frames import RANDOM, make_scene, smooth_kinds
from peers import DEFORM, DEFORM_ALONE, PYRAMID, REFERENCE
from plan import Plan
from rows import Key, Row, judge
from suites.job import BACKWARD_WORK
from suites.peers import COUNTERPARTS, make_peer
from targets import Target
from timing import Timing

FORWARD, STEP = "forward", "forward + backward"
FIXED_DEPTH = f"{CONTINUOUS}, no gradient of depth"
LAYOUT = "channels_last"
#: deform_conv2d makes its input contiguous: it is given what it wants.
OWN_LAYOUTS = {DEFORM: "contiguous", DEFORM_ALONE: "contiguous"}
PEERS = {DEFORM_ALONE: CONTINUOUS, **{n: COUNTERPARTS[n] for n in (DEFORM, REFERENCE, PYRAMID)}}


@dataclass(frozen=True)
class Series:
    """One thing to run on a layer: what, with which depth, in which memory format."""

    subject: str
    depth: str = ""
    layout: str = LAYOUT

    @property
    def ours(self) -> bool:
        return self.subject not in PEERS and self.subject != BASELINE

    @property
    def baseline(self) -> Series:
        """What its time is compared with."""
        if self.subject in PEERS:
            return Series(PEERS[self.subject], self.depth)
        return Series(BASELINE, "", self.layout)

    def key(self, suite: str, table: str, case: str, direction: str, numerics: str) -> Key:
        return Key(
            suite,
            table,
            case,
            self.subject,
            direction,
            self.layout,
            self.depth,
            numerics,
            threads=0,
        )

    def time_target(self, direction: str, numerics: str) -> Target | None:
        """SurfConv2d's limit of price, or deform_conv2d's of how much longer it takes."""
        if numerics not in targets.GPU_NUMERICS or self.layout != OWN_LAYOUTS.get(
            self.subject, LAYOUT
        ):
            return None
        if self.subject == DEFORM:
            return targets.GPU_LEADS[direction]
        return targets.GPU_PRICES[direction] if self.ours else None


def series_of(direction: str, plan: Plan, device: Device, *, memory: bool = False) -> list[Series]:
    """What runs, the baseline first; contiguous input and random depth cost no other memory."""
    smooth = smooth_kinds()[0]
    ours = [Series(CONTINUOUS, smooth), Series(LEVELS, smooth)]
    if direction == STEP:
        ours.append(Series(FIXED_DEPTH, smooth))
    if not memory:
        ours.append(Series(CONTINUOUS, RANDOM))
    if not plan.quick:
        ours.append(Series(SAME_LEVEL, smooth))
        if not memory:
            ours += [Series(BASELINE, "", "contiguous"), Series(CONTINUOUS, smooth, "contiguous")]
    lacking = peers.unavailable(device.where.type)
    others = [
        Series(name, smooth, OWN_LAYOUTS.get(name, LAYOUT))
        for name in (DEFORM, DEFORM_ALONE, REFERENCE, PYRAMID)
        if not (name in (DEFORM, DEFORM_ALONE) and DEFORM in lacking)
    ]
    return [Series(BASELINE), *ours, *others]


def layers_of(plan: Plan) -> list[Layer]:
    """The layers of a plan."""
    chosen = [cases.GPU[name] for name in cases.GPU if name in cases.GPU_QUICK or not plan.quick]
    return [layer.shrunk(plan.shrink) for layer in chosen]


def numerics_of(plan: Plan) -> tuple[str, ...]:
    """Keys of `devices.NUMERICS`: those that are judged, or all."""
    return targets.GPU_NUMERICS if plan.quick else tuple(NUMERICS)


def work_of_layer(layer: Layer, numerics: str, direction: str) -> float:
    """Share of a suite's seconds: true float32 has no tensor cores."""
    factor = (1.0 if direction == FORWARD else BACKWARD_WORK) * (2 if numerics == "float32" else 1)
    return factor * (1 + layer.pixels / 5e5)


def make(series: Series, layer: Layer, dtype: torch.dtype, device: Device) -> Candidate:
    """The candidate of a series."""
    where = device.where
    scene = scene_of(layer, make_scene, series.depth) if series.depth else None
    if series.subject not in PEERS:
        fixed = series.subject == FIXED_DEPTH
        subject = CONTINUOUS if fixed else series.subject
        candidate = make_candidate(subject, layer, series.layout, scene, dtype, where)
        return replace(candidate, fixed_depth=fixed)
    assert scene is not None
    candidate = make_peer(series.subject, layer, scene, series.layout, dtype, where)
    if series.subject == DEFORM_ALONE:
        module = candidate.module
        assert isinstance(module, peers.OffsetConv2d) and candidate.depth is not None
        with torch.no_grad():
            offset = module.offset(candidate.depth).to(peers.deform_dtype(where.type, dtype))
        candidate = replace(candidate, depth=offset)
    return candidate


def ready(
    series: Sequence[Series], layer: Layer, direction: str, dtype: torch.dtype, device: Device
) -> tuple[dict[Series, Callable[[], object]], str]:
    """Every series' call, made once, and which peers the device has too little memory for.

    Raises:
        torch.OutOfMemoryError: of nn.Conv2d or SurfConv2d.
    """
    calls: dict[Series, Callable[[], object]] = {}
    lost = []
    for each in series:
        call = _attempt(each, layer, direction, dtype, device)
        # Out here no traceback holds on to what the attempt had allocated.
        device.forget()
        if call is None:
            lost.append(each.subject)
        else:
            calls[each] = call
    return calls, f"out of memory: {', '.join(lost)}" if lost else ""


def _attempt(
    series: Series, layer: Layer, direction: str, dtype: torch.dtype, device: Device
) -> Callable[[], object] | None:
    try:
        candidate = make(series, layer, dtype, device)
        call = candidate.inference() if direction == FORWARD else candidate.both()
        call()
    except torch.OutOfMemoryError:
        if series.subject not in PEERS:
            raise
        return None
    return call


def note_of(series: Series, dtype: torch.dtype, device: Device) -> str:
    """What else to know about a series."""
    if series.subject not in (DEFORM, DEFORM_ALONE):
        return ""
    computed = peers.deform_dtype(device.where.type, dtype)
    return "" if computed == dtype else f"computed in {str(computed).removeprefix('torch.')}"


def memory_row(key: Key, peak: int, base: int, note: str) -> Row:
    """A row of peak memory in times of nn.Conv2d's.

    Args:
        key: what was run.
        peak: its bytes.
        base: nn.Conv2d's bytes.
        note: what else to know.

    Returns:
        The row, with a verdict where it is SurfConv2d's in numerics that are judged.
    """
    mebibytes = peak / 2**20
    ratio = None if key.subject == BASELINE or base <= 0 else peak / base
    judged = key.dtype in targets.GPU_NUMERICS and key.subject.startswith("SurfConv2d")
    return Row(
        **asdict(key),
        unit="MiB",
        value=mebibytes,
        low=mebibytes,
        high=mebibytes,
        baseline="" if ratio is None else BASELINE,
        ratio=ratio,
        note=note,
        **judge(ratio, targets.GPU_MEMORY if judged else None),
    )


def joined(*notes: str) -> str:
    """The notes that are not empty, as one."""
    return "; ".join(note for note in notes if note)


def host_note(timing: Timing) -> str:
    """How long a call keeps the processor."""
    return f"processor {1e3 * median(timing.host):.2f} ms"
