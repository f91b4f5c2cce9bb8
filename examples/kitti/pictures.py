"""A page of pictures: each frame beside its labels, what a net made of it, and where it errs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

#: name, colours (H, W, 3) uint8, labels (H, W), prediction (H, W), depth (H, W) in metres
FramePictures = tuple[str, ArrayLike, ArrayLike, ArrayLike, ArrayLike]

WRONG, IGNORED = (215, 25, 28), (128, 128, 128)
COLUMNS = ("frame", "labels", "prediction", "error")
MARGIN, GAP, HEAD, NAME, LEGEND_ROW = 0.2, 0.12, 0.62, 0.3, 0.27
LEGEND_COLUMNS = 7


def error_picture(
    rgb: NDArray[np.uint8], label: NDArray[np.int64], prediction: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """Wrong pixels in red, ignored ones in grey, right ones as a pale picture of the frame.

    Args:
        rgb: (H, W, 3) colours.
        label: (H, W) class ids, 0 where a pixel is ignored.
        prediction: (H, W) class ids.

    Returns:
        (H, W, 3) RGB.
    """
    grey = rgb.mean(axis=2, keepdims=True) * (55 / 255)
    shown: NDArray[np.uint8] = (200 + grey.repeat(3, axis=2)).round().astype(np.uint8)
    shown[label != prediction] = WRONG
    shown[label == 0] = IGNORED
    return shown


def _class_picture(
    classes: NDArray[np.int64], palette: NDArray[np.uint8], faded: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    shown = palette[classes].astype(np.float64)
    shown[faded] *= 0.35
    return shown.round().astype(np.uint8)


def _fraction(colour: Iterable[int]) -> tuple[float, float, float]:
    red, green, blue = (float(part) / 255 for part in colour)
    return red, green, blue


def _shares(
    label: NDArray[np.int64], prediction: NDArray[np.int64], depth: NDArray[np.float64]
) -> str:
    counted = label != 0
    if not counted.any():
        return "no labelled pixel"
    wrong = (label != prediction) & counted
    text = f"{100 * wrong.sum() / counted.sum():.1f} % of labelled pixels wrong"
    # A pixel shows a surface of (z / f)^2 square metres; f is the same everywhere and cancels.
    area = np.where(counted & np.isfinite(depth) & (depth > 0), depth, 0.0) ** 2
    if area.any():
        text += f", {100 * area[wrong].sum() / area.sum():.1f} % of their surface"
    return text


def _checked(
    frame: FramePictures, num_classes: int
) -> tuple[str, NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    name = frame[0]
    rgb = np.asarray(frame[1])
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(
            f"frames: {name}: expected colours (H, W, 3) of uint8, got {rgb.shape} of {rgb.dtype}"
        )
    maps = []
    for what, value in zip(("label", "prediction"), frame[2:4], strict=True):
        ids = np.asarray(value).astype(np.int64)
        if ids.shape != rgb.shape[:2]:
            raise ValueError(f"frames: {name}: {what} is {ids.shape}, the colours {rgb.shape[:2]}")
        if ids.size and (ids.min() < 0 or ids.max() >= num_classes):
            raise ValueError(
                f"frames: {name}: {what} holds ids from {ids.min()} to {ids.max()}; class_names "
                f"has {num_classes}, so expected 0 to {num_classes - 1}"
            )
        maps.append(ids)
    depth = np.asarray(frame[4], dtype=np.float64)
    if depth.shape != rgb.shape[:2]:
        raise ValueError(f"frames: {name}: depth is {depth.shape}, the colours {rgb.shape[:2]}")
    return name, rgb, maps[0], maps[1], depth


def page(
    frames: Sequence[FramePictures],
    class_names: Sequence[str],
    palette: ArrayLike,
    path: Path,
) -> None:
    """Draw one row per frame: the frame, its labels, the prediction, the error; a legend below.

    Args:
        frames: for each frame its name, colours (H, W, 3) uint8, labels (H, W), prediction (H, W)
            and depth (H, W) in metres (0 or NaN where there is none). Sizes may differ.
        class_names: the name of each class by id; id 0 is ignored.
        palette: (len(class_names), 3) RGB, 0 to 255.
        path: the picture to write; the suffix chooses the format.

    Raises:
        ValueError: there is no frame, shapes do not match, or an id has no name or colour.
    """
    colours = np.asarray(palette, dtype=np.uint8)
    if colours.shape != (len(class_names), 3):
        raise ValueError(
            f"palette: expected ({len(class_names)}, 3) for as many class_names, "
            f"got {colours.shape}"
        )
    if not frames:
        raise ValueError("frames: expected at least one, got none")
    rows = [_checked(frame, len(class_names)) for frame in frames]
    aspects = [max(rgb.shape[1], 1) / max(rgb.shape[0], 1) for _, rgb, *_ in rows]
    column = 4.6 if max(aspects) > 2 else 3.2
    heights = [column / aspect for aspect in aspects]
    legend_rows = -(-(len(class_names) + 1) // LEGEND_COLUMNS)
    width = 2 * MARGIN + 4 * column + 3 * GAP
    height = HEAD + sum(heights) + len(rows) * NAME + 0.05 + legend_rows * LEGEND_ROW
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    top = HEAD
    for k, title in enumerate(COLUMNS):
        x = (MARGIN + k * (column + GAP)) / width
        figure.text(x, 1 - 0.14 / height, title, fontsize=14, fontweight="bold", va="top")
    for (name, rgb, label, prediction, depth), tall in zip(rows, heights, strict=True):
        caption = f"{name}: {_shares(label, prediction, depth)}"
        figure.text(MARGIN / width, 1 - (top - 0.06) / height, caption, fontsize=10, va="bottom")
        ignored = label == 0
        shown = (
            rgb,
            _class_picture(label, colours, np.zeros_like(ignored)),
            _class_picture(prediction, colours, ignored),
            error_picture(rgb, label, prediction),
        )
        for k, picture in enumerate(shown):
            x = (MARGIN + k * (column + GAP)) / width
            box = (x, 1 - (top + tall) / height, column / width, tall / height)
            axes = figure.add_axes(box)
            axes.imshow(picture, interpolation="antialiased", aspect="auto")
            axes.set_xticks([])
            axes.set_yticks([])
        top += tall + NAME
    entries = [
        Patch(facecolor=_fraction(colours[k]), edgecolor="#555555", label=name)
        for k, name in enumerate(class_names)
        if k > 0
    ]
    for colour, name in (
        (WRONG, "error: wrong"),
        (IGNORED, "ignored (in labels black, in the prediction dark)"),
    ):
        entries.append(Patch(facecolor=_fraction(colour), edgecolor="#555555", label=name))
    figure.legend(
        handles=entries, loc="lower left", ncols=LEGEND_COLUMNS, fontsize=11, frameon=False,
        bbox_to_anchor=(MARGIN / width / 2, 0.0), borderaxespad=0.2,
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
