"""HHA: horizontal disparity, height above ground and angle with gravity, from a depth image.

    python examples/kitti/hha.py depth.png --unit 0.001 --focal 365 --out hha.png

The three channels of Gupta et al., "Learning Rich Features from RGB-D Images for Object Detection
and Segmentation", ECCV 2014; the direction of gravity is found as in Gupta et al., "Perceptual
Organization and Recognition of Indoor Scenes", CVPR 2013. Simpler than theirs: normals come from
one size of window instead of two, neighbours across a jump in depth are left out instead of those
of another superpixel, and the ground is a low percentile of the heights in the frame, with no
assumption on how high the camera is.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

Floats = NDArray[np.float64]

#: Degrees within which a normal counts as along or across gravity, coarse rounds before fine ones.
GRAVITY_ROUNDS = (45.0,) * 5 + (15.0,) * 5
#: A pixel's neighbour lies on another surface where its depth differs by more than this share.
JUMP = 0.1
GROUND_PERCENTILE = 1.0
ENCODINGS = ("gupta", "kitti")


class Intrinsics(NamedTuple):
    """A pinhole camera: focal lengths and principal point, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


class HHA(NamedTuple):
    """The channels in physical units, each (H, W) and NaN where unknown; `gravity` points down."""

    disparity: Floats
    height: Floats
    angle: Floats
    gravity: Floats


def _checked_depth(depth: ArrayLike) -> Floats:
    metres = np.asarray(depth, dtype=np.float64)
    if metres.ndim != 2:
        raise ValueError(f"depth: expected (H, W), got shape {metres.shape}")
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.nan)


def _rays(shape: tuple[int, ...], intrinsics: Intrinsics) -> tuple[Floats, Floats]:
    fx, fy, cx, cy = intrinsics
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    return (columns - cx) / fx, (rows - cy) / fy


def back_project(depth: ArrayLike, intrinsics: Intrinsics) -> Floats:
    """Points (H, W, 3) in metres, x right, y down, z forward; NaN where there is no depth."""
    metres = _checked_depth(depth)
    x, y = _rays(metres.shape, intrinsics)
    return np.stack([x * metres, y * metres, metres], axis=-1)


