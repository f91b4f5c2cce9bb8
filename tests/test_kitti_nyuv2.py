"""NYUv2's loader and export, on a file of its layout made here."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "kitti"))

import nyuv2
from folder import FrameFolder
from hha import Intrinsics, compute_hha, encode
from nyuv2 import NYUv2, export
from nyuv2_labels import LabelMapping, NYUError, read_mapping, read_splits

COUNT, HEIGHT, WIDTH = 4, 12, 16
NAMES = ["wall", "floor", "blinds é", "other prop", "night stand"]


def matlab_arrays() -> dict[str, np.ndarray]:
    """The arrays as MATLAB shows them: rows, columns, (colour,) frame."""
    rng = np.random.default_rng(0)
    depths = rng.uniform(0.7, 9.9, (HEIGHT, WIDTH, COUNT)).astype(np.float32)
    raw = depths.copy()
    raw[2:4, 3, :] = 0
    return {
        "images": rng.integers(0, 256, (HEIGHT, WIDTH, 3, COUNT)).astype(np.uint8),
        "depths": depths,
        "rawDepths": raw,
        "labels": rng.integers(0, len(NAMES) + 1, (HEIGHT, WIDTH, COUNT)).astype(np.uint16),
    }


def write_mat(path: Path, arrays: dict[str, np.ndarray], names: list[str] = NAMES) -> Path:
    """What MATLAB 7.3 writes: a block of its own first, axes reversed, cells as references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = array.T
        cells = file.create_dataset("names", (1, len(names)), dtype=h5py.ref_dtype)
        for k, name in enumerate(names):
            units = np.frombuffer(name.encode("utf-16-le"), "<u2").reshape(-1, 1)
            cells[0, k] = file.create_dataset(f"#refs#/{k}", data=units).ref
    return path


@pytest.fixture
def mat(tmp_path: Path) -> Path:
    return write_mat(tmp_path / "nyu.mat", matlab_arrays())


def test_axes_come_back_in_order(mat: Path) -> None:
    arrays = matlab_arrays()
    with NYUv2(mat) as frames:
        assert len(frames) == COUNT and frames.label_names() == NAMES
        for k, frame in enumerate(frames):
            assert frame.name == f"000{k + 1}"
            assert np.array_equal(frame.rgb, arrays["images"][..., k])
            assert frame.rgb.dtype == np.uint8 and frame.rgb.flags["C_CONTIGUOUS"]
            assert np.array_equal(frame.depth.numpy(), arrays["depths"][..., k])
            assert np.array_equal(frame.label.numpy(), arrays["labels"][..., k])
        assert [frame.name for frame in frames[1:3]] == ["0002", "0003"]
        assert frames[-1].name == "0004"
        with pytest.raises(IndexError):
            frames[COUNT]


def test_raw_depth_keeps_its_holes(mat: Path) -> None:
    arrays = matlab_arrays()
    arrays["rawDepths"][0, 0, 1] = np.nan
    write_mat(mat, arrays)
    with NYUv2(mat, raw=True) as frames:
        depth = frames[1].depth.numpy()
    expected = arrays["rawDepths"][..., 1].copy()
    expected[0, 0] = 0
    assert np.array_equal(depth, expected) and (depth == 0).sum() == 3


def test_only_the_frame_asked_for_is_read(mat: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Any] = []
    original = h5py.Dataset.__getitem__

    def watched(self: h5py.Dataset, key: Any, **more: Any) -> Any:
        found = original(self, key, **more)
        if self.name in ("/images", "/depths", "/labels"):
            read.append((self.name, np.size(found)))
        return found

    monkeypatch.setattr(h5py.Dataset, "__getitem__", watched)
    with NYUv2(mat) as frames:
        assert not read
        assert frames[2].name == "0003"
    assert sorted(read) == [
        ("/depths", HEIGHT * WIDTH), ("/images", 3 * HEIGHT * WIDTH), ("/labels", HEIGHT * WIDTH)
    ]  # fmt: skip


def test_frames_can_be_chosen(mat: Path) -> None:
    with NYUv2(mat, chosen=[3, 0]) as frames:
        assert [frame.name for frame in frames] == ["0004", "0001"]
    with pytest.raises(NYUError, match="holds 4 frames; frame 5"):
        NYUv2(mat, chosen=[4])


