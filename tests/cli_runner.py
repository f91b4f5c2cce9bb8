"""Runs the command line in this process, on depth files made here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from surfconv_ops import cli

Run = Callable[..., tuple[int, str, str]]
UNIT = 0.001


def run_levels(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of ``levels``."""
    try:
        status = cli.main(["levels", *map(str, arguments)])
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    return status, *capsys.readouterr()


def frames(count: int = 3) -> list[np.ndarray]:
    """Depth in millimetres with holes."""
    rng = np.random.default_rng(0)
    depth = rng.lognormal(8.0, 0.5, (count, 20, 30)).clip(1, 60_000).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.2] = 0
    return list(depth)


def save_frames(folder: Path, images: list[np.ndarray]) -> None:
    from PIL import Image

    folder.mkdir(exist_ok=True)
    for number, image in enumerate(images):
        Image.fromarray(image).save(folder / f"frame_{number}.png")
