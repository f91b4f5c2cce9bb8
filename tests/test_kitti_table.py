"""The table of training runs: what is grouped, what is averaged, what counts as finished."""

from __future__ import annotations

import csv
import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "kitti"))

import runs
import table

CONFIG = {
    "mode": "conv2d", "levels": None, "gamma": 1.0, "capacity": 1, "loss": "image", "seed": 0,
    "epochs": 4, "reference_depth": 25.9, "parameters": 65008, "out": "somewhere",
}  # fmt: skip


def figures(iou_surf: float) -> dict[str, float]:
    return {"acc_img": 0.7, "iou_img": iou_surf + 0.01, "acc_surf": 0.6, "iou_surf": iou_surf}


def write_run(folder: Path, iou_surf: float, done: int = 4, first: int = 1, **config: Any) -> Path:
    """A run whose last epoch has `iou_surf` and whose best, the one before, 0.01 more."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({**CONFIG, "out": str(folder), **config}))
    lines: list[dict[str, Any]] = [
        {"epoch": first + k, "train_loss": 1.0 / (k + 1), "seconds": 30.0} for k in range(done)
    ]
    if done > 1:
        lines[-1]["val"], lines[-2]["val"] = figures(iou_surf), figures(iou_surf + 0.01)
        best = {"epoch": lines[-2]["epoch"], "val": lines[-2]["val"]}
        (folder / "best.json").write_text(json.dumps(best))
    if done == 4:
        last = {"epoch": lines[-1]["epoch"], "val": lines[-1]["val"]}
        (folder / "last.json").write_text(json.dumps(last))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def cells(text: str, start: str) -> dict[str, str]:
    """The row of a Markdown table whose first cell is `start`, by column."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    head = lines[0]
    (row,) = [line for line in lines if line[0] == start]
    return dict(zip(head, row, strict=True))


@pytest.fixture
def six(tmp_path: Path) -> list[Path]:
    conv = [write_run(tmp_path / f"c{s}", v, seed=s) for s, v in enumerate((0.20, 0.22, 0.24))]
    surf = [
        write_run(tmp_path / f"s{s}", v, seed=s, mode="levels", levels=4)
        for s, v in enumerate((0.25, 0.24, 0.29))
    ]
    return [*surf, *conv]


def test_runs_that_differ_in_seed_make_one_row(six: list[Path]) -> None:
    groups = runs.group_runs([runs.load_run(folder) for folder in six])
    assert [group.setting["mode"] for group in groups] == ["conv2d", "levels"]
    assert [len(group.runs) for group in groups] == [3, 3]
    row = cells(table.markdown(groups, "last"), "conv2d")
    # By hand: the mean of 20, 22, 24 is 22, their sample deviation 2.
    assert row["IOU_surf"] == "22.00 ± 2.00 (20.00 to 24.00)"
    assert row["IOU_img"] == "23.00 ± 2.00 (21.00 to 25.00)"
    assert row["seeds"] == "3 (0, 1, 2)"
    assert row["minutes a run"] == "2.0"
    best = cells(table.markdown(groups, "best"), "conv2d")
    assert best["IOU_surf"] == "23.00 ± 2.00 (21.00 to 25.00)"


def test_the_gain_is_taken_seed_by_seed(six: list[Path]) -> None:
    groups = runs.group_runs([runs.load_run(folder) for folder in six])
    row = cells(table.markdown(groups, "last"), "levels")
    deviation = math.sqrt((1**2 + 2**2 + 1**2) / 2)  # of 5, 2, 5 about 4
    assert row["IOU_surf over conv2d"] == f"+4.00 ± {deviation:.2f} (2.00 to 5.00)"
    assert cells(table.markdown(groups, "last"), "conv2d")["IOU_surf over conv2d"] == "–"


def test_without_a_fair_baseline_there_is_no_gain(tmp_path: Path) -> None:
    folders = [
        write_run(tmp_path / "c", 0.2, capacity=2),
        write_run(tmp_path / "p", 0.3, mode="pyramid", levels=4),
    ]
    groups = runs.group_runs([runs.load_run(folder) for folder in folders])
    assert cells(table.markdown(groups, "best"), "pyramid")["IOU_surf over conv2d"] == "–"


def test_the_baseline_is_trained_in_the_same_way(tmp_path: Path) -> None:
    folders = [
        write_run(tmp_path / "slow", 0.1, rate=0.01, pools=False),
        write_run(tmp_path / "fast", 0.2, rate=0.05, pools=False),
        write_run(tmp_path / "p", 0.3, mode="pyramid", levels=4, rate=0.05, pools=True),
    ]
    groups = runs.group_runs([runs.load_run(folder) for folder in folders])
    assert cells(table.markdown(groups, "last"), "pyramid")["IOU_surf over conv2d"] == "+10.00"


def test_settings_of_different_versions_are_told_apart(tmp_path: Path) -> None:
    folders = [write_run(tmp_path / "old", 0.1), write_run(tmp_path / "new", 0.1, augment="none")]
    groups = runs.group_runs([runs.load_run(folder) for folder in folders])
    labels = [runs.label_of(group, groups) for group in groups]
    assert labels == ["conv2d", "conv2d, augment none"]
    assert "augment=none" in table.markdown(groups, "last")


def test_a_baseline_of_the_same_loss_goes_first(tmp_path: Path) -> None:
    folders = [
        write_run(tmp_path / "image", 0.2),
        write_run(tmp_path / "levels", 0.1, loss="levels"),
        write_run(tmp_path / "p", 0.3, mode="pyramid", levels=4, loss="levels"),
    ]
    groups = runs.group_runs([runs.load_run(folder) for folder in folders])
    assert cells(table.markdown(groups, "last"), "pyramid")["IOU_surf over conv2d"] == "+20.00"


