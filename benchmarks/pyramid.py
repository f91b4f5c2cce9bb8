"""The paper's multi-scale scheme: a whole net or one layer, run once for every depth level."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from surfconv_ops import DepthLevels


def _read(image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Bilinear reading of an image at rows x columns of real positions, kept inside the image."""
    height, width = image.shape[-2:]
    y = rows * (2 / max(height - 1, 1)) - 1
    x = columns * (2 / max(width - 1, 1)) - 1
    grid = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), -1)
    grid = grid.expand(len(image), -1, -1, -1).to(image.dtype)
    return grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)


class Pyramid(nn.Module):
    """Runs a net once per level on the frame resized to its scale; each pixel keeps its own.

    Pixel r of level k's frame lies at original position r * scale_k, with scale_k =
    reference_depth / centers[k]; the net's output is read back at p / scale_k. Pixels without
    depth are one more level, at scale 1.

    Args:
        net: takes (N, C, h, w) and gives (N, O, h, w).
        levels: depth levels.
        reference_depth: metres at which a level's frame is the original one.

    Source:
        Chu et al., *SurfConv*, CVPR 2018, section 3.3.
    """

    def __init__(
        self, net: Callable[[Tensor], Tensor], levels: DepthLevels, reference_depth: float
    ) -> None:
        super().__init__()
        self.net = net
        self.levels = levels
        self.scales = [*(reference_depth / center for center in levels.centers), 1.0]

    def forward(self, input: Tensor, depth: Tensor) -> Tensor:
        """The net's output for input (N, C, H, W) with depth (N, H, W), each pixel at its scale."""
        height, width = input.shape[-2:]
        rows, columns = torch.arange(height).double(), torch.arange(width).double()
        level_of = self.levels.assign(depth).unsqueeze(1)
        level_of = torch.where(level_of < 0, len(self.levels), level_of)
        output: Tensor | None = None
        for level, scale in enumerate(self.scales):
            own = level_of == level
            if not own.any():
                continue
            small_rows = torch.arange(int((height - 1) / scale) + 1).double() * scale
            small_columns = torch.arange(int((width - 1) / scale) + 1).double() * scale
            result = self.net(_read(input, small_rows, small_columns))
            result = _read(result, rows / scale, columns / scale)
            output = result if output is None else torch.where(own, result, output)
        assert output is not None
        return output
