"""Predictions and their figures, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from folder import Frame, network_input
from segmenter import Segmenter
from surfconv_ops import SegmentationMetrics

#: The paper's four figures.
FIGURES = ("acc_img", "iou_img", "acc_surf", "iou_surf")
#: Metres; where a footprint in metres should matter is seen only by distance.
DEPTH_RANGES = (0.0, 7.5, 15.0, 30.0, float("inf"))


def evaluate(
    model: Segmenter,
    frames: Iterable[Frame],
    device: torch.device,
    seen: Callable[[Frame, Tensor], None] | None = None,
) -> SegmentationMetrics:
    """Metrics of the net over frames, one at a time, so that their sizes may differ.

    Args:
        model: left in the mode (train or eval) it came in.
        frames: with labels; class 0 does not count.
        device: where the model is.
        seen: called with every frame and its prediction (H, W).
    """
    metrics = SegmentationMetrics(model.classes, ignore_index=0, depth_ranges=DEPTH_RANGES)
    training = model.training
    model.eval()
    with torch.no_grad():
        for frame in frames:
            input = network_input(frame).unsqueeze(0).to(device)
            depth = frame.depth.unsqueeze(0).to(device)
            scores = model(input, depth)
            # Class 0 is "not labelled": the net is never shown it, and may not answer it.
            prediction = scores[:, 1:].argmax(1).cpu() + 1
            metrics.update(prediction, frame.label.unsqueeze(0).long(), frame.depth.unsqueeze(0))
            if seen is not None:
                seen(frame, prediction[0])
    model.train(training)
    return metrics


def report(figures: dict[str, Any], class_names: Sequence[str]) -> str:
    """The figures as text, in percent: all pixels, by range of depth, by class."""
    lines = [_row("", *(name.replace("_", " ") for name in FIGURES), "pixels")]
    lines.append(_figures_row("all", figures))
    for part in figures["ranges"]:
        far = "" if math.isinf(part["to"]) else f" to {part['to']:g}"
        lines.append(_figures_row(f"{part['from']:g}{far} m" + (" on" if not far else ""), part))
    lines.append("")
    for part in figures["classes"]:
        if part["pixels"] or not math.isnan(part["iou_img"]):
            lines.append(_figures_row(class_names[part["class"]], part))
    return "\n".join(lines)


def _figures_row(name: str, part: dict[str, Any]) -> str:
    shares = ("-" if math.isnan(part[f]) else f"{100 * part[f]:.2f}" for f in FIGURES)
    return _row(name, *shares, f"{part['pixels']:,}")


def _row(name: str, *cells: str) -> str:
    return f"{name:<16}" + "".join(f"{cell:>13}" for cell in cells)


def without_nan(value: Any) -> Any:
    """The same lists and dicts with None for NaN and infinity, which JSON does not know."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
