"""Accuracy and IOU of confusion matrices, which have the target's class in rows.

Those of pixels come with the suffix ``_img``, those of areas of surface with ``_surf``.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

_FIGURES = ("acc_img", "iou_img", "acc_surf", "iou_surf")


def figures(counts: Tensor, areas: Tensor, ignore_index: int | None) -> dict[str, Any]:
    """The four figures of one pair of confusion matrices."""
    result: dict[str, Any] = {}
    for suffix, confusion in (("img", counts), ("surf", areas)):
        _, iou = _by_class(confusion, ignore_index)
        result[f"acc_{suffix}"] = float(confusion.diagonal().sum() / confusion.sum())
        result[f"iou_{suffix}"] = float(iou.nanmean())
    result["pixels"], result["area"] = int(counts.sum()), float(areas.sum())
    return {key: result[key] for key in (*_FIGURES, "pixels", "area")}


def figures_by_class(
    counts: Tensor, areas: Tensor, ignore_index: int | None
) -> list[dict[str, Any]]:
    """The four figures of every class alone."""
    columns = {"class": list(range(len(counts)))}
    for suffix, confusion in (("img", counts), ("surf", areas)):
        accuracy, iou = _by_class(confusion, ignore_index)
        columns[f"acc_{suffix}"], columns[f"iou_{suffix}"] = accuracy.tolist(), iou.tolist()
    columns["pixels"] = counts.sum(1).to(torch.int64).tolist()
    columns["area"] = areas.sum(1).tolist()
    keys = ("class", *_FIGURES, "pixels", "area")
    rows = zip(*(columns[key] for key in keys), strict=True)
    return [dict(zip(keys, row, strict=True)) for row in rows]


def _by_class(confusion: Tensor, ignore_index: int | None) -> tuple[Tensor, Tensor]:
    """Accuracy (hits per label) and IOU of every class, NaN where there is none."""
    hits, labels = confusion.diagonal(), confusion.sum(1)
    accuracy, iou = hits / labels, hits / (labels + confusion.sum(0) - hits)
    if ignore_index is not None and 0 <= ignore_index < len(confusion):
        accuracy[ignore_index] = iou[ignore_index] = math.nan
    return accuracy, iou
