"""What ``python -m surfconv_ops levels`` reads, and how it fails."""

from __future__ import annotations

import functools
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli_runner import UNIT, Run, frames, run_levels, save_frames
from surfconv_ops import DepthLevels, fit_depth_levels
from surfconv_ops.cli.depth_files import find_files

Image = pytest.importorskip("PIL.Image", reason="Pillow reads and writes the files")
pytest.importorskip("matplotlib", reason="draws the picture")
pytest.importorskip("tqdm", reason="shows the progress")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return functools.partial(run_levels, capsys)


def test_units_and_formats_agree(run: Run, tmp_path: Path) -> None:
    counts = frames(2)
    save_frames(tmp_path / "png", counts)
    np.save(tmp_path / "counts.npy", np.stack(counts))
    np.save(tmp_path / "metres.npy", np.stack(counts) * UNIT)
    np.savez(tmp_path / "one.npz", anything=np.stack(counts))
    np.savez(tmp_path / "two.npz", depth=np.stack(counts), other=np.ones(3))
    Image.fromarray(np.concatenate(counts).astype(np.float32)).save(tmp_path / "float.tiff")
    Image.fromarray(np.concatenate(counts).astype(np.int32)).save(tmp_path / "int.tiff")
    expected = fit_depth_levels(np.stack(counts) * UNIT, 4)
    for pattern, unit in [
        ("png/*", "0.001"),
        ("png/*", "1/1000"),
        ("counts.npy", "1e-3"),
        ("metres.npy", "1"),
        ("one.npz", "0.001"),
        ("two.npz", "0.001"),
        ("float.tiff", "0.001"),
        ("int.tiff", "0.001"),
    ]:
        status, _, err = run(pattern, "--unit", unit, "--no-plot")
        assert status == 0, err
        assert DepthLevels.load("levels.json").edges == pytest.approx(expected.edges, rel=1e-12)


def test_find_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["a/img_10.png", "a/img_2.png", "b/c/img_1.png", "x[1].png"]
    for name in names:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    found = [path.as_posix() for path in find_files(["**/*.png", "a/*", "./x[1].png"])]
    assert found == ["a/img_2.png", "a/img_10.png", "b/c/img_1.png", "x[1].png"]


def test_files_that_are_not_there(run: Run, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    status, _, err = run("nothing/*.png", "--unit", UNIT)
    assert status == 1 and f"no file matches 'nothing/*.png' (seen from {tmp_path})" in err
    status, _, err = run("folder", "--unit", UNIT)
    assert status == 1 and "no file matches 'folder' (it means folders only)" in err


def write_bad_files(folder: Path) -> None:
    grey = np.full((4, 5), 100, np.uint8)
    Image.fromarray(grey).save(folder / "grey.png")
    Image.fromarray(np.stack([grey] * 3, -1)).save(folder / "rgb.png")
    Image.fromarray(grey).convert("P").save(folder / "palette.png")
    Image.fromarray(np.full((40, 50), 1000, np.uint16)).save(folder / "cut.png")
    (folder / "cut.png").write_bytes((folder / "cut.png").read_bytes()[:60])
    (folder / "text.png").write_text("no image")
    (folder / "text.npy").write_text("no array")
    (folder / "text.npz").write_text("no archive")
    np.save(folder / "object.npy", np.array([{}]), allow_pickle=True)
    np.save(folder / "byte.npy", grey)
    np.save(folder / "complex.npy", np.ones(3, complex))
    np.savez(folder / "many.npz", a=grey, b=grey)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("grey.png", r"one channel of 16 bits or more, got .*8-bit grey"),
        ("rgb.png", r"one channel of 16 bits or more, got .*RGB.* sensor's own files"),
        ("palette.png", r"one channel of 16 bits or more, got .*palette"),
        ("cut.png", "cannot be read as an image"),
        ("text.png", "cannot be read as an image"),
        ("text.npy", "cannot be read as an array"),
        ("text.npz", "cannot be read as an array"),
        ("object.npy", "cannot be read as an array"),
        ("byte.npy", r"16 bits or more, got an array of uint8"),
        ("complex.npy", "expected numbers, got complex128"),
        ("many.npz", r"expected one array, or one named 'depth', got a, b"),
    ],
)
def test_files_that_hold_no_depth(run: Run, tmp_path: Path, name: str, message: str) -> None:
    write_bad_files(tmp_path)
    status, out, err = run(name, "--unit", UNIT)
    assert status == 1 and not out
    assert re.search(rf"levels: error: {re.escape(name)}: .*{message}", err)
    assert not (tmp_path / "levels.json").exists()


def test_nothing_but_holes(run: Run, tmp_path: Path) -> None:
    save_frames(tmp_path / "depth", [np.zeros((4, 5), np.uint16), np.full((4, 5), 9000, np.uint16)])
    status, _, err = run("depth/*.png", "--unit", UNIT, "--max-depth", 8)
    assert status == 1
    assert "no valid depth in 2 files: every pixel of 40 is 0" in err and "--max-depth" in err


@pytest.mark.parametrize(
    ("module", "package"), [("PIL.Image", "Pillow"), ("matplotlib", "matplotlib"), ("tqdm", "tqdm")]
)
def test_missing_packages(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, package: str
) -> None:
    save_frames(tmp_path / "depth", frames(1))
    monkeypatch.setitem(sys.modules, module, None)
    status, _, err = run("depth/*.png", "--unit", UNIT)
    assert status == 1
    assert f"{package} is needed" in err and "pip install 'surfconv_ops[cli]'" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--unit is missing: .*0.001 where a count is a millimetre"),
        (["--unit", "0"], "argument --unit: expected a positive, finite number, got '0'"),
        (["--unit", "1/0"], "argument --unit: expected a number or a fraction"),
        (["--unit", "mm"], "argument --unit: expected a number or a fraction"),
        (["--unit", "1", "--levels", "0"], "argument --levels: expected 1 or more, got 0"),
        (["--unit", "1", "--levels", "2.5"], "argument --levels: expected a whole number"),
        (["--unit", "1", "--gamma", "nan"], "argument --gamma: expected a finite number"),
        (["--unit", "1", "--gamma", "x"], "argument --gamma: expected a number"),
        (["--unit", "1", "--reference-depth", "-1"], "argument --reference-depth: expected a pos"),
        (["--unit", "1", "--plot", "levels.txt"], "--plot: expected a file ending in .*.png"),
    ],
)
def test_wrong_arguments(run: Run, arguments: list[str], message: str) -> None:
    status, out, err = run("depth/*.png", *arguments)
    assert status == 2 and not out
    assert re.search(message, err) and err.startswith("usage: ")


def test_results_that_cannot_be_written(run: Run, tmp_path: Path) -> None:
    save_frames(tmp_path / "depth", frames(1))
    (tmp_path / "taken").mkdir()
    status, _, err = run("depth/*.png", "--unit", UNIT, "--out", "taken")
    assert status == 1 and "cannot write taken: " in err
    (tmp_path / "file").touch()
    status, _, err = run("depth/*.png", "--unit", UNIT, "--out", "file/levels.json")
    assert status == 1 and "cannot make the folder of file" in err


def call(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).resolve().parent.parent
    environment: dict[str, Any] = {**os.environ, "PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, "-m", "surfconv_ops", *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


def test_as_a_program(tmp_path: Path) -> None:
    failed = call("levels", "*.png", "--unit", "1", folder=tmp_path)
    assert failed.returncode == 1 and "Traceback" not in failed.stderr
    assert failed.stderr.startswith("python -m surfconv_ops levels: error: no file matches")
