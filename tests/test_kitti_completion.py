"""Surface completion: planes come back exactly, gaps stay open, and nothing is made up."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.tri import Triangulation
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "kitti"))

import completion
from completion import complete, complete_points
from velodyne import CalibrationError, project_points, projection_matrix, read_points

FOCAL, CX, CY = 90.0, 40.0, 22.0


def plane_depth(normal: tuple[float, float, float], shape: tuple[int, int] = (48, 80)) -> NDArray:
    """Depth of the plane normal . (x, y, z) = 1 seen by a pinhole camera."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    ray = ((columns - CX) / FOCAL, (rows - CY) / FOCAL, 1.0)
    return 1 / sum(n * r for n, r in zip(normal, ray, strict=True))


def thinned(depth: NDArray, share: float, seed: int = 0) -> NDArray:
    return np.where(np.random.default_rng(seed).random(depth.shape) < share, depth, 0.0)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 0.2), (0.1, 0.05, 0.15), (-0.15, 0.2, 0.2)])
def test_a_plane_comes_back_exactly(normal: tuple[float, float, float]) -> None:
    depth = plane_depth(normal)
    assert (depth > 0).all() and depth.max() < 40
    sparse = thinned(depth, 0.08)
    sparse[[0, 0, -1, -1], [0, -1, 0, -1]] = depth[[0, 0, -1, -1], [0, -1, 0, -1]]
    dense = complete(sparse, max_edge=100.0, max_ratio=100.0)
    assert (dense > 0).all()
    assert np.abs(dense / depth - 1).max() < 1e-12


def test_two_planes_stay_separate() -> None:
    depth = np.full((40, 60), 5.0)
    depth[:, 30:] = 9.0
    dense = complete(thinned(depth, 0.15))
    filled = dense > 0
    assert filled[8:-8, 8:22].mean() > 0.9 and filled[8:-8, 38:-8].mean() > 0.9
    assert np.abs(dense - depth)[filled].max() < 1e-12
    # With the gap allowed, something does lie between.
    joined = complete(thinned(depth, 0.15), max_ratio=2.0)
    assert ((joined > 5.1) & (joined < 8.9)).any()
    assert np.array_equal(complete(thinned(depth, 0.15), max_ratio=2.0, max_metres=3.9), dense)


def test_nothing_is_made_up_outside() -> None:
    sparse = np.zeros((30, 40))
    # A square, and a point too far from it to be joined.
    sparse[[5, 5, 12, 12], [6, 14, 6, 14]] = 4.0
    sparse[25, 35] = 4.0
    dense = complete(sparse)
    expected = np.zeros_like(sparse)
    expected[5:13, 6:15] = 4.0
    expected[25, 35] = 4.0
    assert np.allclose(dense, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("limit", "joined"), [(9.99, False), (10.01, True)])
def test_the_longest_side_counts(limit: float, joined: bool) -> None:
    positions = np.array([[2.0, 2.0], [2.0, 8.0], [10.0, 2.0]])  # the long side measures 10
    dense = complete_points(positions, np.full(3, 3.0), (12, 12), max_edge=limit)
    assert (dense[3, 3] > 0) == joined


def test_what_was_measured_stays() -> None:
    rng = np.random.default_rng(1)
    sparse = np.where(rng.random((40, 50)) < 0.3, rng.uniform(9.0, 10.0, (40, 50)), 0.0)
    dense = complete(sparse)
    measured = sparse > 0
    assert np.array_equal(dense[measured], sparse[measured])
    filled = dense > 0
    assert filled.mean() > 0.9 and dense[filled].min() >= 9.0 and dense[filled].max() <= 10.0


