"""The paper's four segmentation figures: accuracy and IOU, over the image and over the surface."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .checks import (
    check_class_ids,
    check_depth_ranges,
    check_depth_tensor,
    check_integer,
    check_optional_integer,
    type_name,
    valid_depth,
)
from .figures import figures, figures_by_class
from .gathering import gather_parts

#: Boundaries of the depth ranges that figures are also given for, in metres.
DEPTH_RANGES = (0.0, 5.0, 10.0, 20.0, 40.0, math.inf)

# Pixels looked at together, which bounds the memory an update works in.
_CHUNK = 1 << 22
# Squares of greater depths would leave float64.
_LARGEST_DEPTH = 1e150


class SegmentationMetrics:
    """Accuracy and mean IOU of a segmentation, per pixel and per area of surface.

    Over all pixels whose label is not ignored, accuracy is correct / all, and IOU the mean over
    classes of TP / (TP + FP + FN). For the ``_img`` figures every pixel weighs 1; for the
    ``_surf`` figures it weighs z**2, the area of surface that is back-projected onto it, up to a
    factor that cancels. A pixel whose depth is invalid (zero, negative, NaN, infinite) counts in
    ``_img`` and weighs 0 in ``_surf``. A class that is in neither prediction nor target, or weighs
    nothing in both, is left out of a mean. So is the ignored class; predicting it is a miss.

    Confusion matrices are all that is kept, one for every depth range, on the CPU: counts in
    int64, areas in float64. Instances can be pickled.

    Args:
        num_classes: Number of classes C; ids are 0 .. C-1.
        ignore_index: Label of pixels that do not count, one of the ids or any other integer (255,
            -100); None where all count.
        depth_ranges: Ascending boundaries in metres, the last one possibly infinite; range i holds
            ``depth_ranges[i] < z <= depth_ranges[i + 1]``. None: no figures by range.

    Raises:
        ValueError: A number is out of its range.
        TypeError: An argument is of the wrong type.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, section 4 (Acc_img, IOU_img, Acc_surf, IOU_surf).

    Example:
        >>> import torch
        >>> from surfconv_ops import SegmentationMetrics
        >>> metrics = SegmentationMetrics(num_classes=3)
        >>> target = torch.tensor([[[0, 1], [2, 2]]])
        >>> prediction = torch.tensor([[[1, 1], [2, 1]]])
        >>> depth = torch.tensor([[[1.0, 1.0], [2.0, 0.0]]])
        >>> figures = metrics.update(prediction, target, depth).compute()
        >>> round(figures["acc_img"], 4), figures["iou_img"], figures["acc_surf"]
        (0.6667, 0.5, 1.0)
    """

    def __init__(
        self,
        num_classes: int,
        ignore_index: int | None = 0,
        *,
        depth_ranges: Sequence[float] | None = DEPTH_RANGES,
    ) -> None:
        self.num_classes = check_integer(num_classes, "num_classes", 1)
        self.ignore_index = check_optional_integer(ignore_index, "ignore_index")
        self.depth_ranges = check_depth_ranges(depth_ranges)
        self.reset()

    def reset(self) -> None:
        """Forget all pixels."""
        # The last plane is of pixels that are in no range.
        shape = (len(self._range_pairs()) + 1, self.num_classes, self.num_classes)
        self._counts = torch.zeros(shape, dtype=torch.int64)
        self._areas = torch.zeros(shape, dtype=torch.float64)

    @property
    def confusion_img(self) -> Tensor:
        """Pixels, ``(C, C)`` in int64: row by the target's class, column by the prediction's."""
        return self._counts.sum(0)

    @property
    def confusion_surf(self) -> Tensor:
        """Sums of z**2, ``(C, C)`` in float64: row by the target's class, column as predicted."""
        return self._areas.sum(0)

    def update(
        self,
        prediction: Tensor | np.ndarray[Any, Any],
        target: Tensor | np.ndarray[Any, Any],
        depth: Tensor | np.ndarray[Any, Any],
    ) -> SegmentationMetrics:
        """Count one image or a batch; in whatever batches images come, the result is the same.

        Counts are exactly the same, areas to float64's rounding. A call that raises counts
        nothing.

        Args:
            prediction: Class ids, any integer dtype. Of scores ``(N, C, H, W)``, pass
                ``scores.argmax(1)``. Where the target is ignored it may also be ``ignore_index``.
            target: Class ids or ``ignore_index``.
            depth: Metres, floating point; invalid depth is allowed anywhere.

        Shape:
            - prediction, target: ``(N, H, W)`` or ``(H, W)``
            - depth: the same, or ``(N, 1, H, W)``, ``(1, H, W)``

        Returns:
            This object.

        Raises:
            ValueError: An id is out of range, or shapes or devices differ.
            TypeError: ``prediction`` or ``target`` is not of integers, or ``depth`` not of floats.
        """
        prediction = check_class_ids(_to_tensor(prediction), "prediction")
        target = check_class_ids(_to_tensor(target), "target")
        depth = check_depth_tensor(_to_tensor(depth)).detach()
        if target.ndim not in (2, 3):
            raise ValueError(f"target: expected (N, H, W) or (H, W), got {tuple(target.shape)}")
        if prediction.shape != target.shape:
            raise ValueError(
                f"prediction: expected the target's shape {tuple(target.shape)}, got"
                f" {tuple(prediction.shape)}"
            )
        size = tuple(target.shape)
        with_channel = (*size[:-2], 1, *size[-2:])
        if tuple(depth.shape) not in (size, with_channel):
            raise ValueError(f"depth: expected {size} or {with_channel}, got {tuple(depth.shape)}")
        for name, map in (("target", target), ("depth", depth)):
            if map.device != prediction.device:
                raise ValueError(
                    f"{name}: expected the prediction's device {prediction.device}, got"
                    f" {map.device}"
                )
        counts, areas = torch.zeros_like(self._counts), torch.zeros_like(self._areas)
        flat = (map.reshape(-1).split(_CHUNK) for map in (prediction, target, depth))
        for chunk in zip(*flat, strict=True):
            more_counts, more_areas = self._count(*chunk)
            counts += more_counts
            areas += more_areas
        self._counts += counts
        self._areas += areas
        return self

    def _count(self, prediction: Tensor, target: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Both stacks of confusion matrices, of flat maps."""
        if not _counts_well(prediction.device):
            prediction, target, depth = prediction.cpu(), target.cpu(), depth.cpu()
        prediction, target = prediction.to(torch.int64), target.to(torch.int64)
        classes = self.num_classes
        counted = torch.ones_like(target, dtype=torch.bool)
        refused = (prediction < 0) | (prediction >= classes)
        if self.ignore_index is not None:
            counted = target != self.ignore_index
            # A target can then be given as its own prediction.
            refused &= counted | (prediction != self.ignore_index)
        self._refuse(prediction, refused, "prediction")
        self._refuse(target, counted & ((target < 0) | (target >= classes)), "target")

        prediction, target, depth = prediction[counted], target[counted], depth[counted]
        metres = depth.to(torch.float64)
        metres = torch.where(valid_depth(metres), metres, 0.0)
        plane = torch.zeros_like(target)
        planes = self._counts.shape[0]
        if self.depth_ranges:
            edges = torch.tensor(self.depth_ranges, dtype=torch.float64, device=metres.device)
            # -1 up to the first edge and for invalid depth: the last plane, as beyond the last one.
            plane = (torch.bucketize(metres, edges) - 1) % planes
        cell = (plane * classes + target) * classes + prediction
        size = self._counts.numel()
        counts = torch.bincount(cell, minlength=size)
        areas = torch.bincount(cell, metres.clamp(max=_LARGEST_DEPTH).square(), minlength=size)
        shape = self._counts.shape
        return counts.cpu().reshape(shape), areas.cpu().reshape(shape)

    def _refuse(self, ids: Tensor, refused: Tensor, name: str) -> None:
        if not refused.any():
            return
        ignored = "" if self.ignore_index is None else f" or ignore_index = {self.ignore_index}"
        raise ValueError(
            f"{name}: expected class ids in 0 .. {self.num_classes - 1}{ignored}, got"
            f" {int(ids[refused][0])}"
        )

    def merge(self, other: SegmentationMetrics) -> SegmentationMetrics:
        """Count what ``other`` has counted as well; ``other`` stays as it is.

        Args:
            other: Metrics with the same classes, ignored class and depth ranges.

        Returns:
            This object.

        Raises:
            ValueError: The two were made with different arguments.
            TypeError: ``other`` is no SegmentationMetrics.
        """
        if not isinstance(other, SegmentationMetrics):
            raise TypeError(f"other: expected SegmentationMetrics, got {type_name(other)}")
        if other._settings() != self._settings():
            raise ValueError(f"other: expected the arguments of {self!r}, got {other!r}")
        self._counts = self._counts + other._counts
        self._areas = self._areas + other._areas
        return self

    def all_reduce(
        self, group: torch.distributed.ProcessGroup | None = None
    ) -> SegmentationMetrics:
        """Merge the metrics of all processes: each ends up with the figures of all.

        To be called by every process of the group, once the last :meth:`update` is done: a second
        call counts everything once more. Samplers that pad the data to a multiple of the
        processes, as DistributedSampler does, repeat images, and these count twice. The matrices
        travel as objects; with NCCL that takes ``torch.cuda.set_device`` beforehand.

        Args:
            group: Process group of torch.distributed; None for the default one.

        Returns:
            This object.

        Raises:
            ValueError: This process is not in the group, or the processes' metrics were made with
                different arguments.
            RuntimeError: torch.distributed is not initialised.
        """
        parts = gather_parts(self, group)
        whole = parts[0]
        for part in parts[1:]:
            whole.merge(part)
        self._counts, self._areas = whole._counts, whole._areas
        return self

    def compute(self) -> dict[str, Any]:
        """The figures of all pixels counted so far, as plain numbers, lists and dicts.

        Returns:
            ``acc_img``, ``iou_img``, ``acc_surf`` and ``iou_surf`` as fractions; ``pixels``, the
            number counted, and ``area``, their sum of z**2. ``classes`` is a list of one dict per
            class: ``class``, its id, and the four figures of that class alone (accuracy is
            TP / (TP + FN)), with the ``pixels`` and ``area`` that the target gives it. ``ranges``
            is a list of one dict per depth range: ``from`` and ``to`` in metres, and the same six
            entries for the pixels in it. What has nothing to be a fraction of is NaN: everything
            before the first update, and the figures of a class or range that has no pixels.

        Example:
            >>> metrics = SegmentationMetrics(num_classes=2, ignore_index=None)
            >>> metrics.compute()["iou_surf"]
            nan
        """
        counts, areas = self._counts.to(torch.float64), self._areas
        whole = counts.sum(0), areas.sum(0)
        result: dict[str, Any] = figures(*whole, self.ignore_index)
        result["classes"] = figures_by_class(*whole, self.ignore_index)
        result["ranges"] = [
            {"from": low, "to": high, **figures(counts[i], areas[i], self.ignore_index)}
            for i, (low, high) in enumerate(self._range_pairs())
        ]
        return result

    def _settings(self) -> tuple[int, int | None, tuple[float, ...] | None]:
        return self.num_classes, self.ignore_index, self.depth_ranges

    def _range_pairs(self) -> list[tuple[float, float]]:
        return list(itertools.pairwise(self.depth_ranges or ()))

    def __repr__(self) -> str:
        """The arguments it was made with."""
        return (
            f"SegmentationMetrics(num_classes={self.num_classes}, ignore_index={self.ignore_index},"
            f" depth_ranges={self.depth_ranges})"
        )


def _counts_well(device: torch.device) -> bool:
    """Whether float64 sums can be had there, the same ones in every run if that was asked for."""
    on_cuda = device.type == "cuda" and not torch.are_deterministic_algorithms_enabled()
    return device.type == "cpu" or on_cuda


def _to_tensor(map: Any) -> Any:
    # Copied: an array may be read-only or run backwards, which tensors cannot.
    return torch.from_numpy(map.copy()) if isinstance(map, np.ndarray) else map
