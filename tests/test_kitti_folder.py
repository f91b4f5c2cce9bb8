"""The KITTI example's data folder: what it reads, and how it says what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from folder import FolderError, FrameFolder, network_input, split
from kitti_frames import EXAMPLE, SIZE, write_folder

NAMES = ["img_1", "img_2", "img_10"]


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "frames", ["img_10", "img_1", "img_2"])


def test_frames_come_in_natural_order_and_in_metres(frames: Path) -> None:
    folder = FrameFolder(frames)
    assert folder.names == NAMES
    frame = folder.frame("img_2")
    counts = np.array(Image.open(frames / "depth" / "img_2.png"))
    np.testing.assert_allclose(frame.depth.numpy(), counts / 65535 * 90, rtol=1e-6)
    assert (frame.depth[frame.label == 0] == 0).all() and (frame.depth[frame.label > 0] > 7).all()
    assert frame.rgb.shape == frame.hha.shape == (*SIZE, 3)


def test_a_unit_beside_the_folders_is_used(frames: Path) -> None:
    before = FrameFolder(frames).depth("img_1")
    (frames / "dataset.json").write_text('{"metres_per_count": 0.001}')
    after = FrameFolder(frames).depth("img_1")
    torch.testing.assert_close(after, before * (0.001 * 65535 / 90))
    (frames / "dataset.json").write_text('{"metres_per_count": 0}')
    with pytest.raises(FolderError, match="positive number under metres_per_count"):
        FrameFolder(frames)


def test_classes_beside_the_folders_are_used(frames: Path) -> None:
    assert len(FrameFolder(frames).class_names) == 12
    (frames / "dataset.json").write_text('{"classes": ["ignored", "wall", "floor"]}')
    folder = FrameFolder(frames)
    assert folder.class_names == ("ignored", "wall", "floor")
    with pytest.raises(FolderError, match=r"holds class 3; expected 0 .* to 2"):
        folder.frame("img_1")
    for text, message in (
        ('{"classes": []}', "2 to 256 names"),
        ('{"classes": 3}', "cannot be read"),
        ("no JSON", "cannot be read"),
    ):
        (frames / "dataset.json").write_text(text)
        with pytest.raises(FolderError, match=message):
            FrameFolder(frames)


def test_the_networks_input_is_rgb_then_hha_around_zero(frames: Path) -> None:
    frame = FrameFolder(frames).frame("img_1")
    input = network_input(frame)
    assert input.shape == (6, *SIZE) and input.is_contiguous()
    assert input[2, 5, 7].item() == pytest.approx((float(frame.rgb[5, 7, 2]) - 90.96) / 64)
    assert input[5, 5, 7].item() == pytest.approx((float(frame.hha[5, 7, 2]) - 96.97) / 64)


def _replace(frames: Path, folder: str, picture: np.ndarray) -> None:
    Image.fromarray(picture).save(frames / folder / "img_2.png")


@pytest.mark.parametrize(
    ("folder", "picture", "message"),
    [
        ("depth", np.ones(SIZE, np.uint8), r"img_2.png: expected I;16.*got L"),
        ("rgb", np.ones(SIZE, np.uint8), r"rgb/img_2.png: expected RGB pixels, got L"),
        ("hha", np.ones((16, 16, 3), np.uint8), r"hha/img_2.png has 16 x 16 pixels.* 48 x 32"),
        ("label", np.full(SIZE, 12, np.uint8), r"holds class 12; expected 0 .* to 11"),
    ],
)
def test_a_wrong_picture_is_named(
    frames: Path, folder: str, picture: np.ndarray, message: str
) -> None:
    _replace(frames, folder, picture)
    with pytest.raises(FolderError, match=message):
        FrameFolder(frames).frame("img_2")


def test_a_broken_picture_is_named(frames: Path) -> None:
    (frames / "rgb" / "img_2.png").write_bytes(b"no picture")
    with pytest.raises(FolderError, match=r"rgb/img_2.png is not a picture"):
        FrameFolder(frames).frame("img_2")


def test_what_is_missing_is_named(frames: Path, tmp_path: Path) -> None:
    with pytest.raises(FolderError, match="nowhere is not a folder; expected one with the folders"):
        FrameFolder(tmp_path / "nowhere")
    (frames / "hha" / "img_10.png").unlink()
    with pytest.raises(FolderError, match=r"hha lacks 1 of 3 frames .*: img_10.png"):
        FrameFolder(frames)
    for path in (frames / "hha").iterdir():
        path.unlink()
    (frames / "hha").rmdir()
    with pytest.raises(FolderError, match="has no folder hha; expected the folders rgb/"):
        FrameFolder(frames)
    empty = tmp_path / "empty"
    for name in ("rgb", "depth", "hha", "label"):
        (empty / name).mkdir(parents=True)
    with pytest.raises(FolderError, match=r"no .png file in any of rgb, depth, hha and label"):
        FrameFolder(empty)


def test_a_split_keeps_the_named_frames_apart(tmp_path: Path) -> None:
    path = tmp_path / "kept.txt"
    path.write_text("# a comment\nimg_2  # this one\n\n")
    assert split(NAMES, path) == (["img_1", "img_10"], ["img_2"])
    assert split(NAMES, None) == (NAMES, [])
    path.write_text("img_3\n")
    with pytest.raises(FolderError, match=r"names frames that are not in the folder: img_3;"):
        split(NAMES, path)
    path.write_text("\n".join(NAMES))
    with pytest.raises(FolderError, match="leaves no frame to train on"):
        split(NAMES, path)
    with pytest.raises(FolderError, match="no such file"):
        split(NAMES, tmp_path / "nowhere.txt")


def test_the_real_frames_and_their_split(data_folder: Path) -> None:
    folder = FrameFolder(data_folder / "kitti")
    train, kept = split(folder.names, EXAMPLE / "validation.txt")
    assert (len(train), len(kept)) == (56, 14) and folder.names[:2] == ["img_1", "img_2"]
    frame = folder.frame("img_3")
    assert frame.rgb.shape == (240, 960, 3)
    assert frame.depth[frame.depth > 0].min() > 3 and frame.depth.max() < 90
    assert ((frame.label > 0) <= (frame.depth > 0)).all()
