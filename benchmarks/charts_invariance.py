"""The chart of the invariance suite: views, maps of one filter on the surface, and the figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from matplotlib import pyplot
from matplotlib.lines import Line2D

from charts_price import TARGET, colour
from features import Net, convert, features, read
from rows import Row
from scene import View
from suites import invariance
from suites.invariance import (
    BOXES,
    CHANGE,
    DISTANCES,
    LIMIT,
    OCTAVES,
    SIZE,
    WINDOW,
    Case,
    options_of,
    view_of,
)

#: Views are drawn finer than they are measured.
DRAWN_SIZE = 5 * SIZE // 4
DRAWN = {"nn.Conv2d": invariance.BASELINE, "4 levels": invariance.LEVELS,
         "continuous": invariance.CONTINUOUS}  # fmt: skip
FILTER = Net("3x3, zero-sum filters", zero_sum=True)
#: Without the octaves that no view from 4x can hold; what becomes of them is in the graphs.
DRAWN_OCTAVES = OCTAVES[:4]
#: The eye finds the boxes by these tints (front, left, right, top, bottom); no layer sees them.
WALL_TINT = (0.62, 0.64, 0.68)
FRONT_TINTS = ((0.86, 0.62, 0.42), (0.52, 0.72, 0.56), (0.55, 0.66, 0.86), (0.84, 0.76, 0.46))
SIDE_SHADES = (1.0, 0.6, 0.6, 0.75, 0.5)
MAPS: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -2.5, "vmax": 2.5}
UNRELATED = 2**0.5
#: Tops of the graphs: most of them, and those of small changes.
TALL, LOW = 1.75, 0.75
SHORT = {"wavelength ": "", " taps": "", "at ": "", ", zero-sum filters": "\nzero sum",
         ", stride": "\nstride", "three layers ": "3 layers\n"}  # fmt: skip
STYLES: dict[str, Any] = {LIMIT: {"color": "black", "linestyle": ":", "marker": ""},
                          WINDOW: {"linestyle": "--"}}  # fmt: skip


def aligned(values: torch.Tensor, view: View, near: View) -> torch.Tensor:
    """A map (H, W) of a view brought to the pixels of the nearest view; NaN where it sees none."""
    points = near.points()
    at = view.camera.project(points)
    nearest = at.round().long()
    size = view.camera.size
    inside = ((nearest >= 0) & (nearest < size)).all(1)
    place = nearest.clamp(0, size - 1)
    same = view.facet[place[:, 1], place[:, 0]] == near.facet.flatten()
    found = read(values[None], at)[0]
    return torch.where(inside & same, found, torch.nan).reshape(near.facet.shape)


def maps_of(subject: str, case: Case, views: Sequence[View]) -> list[torch.Tensor]:
    """One filter's map in every view, on the nearest view's pixels, in its standard deviations."""
    convs: Any = case.net.convolutions(0)
    if subject != invariance.BASELINE:
        convs = convert(convs, **options_of(subject, case, views[0].camera.focal, 0.25))
    maps = [aligned(features(convs, view)[0], view, views[0]) for view in views]
    middle, spread = maps[0].mean(), maps[0].std()
    return [(each - middle) / spread for each in maps]


def _picture(axes: Any, image: torch.Tensor, title: str, **options: Any) -> None:
    axes.imshow(image.numpy(), interpolation="nearest", **options)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(title, fontsize=10)


def tinted(view: View) -> torch.Tensor:
    """A view in grey, each face tinted."""
    tints = [WALL_TINT]
    tints += [tuple(s * c for c in tint) for tint in FRONT_TINTS for s in SIDE_SHADES]
    base = torch.tensor(tints)[view.facet]
    return (base * (1 + 0.3 * view.image.mean(0)[..., None])).clamp(0, 1)


def _views(panels: Any, views: Sequence[View]) -> None:
    """What the camera sees, with the nearest view's frame in the others, and what all this is."""
    size = views[0].camera.size
    for axes, view, times in zip(panels, views, DISTANCES, strict=False):
        metres = times * invariance.DISTANCE
        _picture(axes, tinted(view), f"the scene from {metres:g} m ({times}x)")
        corners = torch.tensor(((0.0, 0.0), (1, 0), (1, 1), (0, 1), (0, 0))) * (size - 1)
        rays = views[0].camera.rays(corners.double()) * float(views[0].depth.max())
        frame = view.camera.project(rays).T.numpy()
        if times > 1:
            axes.plot(*frame, color="white", linewidth=3)
            axes.plot(*frame, color="black", linewidth=1.2)
    panels[3].axis("off")
    panels[3].text(
        0.0,
        1.0,
        "The camera moves back from boxes\nbefore a wall (tinted for the eye only).\n"
        "Black frame: what it saw from 2 m.\n\n"
        "Below: one filter of a 3x3 layer with\nrandom weights, the same in every map;\n"
        "reference depth 4 m. Each map is put\nback onto the pixels of the view from\n"
        "2 m, so that every point of the surface\nkeeps its place: a layer that allows for\n"
        "distance shows the same map three\ntimes. Grey: hidden from there.\n\n"
        "This texture has no detail finer than\na pixel from 8 m; the graphs show\n"
        "what becomes of such detail.",
        va="top",
        fontsize=8.5,
        transform=panels[3].transAxes,
    )


