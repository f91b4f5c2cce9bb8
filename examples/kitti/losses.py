"""The three ways to weigh a pixel's log loss.

On the pyramid's resized frames a pixel stands for more or less of the original image: a level
resized by s = reference_depth / center has 1 / s^2 pixels per original one. The paper averages
within each level (`levels`) and has a variant that weighs pixels back to image area (`image`);
`surface` gives every original pixel the weight it has on the resized frames.

Source:
    Chu et al., *SurfConv*, CVPR 2018, section 4.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from surfconv_ops import DepthLevels

LOSSES = ("image", "surface", "levels")
IGNORED = 0


def segmentation_loss(
    scores: Tensor,
    label: Tensor,
    depth: Tensor,
    *,
    kind: str,
    levels: DepthLevels,
    reference_depth: float,
) -> Tensor:
    """Log loss over the labelled pixels of a batch.

    Args:
        scores: (N, classes, H, W).
        label: (N, H, W), class ids; 0 is not labelled and does not count.
        depth: (N, H, W) in metres.
        kind: `image`: every pixel counts 1. `surface`: a pixel counts
            (center of its level / reference_depth)^2, over the sum of these weights. `levels`:
            the mean within each level that has a labelled pixel, summed. Pixels without depth
            count 1 (`surface`) and form a level of their own (`levels`).
        levels: depth levels, whatever the net itself uses.
        reference_depth: metres.

    Returns:
        A scalar; 0 with zero gradient where no pixel is labelled.
    """
    losses = cross_entropy(scores, label, ignore_index=IGNORED, reduction="none")
    counted = label != IGNORED
    if kind == "image":
        return _weighted_mean(losses, counted.to(losses.dtype))
    level = levels.assign(depth)
    if kind == "surface":
        weights = [(center / reference_depth) ** 2 for center in levels.centers]
        # The last entry is read by level -1: no depth.
        of_level = losses.new_tensor([*weights, 1.0])
        return _weighted_mean(losses, counted * of_level[level])
    if kind != "levels":
        raise ValueError(f"kind: expected one of {LOSSES}, got {kind!r}")
    means = [
        _weighted_mean(losses, (counted & (level == k)).to(losses.dtype))
        for k in range(-1, len(levels))
    ]
    return torch.stack(means).sum()


def _weighted_mean(losses: Tensor, weights: Tensor) -> Tensor:
    total = weights.sum()
    return (losses * weights).sum() / torch.where(total > 0, total, 1.0)
