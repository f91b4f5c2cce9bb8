"""``python -m surfconv_ops levels``: what it reads, prints, writes and draws, and how it fails."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import oracle_d4
from surfconv_ops import DepthLevels, cli, d4, fit_depth_levels
from surfconv_ops.cli import levels as command
from surfconv_ops.cli.depth_files import find_files

Image = pytest.importorskip("PIL.Image", reason="Pillow reads and writes the files")
pytest.importorskip("matplotlib", reason="draws the picture")
pytest.importorskip("tqdm", reason="shows the progress")

Run = Callable[..., tuple[int, str, str]]
UNIT = 0.001


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command in an empty folder: exit status, standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    def run_command(*arguments: object) -> tuple[int, str, str]:
        try:
            status = cli.main(["levels", *map(str, arguments)])
        except SystemExit as error:
            status = error.code if isinstance(error.code, int) else 1
        return status, *capsys.readouterr()

    return run_command


def frames(count: int = 3) -> list[np.ndarray]:
    """Depth in millimetres with holes."""
    rng = np.random.default_rng(0)
    depth = rng.lognormal(8.0, 0.5, (count, 20, 30)).clip(1, 60_000).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.2] = 0
    return list(depth)


def save_frames(folder: Path, images: list[np.ndarray]) -> None:
    folder.mkdir(exist_ok=True)
    for number, image in enumerate(images):
        Image.fromarray(image).save(folder / f"frame_{number}.png")


def rows(text: str) -> list[list[float]]:
    """The numbers of the table's lines: level, low, high, centre, pixels, importance, scale."""
    lines = [line for line in text.splitlines() if re.match(r"\d+ +\d+\.\d+ +- ", line)]
    return [[float(number) for number in re.findall(r"\d+(?:\.\d+)?", line)] for line in lines]


@pytest.mark.parametrize("gamma", [0, 1, 2])
def test_levels_table_and_picture(run: Run, tmp_path: Path, gamma: int) -> None:
    save_frames(tmp_path / "depth", frames())
    status, out, err = run("depth/*.png", "--unit", UNIT, "--levels", 5, "--gamma", gamma)
    assert status == 0 and "3/3" in err

    metres = np.concatenate([image.ravel() for image in frames()]) * UNIT
    expected = oracle_d4.fit(metres.tolist(), 5, gamma)
    saved = DepthLevels.load(tmp_path / "levels.json")
    assert list(saved.edges) == expected.edges and saved.gamma == gamma
    assert saved.centers == pytest.approx(expected.centers, rel=1e-12)

    valid = np.sort(metres[metres > 0])
    median = valid[(len(valid) - 1) // 2]
    assert f"{len(valid) / metres.size:.1%} valid" in out and f"median {median:.3f} m" in out
    assert f"Scale 1 at {median:.3f} m (median of the valid pixels)" in out
    assert "(exact)" in out
    bounds = [valid[0], *expected.edges, valid[-1]]
    weight = valid**gamma
    table = rows(out)
    assert len(table) == 5
    for k, (level, low, high, center, pixels, importance, scale) in enumerate(table):
        inside = (valid <= bounds[k + 1]) & ((valid > bounds[k]) | (k == 0))
        assert level == k
        assert [low, high] == pytest.approx(bounds[k : k + 2], abs=6e-4)
        assert center == pytest.approx(expected.centers[k], abs=6e-4)
        assert pixels == pytest.approx(100 * inside.mean(), abs=0.06)
        assert importance == pytest.approx(100 * weight[inside].sum() / weight.sum(), abs=0.06)
        assert scale == pytest.approx(median / expected.centers[k], abs=6e-4)

    with Image.open(tmp_path / "levels.png") as image:
        assert min(image.size) > 400 and len(image.convert("RGB").getcolors(2**24)) > 50


def test_reference_depth(run: Run, tmp_path: Path) -> None:
    save_frames(tmp_path / "depth", frames(1))
    _, out, _ = run("depth/*.png", "--unit", UNIT, "--reference-depth", 2.5, "--no-plot")
    assert "Scale 1 at 2.500 m (--reference-depth)" in out
    for row, center in zip(rows(out), DepthLevels.load("levels.json").centers, strict=True):
        assert row[-1] == pytest.approx(2.5 / center, abs=6e-4)
    assert not (tmp_path / "levels.png").exists()


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


def test_what_counts_as_a_hole(run: Run, tmp_path: Path) -> None:
    image = np.array([[1000, 2000, 3000, 4000, 9000, 65535, 65535, 0]], np.uint16)
    save_frames(tmp_path / "depth", [image])
    options = ("depth/*.png", "--unit", UNIT, "--gamma", 0, "--levels", 1, "--no-plot")
    _, _, err = run(*options)
    assert DepthLevels.load("levels.json").centers[0] == pytest.approx((19 + 2 * 65.535) / 7)
    assert "28.6% of the valid pixels have the count 65535" in err
    assert "--invalid-counts 65535" in err
    _, _, err = run(*options, "--invalid-counts", 65535, 9000)
    assert DepthLevels.load("levels.json").centers == (2.5,)
    assert "65535" not in err
    _, _, err = run(*options, "--max-depth", 3)
    assert DepthLevels.load("levels.json").centers == (2.0,)
    assert "65535" not in err


def test_notes(run: Run, tmp_path: Path) -> None:
    save_frames(tmp_path / "depth", [np.full((4, 5), 1500, np.uint16)])
    status, out, err = run("depth/*.png", "--unit", 1)
    assert status == 0 and rows(out) == [[0, 1500, 1500, 1500, 100, 100, 1]]
    assert "note: depth levels: asked for 4, made 1" in err
    assert "note: the median depth is 1500 m; is --unit 1 right?" in err
    assert "1 file, 20 pixels" in out and "1 level of" in out


def test_levels_from_bins(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_frames(tmp_path / "depth", frames())
    monkeypatch.setattr(d4, "EXACT_LIMIT", 100)
    _, out, _ = run("depth/*.png", "--unit", UNIT, "--no-plot")
    exact = fit_depth_levels(np.stack(frames()) * UNIT, 4)
    assert "(from bins: edges at most 0.025 % above the exact ones)" in out
    assert DepthLevels.load("levels.json").edges == pytest.approx(exact.edges, rel=2.5e-4)


@pytest.mark.parametrize("gamma", [0.0, 1.0, 2.0])
def test_coloured_areas_are_the_shares(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                       gamma: float) -> None:  # fmt: skip
    from matplotlib.patches import StepPatch

    from surfconv_ops.cli import levels_picture

    figures = []
    draw = levels_picture.draw_picture
    monkeypatch.setattr(
        levels_picture, "draw_picture", lambda summary: figures.append(draw(summary)) or figures[0]
    )
    save_frames(tmp_path / "depth", frames())
    _, out, _ = run("depth/*.png", "--unit", UNIT, "--gamma", gamma)
    panels = figures[0].axes
    assert len(panels) == (1 if gamma == 0 else 2)
    for panel, column in zip(panels, (4, 5), strict=False):
        bands = [patch for patch in panel.patches if isinstance(patch, StepPatch)]
        assert len(bands) == 4
        for band, row in zip(bands, rows(out), strict=True):
            heights, ends, _ = band.get_data()
            assert (heights * np.diff(ends)).sum() == pytest.approx(row[column], abs=0.06)
            assert [ends[0], ends[-1]] == pytest.approx(row[1:3], abs=6e-4)
            assert f"level {int(row[0])}" in " ".join(text.get_text() for text in panel.texts)


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(np.full((2, 3), 1500, np.uint16), id="constant"),
        pytest.param(np.array([[1000, 2000]], np.uint16), id="two depths"),
        pytest.param(np.array([[1]], np.uint16), id="one pixel"),
        pytest.param(np.arange(65536, dtype=np.uint16).reshape(256, 256), id="all counts"),
    ],
)
@pytest.mark.parametrize("name", ["picture.png", "new/folder/picture.pdf", "picture.svg"])
def test_pictures_of_odd_data(run: Run, tmp_path: Path, image: np.ndarray, name: str) -> None:
    save_frames(tmp_path / "depth", [image])
    status, out, err = run("depth/*.png", "--unit", UNIT, "--levels", 6, "--plot", name,
                           "--out", "new/levels.json")  # fmt: skip
    assert status == 0, err
    assert f"Wrote new/levels.json and {name}" in out
    start = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[name[-3:]]
    assert (tmp_path / name).read_bytes().startswith(start)
    assert len(DepthLevels.load("new/levels.json")) == len(rows(out))


