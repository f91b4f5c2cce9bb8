"""SegmentationMetrics against the definitions in plain Python, and what it does with odd input."""

from __future__ import annotations

import itertools
import json
import math
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import oracle_metrics as oracle
from oracle_metrics import Pixel
from surfconv_ops import SegmentationMetrics

FOUR = ("acc_img", "iou_img", "acc_surf", "iou_surf")
ODD_DEPTHS = (0.0, -2.0, math.nan, math.inf, -math.inf, 1e30, 1e-30, 5.0, 10.0, 40.0)
IGNORED = (0, 2, 4, None, 255, -100)


def problem(
    classes: int, ignore: int | None, seed: int, size: tuple[int, ...] = (3, 7, 9)
) -> tuple[Tensor, Tensor, Tensor]:
    """Prediction, target and depth: mostly right, some labels ignored, some depths odd."""
    rng = np.random.default_rng(seed)
    target = rng.integers(0, classes, size)
    prediction = np.where(rng.random(size) < 0.6, target, rng.integers(0, classes, size))
    if ignore is not None:
        target = np.where(rng.random(size) < 0.2, ignore, target)
    depth = rng.gamma(2.0, 7.0, size)
    depth = np.where(rng.random(size) < 0.2, rng.choice(ODD_DEPTHS, size), depth)
    return (
        torch.from_numpy(prediction),
        torch.from_numpy(target),
        torch.from_numpy(depth.astype(np.float32)),
    )


def pixels_of(prediction: Tensor, target: Tensor, depth: Tensor) -> list[Pixel]:
    maps = (map.flatten().tolist() for map in (prediction, target, depth))
    return list(itertools.starmap(Pixel, zip(*maps, strict=True)))


def counted(problem: tuple[Tensor, Tensor, Tensor], *arguments: Any, **options: Any) -> Any:
    return SegmentationMetrics(*arguments, **options).update(*problem)


def assert_figures(actual: dict[str, Any], expected: dict[str, float], what: str) -> None:
    for name in FOUR:
        assert actual[name] == pytest.approx(expected[name], rel=1e-12, nan_ok=True), (what, name)


@pytest.mark.parametrize("ignore", IGNORED)
@pytest.mark.parametrize("seed", range(3))
def test_the_definitions(ignore: int | None, seed: int) -> None:
    classes = 5
    maps = problem(classes, ignore, seed)
    pixels = pixels_of(*maps)
    figures = counted(maps, classes, ignore).compute()
    assert_figures(figures, oracle.four(pixels, ignore, classes), "all")
    labelled = [p for p in pixels if p.target != ignore]
    assert figures["pixels"] == len(labelled)
    areas = [float(oracle.weight_of(p, True)) for p in labelled]
    assert figures["area"] == pytest.approx(math.fsum(areas), rel=1e-12)


@pytest.mark.parametrize("ignore", IGNORED)
def test_by_class(ignore: int | None) -> None:
    classes = 5
    maps = problem(classes, ignore, seed=7)
    pixels = pixels_of(*maps)
    rows = counted(maps, classes, ignore).compute()["classes"]
    assert [row["class"] for row in rows] == list(range(classes))
    for label, row in enumerate(rows):
        expected = dict.fromkeys(FOUR, math.nan)
        own = [p for p in pixels if p.target == label != ignore]
        if label != ignore:
            for name, surface in (("img", False), ("surf", True)):
                arguments = (pixels, ignore, surface, label)
                expected[f"acc_{name}"] = oracle.class_accuracy(*arguments)
                expected[f"iou_{name}"] = oracle.class_iou(*arguments)
        assert_figures(row, expected, f"class {label}")
        assert row["pixels"] == len(own)
        areas = [float(oracle.weight_of(p, True)) for p in own]
        assert row["area"] == pytest.approx(math.fsum(areas), rel=1e-12)


@pytest.mark.parametrize(
    "edges", [(0.0, 5.0, 10.0, 20.0, 40.0, math.inf), (3.0, 7.5), (5.0, 10.0, 40.0), [1, 2, 3]]
)
@pytest.mark.parametrize("ignore", [0, 255])
def test_by_depth_range(edges: Any, ignore: int) -> None:
    maps = problem(4, ignore, seed=11, size=(2, 20, 21))
    figures = counted(maps, 4, ignore, depth_ranges=edges).compute()
    assert [(r["from"], r["to"]) for r in figures["ranges"]] == list(itertools.pairwise(edges))
    total = 0
    for row in figures["ranges"]:
        inside = oracle.within(pixels_of(*maps), row["from"], row["to"])
        total += len(inside)
        assert_figures(row, oracle.four(inside, ignore, 4), f"{row['from']} .. {row['to']} m")
        assert row["pixels"] == sum(p.target != ignore for p in inside)
    assert total > 10
    # Ranges only divide what is counted.
    without = counted(maps, 4, ignore, depth_ranges=None).compute()
    assert without["ranges"] == []
    assert_figures(figures, without, "no ranges")


