"""Charts of the device suites: everything on a layer in times of nn.Conv2d, with the targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib import pyplot
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from candidates import BASELINE, CONTINUOUS, LEVELS, SAME_LEVEL
from charts_bars import BOX
from charts_price import TARGET
from document_device import series_name
from peers import DEFORM, DEFORM_ALONE, PYRAMID, REFERENCE
from rows import Row
from suites.series import FIXED_DEPTH

#: Marker and colour (Okabe and Ito) by series; SurfConv2d's are filled, the others' hollow.
STYLES = {
    CONTINUOUS: ("o", "#0072B2"),
    f"{CONTINUOUS}, random depth": ("^", "#0072B2"),
    FIXED_DEPTH: ("v", "#56B4E9"),
    LEVELS: ("s", "#E69F00"),
    SAME_LEVEL: ("D", "#D55E00"),
    DEFORM: ("o", "#009E73"),
    DEFORM_ALONE: ("^", "#009E73"),
    REFERENCE: ("s", "0.45"),
    PYRAMID: ("D", "#CC79A7"),
}
PEERS = (DEFORM, DEFORM_ALONE, REFERENCE, PYRAMID)
#: The least that deform_conv2d is to take: it has to lie above.
LEAD: dict[str, Any] = {"color": STYLES[DEFORM][1], "linewidth": 2.2, "linestyle": (0, (2, 1))}
#: What numerics are called above their panels.
TITLES = {"float32": "float32 (no tensor cores)", "tf32": "float32 in tf32"}


def _label(case: str) -> str:
    """A layer's size on two lines."""
    size, _, outputs = case.split(", ")[0].split(" ", 1)[1].partition(" -> ")
    return f"{size}\nto {outputs}"


def _marker(name: str) -> dict[str, Any]:
    marker, colour = STYLES[name]
    face = "white" if name in PEERS else colour
    return {"marker": marker, "color": colour, "markerfacecolor": face, "linestyle": ""}


def _panel(axes: Any, rows: Sequence[Row], cases: Sequence[str], names: Sequence[str]) -> None:
    """Values in times of nn.Conv2d's; SurfConv2d's first mode with its number, red beyond it."""
    base = {row.case: row.value for row in rows if row.subject == BASELINE}
    ours = {row.case: row.value for row in rows if series_name(row) == CONTINUOUS}
    for row in rows:
        name = series_name(row)
        if name not in names or base.get(row.case, 0) <= 0:
            continue
        place = cases.index(row.case)
        at = place + 0.8 * ((names.index(name) + 0.5) / len(names) - 0.5)
        ratio = row.value / base[row.case]
        axes.plot(at, ratio, markersize=6.5, markeredgewidth=1.5, zorder=3, **_marker(name))
        ends = [place - 0.42, place + 0.42]
        if name == CONTINUOUS:
            colour = "#B00020" if row.verdict == "missed" else "black"
            axes.annotate(f"{ratio:.2f}", (at, ratio), (0, -12), textcoords="offset points",
                          ha="center", fontsize=8, color=colour, bbox=BOX, zorder=4)  # fmt: skip
            if row.target is not None:
                axes.plot(ends, [row.target] * 2, **TARGET)
        elif name == DEFORM and row.target is not None and row.case in ours:
            axes.plot(ends, [row.target * ours[row.case] / base[row.case]] * 2, **LEAD)
    axes.axhline(1, color="0.6", linewidth=1, linestyle=":")
    axes.set_xticks(range(len(cases)), [_label(case) for case in cases], fontsize=7.5)
    axes.set_xlim(-0.6, len(cases) - 0.4)
    axes.grid(axis="y", which="both", color="0.93")
    axes.set_axisbelow(True)


