"""The picture of ``levels``: how depth is distributed, and which part each level holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ..depth_table import row_importance
from .common import counted

if TYPE_CHECKING:
    from .levels import Summary

BARS = 240
# Depths shown: all but this share of pixels where the rest would squeeze the picture.
TAIL = 0.001
SQUEEZE = 1.5
# Width a band needs for its name, as a share of the picture's.
ROOM = 0.055
# On the axis, which would otherwise cut them in half.
MARKER: dict[str, Any] = {
    "markeredgecolor": "black",
    "markersize": 9,
    "clip_on": False,
    "zorder": 3,
}


def draw_picture(summary: Summary) -> Figure:
    """The histogram of depth with the levels' bands (the paper's Fig. 4)."""
    gamma = summary.levels.gamma or 0.0
    panels = 1 if gamma == 0 else 2
    legend = _legend(summary)
    figure = Figure(figsize=(11, 1 + 3 * panels + 0.11 * len(legend)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    figure.suptitle(
        f"{counted(len(summary.levels), 'depth level')} of equal importance, fitted to"
        f" {summary.valid_pixels:,} pixels of {counted(summary.files, 'file')}",
        fontweight="bold",
    )
    pixels = summary.table.pixels.astype(np.float64)
    view = _view(summary)
    _draw(axes[0], summary, pixels, summary.pixel_shares, view)
    axes[0].set_title("Pixels by depth, and each level's share of them", loc="left", fontsize=10)
    axes[0].set_ylabel("% of the pixels\nper metre of depth")
    if panels == 2:
        _draw(axes[1], summary, row_importance(summary.table, gamma), summary.importance_shares,
              view)  # fmt: skip
        axes[1].set_title(
            f"The same pixels weighted by their importance, depth$^{{{gamma:g}}}$: this is what the"
            " levels share out evenly",
            loc="left",
            fontsize=10,
        )
        axes[1].set_ylabel("% of the importance\nper metre of depth")
    for level, center in enumerate(summary.levels.centers):
        if center <= view.right:
            axes[-1].plot(center, 0, "^", color=_colour(summary, level), **MARKER)
    hidden = pixels[summary.table.high > view.right].sum() / pixels.sum()
    beyond = (
        f"   ({100 * hidden:.2g} % of the pixels lie beyond {view.right:.4g} m)" if hidden else ""
    )
    axes[-1].set_xlabel(f"depth in metres{beyond}")
    figure.legend(handles=legend, loc="outside lower center", ncols=2, fontsize=9)
    return figure


def _colour(summary: Summary, level: int) -> Any:
    number = len(summary.levels)
    return colormaps["viridis"](0.1 + 0.8 * (level / (number - 1) if number > 1 else 0.5))


def _legend(summary: Summary) -> list[Artist]:
    bounds = summary.bounds
    marks: list[Artist] = [
        Patch(
            color=_colour(summary, k),
            label=f"level {k}: {bounds[k]:.4g} to {bounds[k + 1]:.4g} m, all taken as"
            f" {center:.4g} m, scale {summary.scales[k]:.3g}",
        )
        for k, center in enumerate(summary.levels.centers)
    ]
    center = Line2D([], [], color="0.6", marker="^", markeredgecolor="black", linestyle="")
    center.set_label("a level's centre: the depth its pixels are taken as")
    reference = Line2D([], [], color="black", linestyle=":", linewidth=1.5)
    reference.set_label(f"reference depth, {summary.reference_depth:.4g} m: scale 1")
    return [*marks, center, reference]


class View(NamedTuple):
    """Depths between which the picture is drawn, in metres."""

    left: float
    right: float


def _view(summary: Summary) -> View:
    """From the smallest to the largest depth, unless a few far pixels would squeeze the rest."""
    table = summary.table
    below = np.cumsum(table.pixels)
    tail = float(table.high[np.searchsorted(below, (1 - TAIL) * below[-1])])
    # Something of the last level has to be seen as well.
    right = min(float(table.high[-1]), SQUEEZE * max(tail, summary.bounds[-2]))
    margin = max(0.01 * (right - summary.bounds[0]), 0.001 * right)
    return View(summary.bounds[0] - margin, right + margin)


def _draw(
    axes: Axes, summary: Summary, weight: NDArray[np.float64], shares: list[float], view: View
) -> None:
    bounds = summary.bounds
    width = (view.right - view.left) / BARS
    peak = 0.0
    for k in range(len(shares)):
        low, high = bounds[k], min(bounds[k + 1], view.right)
        axes.axvspan(low, high, color=_colour(summary, k), alpha=0.13, linewidth=0)
        # Bars end where levels do, so that the coloured areas are the levels' shares.
        ends = np.linspace(min(low, high - width), high, max(1, round((high - low) / width)) + 1)
        own = (summary.table.high <= bounds[k + 1]) & (summary.table.low > (low if k else 0))
        own &= summary.table.high <= view.right
        bar = np.clip(np.searchsorted(ends, summary.table.mean[own]) - 1, 0, len(ends) - 2)
        sums = np.bincount(bar, weight[own], minlength=len(ends) - 1)
        heights = 100 * sums / weight.sum() / np.diff(ends)
        axes.stairs(heights, ends, fill=True, color=_colour(summary, k), linewidth=0)
        peak = max(peak, float(heights.max()))
    axes.set_xlim(view.left, view.right)
    axes.set_ylim(0, 1.25 * peak)
    axes.spines[["top", "right"]].set_visible(False)
    for k, share in enumerate(shares):
        low, high = bounds[k], min(bounds[k + 1], view.right)
        if high - low > ROOM * (view.right - view.left):
            axes.text(
                (low + high) / 2, 1.23 * peak, f"level {k}\n{share:.1%}", ha="center", va="top"
            )
        if k:
            axes.axvline(low, color="white", linewidth=1)
    axes.plot([summary.reference_depth] * 2, [0, 1.04 * peak], ":", color="black", linewidth=1.5)
