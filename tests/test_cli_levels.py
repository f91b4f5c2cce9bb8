"""``python -m surfconv_ops levels``: what it reads, prints, writes and draws."""

from __future__ import annotations

import functools
import re
import weakref
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import oracle_d4
from cli_runner import UNIT, Run, frames, run_levels, save_frames
from surfconv_ops import DepthLevels, d4, fit_depth_levels
from surfconv_ops.cli import levels as command

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Image = pytest.importorskip("PIL.Image", reason="Pillow reads and writes the files")
pytest.importorskip("matplotlib", reason="draws the picture")
pytest.importorskip("tqdm", reason="shows the progress")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return functools.partial(run_levels, capsys)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that the command draws."""
    from surfconv_ops.cli import levels_picture

    figures: list[Figure] = []
    draw = levels_picture.draw_picture

    def keep(summary: command.Summary) -> Figure:
        figures.append(draw(summary))
        return figures[-1]

    monkeypatch.setattr(levels_picture, "draw_picture", keep)
    return figures


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
def test_coloured_areas_are_the_shares(
    drawn: list[Figure], run: Run, tmp_path: Path, gamma: float
) -> None:
    from matplotlib.patches import StepPatch

    save_frames(tmp_path / "depth", frames())
    _, out, _ = run("depth/*.png", "--unit", UNIT, "--gamma", gamma)
    panels = drawn[0].axes
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


def test_far_pixels_do_not_squeeze_the_picture(drawn: list[Figure], run: Run) -> None:
    from matplotlib.patches import StepPatch

    np.save("depth.npy", np.append(np.random.default_rng(0).uniform(1.0, 4.0, 9999), 5000.0))
    run("depth.npy", "--unit", 1, "--gamma", 0)
    (panel,) = drawn[0].axes
    assert panel.get_xlim()[1] < 10
    last = [patch for patch in panel.patches if isinstance(patch, StepPatch)][-1].get_data()
    # One of 10,000 pixels is out of the picture, so not in its last bar either.
    assert last.values[-1] == 0
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


def test_kitti(run: Run, data_folder: Path) -> None:
    pattern = data_folder / "kitti" / "depth" / "*.png"
    status, out, err = run(pattern, "--unit", "90/65535", "--levels", 4, "--gamma", 1)
    assert status == 0 and "70/70" in err
    assert "70 files, 16,128,000 pixels: 71.1% valid" in out and "(exact)" in out
    # The exact edges.
    assert [row[2] for row in rows(out)[:3]] == [11.640, 20.005, 36.376]
    assert [row[5] for row in rows(out)] == [25.0] * 4
