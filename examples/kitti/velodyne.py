"""KITTI's laser scans: points in the scanner's axes, and how a camera sees them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

#: Names of the left colour camera's matrices: in KITTI's object and odometry files, and raw ones.
PROJECTION = ("P2", "P_rect_02")
RECTIFICATION = ("R0_rect", "R_rect", "R_rect_00")
SCANNER_TO_CAMERA = ("Tr_velo_to_cam", "Tr_velo_cam", "Tr")
#: Points nearer to the camera's plane than this, in metres, have no meaningful position.
NEAREST = 0.1


class CalibrationError(ValueError):
    """Scan or calibration files cannot be used; the message says what is wrong."""


def read_points(path: Path) -> Floats:
    """The points (N, 3) of a scan in metres: x forward, y left, z up (reflectance is dropped)."""
    values = np.fromfile(path, dtype="<f4")
    if values.size % 4:
        raise CalibrationError(
            f"{path}: expected 4 numbers of 32 bits a point, got {values.size} numbers"
        )
    return values.reshape(-1, 4)[:, :3].astype(np.float64)


def projection_matrix(paths: Sequence[Path]) -> Floats:
    """The (3, 4) matrix from scanner axes to image coordinates times depth.

    Args:
        paths: one file of the object or odometry sets, or calib_cam_to_cam.txt and
            calib_velo_to_cam.txt of the raw data.

    Raises:
        CalibrationError: a matrix is missing.
    """
    entries: dict[str, Floats] = {}
    for path in paths:
        for line in path.read_text().splitlines():
            name, _, rest = line.partition(":")
            try:
                entries[name.strip()] = np.array([float(part) for part in rest.split()])
            except ValueError:
                continue  # a date
    projection = _find(entries, PROJECTION, 12, paths).reshape(3, 4)
    rectification = np.eye(4)
    if any(name in entries for name in RECTIFICATION):
        rectification[:3, :3] = _find(entries, RECTIFICATION, 9, paths).reshape(3, 3)
    to_camera = np.eye(4)
    if "R" in entries and "T" in entries:
        to_camera[:3, :3] = _find(entries, ("R",), 9, paths).reshape(3, 3)
        to_camera[:3, 3] = _find(entries, ("T",), 3, paths)
    else:
        to_camera[:3] = _find(entries, SCANNER_TO_CAMERA, 12, paths).reshape(3, 4)
    matrix: Floats = projection @ rectification @ to_camera
    return matrix


def _find(
    entries: dict[str, Floats], names: Sequence[str], size: int, paths: Sequence[Path]
) -> Floats:
    for name in names:
        if name in entries and entries[name].size == size:
            return entries[name]
    files = ", ".join(str(path) for path in paths)
    raise CalibrationError(f"{files}: no {' or '.join(names)} of {size} numbers in there")


def project_points(points: ArrayLike, matrix: ArrayLike) -> tuple[Floats, Floats]:
    """Columns and rows (M, 2) in pixels, and depth (M,) in metres, of the points in front.

    Args:
        points: (N, 3) in the scanner's axes.
        matrix: (3, 4), as `projection_matrix` gives it.
    """
    xyz = np.asarray(points, dtype=np.float64)
    seen = np.column_stack([xyz, np.ones(len(xyz))]) @ np.asarray(matrix, dtype=np.float64).T
    seen = seen[seen[:, 2] > NEAREST]
    return seen[:, :2] / seen[:, 2:], seen[:, 2]