def test_far_pixels_do_not_squeeze_the_picture(run: Run, tmp_path: Path) -> None:
    depth = np.append(np.random.default_rng(0).uniform(1.0, 4.0, 9999), 5000.0)
    np.save(tmp_path / "depth.npy", depth)
    from surfconv_ops.cli import levels_picture

    parser_options = ["depth.npy", "--unit", "1", "--gamma", "0", "--no-plot"]
    summaries = []
    keep = command.summarise
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "summarise", lambda *a: summaries.append(keep(*a)) or summaries[0])
        run(*parser_options)
    (panel,) = levels_picture.draw_picture(summaries[0]).axes
    assert panel.get_xlim()[1] < 10
    assert "0.01 % of the pixels lie beyond" in panel.get_xlabel()


def test_one_file_in_memory_at_a_time(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_frames(tmp_path / "depth", frames(8))
    alive: list[weakref.ref[np.ndarray]] = []
    read = command.read_counts

    def watched(path: Path) -> np.ndarray:
        assert sum(reference() is not None for reference in alive) <= 1
        counts = read(path)
        alive.append(weakref.ref(counts))
        return counts

    monkeypatch.setattr(command, "read_counts", watched)
    assert run("depth/*.png", "--unit", UNIT, "--no-plot")[0] == 0
    assert len(alive) == 8


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
    assert call("--help", folder=tmp_path).stdout.startswith("usage: python -m surfconv_ops")
    help_text = call("levels", "--help", folder=tmp_path).stdout
    assert "examples:" in help_text and "--unit 90/65535" in help_text
    failed = call("levels", "*.png", "--unit", "1", folder=tmp_path)
    assert failed.returncode == 1 and "Traceback" not in failed.stderr
    assert failed.stderr.startswith("python -m surfconv_ops levels: error: no file matches")


def test_kitti(run: Run, data_folder: Path) -> None:
    pattern = data_folder / "kitti" / "depth" / "*.png"
    status, out, err = run(pattern, "--unit", "90/65535", "--levels", 4, "--gamma", 1)
    assert status == 0 and "70/70" in err
    assert "70 files, 16,128,000 pixels: 71.1% valid" in out and "(exact)" in out
    # The exact edges.
    assert [row[2] for row in rows(out)[:3]] == [11.640, 20.005, 36.376]
    assert [row[5] for row in rows(out)] == [25.0] * 4