def surface_normals(depth: ArrayLike, intrinsics: Intrinsics, radius: int = 3) -> Floats:
    """Unit normals (H, W, 3) pointing away from the camera, NaN where they cannot be told.

    On a plane n.P = d, 1/z is linear across the image: 1/z = (n/d).(x/z, y/z, 1). That line is
    fitted by least squares in a window around each pixel, over neighbours of similar depth.

    Args:
        depth: (H, W) in metres; zero, negative and non-finite values are holes.
        intrinsics: of the camera.
        radius: half-width of the window in pixels.
    """
    metres = _checked_depth(depth)
    height, width = metres.shape
    padded = np.pad(metres, radius, constant_values=np.nan)
    # Sums over the window of 1, u, v, uu, uv, vv and of w, uw, vw, where w = z / z(q) - 1.
    sums = np.zeros((9, height, width))
    for dv in range(-radius, radius + 1):
        for du in range(-radius, radius + 1):
            other = padded[radius + dv :, radius + du :][:height, :width]
            with np.errstate(invalid="ignore"):
                kept = np.abs(other - metres) <= JUMP * metres
                w = np.where(kept, metres / other - 1, 0.0)
            for k, weight in enumerate((1, du, dv, du * du, du * dv, dv * dv)):
                if weight:
                    sums[k] += weight * kept
            for k, weight in enumerate((1, du, dv), start=6):
                if weight:
                    sums[k] += weight * w
    n, u, v, uu, uv, vv, w, uw, vw = sums
    # Centred second moments times n; sums of whole numbers, so a line of pixels gives exactly 0.
    suu, suv, svv = n * uu - u * u, n * uv - u * v, n * vv - v * v
    suw, svw = n * uw - u * w, n * vw - v * w
    determinant = suu * svv - suv * suv
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_u = np.where(determinant > 0, (svv * suw - suv * svw) / determinant, np.nan)
        slope_v = np.where(determinant > 0, (suu * svw - suv * suw) / determinant, np.nan)
        level = 1 + (w - slope_u * u - slope_v * v) / n
    x, y = _rays(metres.shape, intrinsics)
    a, b = slope_u * intrinsics.fx, slope_v * intrinsics.fy
    normals: Floats = np.stack([a, b, level - a * x - b * y], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals


def find_gravity(normals: ArrayLike, start: ArrayLike = (0.0, 1.0, 0.0)) -> Floats:
    """The direction that surfaces are most along or across: down, in camera axes.

    Each round takes the normals within some degrees of the present direction (floors, ceilings)
    and those within as many of its perpendicular plane (walls), and turns to the unit vector that
    minimises the squared sine of the angles to the former plus the squared cosine to the latter:
    an eigenvector, Gupta et al. 2013, section 3.

    Args:
        normals: (..., 3); rows with NaN are left out.
        start: first guess; a camera held upright has (0, 1, 0).

    Returns:
        (3,), the guess itself where there is no normal to go by.
    """
    known = np.asarray(normals, dtype=np.float64).reshape(-1, 3)
    known = known[np.isfinite(known).all(axis=1)]
    down = np.asarray(start, dtype=np.float64)
    if down.shape != (3,) or not np.linalg.norm(down) > 0:
        raise ValueError(f"start: expected a direction of 3 numbers, got {start!r}")
    down = down / np.linalg.norm(down)
    for degrees in GRAVITY_ROUNDS:
        cosine = np.abs(known @ down)
        along = known[cosine > np.cos(np.radians(degrees))]
        across = known[cosine < np.sin(np.radians(degrees))]
        if not len(along) + len(across):
            break
        values, vectors = np.linalg.eigh(across.T @ across - along.T @ along)
        # Walls of one direction alone leave a whole plane equally good; stay near the guess then.
        flat = values - values[0] <= 1e-9 * max(1.0, float(np.abs(values).max()))
        best = vectors[:, flat] @ (vectors[:, flat].T @ down)
        if not np.linalg.norm(best) > 1e-6:
            break
        down = best / np.linalg.norm(best)
    return down


def compute_hha(
    depth: ArrayLike, intrinsics: Intrinsics, gravity: ArrayLike | None = None, radius: int = 3
) -> HHA:
    """The three channels in physical units.

    Args:
        depth: (H, W) in metres; zero, negative and non-finite values are holes.
        intrinsics: of the camera.
        gravity: direction of down in camera axes (x right, y down, z forward), any length; found
            from the surfaces where None.
        radius: half-width of the windows that normals are fitted in, pixels.

    Returns:
        `disparity` 1/z in 1/m; `height` in metres above the frame's lowest surface; `angle` in
        degrees between gravity and the normal that points away from the camera (0 floor, 90 wall,
        180 ceiling); NaN in holes, and for `angle` where no plane fits.

    Raises:
        ValueError: depth is not (H, W), or gravity not three numbers with a direction.

    Example:
        >>> import numpy as np
        >>> wall = compute_hha(np.full((5, 5), 2.0), Intrinsics(10.0, 10.0, 2.0, 2.0), (0, 1, 0))
        >>> print(wall.disparity[2, 2], round(float(wall.angle[2, 2]), 6))
        0.5 90.0
    """
    points = back_project(depth, intrinsics)
    normals = surface_normals(depth, intrinsics, radius)
    down = find_gravity(normals) if gravity is None else np.asarray(gravity, dtype=np.float64)
    if down.shape != (3,) or not np.isfinite(down).all() or not np.linalg.norm(down) > 0:
        raise ValueError(f"gravity: expected a direction of 3 finite numbers, got {gravity!r}")
    down = down / np.linalg.norm(down)
    height = -(points @ down)
    known = height[np.isfinite(height)]
    if known.size:
        height = height - np.percentile(known, GROUND_PERCENTILE)
    with np.errstate(over="ignore"):
        disparity = 1 / points[..., 2]
    angle = np.degrees(np.arccos(np.clip(normals @ down, -1, 1)))
    return HHA(disparity, height, angle, down)


def encode(channels: HHA, encoding: str = "gupta") -> NDArray[np.uint8]:
    """The channels as an 8-bit picture (H, W, 3); unknown values and holes are 0.

    Args:
        channels: in physical units.
        encoding: 'gupta', for rooms: disparity 310 / z (z at least 1 m), height in centimetres,
            angle in degrees + 38. 'kitti', for streets, as measured in the frames that the
            SurfConv authors published: height x 51 / m, disparity 1020 / z, angle from the
            horizontal (0 to 90 degrees) x 255 / 90, in this order.

    Raises:
        ValueError: another encoding.
    """
    if encoding == "gupta":
        parts = (
            310 * np.minimum(channels.disparity, 1.0),
            100 * channels.height,
            channels.angle + 38,
        )
    elif encoding == "kitti":
        folded = np.minimum(channels.angle, 180 - channels.angle)
        parts = (51 * channels.height, 1020 * channels.disparity, folded * (255 / 90))
    else:
        raise ValueError(f"encoding: expected one of {ENCODINGS}, got {encoding!r}")
    stacked = np.clip(np.nan_to_num(np.stack(parts, axis=-1), nan=0.0, posinf=255.0), 0, 255)
    picture: NDArray[np.uint8] = stacked.round().astype(np.uint8)
    return picture


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("depth", type=Path, help="depth image, 16-bit counts, 0 = none")
    add("--unit", type=float, required=True, metavar="M", help="metres per count")
    add("--focal", type=float, required=True, metavar="F", help="focal length in pixels")
    add("--center", type=float, nargs=2, metavar=("X", "Y"), help="principal point (the middle)")
    add("--encoding", choices=ENCODINGS, default="gupta", help="of the 8 bits (gupta)")
    add("--out", type=Path, required=True, metavar="FILE", help="picture to write")
    chosen = parser.parse_args(arguments)
    if not (0 < chosen.unit < np.inf and 0 < chosen.focal < np.inf):
        parser.error("--unit and --focal: expected positive finite numbers")
    try:
        with Image.open(chosen.depth) as image:
            counts = np.asarray(image)
        middle = ((counts.shape[1] - 1) / 2, (counts.shape[0] - 1) / 2)
        intrinsics = Intrinsics(chosen.focal, chosen.focal, *(chosen.center or middle))
        channels = compute_hha(counts.astype(np.float64) * chosen.unit, intrinsics)
        Image.fromarray(encode(channels, chosen.encoding)).save(chosen.out)
    except (OSError, ValueError) as error:
        print(f"hha.py: error: {error}", file=sys.stderr)
        return 2
    down = ", ".join(f"{part:+.3f}" for part in channels.gravity)
    print(f"down is ({down}) in camera axes (right, down, forward); wrote {chosen.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
