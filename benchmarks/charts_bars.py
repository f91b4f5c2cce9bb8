"""Charts of one number a row: peers, memory, dtypes and the net."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib import pyplot
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from charts_price import OTHER_COLOUR, TARGET, colour, short_case
from rows import Row

#: Keeps numbers readable where a target's line crosses them.
BOX: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}
HATCH = {"forward": "", "backward": "//", "forward + backward": "//"}


def peers(rows: Sequence[Row]) -> Any:
    """How many times as long as SurfConv2d each peer takes."""
    rows = [row for row in rows if row.ratio is not None]
    labels = [
        ", ".join(
            (f"{row.subject}\n{row.case}", row.direction, row.dtype)[: 2 + (row.dtype != "float32")]
        )
        for row in rows
    ]
    figure, axes = pyplot.subplots(figsize=(10, 0.55 * len(rows) + 2.2))
    for place, row in enumerate(rows):
        assert row.ratio is not None
        axes.barh(
            place, row.ratio, color=OTHER_COLOUR, alpha=0.85, hatch=HATCH[row.direction],
            edgecolor="white", height=0.7,
        )  # fmt: skip
        axes.text(row.ratio * 1.05, place, f"{row.ratio:.1f}x", va="center", fontsize=9, bbox=BOX,
                  zorder=3)  # fmt: skip
        if row.target is not None:
            axes.plot([row.target] * 2, [place - 0.42, place + 0.42], **TARGET)
    axes.axvline(1, color="0.6", linewidth=1, linestyle=":")
    axes.set_yticks(range(len(rows)), labels, fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlim(0.5, 3 * max(row.ratio or 1 for row in rows))
    axes.set_xlabel("time in times of SurfConv2d's (logarithmic; 1 = as fast as SurfConv2d)")
    axes.set_title("How much longer the alternatives take than SurfConv2d", fontsize=12)
    handles: list[Any] = []
    if any(row.target is not None for row in rows):
        handles.append(Line2D([], [], label="target: the bar reaches this line", **TARGET))
    handles += [
        Patch(facecolor=OTHER_COLOUR, edgecolor="white", hatch=HATCH[direction], label=direction)
        for direction in dict.fromkeys(row.direction for row in rows)
    ]
    figure.legend(handles=handles, loc="lower left", fontsize=8, frameon=False, ncols=3)
    figure.tight_layout(rect=(0, 0.35 / figure.get_figheight(), 1, 1))
    return figure


def _grouped_bars(
    axes: Any, rows: Sequence[Row], groups: Sequence[str], names: Sequence[str], name_of: Any
) -> None:
    """Bars of ratios, grouped by case and layout."""
    width = 0.8 / len(names)
    for row, group in zip(rows, groups, strict=True):
        places = list(dict.fromkeys(groups))
        if row.ratio is None:
            continue
        shift = (names.index(name_of(row)) + 0.5) * width - 0.4
        place = places.index(group) + shift
        axes.bar(place, row.ratio, width * 0.92, color=colour(row.subject))
        axes.text(place, row.ratio, f"{row.ratio:.2f}", ha="center", va="bottom", fontsize=6.5,
                  bbox=BOX, zorder=3)  # fmt: skip
    axes.set_xticks(range(len(set(groups))), list(dict.fromkeys(groups)), fontsize=7.5)
    axes.grid(axis="y", color="0.92")
    axes.set_axisbelow(True)


def memory(rows: Sequence[Row]) -> Any:
    """Peak extra memory in times of nn.Conv2d's."""
    rows = [row for row in rows if row.subject != "nn.Conv2d" and row.ratio is not None]
    directions = list(dict.fromkeys(row.direction for row in rows))
    names = list(dict.fromkeys(row.subject for row in rows))
    figure, panels = pyplot.subplots(
        len(directions), 1, figsize=(11, 3.3 * len(directions) + 1.2), squeeze=False, sharex=True
    )
    for axes, direction in zip(panels[:, 0], directions, strict=True):
        own = [row for row in rows if row.direction == direction]
        groups = [f"{short_case(row.case)}\n{row.layout}" for row in own]
        _grouped_bars(axes, own, groups, names, lambda row: row.subject)
        limit = next((row.target for row in own if row.target is not None), None)
        if limit is not None:
            axes.axhline(limit, **TARGET)
        axes.set_title(direction, fontsize=10)
        axes.set_ylabel("peak extra memory in\ntimes of nn.Conv2d's", fontsize=9)
        axes.set_ylim(0, 1.15 * max(limit or 1, *(row.ratio or 0 for row in own)))
    handles: list[Any] = [Patch(color=colour(name), label=name) for name in names]
    handles.append(Line2D([], [], label="target: at or below this line", **TARGET))
    figure.suptitle("Peak extra memory of one call, in times of nn.Conv2d's", fontsize=12)
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8,
                  frameon=False, bbox_to_anchor=(0.5, 0.02))  # fmt: skip
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    return figure


