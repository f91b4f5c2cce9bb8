"""Read an RGB-D frame from two files and say plainly what is wrong with them when something is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from synthetic_scene import Frame

SATURATED = 65535
SIXTEEN_BIT_MODES = ("I;16", "I;16B", "I;16L", "I")


class FrameError(ValueError):
    """What the user gave cannot be used; the message says what came and what was expected."""


def _open(path: Path, argument: str) -> Image.Image:
    if not path.is_file():
        raise FrameError(f"{argument}: no such file: {path}")
    try:
        image = Image.open(path)
        image.load()
    except (UnidentifiedImageError, OSError) as error:
        raise FrameError(
            f"{argument}: {path} is not an image that Pillow can read: {error}"
        ) from None
    return image


def load_frame(
    rgb_path: Path,
    depth_path: Path,
    *,
    depth_scale: float,
    focal: float,
    invalid_counts: Sequence[int] = (SATURATED,),
) -> Frame:
    """Load a colour image and a 16-bit depth image.

    Args:
        rgb_path: any image Pillow reads; converted to RGB.
        depth_path: one channel of 16-bit counts, the same size as the colour image.
        depth_scale: metres per count (0.001 for millimetres).
        focal: focal length in pixels of these images.
        invalid_counts: counts that mean "no depth" besides 0.

    Returns:
        The frame, depth in metres and 0 where there is none.

    Raises:
        FrameError: a file is missing or unreadable, the depth is not 16-bit, the sizes differ, or
            no pixel has depth.
    """
    rgb = np.array(_open(rgb_path, "--rgb").convert("RGB"), dtype=np.uint8)
    image = _open(depth_path, "--depth")
    if image.mode not in SIXTEEN_BIT_MODES:
        raise FrameError(
            f"--depth: {depth_path} has pixel mode {image.mode!r}; expected one channel of 16-bit "
            "counts. An 8-bit or colour image only shows depth: use the sensor's own file."
        )
    counts: NDArray[np.int64] = np.asarray(image).astype(np.int64)
    if counts.shape != rgb.shape[:2]:
        raise FrameError(
            f"--rgb is {rgb.shape[1]} x {rgb.shape[0]} pixels but --depth is {counts.shape[1]} x "
            f"{counts.shape[0]}: both must show the same pixels (width x height)"
        )
    valid = (counts > 0) & ~np.isin(counts, list(invalid_counts))
    if not valid.any():
        raise FrameError(
            f"--depth: no pixel of {depth_path} has depth; 0 and {list(invalid_counts)} mean none"
        )
    depth = np.where(valid, counts * depth_scale, 0.0).astype(np.float32)
    return Frame(rgb, depth, focal)
