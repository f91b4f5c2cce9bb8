"""Depth maps from files: which ones a pattern means, and what is in them."""

from __future__ import annotations

import glob
import os
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .common import CommandError, need

ARRAYS = {".npy", ".npz"}
# Pillow's modes of one channel with more than 8 bits; which of them a 16-bit PNG has depends on
# Pillow's version.
DEEP_MODES = {"I", "I;16", "I;16B", "I;16L", "I;16N", "F"}
MODE_NAMES = {
    "1": "black and white",
    "L": "8-bit grey",
    "LA": "8-bit grey with transparency",
    "P": "8-bit palette colours",
    "RGB": "RGB",
    "RGBA": "RGB with transparency",
}


def find_files(patterns: Sequence[str]) -> list[Path]:
    """The files that patterns or names mean, each once, img_2 before img_10.

    Raises:
        CommandError: A pattern means no file.
    """
    found: set[str] = set()
    for pattern in patterns:
        # A file whose name has brackets is itself before it is a pattern.
        names = [pattern] if Path(pattern).is_file() else glob.glob(pattern, recursive=True)  # noqa: PTH207
        files = [name for name in names if Path(name).is_file()]
        if not files:
            what = "it means folders only" if names else f"seen from {Path.cwd()}"
            raise CommandError(
                f"no file matches {pattern!r} ({what}); expected a pattern such as"
                " 'data/depth/*.png', or '**/depth/*.png' for all folders below"
            )
        found.update(os.path.normpath(name) for name in files)
    return [Path(name) for name in sorted(found, key=_natural)]


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts digits by their number."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)
    ]


def read_counts(path: Path) -> NDArray[Any]:
    """The numbers in a depth file, as they are stored.

    Raises:
        CommandError: It cannot be read, or is no depth map.
    """
    counts = _read_array(path) if path.suffix.lower() in ARRAYS else _read_image(path)
    if counts.dtype.kind not in "iuf":
        raise CommandError(f"{path}: expected numbers, got {counts.dtype}")
    if counts.dtype.itemsize == 1:
        raise CommandError(f"{path}: {_not_depth(f'an array of {counts.dtype}')}")
    return counts


def _read_image(path: Path) -> NDArray[Any]:
    image_module = need("PIL.Image", "Pillow")
    try:
        with image_module.open(path) as image:
            if image.mode not in DEEP_MODES:
                kind = MODE_NAMES.get(image.mode, f"Pillow mode {image.mode}")
                raise CommandError(f"{path}: {_not_depth(f'an image of another kind: {kind}')}")
            return np.asarray(image)
    except (OSError, ValueError, SyntaxError) as error:
        raise CommandError(f"{path}: cannot be read as an image: {error}") from error


def _not_depth(found: str) -> str:
    return (
        f"expected depth, one channel of 16 bits or more, got {found}. Pictures made for looking at"
        " do not hold metres: use the sensor's own files"
    )


def _read_array(path: Path) -> NDArray[Any]:
    try:
        content = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise CommandError(f"{path}: cannot be read as an array: {error}") from error
    if isinstance(content, np.ndarray):
        return content
    with content:
        names = content.files
        name = names[0] if len(names) == 1 else "depth"
        if name not in names:
            raise CommandError(
                f"{path}: expected one array, or one named 'depth',"
                f" got {', '.join(names) or 'none'}"
            )
        try:
            array: NDArray[Any] = content[name]
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise CommandError(f"{path}: cannot be read as an array: {error}") from error
        return array


def to_metres(
    counts: NDArray[Any],
    unit: float,
    invalid_counts: Sequence[int] = (),
    max_depth: float | None = None,
) -> NDArray[np.float64]:
    """Counts in metres, 0 where they mean no depth."""
    metres = counts.astype(np.float64) * unit
    if invalid_counts:
        metres[np.isin(counts, invalid_counts)] = 0
    if max_depth is not None:
        metres[metres > max_depth] = 0
    return metres
