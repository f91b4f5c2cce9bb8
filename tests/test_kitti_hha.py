"""HHA on rooms whose floor, walls and ceiling are known exactly."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "kitti"))

import hha
from hha import Intrinsics, compute_hha, encode, find_gravity, surface_normals

CAMERA = Intrinsics(42.0, 44.0, 49.0, 38.5)
FLOOR, CEILING, BACK, LEFT = range(4)


class Room(NamedTuple):
    """What a camera sees of floor, ceiling, back wall and left wall, and what it should find."""

    depth: NDArray[np.float64]
    surface: NDArray[np.int64]
    height: NDArray[np.float64]
    down: NDArray[np.float64]
    normals: NDArray[np.float64]


def make_room(pitch: float = 0.0, roll: float = 0.0, shape: tuple[int, int] = (80, 100)) -> Room:
    """Rays cut with four planes, pixel by pixel: the nearest plane in front is seen."""
    p, r = np.radians(pitch), np.radians(roll)
    turn_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    turn_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    turn = turn_z @ turn_x
    down, right, forward = turn @ [0.0, 1, 0], turn @ [1.0, 0, 0], turn @ [0.0, 0, 1]
    # The camera is 1.5 m above the floor, 1 m below the ceiling.
    planes = [(down, 1.5), (-down, 1.0), (forward, 4.0), (-right, 1.8)]
    normals = np.array([normal for normal, _ in planes])
    depth, surface = np.full(shape, np.inf), np.zeros(shape, int)
    for i in range(shape[0]):
        for j in range(shape[1]):
            ray = np.array([(j - CAMERA.cx) / CAMERA.fx, (i - CAMERA.cy) / CAMERA.fy, 1.0])
            for k, (normal, distance) in enumerate(planes):
                towards = float(normal @ ray)
                if towards > 0 and distance / towards < depth[i, j]:
                    depth[i, j], surface[i, j] = distance / towards, k
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    rays = [(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(shape)]
    below = sum(ray * part for ray, part in zip(rays, down, strict=True)) * depth
    return Room(depth, surface, 1.5 - below, down, normals)


def inside(surface: NDArray[np.int64], margin: int = 4) -> NDArray[np.bool_]:
    """Pixels whose whole window lies on one surface."""
    alike = np.ones_like(surface, bool)
    for dv in range(-margin, margin + 1):
        for du in range(-margin, margin + 1):
            alike &= np.roll(surface, (dv, du), (0, 1)) == surface
    alike[:margin], alike[-margin:], alike[:, :margin], alike[:, -margin:] = False, False, False, 0
    return alike


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (15.0, 0.0), (-5.0, 6.0)])
def test_a_room(pitch: float, roll: float) -> None:
    room = make_room(pitch, roll)
    found = compute_hha(room.depth, CAMERA)
    off = np.degrees(np.arccos(np.clip(found.gravity @ room.down, -1, 1)))
    # Windows that reach across an edge of the room fit something between its two planes.
    assert off < 0.3
    flat = inside(room.surface)
    for surface, angle in ((FLOOR, 0), (CEILING, 180), (BACK, 90), (LEFT, 90)):
        chosen = flat & (room.surface == surface)
        assert chosen.sum() > 50
        assert np.abs(found.angle[chosen] - angle).max() < 0.3
    # 4 m away, 0.3 degrees are 2 cm.
    assert np.abs(found.height - room.height).max() < 0.03
    assert np.array_equal(found.disparity, 1 / room.depth)


def test_normals_of_planes_are_exact_up_to_the_border_and_beside_holes() -> None:
    room = make_room(15.0, 4.0)
    only = np.where(room.surface == FLOOR, room.depth, np.nan)
    only[::7, ::3] = 0
    normals = surface_normals(only, CAMERA)
    seen = np.isfinite(only) & (only > 0)
    known = np.isfinite(normals).all(axis=-1)
    assert not known[~seen].any()
    assert known[seen].mean() > 0.99
    assert np.abs(normals[known] - room.normals[FLOOR]).max() < 1e-6


def test_normals_do_not_mix_surfaces_across_a_jump() -> None:
    depth = np.full((20, 30), 4.0)
    depth[:, 15:] = 2.0
    normals = surface_normals(depth, CAMERA)
    assert np.abs(normals - [0, 0, 1]).max() < 1e-12


def test_gravity_can_be_given() -> None:
    room = make_room(15.0)
    found = compute_hha(room.depth, CAMERA, gravity=3 * room.down)
    assert np.allclose(found.gravity, room.down, atol=1e-15)
    assert np.abs(found.height - room.height).max() < 1e-9
    tilted = compute_hha(room.depth, CAMERA, gravity=(0, 0, 1))
    back = inside(room.surface) & (room.surface == BACK)
    assert tilted.angle[back] == pytest.approx(15.0, abs=1e-6)


def test_one_wall_alone_leaves_the_guess_as_it_is() -> None:
    assert find_gravity(np.tile([0.0, 0.0, 1.0], (50, 1))).tolist() == [0.0, 1.0, 0.0]
    assert find_gravity(np.full((5, 3), np.nan)).tolist() == [0.0, 1.0, 0.0]


def test_gravity_ignores_slanted_surfaces() -> None:
    rng = np.random.default_rng(0)
    down = np.array([0.1, 0.98, 0.17])
    down /= np.linalg.norm(down)
    side = np.cross(down, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    other = np.cross(down, side)
    normals = np.concatenate([np.tile(v, (200, 1)) for v in (down, side, other)])
    normals = np.concatenate([normals, np.tile((down + side) / np.sqrt(2), (100, 1))])
    normals += rng.normal(0, 0.01, normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.degrees(np.arccos(find_gravity(normals) @ down)) < 0.2


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_nothing_but_holes(value: float) -> None:
    found = compute_hha(np.full((6, 7), value), CAMERA)
    assert np.isnan(found.disparity).all() and np.isnan(found.angle).all()
    assert not encode(found).any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (0, 5)])
def test_maps_without_a_plane(shape: tuple[int, int]) -> None:
    found = compute_hha(np.full(shape, 2.0), CAMERA)
    assert np.isnan(found.angle).all()
    assert (found.disparity == 0.5).all() and (np.abs(found.height) < 0.3).all()


def test_absurd_depths_stay_where_they_are() -> None:
    depth = np.full((12, 12), 2.0)
    depth[3, 3], depth[8, 8], depth[5, 9] = 1e30, 1e-30, -5.0
    picture = encode(compute_hha(depth, CAMERA, gravity=(0, 1, 0)))
    assert picture[5, 9].tolist() == [0, 0, 0]
    assert picture[6, 2, 0] == 155 and picture[6, 2, 2] == 90 + 38


def test_encodings() -> None:
    room = make_room()
    found = compute_hha(room.depth, CAMERA, gravity=room.down)
    back = inside(room.surface) & (room.surface == BACK)
    height = room.height[back]
    gupta, kitti = encode(found), encode(found, "kitti")
    assert np.abs(gupta[back] - np.stack([310 / 4 + 0 * height, 100 * height, 128 + 0 * height], 1)
                  ).max() <= 0.6  # fmt: skip
    expected = np.stack([51 * height, 255 + 0 * height, 255 + 0 * height], 1)
    assert np.abs(kitti[back] - expected).max() <= 1.1
    ceiling = inside(room.surface) & (room.surface == CEILING)
    assert (gupta[ceiling][:, 2] == 218).all() and (kitti[ceiling][:, 2] <= 1).all()
    with pytest.raises(ValueError, match="encoding: expected one of"):
        encode(found, "other")


@pytest.mark.parametrize("gravity", [(0, 0, 0), (0, 1), (np.nan, 1, 0)])
def test_no_direction_is_refused(gravity: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="gravity: expected a direction"):
        compute_hha(np.ones((4, 4)), CAMERA, gravity)
    with pytest.raises(ValueError, match="depth: expected"):
        compute_hha(np.ones((1, 4, 4)), CAMERA)


def test_against_the_published_channels(data_folder: Path) -> None:
    kitti = data_folder / "kitti"
    counts = np.asarray(Image.open(kitti / "depth" / "img_18.png")).astype(np.float64)
    published = np.asarray(Image.open(kitti / "hha" / "img_18.png")).astype(np.float64)
    own = encode(compute_hha(counts * (90 / 65535), Intrinsics(721, 721, 480, 47)), "kitti")
    valid = counts > 0
    assert np.abs(own[valid][:, 1] - published[valid][:, 1]).max() <= 1
    for channel in (0, 2):
        both = np.corrcoef(own[valid][:, channel], published[valid][:, channel])
        assert both[0, 1] > 0.94


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = make_room()
    Image.fromarray((room.depth * 1000).astype(np.uint16)).save(tmp_path / "depth.png")
    out = tmp_path / "hha.png"
    arguments = ["--unit", "0.001", "--focal", "43", "--out", str(out)]
    assert hha.main([str(tmp_path / "depth.png"), *arguments]) == 0
    assert "down is" in capsys.readouterr().out
    picture = np.asarray(Image.open(out))
    assert picture.shape == (80, 100, 3)
    assert picture[38, 50, 2] == pytest.approx(128, abs=2)
    assert hha.main([str(tmp_path / "none.png"), *arguments]) == 2
    assert "none.png" in capsys.readouterr().err