def _maps(panels: Any, name: str, maps: Sequence[torch.Tensor]) -> None:
    for axes in panels:
        axes.set_facecolor("0.6")
    for axes, values, times in zip(panels, maps, DISTANCES, strict=False):
        _picture(axes, values, f"{name}, from {times}x", **MAPS)
    moved = (maps[-1] - maps[0]).abs()
    middle = moved[moved.isfinite()].median()
    title = f"|from 4x - from 1x|, median {middle:.2f}"
    _picture(panels[3], moved, title, cmap="magma", vmin=0, vmax=2.5)


def _lines(
    axes: Any, rows: Sequence[Row], places: Sequence[str], place_of: Callable[[Row], str]
) -> None:
    """A line a subject over named places, with quartiles."""
    subjects = list(dict.fromkeys(row.subject for row in rows))
    for number, subject in enumerate(subjects):
        own = [row for row in rows if row.subject == subject]
        shift = 0.05 * (number - (len(subjects) - 1) / 2)
        style = {"color": colour(subject), "marker": "o", "markersize": 4, "linewidth": 1.5}
        axes.errorbar(
            [places.index(place_of(row)) + shift for row in own],
            [row.value for row in own],
            yerr=[[row.value - row.low for row in own], [row.high - row.value for row in own]],
            elinewidth=0.8,
            **{**style, **STYLES.get(subject, {})},
        )
    axes.axhline(UNRELATED, color="0.6", linewidth=1, linestyle="--")
    axes.set_xticks(range(len(places)), places, fontsize=8)
    axes.set_xlim(-0.4, len(places) - 0.6)
    most = max(row.high for row in rows)
    axes.set_ylim(0, TALL if most > LOW else LOW)
    axes.grid(axis="y", color="0.92")
    axes.set_axisbelow(True)


def _scenes(panels: Any, rows: Sequence[Row]) -> None:
    distances = [f"{times}x" for times in DISTANCES]
    for axes, case in zip(panels, dict.fromkeys(row.case for row in rows), strict=False):
        own = [row for row in rows if row.case == case]
        nearest = {"depth": distances[0], "value": 0.0, "low": 0.0, "high": 0.0}
        zeros = [replace(row, **nearest) for row in {row.subject: row for row in own}.values()]
        _lines(axes, [*zeros, *own], distances, lambda row: row.depth)
        _targets(axes, own, distances, lambda row: row.depth)
        axes.set_title(case.replace(", ", "\n"), fontsize=10)
        axes.set_xlabel("distance", fontsize=9)