def test_against_planes_through_three_points() -> None:
    """Every pixel's ray cut with the plane through its triangle's corners in space."""
    rng = np.random.default_rng(3)
    positions = rng.uniform(1, 28, (25, 2))
    z = rng.uniform(4.0, 9.0, 25)
    limits = {"max_edge": 14.0, "max_ratio": 1.6, "max_metres": 3.0}
    dense = complete_points(positions, z, (30, 30), **limits)
    points = np.column_stack([(positions - (CX, CY)) / FOCAL * z[:, None], z])
    checked = 0
    for corners in Triangulation(*positions.T).triangles:
        a, b, c = positions[corners]
        sides = max(np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a))
        low, high = z[corners].min(), z[corners].max()
        whole = sides <= 14.0 and high / low <= 1.6 and high - low <= 3.0
        for i in range(30):
            for j in range(30):
                loop = [a, b, c, a]
                turns = [(q - p)[0] * (i - p[1]) - (q - p)[1] * (j - p[0])
                         for p, q in pairwise(loop)]  # fmt: skip
                if not (min(turns) > 1e-9 or max(turns) < -1e-9):
                    continue
                checked += 1
                if not whole:
                    assert dense[i, j] == 0
                    continue
                p, q, r = points[corners]
                normal = np.cross(q - p, r - p)
                ray = np.array([(j - CX) / FOCAL, (i - CY) / FOCAL, 1.0])
                assert dense[i, j] == pytest.approx((normal @ p) / (normal @ ray), rel=1e-9)
    assert checked > 300


@pytest.mark.parametrize("shape", [(0, 0), (0, 7), (1, 1), (1, 9), (5, 1), (6, 6)])
def test_maps_without_points(shape: tuple[int, int]) -> None:
    assert np.array_equal(complete(np.zeros(shape)), np.zeros(shape))


def test_points_on_one_line_or_too_few_are_kept() -> None:
    sparse = np.zeros((9, 9))
    for k in (1, 3, 5, 7):
        sparse[k, k] = 2.0 + k
        assert np.array_equal(complete(sparse), sparse)


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf, -3.0])
def test_pixels_without_depth(odd: float) -> None:
    sparse = thinned(np.full((20, 20), 6.0), 0.4)
    dense = complete(sparse)
    assert np.array_equal(complete(np.where(sparse > 0, sparse, odd)), dense)


def test_absurd_depths_tear_the_surface_and_no_more() -> None:
    sparse = thinned(np.full((20, 20), 6.0), 0.4)
    sparse[10, 10], sparse[4, 4] = 1e30, 1e-30
    dense = complete(sparse)
    ordinary = (dense > 0) & (sparse != 1e30) & (sparse != 1e-30)
    assert np.abs(dense[ordinary] - 6).max() < 1e-12 and ordinary.mean() > 0.7


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="sparse: expected"):
        complete(np.zeros((2, 3, 4)))
    with pytest.raises(ValueError, match="positions and depth"):
        complete_points(np.zeros((4, 2)), np.ones(3), (5, 5))
    for name, value in (("max_edge", -1.0), ("max_ratio", 0.9), ("max_metres", np.nan)):
        with pytest.raises(ValueError, match=f"{name}: expected"):
            complete(np.ones((3, 3)), **{name: value})


def test_a_street(data_folder: Path) -> None:
    """One pixel in twenty of a real depth map gives most of the rest back."""
    counts = np.asarray(Image.open(data_folder / "kitti" / "depth" / "img_46.png"))
    depth = counts.astype(np.float64) * (90 / 65535)
    sparse = thinned(depth, 0.05)
    dense = complete(sparse)
    new, valid = (dense > 0) & (sparse == 0), depth > 0
    assert (new & valid).sum() / (valid & (sparse == 0)).sum() > 0.8
    assert (new & ~valid).sum() / new.sum() < 0.01
    relative = np.abs(dense - depth)[new & valid] / depth[new & valid]
    assert np.median(relative) < 0.002 and np.quantile(relative, 0.95) < 0.03


# A scanner 0.3 m above the camera and 0.2 m behind it; its x is the camera's z.
TO_CAMERA = "0 -1 0 0 0 0 -1 0.3 1 0 0 -0.2"
P2 = "100 0 20 0 0 100 12 0 0 0 1 0"


def write_scan(folder: Path) -> tuple[Path, Path]:
    """A wall 8 m in front of the camera, with points behind it and beside it."""
    across, up = np.meshgrid(np.arange(-3, 3, 0.16), np.arange(-2, 2, 0.16))
    wall = np.stack([np.full(across.size, 8.2), across.ravel(), up.ravel() + 0.3], axis=1)
    behind = np.array([[-5.0, 0, 0]])
    points = np.concatenate([wall, behind])
    scan = np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4")
    scan.tofile(folder / "1.bin")
    (folder / "1.txt").write_text(
        f"P0: {P2}\nP2: {P2}\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {TO_CAMERA}\n"
    )
    return folder / "1.bin", folder / "1.txt"


