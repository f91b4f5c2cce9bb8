"""Charts of growth: with levels, pixels, channels, batch and threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from matplotlib import pyplot
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

from charts_price import OTHER_COLOUR, TARGET, colour, short_case
from rows import Row

STYLES: dict[str, Any] = {"forward": "-", "backward": "--"}


def levels(rows: Sequence[Row]) -> Any:
    """Time against the number of levels, in times of one level's."""
    rows = [row for row in rows if row.table == "cost of N levels"]
    figure, axes = pyplot.subplots(figsize=(9, 5))
    colours = ("#0072B2", "#E69F00", OTHER_COLOUR, "#D55E00")
    series = list(dict.fromkeys((row.case, row.direction) for row in rows))
    counts = sorted({int(row.subject.split()[0]) for row in rows if row.subject[0].isdigit()})
    for number, (case, direction) in enumerate(series):
        own = [row for row in rows if (row.case, row.direction) == (case, direction)]
        numbered = [row for row in own if row.subject[0].isdigit()]
        shade = colours[number % len(colours)]
        axes.errorbar(
            [counts.index(int(row.subject.split()[0])) for row in numbered],
            [row.ratio or 0 for row in numbered],
            yerr=_whiskers(numbered),
            color=shade,
            marker="o",
            capsize=3,
            linestyle=STYLES[direction],
            label=f"{case}, {direction}",
        )
        free = [row.ratio or 0 for row in own if row.subject == "continuous"]
        axes.plot([len(counts)] * len(free), free, marker="D", color=shade, linestyle="")
    axes.set_xticks(range(len(counts) + 1), [*map(str, counts), "continuous"])
    axes.axhline(1, color="0.6", linewidth=1, linestyle=":")
    axes.set_ylim(0, max(1.4, axes.get_ylim()[1]))
    axes.set_xlabel("number of depth levels")
    axes.set_ylabel("time in times of SurfConv2d with 1 level")
    axes.set_title("What more depth levels cost (whiskers: quartiles)", fontsize=12)
    axes.legend(fontsize=8, loc="lower left")
    axes.grid(axis="y", color="0.92")
    figure.tight_layout(rect=(0, 0.02, 1, 1))
    return figure


def _whiskers(rows: Sequence[Row]) -> list[list[float]]:
    low = [max(0.0, (row.ratio or 0) - (row.ratio_low or 0)) for row in rows]
    high = [max(0.0, (row.ratio_high or 0) - (row.ratio or 0)) for row in rows]
    return [low, high]


def _lines(
    axes: Any, rows: Sequence[Row], x: Callable[[Row], float], y: Callable[[Row], float]
) -> None:
    for subject in dict.fromkeys(row.subject for row in rows):
        for direction, style in STYLES.items():
            own = [row for row in rows if (row.subject, row.direction) == (subject, direction)]
            axes.plot(
                [x(row) for row in own],
                [y(row) for row in own],
                color=colour(subject),
                linestyle=style,
                marker="o",
                markersize=4,
            )
    ticks = sorted({x(row) for row in rows})
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.ticklabel_format(axis="x", style="plain")
    axes.tick_params(axis="x", labelsize=8)
    axes.set_ylim(0, 1.1 * max(y(row) for row in rows))
    axes.grid(color="0.92")


def _channels(row: Row) -> float:
    return float(row.case.split("x")[1])


def _batch(row: Row) -> float:
    return float(row.case.split()[1].split("x")[0])


def _speedup(axes: Any, rows: Sequence[Row]) -> None:
    """How many times faster than with one thread, layer by layer."""
    rows = [row for row in rows if row.threads > 1]
    if not rows:
        axes.set_visible(False)
        return
    most = max(row.threads for row in rows)
    rows = [row for row in rows if row.threads == most]
    places = list(dict.fromkeys((row.case, row.direction) for row in rows))
    subjects = list(dict.fromkeys(row.subject for row in rows))
    width = 0.8 / len(subjects)
    for row in rows:
        shift = (subjects.index(row.subject) + 0.5) * width - 0.4
        place = places.index((row.case, row.direction)) + shift
        axes.bar(place, row.ratio or 0, 0.9 * width, color=colour(row.subject))
    limit = next((row.target for row in rows if row.target is not None), None)
    if limit is not None:
        axes.axhline(limit, label="target for SurfConv2d: at or above", **TARGET)
        axes.legend(fontsize=8, loc="upper right", frameon=False)
    names = [f"{short_case(case).splitlines()[0]}\n{'fwd' if d == 'forward' else 'bwd'}"
             for case, d in places]  # fmt: skip
    axes.set_xticks(range(len(places)), names, fontsize=8)
    axes.set_ylim(0, 1.25 * max(most, *(row.ratio or 0 for row in rows)))
    axes.set_ylabel("speed-up over 1 thread")
    axes.set_title(f"{most} threads, layers of the price table", fontsize=10)


def scaling(rows: Sequence[Row]) -> Any:
    """Four panels: pixels, channels, batch, threads."""
    figure, panels = pyplot.subplots(2, 2, figsize=(12, 8.6))
    by_table = {name: [row for row in rows if row.table == name]
                for name in dict.fromkeys(row.table for row in rows)}  # fmt: skip
    pixels, channels, batch = (by_table[name] for name in ("pixels", "channels", "batch"))
    _lines(panels[0, 0], pixels, lambda row: row.pixels, lambda row: 1e6 * row.value / row.pixels)
    panels[0, 0].set_xlabel("pixels of the frame (64 to 64 channels)")
    panels[0, 0].set_ylabel("nanoseconds a pixel")
    panels[0, 0].set_title("bigger frames: flat means cost in proportion to pixels", fontsize=10)
    _lines(panels[0, 1], channels, _channels, lambda row: 1e9 * row.value / row.macs)
    size = "x".join(channels[0].case.split(" ->")[0].split("x")[-2:])
    panels[0, 1].set_xlabel(f"channels in and out (frame {size})")
    panels[0, 1].set_yscale("log")
    panels[0, 1].autoscale(axis="y")
    panels[0, 1].set_ylabel("nanoseconds per 1000 multiplications\n(logarithmic)")
    panels[0, 1].set_title("more channels: falling means better use of the processor", fontsize=10)
    _lines(panels[1, 0], batch, _batch, lambda row: row.value / _batch(row))
    panels[1, 0].set_xlabel("images in the batch (64 to 64 channels)")
    panels[1, 0].set_ylabel("milliseconds an image")
    panels[1, 0].set_title("bigger batches: flat means cost in proportion to images", fontsize=10)
    _speedup(panels[1, 1], by_table.get("threads", []))
    subjects = dict.fromkeys(row.subject for row in rows)
    handles = [Line2D([], [], color=colour(s), linewidth=5, label=s) for s in subjects]
    handles += [Line2D([], [], color="0.3", linestyle=style, label=direction)
                for direction, style in STYLES.items()]  # fmt: skip
    figure.suptitle("How the cost of a 3x3 layer grows", fontsize=12)
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False,
                  fontsize=9, bbox_to_anchor=(0.5, 0.012))  # fmt: skip
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    return figure