@pytest.mark.parametrize("first", [0, 1])
def test_an_unfinished_run_is_named_and_not_counted(tmp_path: Path, first: int) -> None:
    folders = [
        write_run(tmp_path / "a", 0.2, seed=0, first=first),
        write_run(tmp_path / "b", 0.4, seed=1, done=3, first=first),
        write_run(tmp_path / "c", 0.4, seed=2, done=0),
    ]
    groups = runs.group_runs([runs.load_run(folder) for folder in folders])
    text = table.markdown(groups, "last")
    assert cells(text, "conv2d")["IOU_surf"] == "20.00"
    assert f"| {folders[1]} | conv2d | 1 | 3 of 4 | 41.00 |" in text
    assert f"| {folders[2]} | conv2d | 2 | 0 of 4 | – |" in text


def test_last_json_does_not_end_a_run_that_was_prolonged(tmp_path: Path) -> None:
    run = runs.load_run(write_run(tmp_path / "a", 0.2, epochs=10))
    assert run.epochs_done == 4 and not run.finished


def test_other_settings_split_rows_and_are_shown(tmp_path: Path) -> None:
    folders = [write_run(tmp_path / f"{rate}", 0.2, rate=rate) for rate in (0.01, 0.001)]
    loaded = [runs.load_run(folder) for folder in folders]
    text = table.markdown(runs.group_runs(loaded), "best")
    assert "rate=0.01" in text and "rate=0.001" in text
    with pytest.raises(runs.RunError, match="one run of each setting and seed"):
        runs.group_runs(loaded, ignored=["rate"])


def test_levels_of_a_net_without_levels_do_not_split_rows() -> None:
    plain = {"mode": "conv2d", "loss": "image", "seed": 1}
    assert runs.setting_of({**plain, "levels": 4, "gamma": 0.0, "reference_depth": 9.0}) == (
        runs.setting_of({**plain, "levels": 1, "gamma": 1.0, "reference_depth": 8.0})
    )
    weighted = {**plain, "loss": "surface"}
    assert runs.setting_of({**weighted, "levels": 4}) != runs.setting_of({**weighted, "levels": 2})


def test_a_log_that_was_cut_off_or_written_twice(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a", 0.2)
    log = folder / "metrics.jsonl"
    again = {"epoch": 3, "seconds": 90.0, "val": figures(0.5)}
    log.write_text(log.read_text() + json.dumps(again) + '\n{"epoch": 5, "tra')
    run = runs.load_run(folder)
    assert [line["epoch"] for line in run.log] == [1, 2, 3, 4]
    assert run.curve("iou_surf") == [(3, 0.5), (4, 0.2)]
    assert run.minutes == pytest.approx((30 + 30 + 90 + 30) / 60)
    log.write_text('{"epoch": 1}\nnothing\n{"epoch": 2}\n')
    with pytest.raises(runs.RunError, match="line 2"):
        runs.load_run(folder)


def test_files_and_figure(six: list[Path], tmp_path: Path, capsys: Any) -> None:
    written = {k: tmp_path / "new" / f"table.{k}" for k in ("md", "csv", "png")}
    arguments = ["--md", written["md"], "--csv", written["csv"], "--figure", written["png"]]
    assert table.main([str(a) for a in (*six, *arguments)]) == 0
    assert written["md"].read_text() == capsys.readouterr().out
    with written["csv"].open() as file:
        rows = {row["mode"]: row for row in csv.DictReader(file)}
    assert float(rows["levels"]["iou_surf_mean"]) == pytest.approx((0.26 + 0.25 + 0.30) / 3)
    assert float(rows["levels"]["iou_surf_max"]) == pytest.approx(0.30)
    assert rows["conv2d"]["seeds"] == "0 1 2"
    with Image.open(written["png"]) as image:
        assert image.width > 800 and image.height > 500


def test_the_papers_figures_are_below(six: list[Path], capsys: Any) -> None:
    assert table.main([str(folder) for folder in six]) == 0
    text = capsys.readouterr().out
    assert cells(text, "the paper, single level")["IOU_surf"] == "26.56"
    paper = cells(text, "the paper, 4 levels")
    assert paper["IOU_surf"] == "30.65" and paper["IOU_surf over conv2d"] == "+4.09"


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda folder: (folder / "config.json").unlink(), "no config.json"),
        (lambda folder: (folder / "best.json").write_text("{"), "best.json: not JSON"),
        (lambda folder: (folder / "last.json").write_text("[]"), "expected a JSON object"),
    ],
)
def test_damaged_folders_are_refused(
    tmp_path: Path, capsys: Any, break_it: Any, message: str
) -> None:
    folder = write_run(tmp_path / "a", 0.2)
    break_it(folder)
    assert table.main([str(folder)]) == 2
    assert message in capsys.readouterr().err


def test_a_missing_folder_is_named(tmp_path: Path, capsys: Any) -> None:
    assert table.main([str(tmp_path / "nowhere")]) == 2
    assert "nowhere: no such folder" in capsys.readouterr().err


def test_runs_without_validation_show_no_figures(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a", 0.2)
    nothing = json.dumps({"epoch": 4, "val": None})
    for name in ("best.json", "last.json"):
        (folder / name).write_text(nothing)
    run = runs.load_run(folder)
    assert run.finished and run.value("iou_surf", "best") is None
    row = cells(table.markdown(runs.group_runs([run]), "best"), "conv2d")
    assert row["IOU_surf"] == "–" and row["seeds"] == "1 (0)"
