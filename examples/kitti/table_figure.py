"""The figure of table.py: every seed as a dot, and the validation curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from runs import Group, label_of

SHOWN = (("iou_img", "IOU_img"), ("iou_surf", "IOU_surf"))


def _dots(axes: Axes, groups: Sequence[Group], metric: str, at: str) -> None:
    for row, group in enumerate(groups):
        spread = group.spread(metric, at)
        if spread is None:
            continue
        colour = colormaps["tab10"](row % 10)
        values = [100 * value for value in spread.values]
        # A fixed fan keeps seeds of equal value apart, the same on every drawing.
        fan = row + (np.arange(len(values)) - (len(values) - 1) / 2) * 0.12
        axes.plot(values, fan, "o", color=colour, ms=7, alpha=0.75)
        axes.plot([100 * spread.mean] * 2, [row - 0.32, row + 0.32], color="black", lw=2)
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.grid(axis="x", alpha=0.3)


def _curves(axes: Axes, groups: Sequence[Group], metric: str) -> None:
    for row, group in enumerate(groups):
        colour = colormaps["tab10"](row % 10)
        curves = [dict(run.curve(metric)) for run in group.runs]
        for run, curve in zip(group.runs, curves, strict=True):
            axes.plot(
                list(curve), [100 * value for value in curve.values()],
                color=colour, lw=0.8, alpha=0.45, ls="-" if run.finished else ":",
            )  # fmt: skip
        # One run that stopped early must not cut the mean of the others short.
        whole = [dict(run.curve(metric)) for run in group.finished] or curves
        shared = sorted(set.intersection(*map(set, whole)))
        mean = [100 * float(np.mean([curve[epoch] for curve in whole])) for epoch in shared]
        axes.plot(shared, mean, color=colour, lw=2.2)
    top = max((value for group in groups for run in group.runs for _, value in run.curve(metric)),
              default=0.0)  # fmt: skip
    if top > 0:
        # The steep start says nothing about the settings and would flatten the rest.
        axes.set_ylim(60 * top, 102 * top)
    axes.set_xlabel("epoch")
    axes.set_ylabel("percent")
    axes.grid(alpha=0.3)


def save_figure(groups: Sequence[Group], at: str, path: Path) -> None:
    """Draw IOU_img and IOU_surf by setting, each seed a dot, and their curves over the epochs.

    Args:
        groups: settings with their runs; a run that has not ended gets a dotted curve, no dot.
        at: 'best' or 'last': the epoch that the dots show.
        path: the picture to write; the suffix chooses the format.
    """
    labels = [label_of(group, groups) for group in groups]
    dots = 0.9 + 0.42 * len(groups)
    left = 0.5 + 0.075 * max(len(label) for label in labels)
    width, height = left + 9.6, dots + 4.6
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    for k, (metric, name) in enumerate(SHOWN):
        x, size = (left + k * 4.8) / width, 4.3 / width
        axes = figure.add_axes((x, 1 - (dots - 0.4) / height, size, (dots - 0.9) / height))
        axes.set_title(f"{name} at the {at} epoch, percent (dot: seed, bar: mean)", fontsize=10)
        _dots(axes, groups, metric, at)
        axes.set_yticks(range(len(groups)), labels if k == 0 else [""] * len(groups))
        for tick, row in zip(axes.get_yticklabels(), range(len(groups)), strict=True):
            tick.set_color(colormaps["tab10"](row % 10))
        axes = figure.add_axes((x, 0.55 / height, size, 3.1 / height))
        axes.set_title(f"{name} on the validation frames (bold: mean of the seeds)", fontsize=10)
        _curves(axes, groups, metric)
        axes.set_ylabel("percent" if k == 0 else "")
    figure.savefig(path, dpi=110)
