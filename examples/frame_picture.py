"""One picture that explains SurfConv: read it column by column, top to bottom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image

from frame_points import Footprint
from synthetic_scene import Frame

MARKS = ("#ff3b8d", "#ffd400", "#00e5ff")
HOLE = "#20242c"
HALO = [withStroke(linewidth=3, foreground="black")]
TITLE, TEXT, SMALL = 14, 12, 11
MARGIN, GAP = 0.25, 0.45
PATCH_PIXELS = 160


@dataclass(frozen=True)
class Explained:
    """What the picture shows: maps at the frame's size (NaN in holes), and each mode's squares."""

    frame: Frame
    reference_depth: float
    scale: NDArray[np.float32]
    level: NDArray[np.float32]
    edges: Sequence[float]
    centers: Sequence[float]
    names: Sequence[str]
    conv2d: Sequence[Footprint]
    continuous: Sequence[Footprint]
    levels: Sequence[Footprint]


def _number(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def _short(value: float) -> str:
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def _ticks(low: float, high: float) -> list[float]:
    """Round scales inside the range, few enough to be read."""
    coarse = [
        t for t in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 7, 10) if low <= t <= high
    ]
    fine = [float(t) for t in np.arange(0.1, 3.0, 0.1).round(1) if low <= t <= high]
    return coarse if len(coarse) >= 4 else fine


def _level_colors(count: int) -> ListedColormap:
    from matplotlib import colormaps

    return ListedColormap(colormaps["turbo"](np.linspace(0.92, 0.1, count)))


class _Page:
    """A figure laid out in inches from its top left corner."""

    def __init__(self, aspect: float) -> None:
        self.column = 4.1 if aspect < 2.5 else 6.2
        self.image = self.column / aspect
        self.patch = (self.column - 0.3) / 3
        self.width = 2 * MARGIN + 3 * self.column + 2 * GAP
        self.rows = [1.36, 3.06 + self.image, 3.6 + 2 * self.image]
        self.height = self.rows[2] + self.patch + 0.82
        self.figure = Figure(figsize=(self.width, self.height), facecolor="white")
        FigureCanvasAgg(self.figure)

    def left(self, column: int) -> float:
        return MARGIN + column * (self.column + GAP)

    def axes(self, x: float, y: float, width: float, height: float) -> Axes:
        box = (
            x / self.width,
            1 - (y + height) / self.height,
            width / self.width,
            height / self.height,
        )
        return self.figure.add_axes(box)

    def text(self, x: float, y: float, text: str, size: float, **style: object) -> None:
        options = {"ha": "left", "va": "top", "color": "black", **style}
        self.figure.text(x / self.width, 1 - y / self.height, text, fontsize=size, **options)


def _panel(page: _Page, column: int, row: int) -> Axes:
    axes = page.axes(page.left(column), page.rows[row], page.column, page.image)
    axes.set_xticks([])
    axes.set_yticks([])
    return axes


def _draw_squares(axes: Axes, squares: Sequence[Footprint], frame: Frame) -> None:
    height, width = frame.depth.shape
    axes.imshow(frame.rgb, interpolation="antialiased")
    for square, color in zip(squares, MARKS, strict=False):
        corner = (square.column - square.width / 2, square.row - square.width / 2)
        for line, shade in ((4.0, "black"), (2.2, color)):
            axes.add_patch(
                Rectangle(corner, square.width, square.width, fill=False, ec=shade, lw=line)
            )
        if square.width > 0.03 * width:
            taps = square.taps()
            axes.plot(
                taps[:, 1], taps[:, 0], "o", ms=3.4, mfc=color, mec="black", mew=0.7, clip_on=True
            )
        above = square.row - square.width / 2 - 0.012 * width
        fits = above > 0.05 * width
        axes.text(
            square.column,
            above if fits else square.row + square.width / 2 + 0.012 * width,
            f"{_number(square.meters(frame.focal))} m",
            color=color,
            fontsize=TEXT,
            fontweight="bold",
            ha="center",
            va="bottom" if fits else "top",
            path_effects=HALO,
        )
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)


def _cut(frame: Frame, square: Footprint) -> NDArray[np.uint8]:
    """What lies inside the square, resized to a fixed number of pixels; black outside the frame."""
    half = square.width / 2
    box = (square.column + 0.5 - half, square.row + 0.5 - half)
    step = square.width / PATCH_PIXELS
    coefficients = (step, 0.0, box[0], 0.0, step, box[1])
    size = (PATCH_PIXELS, PATCH_PIXELS)
    image = Image.fromarray(frame.rgb)
    return np.asarray(
        image.transform(size, Image.Transform.AFFINE, coefficients, Image.Resampling.BILINEAR)
    )


def _draw_patches(
    page: _Page,
    column: int,
    squares: Sequence[Footprint],
    names: Sequence[str],
    focal: float,
    frame: Frame,
) -> None:
    top = page.rows[2]
    for index, (square, name, color) in enumerate(zip(squares, names, MARKS, strict=False)):
        x = page.left(column) + index * (page.patch + 0.15)
        axes = page.axes(x, top, page.patch, page.patch)
        axes.imshow(_cut(frame, square), extent=(-1.5, 1.5, 1.5, -1.5))
        for cell in (-0.5, 0.5):
            axes.axhline(cell, color="white", lw=0.6, alpha=0.55)
            axes.axvline(cell, color="white", lw=0.6, alpha=0.55)
        grid = np.array([-1.0, 0.0, 1.0])
        axes.plot(np.tile(grid, 3), np.repeat(grid, 3), "o", ms=5, mfc=color, mec="black", mew=0.8)
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set(edgecolor=color, linewidth=3)
        middle, below = x + page.patch / 2, top + page.patch
        size = f"{_number(square.meters(focal))} m wide"
        page.text(middle, below + 0.09, size, TEXT, ha="center", fontweight="bold")
        where = f"{square.width:.0f} px, {name}"
        page.text(middle, below + 0.31, where, SMALL, ha="center", color="#444444")
        distance = f"{_number(square.depth)} m away"
        page.text(middle, below + 0.51, distance, SMALL, ha="center", color="#444444")


def _scale_map(page: _Page, shown: Explained, cmap: Colormap) -> None:
    axes = _panel(page, 1, 0)
    values = shown.scale[np.isfinite(shown.scale)]
    low, high = np.quantile(values, (0.01, 0.99))
    axes.set_facecolor(HOLE)
    picture = axes.imshow(shown.scale, cmap=cmap, norm=LogNorm(low, max(high, low * 1.01)))
    bar_axes = page.axes(page.left(1), page.rows[0] + page.image + 0.14, page.column, 0.16)
    bar = page.figure.colorbar(picture, cax=bar_axes, orientation="horizontal")
    ticks = _ticks(low, high)
    bar.set_ticks(ticks, labels=[f"{tick:g}x" for tick in ticks])
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL)
    bar.set_label("tap spacing, times nn.Conv2d's", fontsize=SMALL)


def _level_map(page: _Page, shown: Explained) -> None:
    axes = _panel(page, 2, 0)
    count = len(shown.centers)
    norm = BoundaryNorm(np.arange(count + 1) - 0.5, count)
    axes.set_facecolor(HOLE)
    picture = axes.imshow(
        shown.level, cmap=_level_colors(count), norm=norm, interpolation="nearest"
    )
    bar_axes = page.axes(page.left(2), page.rows[0] + page.image + 0.14, page.column, 0.16)
    bar = page.figure.colorbar(picture, cax=bar_axes, orientation="horizontal")
    if count <= 6:
        depths = shown.frame.depth[shown.frame.depth > 0]
        bounds = [depths.min(), *shown.edges, depths.max()]
        labels = [
            f"{_short(near)} - {_short(far)} m\n{shown.reference_depth / center:.2f}x"
            for near, far, center in zip(bounds[:-1], bounds[1:], shown.centers, strict=True)
        ]
        bar.set_ticks(range(count), labels=labels)
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL, length=0)
    bar.set_label("depths of the level, and its tap spacing", fontsize=SMALL)


def _spread(squares: Sequence[Footprint], focal: float) -> str:
    sizes = [square.meters(focal) for square in squares]
    low, high = _number(min(sizes)), _number(max(sizes))
    return f"{low} m everywhere" if low == high else f"{low} to {high} m"


def save_picture(shown: Explained, path: Path) -> None:
    """Draw the explanation and save it as an image file.

    Args:
        shown: the frame, its maps and the squares of each mode.
        path: where to write; the suffix chooses the format.
    """
    from matplotlib import colormaps

    frame, focal = shown.frame, shown.frame.focal
    height, width = frame.depth.shape
    page = _Page(width / height)
    page.text(
        MARGIN, 0.18, "SurfConv2d: a convolution that sees the same metres at every depth",
        TITLE + 6, fontweight="bold",
    )  # fmt: skip
    page.text(
        MARGIN, 0.58,
        "Things look smaller far away. nn.Conv2d ignores that; SurfConv2d spreads its taps by "
        f"scale = reference depth / depth, here {_number(shown.reference_depth)} m / depth.",
        TEXT + 1, color="#333333",
    )  # fmt: skip
    heads = ("The frame", "A scale for each pixel", "... or for each depth level")
    for column, head in enumerate(heads):
        page.text(page.left(column), page.rows[0] - 0.3, head, TITLE, fontweight="bold")
        if column > 0:
            right = page.left(column) + page.column
            page.text(right, page.rows[0] - 0.28, "■ no depth", SMALL, ha="right", color=HOLE)
    picture = _panel(page, 0, 0)
    picture.imshow(frame.rgb, interpolation="antialiased")
    page.text(
        page.left(0), page.rows[0] + page.image + 0.12,
        "Below: the square that one 3 x 3 layer sees\n"
        "around three pixels, and its nine taps (dots).\n"
        "Pixels without depth are normal: there\nSurfConv2d works just like nn.Conv2d.",
        TEXT, color="#333333", linespacing=1.3,
    )  # fmt: skip
    _scale_map(page, shown, colormaps["viridis"])
    _level_map(page, shown)
    modes = (
        ("nn.Conv2d", shown.conv2d, "same pixels"),
        ("SurfConv2d, continuous depth", shown.continuous, "same metres"),
        (f"SurfConv2d, {len(shown.centers)} depth levels", shown.levels, "about the same metres"),
    )
    for column, (name, squares, what) in enumerate(modes):
        top = page.rows[1]
        page.text(page.left(column), top - 0.56, name, TITLE, fontweight="bold")
        note = f"{what}: {_spread(squares, focal)}" if squares else what
        page.text(page.left(column), top - 0.28, note, TEXT, color="#333333")
        _draw_squares(_panel(page, column, 1), squares, frame)
        page.text(page.left(column), page.rows[2] - 0.29, "What the squares hold:", TEXT)
        _draw_patches(page, column, squares, shown.names, focal, frame)
    page.figure.savefig(path, dpi=120)
