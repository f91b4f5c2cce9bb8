"""Charts of prices in times of nn.Conv2d, layer by layer, with the target of each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib import pyplot
from matplotlib.lines import Line2D

from cases import DIRECTIONS, LAYOUTS
from rows import Row

#: Colours that people with any colour vision can tell apart (Okabe and Ito).
COLOURS = {
    "nn.Conv2d": "0.55",
    "SurfMaxPool2d": "#0072B2",
    "SurfAvgPool2d": "#E69F00",
    "SurfConv2d continuous": "#0072B2",
    "SurfConv2d 4 levels": "#E69F00",
    "SurfConv2d 8 levels": "#CC79A7",
    "SurfConv2d continuous, depth window": "#56B4E9",
    "SurfConv2d continuous, gradient of depth too": "#56B4E9",
    "SurfConv2d 4 levels, same level only": "#D55E00",
}
OTHER_COLOUR = "#009E73"
MARKERS = ("o", "s", "^", "D", "v")
TARGET: dict[str, Any] = {"color": "black", "linewidth": 2.2}
INCHES_A_PANEL = 4.1
#: With more cases than this, forward and backward stand below each other.
MOST_CASES_ABREAST = 6


def colour(subject: str) -> str:
    return COLOURS.get(subject, OTHER_COLOUR)


def short_case(case: str) -> str:
    """A layer's name and shape on two or three lines."""
    shape, *rest = case.split(", ")
    name, _, size = shape.partition(" 1x")
    if not size:
        name, _, size = shape.partition(" 2x")
        size = f"2x{size}"
    rest = [part for part in rest if part != "3x3"]
    return "\n".join((name, size.replace(" -> ", "\nto "), *rest))


def _panel(axes: Any, rows: Sequence[Row], cases: Sequence[str], marks: dict[str, str]) -> None:
    """One direction and layout: a marker a row, its quartiles, and a bar where the target is."""
    series = list(dict.fromkeys((row.subject, row.depth) for row in rows))
    for row in rows:
        assert row.ratio is not None
        place = cases.index(row.case)
        shift = (series.index((row.subject, row.depth)) + 0.5) / len(series) - 0.5
        low, high = row.ratio_low or row.ratio, row.ratio_high or row.ratio
        axes.errorbar(
            place + 0.7 * shift,
            row.ratio,
            yerr=[[max(0, row.ratio - low)], [max(0, high - row.ratio)]],
            fmt=marks[row.depth],
            color=colour(row.subject),
            markersize=5.5,
            linewidth=1,
        )
        if row.target is not None:
            axes.plot([place - 0.42, place + 0.42], [row.target] * 2, **TARGET)
    axes.axhline(1, color="0.6", linewidth=1, linestyle=":")
    axes.set_xticks(range(len(cases)), [short_case(case) for case in cases], fontsize=7.5)
    axes.set_xlim(-0.6, len(cases) - 0.4)
    axes.grid(axis="y", color="0.92")
    axes.set_axisbelow(True)


def _prices(rows: Sequence[Row], title: str, baseline: str = "nn.Conv2d") -> Any:
    """Panels by thread count (down) and direction and layout (across)."""
    rows = [row for row in rows if row.ratio is not None and row.depth and row.table != "guide"]
    threads = sorted({row.threads for row in rows})
    cases = list(dict.fromkeys(row.case for row in rows))
    depths = list(dict.fromkeys(row.depth for row in rows))
    marks = dict(zip(depths, MARKERS, strict=False))
    lines = [[(direction, layout) for direction in DIRECTIONS for layout in LAYOUTS]]
    if len(cases) > MOST_CASES_ABREAST:
        lines = [[(direction, layout) for layout in LAYOUTS] for direction in DIRECTIONS]
    grid = [[(count, *cell) for cell in line] for count in threads for line in lines]
    width = max(INCHES_A_PANEL, 0.82 * len(cases) + 0.6)
    figure, panels = pyplot.subplots(
        len(grid),
        len(grid[0]),
        figsize=(width * len(grid[0]), 4.1 * len(grid) + 1.1),
        squeeze=False,
        sharey="row",
    )
    for axes_line, line in zip(panels, grid, strict=True):
        shown: list[Row] = []
        for axes, (count, direction, layout) in zip(axes_line, line, strict=True):
            own = [
                row
                for row in rows
                if (row.threads, row.direction, row.layout) == (count, direction, layout)
            ]
            _panel(axes, own, cases, marks)
            shown += own
            plural = "s" if count > 1 else ""
            axes.set_title(f"{direction}, {layout}, {count} thread{plural}", fontsize=10)
        highest = max(max(row.ratio_high or 0, row.ratio or 0, row.target or 0) for row in shown)
        axes_line[0].set_ylim(0, 1.08 * max(1.2, highest))
        axes_line[0].set_ylabel(f"time in times of {baseline}")
    subjects = dict.fromkeys(row.subject for row in rows)
    handles = [
        Line2D([], [], color=colour(subject), linewidth=5, label=subject) for subject in subjects
    ]
    handles += [
        Line2D([], [], color="0.3", marker=marks[d], linestyle="", label=f"{d} depth")
        for d in depths
    ]
    if any(row.target is not None for row in rows):
        handles.append(Line2D([], [], label="target: at or below this line", **TARGET))
    handles.append(Line2D([], [], color="0.6", linestyle=":", label=f"1 = the price of {baseline}"))
    figure.suptitle(title, fontsize=12)
    figure.legend(handles=handles, loc="lower center", ncols=min(len(handles), 7), fontsize=9,
                  frameon=False, bbox_to_anchor=(0.5, 0.02))  # fmt: skip
    figure.tight_layout(rect=(0, 0.09 if len(grid) == 1 else 0.06, 1, 1))
    return figure


def layers(rows: Sequence[Row]) -> Any:
    """Ordinary 3x3 layers."""
    return _prices(
        rows,
        "What SurfConv2d costs on 3x3 layers (float32; whiskers: quartiles; backward against"
        " nn.Conv2d's faster layout, gradient of depth included)",
    )


def channels(rows: Sequence[Row]) -> Any:
    """Few and odd channels, 1x1."""
    return _prices(rows, "What SurfConv2d costs with few or odd channels and with 1x1 kernels")


def grouped(rows: Sequence[Row]) -> Any:
    """Depthwise and grouped."""
    return _prices(rows, "What SurfConv2d costs on depthwise and grouped layers")


def pools(rows: Sequence[Row]) -> Any:
    """Pools."""
    return _prices(rows, "What pools cost whose window follows depth", "nn's pool")