def _targets(
    axes: Any, rows: Sequence[Row], places: Sequence[str], place_of: Callable[[Row], str]
) -> None:
    """A bar at the target's share of nn.Conv2d's change."""
    base = {place_of(row): row.value for row in rows if row.subject == invariance.BASELINE}
    for row in rows:
        if row.target is not None:
            place, height = places.index(place_of(row)), row.target * base[place_of(row)]
            axes.plot([place - 0.3, place + 0.3], [height] * 2, **TARGET)


def _short(case: str) -> str:
    for long, short in SHORT.items():
        case = case.replace(long, short)
    return case


def _topics(panels: Any, by_topic: dict[str, list[Row]]) -> None:
    drawings = (
        ("texture", "2x", "by texture, from 2x\n(a wall with one wavelength)",
         "wavelength in tap spacings"),
        ("texture", "4x", "by texture, from 4x\n(a wall with one wavelength)",
         "wavelength in tap spacings"),
        ("reference depth", "4x", "by reference depth, from 4x\n(all octaves)",
         "reference depth, in nearest distances"),
        ("layers", "4x", "by layer, from 4x\n(all octaves)", ""),
    )  # fmt: skip
    for axes, (topic, distance, title, label) in zip(panels, drawings, strict=True):
        own = [row for row in by_topic.get(topic, []) if row.depth == distance]
        if not own:
            axes.axis("off")
            continue
        places = list(dict.fromkeys(_short(row.case) for row in own))
        _lines(axes, own, places, lambda row: _short(row.case))
        _targets(axes, own, places, lambda row: _short(row.case))
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(label, fontsize=9)


def invariance_chart(rows: Sequence[Row]) -> Any:
    """Views and maps above, changes below."""
    by_topic: dict[str, list[Row]] = {}
    for row in rows:
        if row.unit == CHANGE:
            by_topic.setdefault(row.table.split(":")[0], []).append(row)
    figure = pyplot.figure(figsize=(12, 21))
    pictures = figure.add_gridspec(4, 4, left=0.03, right=0.985, top=0.961, bottom=0.458,
                                   hspace=0.13, wspace=0.05)  # fmt: skip
    charts = figure.add_gridspec(3, 4, left=0.07, right=0.985, top=0.42, bottom=0.065,
                                 hspace=0.47, wspace=0.2)  # fmt: skip
    case = Case("", BOXES, BOXES, DRAWN_OCTAVES, FILTER)
    seen = partial(view_of, BOXES, DRAWN_OCTAVES, DRAWN_SIZE)
    views = [seen(times) for times in DISTANCES]
    panels = [[figure.add_subplot(pictures[y, x]) for x in range(4)] for y in range(4)]
    _views(panels[0], views)
    for line, (name, subject) in zip(panels[1:], DRAWN.items(), strict=True):
        _maps(line, name, maps_of(subject, case, views))
    graphs = [[figure.add_subplot(charts[y, x]) for x in range(4)] for y in range(3)]
    _scenes([*graphs[0], *graphs[1]], by_topic.get("scenes", []))
    _topics(graphs[2], by_topic)
    for line in graphs:
        line[0].set_ylabel("change of a feature, in its\nstandard deviations over the surface")
    subjects = list(dict.fromkeys(row.subject for own in by_topic.values() for row in own))
    handles = [
        Line2D([], [], **{"color": colour(s), "linewidth": 2.5, "label": s, **STYLES.get(s, {})})
        for s in subjects
    ]
    handles.append(Line2D([], [], color="0.6", linestyle="--", label="unrelated features"))
    handles.append(Line2D([], [], label="target for continuous: at or below", **TARGET))
    figure.legend(handles=handles, loc="lower center", ncols=4, fontsize=9, frameon=False,
                  bbox_to_anchor=(0.5, 0.01))  # fmt: skip
    figure.suptitle("How features change when the same surfaces are seen from farther away "
                    "(untrained layers; 0 = not at all)", fontsize=13, y=0.987)  # fmt: skip
    return figure