def dtypes(rows: Sequence[Row]) -> Any:
    """Time of each dtype in times of the same module's float32."""
    rows = [row for row in rows if row.dtype != "float32"]
    names = list(dict.fromkeys(row.subject for row in rows))
    figure, axes = pyplot.subplots(figsize=(11, 5))
    groups = [f"{short_case(row.case)}\n{row.direction}\n{row.dtype}" for row in rows]
    _grouped_bars(axes, rows, groups, names, lambda row: row.subject)
    limit = next((row.target for row in rows if row.target is not None), None)
    if limit is not None:
        axes.axhline(limit, **TARGET)
    axes.axhline(1, color="0.6", linewidth=1, linestyle=":")
    ratios = [row.ratio or 1 for row in rows]
    axes.set_yscale("log")
    axes.set_ylim(0.7 * min(1, *ratios), 2 * max(ratios))
    axes.set_ylabel("time in times of the module's own float32 (logarithmic)")
    axes.set_title("What half-precision costs: SurfConv2d and nn.Conv2d", fontsize=12)
    handles: list[Any] = [Patch(color=colour(name), label=name) for name in names]
    handles.append(Line2D([], [], label="target for SurfConv2d: at or below", **TARGET))
    axes.legend(handles=handles, fontsize=8)
    figure.tight_layout(rect=(0, 0.02, 1, 1))
    return figure


def net(rows: Sequence[Row]) -> Any:
    """Milliseconds of the paper's net."""
    directions = list(dict.fromkeys(row.direction for row in rows))
    threads = sorted({row.threads for row in rows})
    figure, panels = pyplot.subplots(
        len(threads), len(directions), figsize=(7 * len(directions), 2.6 * len(threads) + 1.3),
        squeeze=False,
    )  # fmt: skip
    for line, count in zip(panels, threads, strict=True):
        for axes, direction in zip(line, directions, strict=True):
            own = [row for row in rows if (row.threads, row.direction) == (count, direction)]
            base = own[0].value
            for place, row in enumerate(own):
                axes.barh(place, row.value, color=colour(row.subject), height=0.7)
                told = f" {row.value:.1f} ms" + (f" = {row.ratio:.2f}x" if place else "")
                axes.text(row.value, place, told, va="center", fontsize=9, bbox=BOX, zorder=3)
                if row.target is not None:
                    axes.plot([row.target * base] * 2, [place - 0.42, place + 0.42], **TARGET)
            axes.set_yticks(
                range(len(own)), [row.subject.replace(", ", ",\n") for row in own], fontsize=8
            )
            axes.invert_yaxis()
            axes.set_xlim(0, 1.35 * max(row.value for row in own))
            axes.set_xlabel("milliseconds a frame")
            axes.set_title(f"{direction}, {count} thread{'s' if count > 1 else ''}", fontsize=10)
    figure.suptitle(f"The paper's net on a frame of {rows[0].case}", fontsize=12)
    handles = [Line2D([], [], label="target: the bar ends at or before this line", **TARGET)]
    figure.legend(handles=handles, loc="lower left", fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    return figure
