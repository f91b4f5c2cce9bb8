"""Read the folders that training runs leave behind, and group those that differ in seed only."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

METRICS = ("acc_img", "iou_img", "acc_surf", "iou_surf")
#: What sets two settings apart comes first in tables, in this order.
SETTING_KEYS = ("mode", "levels", "gamma", "capacity", "loss", "reference_depth", "epochs")
#: What the modes differ in, apart from how they are trained; the loss may have to differ too.
MODE_KEYS = frozenset(
    {
        "mode", "levels", "gamma", "reference_depth", "loss", "invalid_scale", "min_scale",
        "max_scale", "depth_window", "same_level_only", "pools",
    }
)  # fmt: skip
MODES = ("conv2d", "pyramid", "levels", "continuous")
#: Facts about a run that are not its setting.
RUN_KEYS = frozenset(
    {
        "seed", "out", "data", "device", "threads", "workers", "resume", "parameters", "command",
        "commit", "started", "version", "versions", "torch", "host", "frames", "validation_frames",
    }
)  # fmt: skip


class RunError(ValueError):
    """A run folder cannot be read; the message says what is wrong with it."""


@dataclass(frozen=True)
class Run:
    """One training run: its settings, its log by epoch, and the epochs to report."""

    folder: Path
    config: dict[str, Any]
    log: list[dict[str, Any]]
    best: dict[str, Any] | None
    last: dict[str, Any] | None

    @property
    def seed(self) -> str:
        return str(self.config.get("seed", "?"))

    @property
    def epochs_done(self) -> int:
        """Epochs in the log; the first may be numbered 0 or 1."""
        if not self.log:
            return 0
        first, last = int(self.log[0]["epoch"]), int(self.log[-1]["epoch"])
        return last - min(first, 1) + 1

    @property
    def finished(self) -> bool:
        planned = self.config.get("epochs")
        whole = self.last is not None and self.best is not None
        return whole and (planned is None or self.epochs_done >= int(planned))

    @property
    def minutes(self) -> float | None:
        """Training time as logged."""
        seconds = [float(line["seconds"]) for line in self.log if "seconds" in line]
        return sum(seconds) / 60 if seconds else None

    def curve(self, metric: str) -> list[tuple[int, float]]:
        """(epoch, value) wherever the run was validated."""
        return [
            (int(line["epoch"]), float(line["val"][metric]))
            for line in self.log
            if line.get("val") and line["val"].get(metric) is not None
        ]

    def value(self, metric: str, at: str) -> float | None:
        """The metric at 'best' or 'last' epoch; None where the run does not hold it."""
        record = self.best if at == "best" else self.last
        found = ((record or {}).get("val") or {}).get(metric)
        return None if found is None or math.isnan(found) else float(found)


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise RunError(f"{path}: not JSON: {error}") from None
    if not isinstance(found, dict):
        raise RunError(f"{path}: expected a JSON object, got {type(found).__name__}")
    return found


def _read_log(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    lines = [line for line in path.read_text().splitlines() if line.strip()]
    by_epoch: dict[int, dict[str, Any]] = {}
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            # A resumed run writes the epochs after its checkpoint again.
            by_epoch[int(record["epoch"])] = record
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines):
                break  # a run that was killed while it wrote
            raise RunError(f"{path}, line {number}: {error!r}") from None
    return [by_epoch[epoch] for epoch in sorted(by_epoch)]


def load_run(folder: Path) -> Run:
    """Read one run's folder.

    Args:
        folder: holds config.json and, as far as the run got, metrics.jsonl, best.json, last.json.

    Raises:
        RunError: there is no such folder, no config.json in it, or a file is damaged.
    """
    if not folder.is_dir():
        raise RunError(f"{folder}: no such folder")
    config = _read(folder / "config.json")
    if config is None:
        raise RunError(f"{folder}: no config.json in it; expected the folder of a training run")
    log = _read_log(folder / "metrics.jsonl")
    return Run(folder, config, log, _read(folder / "best.json"), _read(folder / "last.json"))


@dataclass(frozen=True)
class Spread:
    """A figure over seeds; `std` is the sample's (n - 1), None for one seed."""

    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        return statistics.fmean(self.values)

    @property
    def std(self) -> float | None:
        return statistics.stdev(self.values) if len(self.values) > 1 else None