def test_hha_is_that_of_the_depth(mat: Path) -> None:
    camera = Intrinsics(20.0, 20.0, 7.5, 5.5)
    with NYUv2(mat, intrinsics=camera) as frames:
        expected = encode(compute_hha(matlab_arrays()["depths"][..., 0], camera))
        assert np.array_equal(frames[0].hha, expected)


def write_mapping(folder: Path, kind: str, values: list[int]) -> Path:
    path = folder / f"mapping.{kind}"
    if kind == "mat":
        names = np.array([f"class {k}" for k in range(1, 41)], dtype=object)
        scipy.io.savemat(path, {"mapClass": np.array([values]), "className": names})
    elif kind == "npy":
        np.save(path, np.array(values, np.uint8))
    else:
        path.write_text(json.dumps(values))
    return path


@pytest.mark.parametrize("kind", ["mat", "npy", "json"])
def test_labels_are_mapped(mat: Path, tmp_path: Path, kind: str) -> None:
    mapping = read_mapping(write_mapping(tmp_path, kind, [1, 2, 37, 38, 32]), NAMES)
    assert mapping.table.tolist() == [0, 1, 2, 37, 0, 32]
    if kind == "mat":
        assert mapping.class_names is not None and len(mapping.class_names) == 38
        assert mapping.class_names[:2] == ["ignored", "class 1"]
    with NYUv2(mat, mapping=mapping) as frames:
        label = frames[0].label.numpy()
    before = matlab_arrays()["labels"][..., 0]
    for old, new in enumerate([0, 1, 2, 37, 0, 32]):
        assert (label[before == old] == new).all()
    whole = read_mapping(tmp_path / f"mapping.{kind}", NAMES, classes=None)
    assert whole.table.tolist() == [0, 1, 2, 37, 38, 32]


