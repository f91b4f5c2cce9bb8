"""The page of pictures: what each pixel of it says, and what it refuses."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "kitti"))

import pictures
from classes import KITTI_CLASSES, palette


def frame(name: str = "one", height: int = 24, width: int = 96) -> tuple[Any, ...]:
    rng = np.random.default_rng(0)
    label = rng.integers(0, 12, (height, width)).astype(np.uint8)
    prediction = np.where(rng.random(label.shape) < 0.3, 4, label)
    rgb = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return name, rgb, label, prediction, rng.uniform(2, 80, label.shape)


def test_the_page_has_a_row_for_each_frame(tmp_path: Path) -> None:
    sizes = []
    for count in (1, 3):
        path = tmp_path / "new" / f"{count}.png"
        pictures.page([frame(f"frame {k}") for k in range(count)], KITTI_CLASSES, palette(12), path)
        with Image.open(path) as image:
            sizes.append(image.size)
            shown = np.asarray(image.convert("RGB")).reshape(-1, 3)
        # Every class colour, red for errors and grey for ignored pixels appear.
        found = {tuple(colour) for colour in np.unique(shown, axis=0).tolist()}
        wanted = {tuple(colour) for colour in palette(12).tolist()}
        assert wanted | {pictures.WRONG, pictures.IGNORED} <= found
    (one, low), (three, high) = sizes
    assert one == three and one > 1500
    assert 250 < low < high < 900
    # Two more frames, each a quarter as high as wide, and their captions.
    assert high - low == pytest.approx(2 * 100 * (4.6 / 4 + pictures.NAME), abs=2)


def test_errors_are_red_and_ignored_pixels_grey() -> None:
    rgb = np.full((1, 4, 3), 255, np.uint8)
    label = np.array([[0, 1, 1, 0]])
    prediction = np.array([[0, 1, 2, 2]])
    shown = pictures.error_picture(rgb, label, prediction)
    expected = [pictures.IGNORED, (255, 255, 255), pictures.WRONG, pictures.IGNORED]
    assert shown.tolist() == [[list(colour) for colour in expected]]


def test_the_caption_weighs_by_surface() -> None:
    label = np.array([[1, 1, 1, 0]])
    prediction = np.array([[1, 1, 2, 2]])
    depth = np.array([[1.0, np.nan, 3.0, 5.0]])
    # One of three pixels; of their surface 3^2 of 1^2 + 3^2.
    caption = pictures._shares(label, prediction, depth)
    assert caption == "33.3 % of labelled pixels wrong, 90.0 % of their surface"
    assert pictures._shares(label, prediction, 0 * depth) == "33.3 % of labelled pixels wrong"
    assert pictures._shares(0 * label, prediction, depth) == "no labelled pixel"


def test_frames_of_another_shape_and_many_classes(tmp_path: Path) -> None:
    names = ["ignored", *(f"class {k}" for k in range(1, 38))]
    path = tmp_path / "page.pdf"
    pictures.page([frame(), frame("two", 60, 80)], names, palette(38), path)
    assert path.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("count", [1, 2, 12, 38, 41])
def test_colours_differ(count: int) -> None:
    colours = palette(count)
    assert colours.shape == (count, 3) and colours.dtype == np.uint8
    assert len({tuple(colour) for colour in colours.tolist()}) == count
    assert colours[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (1, np.zeros((24, 96), np.uint8), "expected colours"),
        (1, np.zeros((24, 96, 3), np.float32), "expected colours"),
        (2, np.zeros((24, 95), np.uint8), "label is"),
        (2, np.full((24, 96), 12), "expected 0 to 11"),
        (3, np.full((24, 96), -1), "expected 0 to 11"),
        (4, np.zeros((12, 48)), "depth is"),
    ],
)
def test_frames_that_do_not_fit_are_refused(
    tmp_path: Path, index: int, value: np.ndarray, message: str
) -> None:
    parts = list(frame())
    parts[index] = value
    with pytest.raises(ValueError, match=message):
        pictures.page([tuple(parts)], KITTI_CLASSES, palette(12), tmp_path / "page.png")


def test_pages_without_frames_or_colours_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        pictures.page([], KITTI_CLASSES, palette(12), tmp_path / "page.png")
    with pytest.raises(ValueError, match="palette: expected \\(12, 3\\)"):
        pictures.page([frame()], KITTI_CLASSES, palette(11), tmp_path / "page.png")