def _panels(rows: Sequence[Row], title: str, unit: str, target: str) -> Any:
    """Directions below each other, numerics beside each other, one scale for all."""
    directions = list(dict.fromkeys(row.direction for row in rows))
    numerics = list(dict.fromkeys(row.dtype for row in rows))
    cases = list(dict.fromkeys(row.case for row in rows))
    present = {series_name(row) for row in rows}
    names = [name for name in STYLES if name in present]
    width = max(11.0, (1.05 * len(cases) + 0.6) * len(numerics))
    figure, panels = pyplot.subplots(
        len(directions),
        len(numerics),
        figsize=(width, 4.0 * len(directions) + 1.5),
        squeeze=False,
        sharey="row",
    )
    for line, direction in zip(panels, directions, strict=True):
        for axes, name in zip(line, numerics, strict=True):
            own = [row for row in rows if (row.direction, row.dtype) == (direction, name)]
            axes.set_yscale("log")
            _panel(axes, own, cases, names)
            axes.set_title(f"{direction}, {TITLES.get(name, name)}", fontsize=10)
            axes.yaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        low, high = line[0].get_ylim()
        line[0].set_ylim(min(0.7, 0.85 * low), 1.15 * high)
        line[0].set_ylabel(f"{unit} in times of nn.Conv2d's\n(logarithmic; lower is better)")
    handles = [Line2D([], [], label=name, **_marker(name)) for name in names]
    handles.append(Line2D([], [], color="0.6", linestyle=":", label="1 = nn.Conv2d (cuDNN)"))
    handles.append(Line2D([], [], label=target, **TARGET))
    if any(row.subject == DEFORM and row.target is not None for row in rows):
        told = "target: deform_conv2d (green circle) lies above this line"
        handles.append(Line2D([], [], label=told, **LEAD))
    figure.suptitle(title, fontsize=12)
    columns = 4
    lines = -(-len(handles) // columns)
    figure.legend(handles=handles, loc="lower center", ncols=columns, fontsize=8.5, frameon=False,
                  bbox_to_anchor=(0.5, 0.02))  # fmt: skip
    figure.tight_layout(rect=(0, (0.35 + 0.22 * lines) / figure.get_figheight(), 1, 1))
    return figure


def _shown(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if series_name(row) in (BASELINE, *STYLES)]


def layers(rows: Sequence[Row]) -> Any:
    """Time of everything on each layer."""
    return _panels(
        _shown(rows),
        "What a 3x3 layer takes on the GPU: SurfConv2d (filled; its number below it, red where it"
        " missed its target) and alternatives (hollow)",
        "time",
        "target: SurfConv2d (filled) lies at or below this line",
    )


def memory(rows: Sequence[Row]) -> Any:
    """Peak memory of everything on each layer."""
    return _panels(
        _shown(rows),
        "Peak device memory of one call: SurfConv2d (filled; its number below it, red where it"
        " missed its target) and alternatives (hollow)",
        "peak memory",
        "target: SurfConv2d (filled) lies at or below this line",
    )


def net(rows: Sequence[Row]) -> Any:
    """Milliseconds of the paper's net, one panel a batch and direction, bars by numerics."""
    rows = [row for row in rows if row.unit == "ms"]
    cases = list(dict.fromkeys(row.case for row in rows))
    directions = list(dict.fromkeys(row.direction for row in rows))
    numerics = list(dict.fromkeys(row.dtype for row in rows))
    subjects = list(dict.fromkeys(row.subject for row in rows))
    figure, panels = pyplot.subplots(
        len(cases), len(directions), squeeze=False,
        figsize=(7 * len(directions), (0.95 * len(numerics) + 1.3) * len(cases) + 1.2),
    )  # fmt: skip
    colours = {
        BASELINE: "0.55",
        **{name: STYLES[name][1] for name in (CONTINUOUS, LEVELS, PYRAMID)},
    }
    height = 0.84 / len(subjects)
    for line, case in zip(panels, cases, strict=True):
        for axes, direction in zip(line, directions, strict=True):
            own = [row for row in rows if (row.case, row.direction) == (case, direction)]
            base = {row.dtype: row.value for row in own if row.subject == BASELINE}
            for row in own:
                shift = (subjects.index(row.subject) + 0.5) * height - 0.42
                place = numerics.index(row.dtype) + shift
                axes.barh(place, row.value, 0.9 * height, color=colours[row.subject])
                told = f" {row.value:.2f} ms" + (f" = {row.ratio:.2f}x" if row.ratio else "")
                limit = 0.0
                if row.target is not None:
                    limit = row.target * base[row.dtype]
                    edges = [place - height / 2, place + height / 2]
                    axes.plot([limit] * 2, edges, zorder=4, **TARGET)
                end = max(row.value, limit)
                axes.text(end, place, told, va="center", fontsize=8)
            axes.set_yticks(range(len(numerics)), [TITLES.get(n, n) for n in numerics], fontsize=8)
            axes.invert_yaxis()
            axes.set_xlim(0, 1.35 * max(row.value for row in own))
            axes.set_xlabel("milliseconds a call")
            axes.set_title(f"{direction}, {case.split(',')[0]}", fontsize=10)
    handles: list[Any] = [
        Line2D([], [], color=colours[name], linewidth=6, label=name) for name in subjects
    ]
    handles.append(Line2D([], [], label="target: the bar ends at or before it", **TARGET))
    figure.suptitle("The paper's net on the GPU (x: times of nn.Conv2d)", fontsize=12)
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8.5,
                  frameon=False, bbox_to_anchor=(0.5, 0.02))  # fmt: skip
    figure.tight_layout(rect=(0, 0.6 / figure.get_figheight(), 1, 1))
    return figure
