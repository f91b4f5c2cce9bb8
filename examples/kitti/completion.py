"""Surface completion: the sparse depth of a LiDAR, made dense by joining adjacent points.

    python examples/kitti/completion.py sparse.png --out dense.png
    python examples/kitti/completion.py 0.bin --calib 0.txt --size 1242 375 --out dense.png

Points next to one another in the image become the corners of triangles (Delaunay's), and a pixel
takes the depth of the triangle it lies in. A triangle with a long side, or between surfaces at
different depths, is left open, and so is all that lies outside: nothing is made up there.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.spatial import Delaunay, QhullError

from velodyne import CalibrationError, project_points, projection_matrix, read_points

Floats = NDArray[np.float64]

METRES_PER_COUNT = 90 / 65535
#: A 64-line scanner's lines are 0.4 degrees apart: 5 pixels at a focal length of 720. Twice that
#: bridges a line that is missing.
MAX_EDGE = 12.0
#: Neighbouring lines of that scanner meet a road 40 m ahead in this ratio; a smaller one would tear
#: the road open before that.
MAX_RATIO = 1.2
#: Barycentric coordinate below which a pixel lies on a side of its triangle.
ON_SIDE = 1e-9


def complete_points(
    positions: ArrayLike,
    depth: ArrayLike,
    shape: tuple[int, int],
    *,
    max_edge: float = MAX_EDGE,
    max_ratio: float = MAX_RATIO,
    max_metres: float = math.inf,
) -> Floats:
    """Dense depth from points anywhere in the image.

    A plane in space has 1/z linear over the image, so that is what is interpolated: surfaces made
    of planes come out exact, where linear z would sag behind them between the corners.

    Args:
        positions: (N, 2) columns and rows, in pixels; pixel centres are whole numbers.
        depth: (N,) metres; points without a positive finite depth are left out.
        shape: (H, W) of the image.
        max_edge: longest side of a triangle, pixels.
        max_ratio: largest depth of a triangle's corners over the smallest.
        max_metres: largest difference of a triangle's corners in depth.

    Returns:
        (H, W) metres, 0 where no triangle covers the pixel.

    Raises:
        ValueError: shapes do not fit, or a limit is not one.
    """
    where, z = np.asarray(positions, dtype=np.float64), np.asarray(depth, dtype=np.float64)
    if where.ndim != 2 or where.shape[1] != 2 or z.shape != where.shape[:1]:
        raise ValueError(
            f"positions and depth: expected (N, 2) and (N,), got {where.shape} and {z.shape}"
        )
    for name, limit, least in (
        ("max_edge", max_edge, 0), ("max_ratio", max_ratio, 1), ("max_metres", max_metres, 0)
    ):  # fmt: skip
        if not limit >= least:
            raise ValueError(f"{name}: expected a number of {least} or more, got {limit}")
    dense = np.zeros(shape)
    usable = np.isfinite(z) & (z > 0) & np.isfinite(where).all(axis=1)
    where, z = where[usable], z[usable]
    try:
        mesh = Delaunay(where)
    except (QhullError, ValueError):
        # Fewer than three points, or all of them on one line: there is no triangle.
        return dense
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    found = mesh.find_simplex(pixels)
    whole = _whole(mesh, z, max_edge, max_ratio, max_metres)
    # A pixel on the side of two triangles belongs to either: to the one that is kept, if any is.
    torn = np.flatnonzero((found >= 0) & ~whole[found])
    on_side = _weights(mesh, found[torn], pixels[torn]) < ON_SIDE
    for corner in range(3):
        across = mesh.neighbors[found[torn], corner]
        better = on_side[:, corner] & (across >= 0) & whole[across]
        found[torn[better]] = across[better]
    kept = np.flatnonzero((found >= 0) & whole[found])
    weights = _weights(mesh, found[kept], pixels[kept])
    inverse = (weights / z[mesh.simplices[found[kept]]]).sum(axis=1)
    dense[rows.ravel()[kept], columns.ravel()[kept]] = 1 / inverse
    return dense


def _weights(mesh: Delaunay, triangles: NDArray[np.integer], pixels: Floats) -> Floats:
    """Barycentric coordinates (N, 3) of each pixel in its triangle."""
    transform = mesh.transform[triangles]
    first = np.einsum("nij,nj->ni", transform[:, :2], pixels - transform[:, 2])
    return np.column_stack([first, 1 - first.sum(axis=1)])


def _whole(
    mesh: Delaunay, z: Floats, max_edge: float, max_ratio: float, max_metres: float
) -> NDArray[np.bool_]:
    corners, depths = mesh.points[mesh.simplices], z[mesh.simplices]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    near, far = depths.min(axis=1), depths.max(axis=1)
    # Slivers of points on one line have no transform.
    flat = np.isnan(mesh.transform).any(axis=(1, 2))
    together = (far <= max_ratio * near) & (far - near <= max_metres)
    whole: NDArray[np.bool_] = (sides <= max_edge) & together & ~flat
    return whole


def complete(sparse: ArrayLike, **limits: float) -> Floats:
    """Dense depth from a sparse depth image; what was measured stays as it is.

    Args:
        sparse: (H, W) metres; zero, negative and non-finite values are pixels without a point.
        limits: `max_edge`, `max_ratio` and `max_metres` of `complete_points`.

    Returns:
        (H, W) metres, 0 where there is neither a point nor a triangle.

    Raises:
        ValueError: sparse is not (H, W), or a limit is not one.

    Example:
        >>> import numpy as np
        >>> sparse = np.zeros((3, 5))
        >>> sparse[0, 0] = sparse[0, 4] = sparse[2, 0] = 8.0
        >>> complete(sparse)[1]
        array([8., 8., 8., 0., 0.])
    """
    depth = np.asarray(sparse, dtype=np.float64)
    if depth.ndim != 2:
        raise ValueError(f"sparse: expected (H, W), got shape {depth.shape}")
    measured = np.isfinite(depth) & (depth > 0)
    rows, columns = np.nonzero(measured)
    shape = (depth.shape[0], depth.shape[1])
    dense = complete_points(np.stack([columns, rows], axis=1), depth[measured], shape, **limits)
    dense[measured] = depth[measured]
    return dense


def _read_counts(path: Path) -> NDArray[np.int64]:
    with Image.open(path) as image:
        counts = np.asarray(image)
    if counts.ndim != 2 or counts.dtype.itemsize < 2 or counts.dtype.kind not in "iu":
        raise ValueError(
            f"{path}: expected one channel of 16-bit counts, got {counts.shape} of {counts.dtype}"
        )
    return counts.astype(np.int64)


def _scan(
    path: Path, calibration: Sequence[Path], size: tuple[int, int], limits: dict[str, float]
) -> Floats:
    matrix = projection_matrix(calibration)
    positions, depth = project_points(read_points(path), matrix)
    width, height = size
    # A margin lets triangles across the border fill the picture to its edge.
    margin = limits["max_edge"]
    inside = (np.abs(positions - [(width - 1) / 2, (height - 1) / 2])
              <= [(width - 1) / 2 + margin, (height - 1) / 2 + margin]).all(axis=1)  # fmt: skip
    return complete_points(positions[inside], depth[inside], (height, width), **limits)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("input", type=Path, help="sparse 16-bit depth image (0 = none), or a KITTI scan (.bin)")
    add("--out", type=Path, required=True, metavar="FILE", help="16-bit depth image to write")
    add("--unit", type=float, default=METRES_PER_COUNT, help="metres per count (90 / 65535)")
    add("--calib", type=Path, nargs="+", default=[], help="KITTI calibration files of the scan")
    add("--size", type=int, nargs=2, metavar=("W", "H"), help="pixels of the scan's image")
    add("--max-edge", type=float, default=MAX_EDGE, help="longest side of a triangle, pixels (12)")
    add("--max-ratio", type=float, default=MAX_RATIO, help="of a triangle's depths (1.2)")
    add("--max-metres", type=float, default=math.inf, help="between a triangle's depths (any)")
    chosen = parser.parse_args(arguments)
    scan = chosen.input.suffix == ".bin"
    if scan and not (chosen.calib and chosen.size and min(chosen.size) > 0):
        parser.error("a scan needs --calib and --size, to be seen as an image")
    if not 0 < chosen.unit < math.inf:
        parser.error("--unit: expected a positive finite number")
    limits = {
        "max_edge": chosen.max_edge,
        "max_ratio": chosen.max_ratio,
        "max_metres": chosen.max_metres,
    }
    try:
        if scan:
            metres = _scan(chosen.input, chosen.calib, tuple(chosen.size), limits)
        else:
            metres = complete(_read_counts(chosen.input) * chosen.unit, **limits)
        # A depth below half a count is still a depth, and 0 is none.
        counts = np.where(metres > 0, np.clip(np.rint(metres / chosen.unit), 1, 65535), 0)
        Image.fromarray(counts.astype(np.uint16)).save(chosen.out)
    except (OSError, ValueError, CalibrationError) as error:
        print(f"completion.py: error: {error}", file=sys.stderr)
        return 2
    print(f"{100 * (counts > 0).mean():.1f} % of the pixels have depth; wrote {chosen.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
