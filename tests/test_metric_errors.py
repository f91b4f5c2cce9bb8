"""What SegmentationMetrics refuses, and how it says so."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from surfconv_ops import SegmentationMetrics

IDS, DEPTH = torch.ones(1, 2, 2, dtype=torch.int64), torch.ones(1, 2, 2)


def with_value(value: int) -> Tensor:
    ids = IDS.clone()
    ids[0, 1, 0] = value
    return ids


@pytest.mark.parametrize(
    ("maps", "error", "message"),
    [
        ((with_value(7), IDS, DEPTH), ValueError, r"prediction: .*0 \.\. 2.*got 7$"),
        ((with_value(-1), IDS, DEPTH), ValueError, "prediction: .*got -1"),
        ((IDS, with_value(3), DEPTH), ValueError, "target: .*ignore_index = 0, got 3"),
        ((IDS, with_value(255), DEPTH), ValueError, "target: .*got 255"),
        ((with_value(9), with_value(0), DEPTH), ValueError, "prediction: .*got 9"),
        ((torch.randn(1, 3, 2, 2), IDS, DEPTH), TypeError, r"argmax\(1\)"),
        ((IDS, IDS.float(), DEPTH), TypeError, "target: .*torch.float32"),
        ((IDS.tolist(), IDS, DEPTH), TypeError, "prediction: .*list"),
        ((IDS, IDS, DEPTH.int()), TypeError, "depth: .*metres"),
        ((IDS, IDS, None), TypeError, "depth: .*NoneType"),
        ((IDS[0], IDS, DEPTH), ValueError, r"prediction: .*\(1, 2, 2\), got \(2, 2\)"),
        ((IDS, IDS, DEPTH[..., :1]), ValueError, r"depth: .*\(1, 1, 2, 2\), got \(1, 2, 1\)"),
        ((IDS[None], IDS[None], DEPTH[None]), ValueError, r"target: .*\(1, 1, 2, 2\)"),
        ((IDS, IDS.to("meta"), DEPTH), ValueError, "target: .*device cpu, got meta"),
        ((IDS, IDS, DEPTH.to("meta")), ValueError, "depth: .*device cpu, got meta"),
    ],
)
def test_a_wrong_update_says_so_and_counts_nothing(
    maps: Any, error: type[Exception], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surfconv_ops.metrics._CHUNK", 1)
    metrics = SegmentationMetrics(3)
    with pytest.raises(error, match=message):
        metrics.update(*maps)
    assert metrics.compute()["pixels"] == 0


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        ((0,), {}, ValueError, "num_classes: .*got 0"),
        ((2.0,), {}, TypeError, "num_classes"),
        ((2, 1.5), {}, TypeError, "ignore_index: .*1.5"),
        ((2, True), {}, TypeError, "ignore_index: .*bool"),
        ((2,), {"depth_ranges": (1.0,)}, ValueError, "depth_ranges: .*at least two"),
        ((2,), {"depth_ranges": (2.0, 2.0)}, ValueError, "depth_ranges: .*2.0 after 2.0"),
        ((2,), {"depth_ranges": (-1.0, 2.0)}, ValueError, r"depth_ranges\[0\]"),
        ((2,), {"depth_ranges": (1.0, math.nan)}, ValueError, r"depth_ranges\[1\]"),
        ((2,), {"depth_ranges": 5.0}, TypeError, "depth_ranges: .*5.0"),
    ],
)
def test_wrong_arguments(
    arguments: Any, options: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        SegmentationMetrics(*arguments, **options)


def test_only_the_same_metrics_merge() -> None:
    metrics = SegmentationMetrics(3)
    others = [SegmentationMetrics(4), SegmentationMetrics(3, None)]
    for other in (*others, SegmentationMetrics(3, depth_ranges=None)):
        with pytest.raises(ValueError, match="other: expected the arguments of"):
            metrics.merge(other)
    with pytest.raises(TypeError, match=r"other: .*dict"):
        metrics.merge(metrics.compute())  # type: ignore[arg-type]