def test_a_scan(tmp_path: Path) -> None:
    scan, calibration = write_scan(tmp_path)
    points = read_points(scan)
    positions, depth = project_points(points, projection_matrix([calibration]))
    assert len(points) - len(depth) == 1
    assert np.abs(depth - 8).max() < 1e-5
    # The first point is 3 m to the right and, from the camera, 2 m below.
    assert positions[0] == pytest.approx([20 + 100 * 3 / 8, 12 + 100 * 2 / 8], abs=1e-3)
    out = tmp_path / "dense.png"
    arguments = [str(scan), "--calib", str(calibration), "--size", "41", "25", "--out", str(out)]
    assert completion.main([*arguments, "--unit", "0.001"]) == 0
    counts = np.asarray(Image.open(out))
    assert counts.shape == (25, 41) and np.array_equal(counts, np.full((25, 41), 8000))


def test_calibration_files_of_the_raw_data(tmp_path: Path) -> None:
    _, calibration = write_scan(tmp_path)
    numbers = TO_CAMERA.split()
    rotation = " ".join(numbers[k] for k in (0, 1, 2, 4, 5, 6, 8, 9, 10))
    translation = " ".join(numbers[3::4])
    cameras, scanner = tmp_path / "calib_cam_to_cam.txt", tmp_path / "calib_velo_to_cam.txt"
    cameras.write_text(
        f"calib_time: 09-Jan-2012 13:57:47\nR_00: 9\nP_rect_02: {P2}\n"
        "R_rect_00: 1 0 0 0 1 0 0 0 1\n"
    )
    scanner.write_text(f"calib_time: 15-Mar-2012\nR: {rotation}\nT: {translation}\n")
    raw = projection_matrix([cameras, scanner])
    assert np.array_equal(raw, projection_matrix([calibration]))
    with pytest.raises(CalibrationError, match="no Tr_velo_to_cam or"):
        projection_matrix([cameras])
    with pytest.raises(CalibrationError, match="no P2 or P_rect_02 of 12 numbers"):
        projection_matrix([scanner])


def test_rectification_comes_between(tmp_path: Path) -> None:
    _, calibration = write_scan(tmp_path)
    text = calibration.read_text()
    # A quarter turn about the optical axis: the camera's x becomes y, its y becomes -x.
    calibration.write_text(
        text.replace("R0_rect: 1 0 0 0 1 0 0 0 1", "R0_rect: 0 -1 0 1 0 0 0 0 1")
    )
    positions, depth = project_points([[8.2, 3.0, 0.3]], projection_matrix([calibration]))
    assert depth == pytest.approx([8.0])
    # In camera axes the point is (-3, 0, 8), turned (0, -3, 8).
    assert positions[0] == pytest.approx([20.0, 12 - 100 * 3 / 8])


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sparse, out = tmp_path / "sparse.png", tmp_path / "dense.png"
    depth = plane_depth((0.1, 0.05, 0.15))
    counts = np.rint(thinned(depth, 0.3) / completion.METRES_PER_COUNT).astype(np.uint16)
    Image.fromarray(counts).save(sparse)
    assert completion.main([str(sparse), "--out", str(out)]) == 0
    assert "% of the pixels" in capsys.readouterr().out
    found = np.asarray(Image.open(out)).astype(np.float64)
    seen = found > 0
    assert seen.mean() > 0.9
    assert np.abs(found * (90 / 65535) - depth)[seen].max() < 2 * 90 / 65535

    Image.fromarray((counts // 256).astype(np.uint8)).save(sparse)
    assert completion.main([str(sparse), "--out", str(out)]) == 2
    assert "expected one channel of 16-bit counts" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        completion.main([str(tmp_path / "1.bin"), "--out", str(out)])
    assert "--calib and --size" in capsys.readouterr().err
    (tmp_path / "1.bin").write_bytes(b"1234567")
    arguments = ["--calib", str(sparse), "--size", "4", "4", "--out", str(out)]
    (sparse).write_text(f"P2: {P2}\nTr: {TO_CAMERA}\n")
    (tmp_path / "1.bin").write_bytes(bytes(12))
    assert completion.main([str(tmp_path / "1.bin"), *arguments]) == 2
    assert "4 numbers of 32 bits a point" in capsys.readouterr().err
