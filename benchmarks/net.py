"""The paper's net, which the KITTI example holds, plain and converted."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from surfconv_ops import DepthGuided, convert_conv2d

sys.path.append(str(Path(__file__).parents[1] / "examples" / "kitti"))

from paper_net import PARAMETERS_AT_CAPACITY_1, PaperNet

PARAMETERS = PARAMETERS_AT_CAPACITY_1


class GuidedPaperNet(nn.Module):
    """The net with SurfConv2d in every layer larger than 1 x 1, as a user converts it.

    Args:
        options: SurfConv2d's depth arguments.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.guided = DepthGuided(convert_conv2d(PaperNet(), **options))

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        """Scores (N, classes, H, W) of frames (N, 6, H, W) with depth (N, H, W) in metres."""
        scores: Tensor = self.guided(input, depth=depth)
        return scores