@dataclass(frozen=True)
class Group:
    """Runs of one setting: they differ in seed only."""

    setting: dict[str, Any]
    runs: list[Run]

    @property
    def finished(self) -> list[Run]:
        return [run for run in self.runs if run.finished]

    def spread(self, metric: str, at: str) -> Spread | None:
        """The metric over the finished runs; None where there is none."""
        values = [run.value(metric, at) for run in self.finished]
        known = tuple(value for value in values if value is not None)
        return Spread(known) if known else None

    def gain(self, baseline: Group, metric: str, at: str) -> Spread | None:
        """Differences to `baseline` seed by seed, over the seeds that both have."""
        theirs = {run.seed: run.value(metric, at) for run in baseline.finished}
        pairs = [(run.value(metric, at), theirs.get(run.seed)) for run in self.finished]
        known = tuple(own - other for own, other in pairs if own is not None and other is not None)
        return Spread(known) if known else None


def setting_of(config: dict[str, Any], ignored: Sequence[str] = ()) -> dict[str, Any]:
    """What of a run's configuration its result depends on, the seed apart."""
    setting = {k: v for k, v in config.items() if k not in RUN_KEYS and k not in ignored}
    if setting.get("loss") == "image" and setting.get("mode") in ("conv2d", "continuous"):
        # Neither has levels then, whatever the command line's defaults were.
        setting = {k: v for k, v in setting.items() if k not in ("levels", "gamma")}
        if setting["mode"] == "conv2d":
            setting.pop("reference_depth", None)
    return setting


def group_runs(runs: Sequence[Run], ignored: Sequence[str] = ()) -> list[Group]:
    """Put runs of one setting together: conv2d first, then in the order they were given.

    Raises:
        RunError: two finished runs share setting and seed; counted twice, they would look like
            agreement between seeds.
    """
    groups: dict[str, Group] = {}
    for run in runs:
        setting = setting_of(run.config, ignored)
        key = json.dumps(setting, sort_keys=True)
        groups.setdefault(key, Group(setting, [])).runs.append(run)
    for group in groups.values():
        seeds = [run.seed for run in group.finished]
        twice = {seed for seed in seeds if seeds.count(seed) > 1}
        if twice:
            names = [str(run.folder) for run in group.finished if run.seed in twice]
            raise RunError(
                f"expected one run of each setting and seed, got {len(names)} that differ in "
                f"neither: {', '.join(names)}"
            )
    return sorted(groups.values(), key=lambda group: _order(group.setting.get("mode")))


def _order(mode: Any) -> int:
    return MODES.index(mode) if mode in MODES else len(MODES)


def baseline_of(group: Group, groups: Sequence[Group]) -> Group | None:
    """The conv2d setting to compare with: alike in training, and in the loss where there is one."""
    same = [
        other
        for other in groups
        if other.setting.get("mode") == "conv2d"
        and all(
            other.setting[key] == value
            for key, value in group.setting.items()
            if key in other.setting and key not in MODE_KEYS
        )
    ]
    alike = [other for other in same if other.setting.get("loss") == group.setting.get("loss")]
    chosen = alike or same
    return chosen[0] if len(chosen) == 1 and chosen[0] is not group else None


def label_of(group: Group, groups: Sequence[Group]) -> str:
    """A name for the setting: its mode, and whatever differs between the settings shown."""
    parts = [str(group.setting.get("mode", "?"))]
    for key in varying_keys(groups):
        if key != "mode" and key in group.setting:
            parts.append(f"{key.replace('_', ' ')} {short(group.setting[key])}")
    return ", ".join(parts)


def varying_keys(groups: Sequence[Group]) -> list[str]:
    """Keys on which settings of one mode or of two disagree, the usual ones first."""
    keys = dict.fromkeys((*SETTING_KEYS, *(k for group in groups for k in group.setting)))
    return [key for key in keys if _varies(key, groups)]


def _varies(key: str, groups: Sequence[Group]) -> bool:
    values: dict[Any, set[str]] = {}
    for group in groups:
        shown = json.dumps(group.setting[key], sort_keys=True) if key in group.setting else ""
        values.setdefault(group.setting.get("mode"), set()).add(shown)
    # A mode may do without a key; between runs of one mode its absence is a difference.
    within = any(len(found) > 1 for found in values.values())
    return within or len(set().union(*values.values()) - {""}) > 1


def short(value: Any) -> str:
    """A setting's value as a table shows it."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)
