"""A folder of labelled RGB-D frames: what is in it, what is wrong with it, and its frames.

    DIR/rgb/NAME.png     8-bit RGB
    DIR/depth/NAME.png   16-bit counts; 0 = no depth
    DIR/hha/NAME.png     8-bit, 3 channels: height, horizontal disparity and angle with gravity
    DIR/label/NAME.png   8-bit class ids; 0 = not labelled

Metres are counts x 90 / 65535 and classes KITTI's, as in the frames that the SurfConv authors
published, unless DIR/dataset.json says otherwise:

    {"metres_per_count": 0.001, "classes": ["ignored", "wall", "floor"]}
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from classes import KITTI_CLASSES

FOLDERS = ("rgb", "depth", "hha", "label")
METRES_PER_COUNT = 90 / 65535
SIXTEEN_BIT_MODES = ("I;16", "I;16B", "I;16L", "I")
MODES = {"rgb": ("RGB",), "depth": SIXTEEN_BIT_MODES, "hha": ("RGB",), "label": ("L", "P")}
#: Means of the 70 training frames, in counts of 255 (the authors' own figures).
CHANNEL_MEANS = (92.71, 93.08, 90.96, 43.12, 86.08, 96.97)
#: Near the channels' standard deviation; batch normalisation takes up what it is off.
CHANNEL_SCALE = 64.0


class FolderError(ValueError):
    """The data folder cannot be used; the message says what is missing or wrong."""


class Frame(NamedTuple):
    """One frame: `rgb` and `hha` (H, W, 3) uint8, `depth` (H, W) metres, `label` (H, W) uint8."""

    name: str
    rgb: NDArray[np.uint8]
    hha: NDArray[np.uint8]
    depth: Tensor
    label: Tensor


class FrameFolder:
    """The frames of a folder by name, in natural order (img_2 before img_10).

    Args:
        path: the folder.

    Raises:
        FolderError: A folder is missing, empty, or lacks a frame that another one has.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.names = self._find_names()
        about = self._about()
        self.metres_per_count: float = about["metres_per_count"]
        self.class_names: tuple[str, ...] = about["classes"]

    def _find_names(self) -> list[str]:
        if not self.path.is_dir():
            raise FolderError(f"{self.path} is not a folder; expected one with {_layout()}")
        missing = [name for name in FOLDERS if not (self.path / name).is_dir()]
        if missing:
            raise FolderError(f"{self.path} has no folder {_listed(missing)}; expected {_layout()}")
        names = {name: {p.stem for p in (self.path / name).glob("*.png")} for name in FOLDERS}
        together = set().union(*names.values())
        if not together:
            raise FolderError(f"{self.path}: no .png file in any of {_listed(FOLDERS)}")
        for folder in FOLDERS:
            lacking = sorted(together - names[folder], key=_natural)
            if lacking:
                raise FolderError(
                    f"{self.path / folder} lacks {len(lacking)} of {len(together)} frames that"
                    f" other folders have: {_listed([f'{n}.png' for n in lacking])}"
                )
        return sorted(together, key=_natural)

    def _about(self) -> dict[str, Any]:
        about: dict[str, Any] = {"metres_per_count": METRES_PER_COUNT, "classes": KITTI_CLASSES}
        path = self.path / "dataset.json"
        if not path.is_file():
            return about
        try:
            about |= json.loads(path.read_text(encoding="utf-8"))
            about["metres_per_count"] = float(about["metres_per_count"])
            about["classes"] = tuple(str(name) for name in about["classes"])
        except (ValueError, TypeError) as error:
            raise FolderError(f"{path} cannot be read: {error}") from None
        if not 0 < about["metres_per_count"] < 1000:
            raise FolderError(f"{path}: expected a positive number under metres_per_count")
        if not 1 < len(about["classes"]) <= 256:
            raise FolderError(
                f"{path}: expected 2 to 256 names under classes, the ignored one first"
            )
        return about

    def __len__(self) -> int:
        return len(self.names)

    def depth(self, name: str) -> Tensor:
        """Depth (H, W) in metres, 0 where there is none."""
        counts = self._read("depth", name).astype(np.float64)
        return torch.from_numpy((counts * self.metres_per_count).astype(np.float32))

    def frame(self, name: str) -> Frame:
        """A frame, after checking that its four pictures fit together."""
        rgb, hha = self._read("rgb", name), self._read("hha", name)
        label = self._read("label", name)
        depth = self.depth(name)
        sizes = {"rgb": rgb.shape[:2], "hha": hha.shape[:2], "label": label.shape}
        for folder, size in sizes.items():
            if size != tuple(depth.shape):
                raise FolderError(
                    f"{self.path}: {folder}/{name}.png has {size[1]} x {size[0]} pixels,"
                    f" depth/{name}.png {depth.shape[1]} x {depth.shape[0]}"
                )
        if label.max(initial=0) >= len(self.class_names):
            raise FolderError(
                f"{self.path / 'label' / name}.png holds class {label.max()}; expected 0 (not"
                f" labelled) to {len(self.class_names) - 1}"
            )
        return Frame(name, rgb, hha, depth, torch.from_numpy(label.astype(np.uint8)))

    def _read(self, folder: str, name: str) -> NDArray[np.generic]:
        path = self.path / folder / f"{name}.png"
        try:
            with Image.open(path) as image:
                if image.mode not in MODES[folder]:
                    raise FolderError(
                        f"{path}: expected {_listed(MODES[folder], 'or')} pixels, got {image.mode}"
                    )
                return np.array(image)
        except (OSError, UnidentifiedImageError) as error:
            raise FolderError(f"{path} is not a picture that Pillow can read: {error}") from None


def network_input(frame: Frame) -> Tensor:
    """The six channels (6, H, W) that the net reads, in float32 around 0."""
    counts = np.concatenate([frame.rgb, frame.hha], axis=-1).astype(np.float32)
    counts -= np.asarray(CHANNEL_MEANS, dtype=np.float32)
    return torch.from_numpy(counts / CHANNEL_SCALE).permute(2, 0, 1).contiguous()


def split(names: Sequence[str], path: Path | None) -> tuple[list[str], list[str]]:
    """The names to train on, and those that the file `path` keeps for validation.

    Raises:
        FolderError: The file names a frame that is not there, or leaves none to train on.
    """
    if path is None:
        return list(names), []
    if not path.is_file():
        raise FolderError(f"--validation: no such file: {path}")
    lines = [line.split("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines()]
    kept = [line for line in lines if line]
    unknown = [name for name in kept if name not in names]
    if unknown:
        raise FolderError(
            f"--validation: {path} names frames that are not in the folder: {_listed(unknown)};"
            " give a file of your own, one name a line, or 'none'"
        )
    rest = [name for name in names if name not in kept]
    if not rest:
        raise FolderError(f"--validation: {path} leaves no frame to train on")
    return rest, kept


def _natural(name: str) -> list[tuple[int, int | str]]:
    parts = re.split(r"(\d+)", name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts]


def _layout() -> str:
    return "the folders " + ", ".join(f"{name}/" for name in FOLDERS) + " of .png files"


def _listed(names: Sequence[str], last: str = "and", limit: int = 5) -> str:
    shown = list(names[:limit])
    if len(names) > limit:
        return ", ".join(shown) + f", ... ({len(names) - limit} more)"
    return f" {last} ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)
