"""Depth to measure on: real frames where they are at hand, a synthetic one, and a random one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surfconv_ops import DepthLevels, fit_depth_levels

VARIABLE = "SURFCONV_DATA"
RANDOM = "random"
SYNTHETIC = "synthetic"
#: Smallest and largest scale of the random depth, and the synthetic one's limits.
SCALES = (0.3, 6.0)
REFERENCE_DEPTH = 6.0
#: A window of this share of the reference depth, for modes with a guide of depth.
WINDOW_SHARE = 0.1
#: Focal length in pixels of the frames that come with one.
FOCAL_LENGTHS = {"indoor": 365.0, SYNTHETIC: 365.0}


@dataclass(frozen=True)
class Scene:
    """A depth map with what a layer on it is built with.

    Attributes:
        kind: kitti, indoor, synthetic or random.
        depth: (N, H, W) metres; 0 where there is none.
        reference_depth: metres at which the scale is 1: the median of a real frame.
        levels: depth levels of equally many valid pixels.
    """

    kind: str
    depth: Tensor
    reference_depth: float
    levels: DepthLevels

    @property
    def window(self) -> float:
        return WINDOW_SHARE * self.reference_depth


def _read(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image).astype(np.float32)


@lru_cache(maxsize=1)
def _real_frames() -> tuple[dict[str, tuple[Tensor, ...]], str]:
    """Frames by kind, in metres, and a sentence that says where depth came from."""
    name = os.environ.get(VARIABLE)
    if not name:
        return {}, f"{VARIABLE} is not set: smooth depth is a synthetic frame."
    folder = Path(name)
    try:
        # 65535 stands for 90 m outdoors; indoors a count is 0.1 mm and 65535 means saturated.
        kitti = [_read(folder / f"kitti/depth/img_{i}.png") * (90 / 65535) for i in range(1, 5)]
        indoor = _read(folder / "indoor/depth.png")
        indoor = np.where(indoor == 65535, 0, indoor * 1e-4).astype(np.float32)
    except (ImportError, OSError) as error:
        return {}, f"The frames of {VARIABLE} cannot be read ({error}): smooth depth is synthetic."
    frames = {"kitti": tuple(map(torch.from_numpy, kitti)), "indoor": (torch.from_numpy(indoor),)}
    return frames, (
        f"Smooth depth is real: kitti (outdoor, holes) and indoor (one room) from {VARIABLE}, "
        "cropped to the layer's aspect and resized by nearest neighbour."
    )


def source() -> str:
    """Where smooth depth comes from in this run."""
    return _real_frames()[1]


def smooth_kinds() -> tuple[str, ...]:
    """Kinds of smooth depth at hand, the main one first."""
    return tuple(_real_frames()[0]) or (SYNTHETIC,)


def _fit(frame: Tensor, height: int, width: int) -> Tensor:
    """The middle of a frame at the aspect height : width, resized by nearest neighbour."""
    rows, columns = frame.shape
    used_rows = min(rows, round(columns * height / width))
    used_columns = min(columns, round(rows * width / height))
    y = ((torch.arange(height) + 0.5) * used_rows / height).long() + (rows - used_rows) // 2
    x = ((torch.arange(width) + 0.5) * used_columns / width).long() + (columns - used_columns) // 2
    return frame[y][:, x]


def _synthetic(height: int, width: int) -> Tensor:
    """A floor that meets a wall, boxes on it, and a few holes."""
    rows = torch.linspace(0.0, 1.0, height)[:, None]
    columns = torch.linspace(0.0, 1.0, width)[None, :]
    depth = torch.minimum(1.2 / (rows - 0.35).clamp_min(1e-3), 14.0 + 4.0 * columns)
    boxes = ((0.1, 0.3, 0.4, 0.8, 2.6), (0.45, 0.6, 0.3, 0.6, 5.1), (0.7, 0.78, 0.2, 0.5, 9.3))
    for left, right, top, bottom, z in boxes:
        inside = (columns > left) & (columns < right) & (rows > top) & (rows < bottom)
        depth = torch.where(inside, z + 0.6 * (columns - left), depth)
    depth = depth.clamp(REFERENCE_DEPTH / SCALES[1], REFERENCE_DEPTH / SCALES[0])
    holes = torch.rand(height, width, generator=torch.Generator().manual_seed(3)) < 0.01
    return depth.masked_fill(holes, 0.0)


@lru_cache(maxsize=64)
def make_scene(kind: str, batch: int, height: int, width: int, levels: int = 4) -> Scene:
    """Depth of one kind at a size, the images of a batch being different frames where there are.

    Args:
        kind: `RANDOM` or one of `smooth_kinds()`.
        batch: number of images.
        height: rows.
        width: columns.
        levels: number of depth levels.

    Returns:
        The scene.
    """
    reference = REFERENCE_DEPTH
    if kind == RANDOM:
        scale = torch.empty(batch, height, width)
        scale.uniform_(*SCALES, generator=torch.Generator().manual_seed(3))
        depth = reference / scale
    elif kind == SYNTHETIC:
        depth = _synthetic(height, width).expand(batch, -1, -1).contiguous()
    else:
        frames = _real_frames()[0][kind]
        images = [_fit(frames[i % len(frames)], height, width) for i in range(batch)]
        depth = torch.stack(images)
        reference = float(depth[depth > 0].median())
    return Scene(kind, depth, reference, fit_depth_levels(depth, levels, gamma=0.0))