def test_labels_are_mapped_by_name(tmp_path: Path) -> None:
    path = tmp_path / "mapping.json"
    path.write_text(json.dumps({"floor": 1, "night stand": 2}))
    assert read_mapping(path, NAMES).table.tolist() == [0, 0, 1, 0, 0, 2]
    path.write_text(json.dumps({"flor": 1}))
    with pytest.raises(NYUError, match="names labels that the data has not: \\['flor'\\]"):
        read_mapping(path, NAMES)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "expected a class for each of 5 labels"),
        ("[1, 2, 3, 4, -1]", "not whole numbers"),
        ("[1, 2, 3, 4, 0.5]", "not whole numbers"),
        ('["a", "b", "c", "d", "e"]', "expected a class for each"),
        ("[1, 2", "not JSON"),
    ],
)
def test_mappings_that_do_not_fit(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "mapping.json"
    path.write_text(content)
    with pytest.raises(NYUError, match=message):
        read_mapping(path, NAMES)


def test_other_files_are_refused(mat: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.mat"
    text.write_text("nothing")
    with pytest.raises(NYUError, match=r"not a MATLAB 7\.3"):
        NYUv2(text)
    with pytest.raises(NYUError, match="no such file"):
        NYUv2(tmp_path / "none.mat")
    for path, message in ((text, "not a MATLAB file"), (tmp_path / "none.mat", "no such file")):
        with pytest.raises(NYUError, match=f"--mapping: .*{message}"):
            read_mapping(path, NAMES)
        with pytest.raises(NYUError, match=f"--splits: .*{message}"):
            read_splits(path, COUNT)
    (tmp_path / "a.npy").write_text("nothing")
    with pytest.raises(NYUError, match="not an array"):
        read_mapping(tmp_path / "a.npy", NAMES)
    with pytest.raises(NYUError, match=r"expected a \.mat, \.npy or \.json"):
        read_mapping(write_mat(tmp_path / "a.h5", {}), NAMES)
    with pytest.raises(NYUError, match="has no images or depths or labels"):
        NYUv2(write_mat(tmp_path / "empty.mat", {}))
    arrays = matlab_arrays()
    arrays["depths"] = arrays["depths"].swapaxes(0, 1)
    with pytest.raises(NYUError, match=r"depths has shape \(4, 12, 16\); expected \(4, 16"):
        NYUv2(write_mat(tmp_path / "turned.mat", arrays))
    with pytest.raises(NYUError, match="each of the 5 labels"):
        NYUv2(mat, mapping=LabelMapping(np.zeros(3, np.int32), None))


def write_splits(path: Path, train: list[int], test: list[int]) -> Path:
    columns = {"trainNdxs": np.array([train]).T, "testNdxs": np.array([test]).T}
    scipy.io.savemat(path, columns)
    return path


def test_splits_count_from_one(tmp_path: Path) -> None:
    parts = read_splits(write_splits(tmp_path / "s.mat", [1, 4], [2, 3]), COUNT)
    assert {k: v.tolist() for k, v in parts.items()} == {"train": [0, 3], "test": [1, 2]}
    for train, message in (([0, 4], "frames 0 to 4"), ([1, 5], "1 to 4"), ([1, 2], "twice")):
        with pytest.raises(NYUError, match=message):
            read_splits(write_splits(tmp_path / "s.mat", train, [2, 3]), COUNT)
    scipy.io.savemat(tmp_path / "s.mat", {"trainNdxs": np.ones(1)})
    with pytest.raises(NYUError, match="holds no testNdxs"):
        read_splits(tmp_path / "s.mat", COUNT)


def test_the_export_is_a_folder_that_training_reads(mat: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    mapping = write_mapping(tmp_path, "mat", [1, 2, 11, 40, 7])
    splits = write_splits(tmp_path / "splits.mat", [1, 4], [2, 3])
    arguments = ["export", str(mat), "--mapping", str(mapping), "--splits", str(splits)]
    assert nyuv2.main([*arguments, "--out", str(out)]) == 0
    assert (out / "train.txt").read_text() == "0001\n0004\n"
    assert (out / "test.txt").read_text() == "0002\n0003\n"
    folder = FrameFolder(out)
    assert folder.names == ["0001", "0002", "0003", "0004"]
    arrays = matlab_arrays()
    table = np.array([0, 1, 2, 11, 0, 7])
    for k, name in enumerate(folder.names):
        frame = folder.frame(name)
        assert np.array_equal(frame.rgb, arrays["images"][..., k])
        assert np.abs(frame.depth.numpy() - arrays["depths"][..., k]).max() <= 0.00011
        assert np.array_equal(frame.label.numpy(), table[arrays["labels"][..., k]])
        assert frame.hha.shape == (HEIGHT, WIDTH, 3) and frame.hha.any()
    about = json.loads((out / "dataset.json").read_text())
    assert about["metres_per_count"] == 0.0002
    assert about["classes"] == ["ignored", *(f"class {k}" for k in range(1, 12))]


def test_one_split_in_a_unit_of_choice(mat: Path, tmp_path: Path) -> None:
    splits = write_splits(tmp_path / "splits.mat", [4], [2, 3])
    out = tmp_path / "out"
    arguments = ["export", str(mat), "--out", str(out), "--splits", str(splits), "--raw"]
    assert nyuv2.main([*arguments, "--split", "test", "--unit", "0.001"]) == 0
    assert sorted(path.name for path in (out / "depth").iterdir()) == ["0002.png", "0003.png"]
    counts = np.asarray(Image.open(out / "depth" / "0002.png"))
    expected = np.rint(matlab_arrays()["rawDepths"][..., 1].astype(np.float64) * 1000)
    assert np.array_equal(counts, expected)
    about = json.loads((out / "dataset.json").read_text())
    assert about == {"metres_per_count": 0.001, "classes": ["ignored", *NAMES]}
    assert not (out / "test.txt").exists()


def test_what_does_not_fit_the_pictures_is_refused(
    mat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert nyuv2.main(["export", str(mat), "--out", str(out), "--unit", "0.0001"]) == 2
    assert "end at 6.55 m" in capsys.readouterr().err
    assert nyuv2.main(["export", str(mat), "--out", str(out)]) == 2
    assert "exists and is not empty" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        nyuv2.main(["export", str(mat), "--out", str(out), "--split", "test"])
    assert "--splits" in capsys.readouterr().err
    arrays = matlab_arrays()
    arrays["labels"][0, 0, 0] = 256
    with (
        NYUv2(write_mat(tmp_path / "many.mat", arrays)) as frames,
        pytest.raises(NYUError, match="label 256; 8 bits end at 255"),
    ):
        export(frames, tmp_path / "other")