def test_a_boundary_belongs_to_the_nearer_range() -> None:
    edges = (0.0, 0.1, 0.3, math.inf)
    # As float32, 0.1 lies above the boundary 0.1, and 0.3 as well.
    depth = torch.tensor([[0.1, 0.3, 0.25, 0.0]])
    ids = torch.ones(1, 4, dtype=torch.int64)
    ranges = counted((ids, ids, depth), 2, depth_ranges=edges).compute()["ranges"]
    assert [row["pixels"] for row in ranges] == [0, 2, 1]
    double = torch.tensor([[0.1, 0.3, 0.25, 0.0]], dtype=torch.float64)
    ranges = counted((ids, ids, double), 2, depth_ranges=edges).compute()["ranges"]
    assert [row["pixels"] for row in ranges] == [1, 2, 0]


def test_two_by_two_by_hand() -> None:
    """Labels 1 2 / 2 2, predicted 1 1 / 2 0, at depths 1 2 / 3 invalid.

    Correct are two of four pixels, and 1 + 9 of 1 + 4 + 9 square metres (times a constant).
    Class 1: one hit, one false alarm: 1/2, or 1/(1+4). Class 2: one hit, two misses, one of them
    without depth: 1/3, or 9/(9+4). Class 0 is ignored, although one pixel is predicted so.
    """
    figures = counted(
        (
            torch.tensor([[1, 1], [2, 0]]),
            torch.tensor([[1, 2], [2, 2]]),
            torch.tensor([[1.0, 2.0], [3.0, 0.0]]),
        ),
        3,
    ).compute()
    assert figures["acc_img"] == 0.5
    assert figures["acc_surf"] == pytest.approx(10 / 14, rel=1e-15)
    assert figures["iou_img"] == pytest.approx((1 / 2 + 1 / 3) / 2, rel=1e-15)
    assert figures["iou_surf"] == pytest.approx((1 / 5 + 9 / 13) / 2, rel=1e-15)
    assert [figures["pixels"], figures["area"]] == [4, 14.0]
    assert math.isnan(figures["classes"][0]["iou_img"])
    assert figures["classes"][2]["acc_img"] == pytest.approx(1 / 3, rel=1e-15)
    assert figures["classes"][2]["acc_surf"] == pytest.approx(9 / 13, rel=1e-15)


def test_confusion_matrices_have_the_target_in_rows() -> None:
    maps = torch.tensor([[1, 2]]), torch.tensor([[2, 2]]), torch.tensor([[3.0, 2.0]])
    metrics = counted(maps, 3)
    assert metrics.confusion_img.tolist() == [[0, 0, 0], [0, 0, 0], [0, 1, 1]]
    assert metrics.confusion_surf.tolist() == [[0, 0, 0], [0, 0, 0], [0, 9.0, 4.0]]
    assert metrics.confusion_img.dtype == torch.int64
    assert metrics.confusion_surf.dtype == torch.float64


def test_a_class_that_weighs_nothing_leaves_the_surface_mean_only() -> None:
    ids, depth = torch.tensor([[1, 2]]), torch.tensor([[2.0, 0.0]])
    figures = counted((torch.tensor([[1, 1]]), ids, depth), 3).compute()
    assert figures["iou_img"] == 0.25
    assert figures["iou_surf"] == 1.0


@pytest.mark.parametrize("splits", [[1, 4], [2, 2, 1], [1, 1, 1, 1, 1], [5]])
def test_any_division_into_batches_and_metrics(splits: list[int]) -> None:
    maps = problem(6, 0, seed=3, size=(5, 8, 6))
    whole = counted(maps, 6)
    updated, merged = SegmentationMetrics(6), SegmentationMetrics(6)
    for part in zip(*(map.split(splits) for map in maps), strict=True):
        updated.update(*part)
        merged.merge(counted(part, 6))
    for metrics in (updated, merged):
        assert torch.equal(metrics.confusion_img, whole.confusion_img)
        torch.testing.assert_close(
            metrics.confusion_surf, whole.confusion_surf, rtol=1e-14, atol=0.0
        )
        assert_figures(metrics.compute(), whole.compute(), str(splits))


def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = problem(4, 0, seed=5)
    whole = counted(maps, 4)
    monkeypatch.setattr("surfconv_ops.metrics._CHUNK", 10)
    chunked = counted(maps, 4)
    assert torch.equal(chunked.confusion_img, whole.confusion_img)
    assert_figures(chunked.compute(), whole.compute(), "chunks")


def test_merge_leaves_the_other_alone_and_unshared() -> None:
    maps = problem(4, 0, seed=1)
    one, other = SegmentationMetrics(4), counted(maps, 4)
    one.merge(other)
    one.update(*maps)
    assert torch.equal(one.confusion_img, 2 * other.confusion_img)
    assert torch.equal(other.confusion_img, counted(maps, 4).confusion_img)


