"""The KITTI example: its net, its losses, and runs that end the same however they are cut."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import evaluate as evaluate_script
import train as train_script
from evaluation import FIGURES
from kitti_frames import SIZE, write_folder
from losses import LOSSES, segmentation_loss
from paper_net import PARAMETERS_AT_CAPACITY_1, PaperNet, parameter_count
from schedules import make_schedule
from segmenter import MODES, Segmenter, Settings, read_checkpoint
from surfconv_ops import DepthLevels

LEVELS = DepthLevels(edges=[10.0, 20.0], centers=[5.0, 15.0, 30.0])
NAMES = [f"img_{i}" for i in range(1, 6)]


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    (tmp_path / "kept.txt").write_text("img_2\nimg_5\n")
    return write_folder(tmp_path / "frames", NAMES)


def arguments(frames: Path, out: str, *more: str) -> list[str]:
    kept = frames.parent / "kept.txt"
    return [
        *("--data", str(frames), "--out", str(frames.parent / out), "--device", "cpu"),
        *("--validation", str(kept), "--epochs", "3", "--mode", "continuous", *more),
    ]


def lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def without_seconds(run: Path) -> list[dict[str, Any]]:
    return [{key: v for key, v in line.items() if key != "seconds"} for line in lines(run)]


@pytest.mark.parametrize(("capacity", "size"), [(1, (33, 47)), (2, (64, 96))])
def test_the_net_has_the_papers_size_and_answers_every_pixel(
    capacity: int, size: tuple[int, int]
) -> None:
    net = PaperNet(capacity)
    assert net(torch.randn(2, 6, *size)).shape == (2, 12, *size)
    if capacity == 1:
        assert parameter_count(net) == PARAMETERS_AT_CAPACITY_1 == 65_008


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_has_the_same_parameters_and_at_reference_depth_the_same_scores(
    mode: str,
) -> None:
    torch.manual_seed(3)
    settings = Settings(mode, reference_depth=15.0, pools=mode in ("levels", "continuous"))
    model = Segmenter(settings, LEVELS).double().eval()
    torch.manual_seed(3)
    plain = PaperNet().double().eval()
    assert list(model.net.state_dict()) == list(plain.state_dict())
    input = torch.randn(2, 6, *SIZE, dtype=torch.float64)
    depth = torch.full((2, *SIZE), 15.0)
    torch.testing.assert_close(model(input, depth), plain(input), rtol=1e-10, atol=1e-10)
    changed = not torch.allclose(model(input, depth / 3), plain(input), rtol=1e-2, atol=1e-2)
    assert changed == (mode != "conv2d")


def by_hand(scores: Tensor, label: Tensor, depth: Tensor, kind: str) -> float:
    """The definitions again, pixel by pixel."""
    sums: dict[int, float] = {}
    weights: dict[int, float] = {}
    for n, y, x in torch.cartesian_prod(*(torch.arange(s) for s in label.shape)).tolist():
        if label[n, y, x] == 0:
            continue
        z = depth[n, y, x].item()
        level = -1 if not 0 < z < math.inf else sum(z > edge for edge in LEVELS.edges)
        of_pixel = scores[n, :, y, x].double()
        loss = (of_pixel.exp().sum().log() - of_pixel[label[n, y, x]]).item()
        weight = 1.0
        if kind == "surface" and level >= 0:
            weight = (LEVELS.centers[level] / 12.0) ** 2
        group = level if kind == "levels" else 0
        sums[group] = sums.get(group, 0.0) + weight * loss
        weights[group] = weights.get(group, 0.0) + weight
    return sum(sums[group] / weights[group] for group in sums)


@pytest.mark.parametrize("kind", LOSSES)
def test_losses_follow_their_definitions(kind: str) -> None:
    scores = torch.randn(2, 5, 6, 7)
    label = torch.randint(0, 5, (2, 6, 7))
    depth = torch.rand(2, 6, 7) * 18  # nothing in the farthest level
    depth[0, 0, :4] = torch.tensor([0.0, float("nan"), -1.0, float("inf")])
    got = segmentation_loss(scores, label, depth, kind=kind, levels=LEVELS, reference_depth=12.0)
    assert got.item() == pytest.approx(by_hand(scores, label, depth, kind), rel=1e-5)


@pytest.mark.parametrize("kind", LOSSES)
def test_a_batch_without_labels_costs_nothing(kind: str) -> None:
    scores = torch.randn(1, 5, 6, 7, requires_grad=True)
    label, depth = torch.zeros(1, 6, 7, dtype=torch.int64), torch.rand(1, 6, 7)
    loss = segmentation_loss(scores, label, depth, kind=kind, levels=LEVELS, reference_depth=1.0)
    loss.backward()
    assert loss.item() == 0 and scores.grad is not None and (scores.grad == 0).all()


def rates(name: str, epochs: int, figures: list[float]) -> list[float]:
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
    schedule = make_schedule(name, optimizer, epochs, 2)
    seen = []
    for epoch in range(1, epochs + 1):
        seen.append(optimizer.param_groups[0]["lr"])
        schedule.after_batch()
        schedule.after_batch()
        schedule.after_epoch(epoch, figures[epoch - 1])
    return seen


def test_the_papers_schedule_waits_for_ten_epochs_after_the_hundredth() -> None:
    seen = rates("paper", 125, [0.1] * 105 + [0.2] + [0.2] * 19)
    assert seen[:116] == [1.0] * 116 and seen[116:] == [0.1] * 9


def test_the_cosine_ends_at_zero() -> None:
    seen = rates("cosine", 4, [0.0] * 4)
    assert seen == pytest.approx([0.5 * (1 + math.cos(math.pi * e / 4)) for e in range(4)])


@pytest.mark.parametrize("mode", MODES)
def test_a_run_learns_and_its_checkpoint_evaluates_to_its_own_figures(
    frames: Path, capsys: pytest.CaptureFixture[str], mode: str
) -> None:
    # At the schedule's own rate eight epochs on three frames are chaos: rounding decides the end.
    steady = ("--epochs", "8", "--rate", "0.002")
    train_script.main(arguments(frames, "run", "--mode", mode, *steady))
    run = frames.parent / "run"
    trained = lines(run)
    assert [line["epoch"] for line in trained] == list(range(1, 9))
    assert trained[-1]["train_loss"] < 0.8 * trained[0]["train_loss"]
    best = json.loads((run / "best.json").read_text())
    assert best["val"]["iou_surf"] == max(line["val"]["iou_surf"] for line in trained)

    kept = str(frames.parent / "kept.txt")
    checkpoint = ["--checkpoint", str(run / "best.pt"), "--device", "cpu"]
    evaluate_script.main([*checkpoint, "--data", str(frames), "--names", kept])
    printed = capsys.readouterr().out
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["frames"] == ["img_2", "img_5"]
    assert {f: metrics["metrics"][f] for f in best["val"]} == best["val"]
    assert f"{100 * best['val']['iou_surf']:.2f}" in printed
    assert (run / "pictures.png").stat().st_size > 10_000


def test_a_killed_run_goes_on_to_the_same_result(
    frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_script.main(arguments(frames, "whole"))
    calls = 0

    def dies(*args: Any, **options: Any) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == 4:  # within the second epoch of two batches
            raise KeyboardInterrupt
        return segmentation_loss(*args, **options)

    with monkeypatch.context() as patched:
        patched.setattr(train_script, "segmentation_loss", dies)
        with pytest.raises(KeyboardInterrupt):
            train_script.main(arguments(frames, "cut"))
    cut, whole = frames.parent / "cut", frames.parent / "whole"
    assert len(lines(cut)) == 1
    # As if the kill had come between the line and the checkpoint.
    with (cut / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 2}\n')
    train_script.main(arguments(frames, "cut"))
    assert without_seconds(cut) == without_seconds(whole)
    one, other = (read_checkpoint(run / "last.pt") for run in (cut, whole))
    final = read_checkpoint(cut / "final.pt")
    assert final["epoch"] == 3 and "optimizer" not in final
    assert all(torch.equal(value, one["model"][name]) for name, value in final["model"].items())
    for name, value in one["model"].items():
        assert torch.equal(value, other["model"][name]), name
    assert one["best"] == other["best"]


def test_a_folder_of_another_run_is_refused(frames: Path) -> None:
    train_script.main(arguments(frames, "run", "--epochs", "1"))
    with pytest.raises(SystemExit, match=r"other settings: gamma 2.0 \(was 1.0\)"):
        train_script.main(arguments(frames, "run", "--epochs", "1", "--gamma", "2"))


def test_bad_arguments_end_with_a_message(frames: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"train.py: .*nowhere is not a folder"):
        train_script.main(arguments(tmp_path / "nowhere", "run"))
    (tmp_path / "other.pt").write_bytes(b"no checkpoint")
    for path, message in (("other.pt", "is not a checkpoint"), ("gone.pt", "no such file")):
        with pytest.raises(SystemExit, match=message):
            evaluate_script.main(
                ["--checkpoint", str(tmp_path / path), "--data", str(frames), "--device", "cpu"]
            )


def test_the_folder_says_how_many_classes_there_are(frames: Path) -> None:
    train_script.main(arguments(frames, "twelve", "--epochs", "1"))
    names = '{"classes": ["ignored", "red", "green", "blue"]}'
    (frames / "dataset.json").write_text(names)
    train_script.main(arguments(frames, "four", "--epochs", "1"))
    runs = frames.parent
    four = read_checkpoint(runs / "four" / "best.pt")
    assert four["settings"].classes == 4 and four["model"]["scores.weight"].shape[0] == 4
    evaluate_script.main(["--checkpoint", str(runs / "four" / "best.pt"), "--data", str(frames)])
    with pytest.raises(SystemExit, match="has 4 classes, the net was trained for 12"):
        evaluate_script.main(
            ["--checkpoint", str(runs / "twelve" / "best.pt"), "--data", str(frames)]
        )


@pytest.mark.parametrize(
    ("mode", "more", "message"),
    [
        ("conv2d", ["--min-scale", "1"], "min_scale: mode conv2d has no use for it"),
        ("pyramid", ["--pools"], "pools: mode pyramid has no use for it"),
        ("levels", ["--depth-window", "2"], "depth_window: mode levels has no use for it"),
        ("continuous", ["--same-level-only"], "same_level_only: mode continuous has no use"),
        ("continuous", ["--epochs", "0"], "epochs: expected at least 1, got 0"),
        ("continuous", ["--batch", "0"], "batch: expected at least 1, got 0"),
    ],
)
def test_settings_that_would_do_nothing_are_refused(
    frames: Path, mode: str, more: list[str], message: str
) -> None:
    with pytest.raises(SystemExit, match=message):
        train_script.main(arguments(frames, "run", "--mode", mode, *more))
    assert not (frames.parent / "run").exists()


def test_the_best_epoch_is_found_after_one_without_a_figure(
    frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = iter([math.nan, 0.2, 0.1])

    def validate(_: Any) -> dict[str, float]:
        return dict.fromkeys(FIGURES, next(figures))

    monkeypatch.setattr(train_script.Training, "_validate", validate)
    train_script.main(arguments(frames, "run"))
    assert read_checkpoint(frames.parent / "run" / "best.pt")["epoch"] == 2


def test_settings_and_arguments_have_the_same_names(frames: Path) -> None:
    parsed = vars(train_script.parse(arguments(frames, "run")))
    # The number of classes is the folder's to say.
    assert {f.name for f in dataclasses.fields(Settings)} - {"classes"} <= set(parsed)
