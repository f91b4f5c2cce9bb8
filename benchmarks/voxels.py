"""A depth frame as a voxel grid, for nn.Conv3d."""

from __future__ import annotations

import torch
from torch import Tensor


def voxelise(
    features: Tensor, depth: Tensor, focal_length: float, grid: tuple[int, int, int], metres: float
) -> Tensor:
    """Mean feature of the points in every voxel, zero where there is none.

    Args:
        features: (C, H, W).
        depth: (H, W) metres, 0 where there is none.
        focal_length: pixels, the optical axis being at the frame's middle.
        grid: voxels along x (right), y (down) and z (away), the camera in the middle of z = 0.
        metres: side of a voxel.

    Returns:
        (1, C, x, y, z).
    """
    height, width = depth.shape
    y = torch.arange(height)[:, None] - (height - 1) / 2
    x = torch.arange(width) - (width - 1) / 2
    z = depth / metres
    places = (x * z / focal_length + grid[0] / 2, y * z / focal_length + grid[1] / 2, z)
    cell = torch.stack([place.floor().long() for place in places])
    sizes = torch.tensor(grid)[:, None, None]
    inside = ((cell >= 0) & (cell < sizes)).all(0) & (depth > 0)
    flat = ((cell[0] * grid[1] + cell[1]) * grid[2] + cell[2])[inside]
    count = grid[0] * grid[1] * grid[2]
    points = torch.zeros(count).index_add_(0, flat, torch.ones(len(flat)))
    total = torch.zeros(len(features), count).index_add_(1, flat, features[:, inside])
    return (total / points.clamp_min(1)).view(1, len(features), *grid)