def test_nothing_counted_is_nan() -> None:
    empty = SegmentationMetrics(3).compute()
    ignored = torch.zeros(2, 2, dtype=torch.int64)
    nothing = counted((ignored, ignored, torch.ones(2, 2)), 3).compute()
    no_images = counted((ignored[None][:0], ignored[None][:0], torch.ones(0, 2, 2)), 3).compute()
    for figures in (empty, nothing, no_images):
        for row in (figures, *figures["classes"], *figures["ranges"]):
            assert all(math.isnan(row[name]) for name in FOUR)
            assert (row["pixels"], row["area"]) == (0, 0.0)


def test_no_valid_depth_leaves_the_image_figures() -> None:
    ids = torch.tensor([[1, 1], [2, 2]])
    depth = torch.tensor([[0.0, math.nan], [math.inf, -1.0]])
    figures = counted((ids, ids, depth), 3).compute()
    assert figures["acc_img"] == figures["iou_img"] == 1.0
    assert math.isnan(figures["acc_surf"])
    assert math.isnan(figures["iou_surf"])
    assert sum(row["pixels"] for row in figures["ranges"]) == 0


def test_reset_forgets() -> None:
    maps = problem(4, 0, seed=1)
    metrics = counted(maps, 4)
    metrics.reset()
    assert metrics.compute()["pixels"] == 0
    metrics.update(*maps)
    assert repr(metrics.compute()) == repr(counted(maps, 4).compute())
    assert torch.equal(metrics.confusion_img, counted(maps, 4).confusion_img)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int16, torch.int32])
def test_integer_dtypes(dtype: torch.dtype) -> None:
    prediction, target, depth = problem(5, 0, seed=2)
    expected = counted((prediction, target, depth), 5).compute()
    assert_figures(
        counted((prediction.to(dtype), target.to(dtype), depth), 5).compute(), expected, str(dtype)
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_depth_dtypes(dtype: torch.dtype) -> None:
    """Whatever the depth's type, its values are squared in float64."""
    prediction, target, depth = problem(5, 0, seed=2)
    depth = depth.to(dtype)
    expected = oracle.four(pixels_of(prediction, target, depth), 0, 5)
    assert_figures(counted((prediction, target, depth), 5).compute(), expected, str(dtype))


def test_depths_whose_square_is_beyond_float64() -> None:
    ids = torch.tensor([[1, 2, 2]])
    depth = torch.tensor([[1e200, 1e300, 1e-200]], dtype=torch.float64)
    figures = counted((ids, ids, depth), 3).compute()
    assert figures["acc_surf"] == figures["iou_surf"] == 1.0


def test_layouts_shapes_and_arrays() -> None:
    prediction, target, depth = problem(5, 0, seed=4)
    expected = counted((prediction, target, depth), 5)
    strided = tuple(map.transpose(1, 2).contiguous().transpose(1, 2) for map in (
        prediction, target, depth))  # fmt: skip
    same = [
        strided,
        (prediction, target, depth.unsqueeze(1)),
        (prediction.numpy(), target.numpy(), depth.numpy()),
        tuple(map.flip(-1).numpy()[..., ::-1] for map in (prediction, target, depth)),
        (prediction, target, depth.clone().requires_grad_()),
    ]
    for maps in same:
        metrics = counted(maps, 5)
        assert torch.equal(metrics.confusion_img, expected.confusion_img)
        assert not metrics.confusion_surf.requires_grad
    single = SegmentationMetrics(5)
    for image in range(3):
        single.update(prediction[image], target[image], depth[image].unsqueeze(0))
    assert torch.equal(single.confusion_img, expected.confusion_img)


def test_the_target_is_its_own_perfect_prediction() -> None:
    for ignore in IGNORED:
        _, target, depth = problem(5, ignore, seed=9)
        figures = counted((target, target, depth), 5, ignore).compute()
        assert figures["acc_img"] == figures["iou_img"] == 1.0


def test_json_and_pickle() -> None:
    metrics = counted(problem(4, 0, seed=1), 4)
    figures = metrics.compute()
    assert repr(json.loads(json.dumps(figures))) == repr(figures)
    copy = pickle.loads(pickle.dumps(metrics))
    assert repr(copy) == repr(metrics)
    assert repr(copy.compute()) == repr(figures)
    copy.merge(metrics)
    assert copy.compute()["pixels"] == 2 * figures["pixels"]


def test_numbers_that_numpy_computed() -> None:
    inputs = problem(4, 2, seed=1)
    figures = counted(inputs, 4, 2).compute()
    assert repr(counted(inputs, np.int64(4), np.int32(2)).compute()) == repr(figures)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("deterministic", [False, True])
def test_on_cuda(deterministic: bool) -> None:
    maps = problem(5, 0, seed=4)
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(deterministic)
    try:
        on_cuda = counted(tuple(map.cuda() for map in maps), 5)
    finally:
        torch.use_deterministic_algorithms(before)
    assert_figures(on_cuda.compute(), counted(maps, 5).compute(), "cuda")
