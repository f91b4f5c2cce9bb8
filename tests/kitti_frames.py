"""A folder of small made-up frames, laid out as the KITTI example wants them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

EXAMPLE = Path(__file__).parents[1] / "examples" / "kitti"
SIZE = (32, 48)


def write_folder(path: Path, names: list[str], size: tuple[int, int] = SIZE) -> Path:
    """Frames whose class is told by colour, 8 to 60 m away, with holes and unlabelled pixels."""
    for number, name in enumerate(names):
        rng = np.random.default_rng(number)
        label = np.kron(rng.integers(0, 4, (size[0] // 8, size[1] // 8)), np.ones((8, 8), int))
        colours = np.array([[0, 0, 0], [200, 40, 40], [40, 200, 40], [40, 40, 200]])
        rgb = np.clip(colours[label] + rng.integers(-30, 30, (*size, 3)), 0, 255)
        metres = np.linspace(60, 8, size[0])[:, None] + rng.uniform(0, 1, size)
        counts = np.round(metres / 90 * 65535)
        counts[label == 0] = 0
        hha = np.stack([255 * 8 / metres, metres, np.full(size, 90)], -1)
        for folder, picture in (
            ("rgb", rgb.astype(np.uint8)),
            ("depth", counts.astype(np.uint16)),
            ("hha", hha.astype(np.uint8)),
            ("label", label.astype(np.uint8)),
        ):
            (path / folder).mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture).save(path / folder / f"{name}.png")
    return path
