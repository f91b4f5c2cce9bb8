"""The relation written out for chosen output pixels, in float64: what the gate believes."""

from __future__ import annotations

import torch
from torch import Tensor

from cases import Layer

#: Sampled values held at a time, which bounds memory and so the number of points.
MOST_VALUES = 3_000_000
MOST_POINTS = 1500


def choose_points(layer: Layer) -> Tensor:
    """(P, 3) output pixels as (image, row, column): the corners and random ones."""
    rows, columns = layer.output_size
    width = layer.kernel**2 * layer.channels_in
    count = max(16, min(MOST_POINTS, MOST_VALUES // width, layer.pixels // 2))
    generator = torch.Generator().manual_seed(11)
    chosen = torch.randperm(layer.pixels, generator=generator)[:count]
    corners = torch.tensor(
        [0, columns - 1, (rows - 1) * columns, rows * columns - 1, layer.pixels - 1]
    )
    flat = torch.cat((corners, chosen)).unique()
    row = flat // columns
    return torch.stack((row // rows, row % rows, flat % columns), 1)


def _taps(kernel: int, device: torch.device) -> Tensor:
    return torch.arange(kernel, device=device) - (kernel - 1) / 2


def _axis(centre: Tensor, scale: Tensor, kernel: int, size: int) -> list[tuple[Tensor, ...]]:
    """The two pixels around each tap's position along an axis: (index, weight, inside), (P, k)."""
    position = centre[:, None] + scale[:, None] * _taps(kernel, centre.device)
    low = position.detach().floor()
    share = position - low
    pixels = ((low, 1 - share), (low + 1, share))
    return [
        (pixel.clamp(0, size - 1).long(), weight, (pixel >= 0) & (pixel < size))
        for pixel, weight in pixels
    ]


def at_points(
    layer: Layer,
    points: Tensor,
    input: Tensor,
    weight: Tensor,
    bias: Tensor,
    scale: Tensor,
    guide: Tensor | None,
    tolerance: float,
) -> Tensor:
    """Output (P, O) at the points, differentiable, in the dtype of its arguments.

    Args:
        layer: stride, padding and groups; the kernel must be odd.
        points: (P, 3) from `choose_points`.
        input: (N, C, H, W).
        weight: (O, C / groups, k, k).
        bias: (O,).
        scale: (N, Ho, Wo).
        guide: (N, H, W) or None.
        tolerance: largest difference of guide that is seen.
    """
    image, row, column = points.unbind(1)
    shift = (layer.kernel - 1) // 2 - layer.padding
    centre_y, centre_x = layer.stride * row + shift, layer.stride * column + shift
    own = scale[image, row, column]
    pixels_last = input.permute(0, 2, 3, 1)
    image = image[:, None, None]
    sampled: Tensor | float = 0.0
    for y, weight_y, inside_y in _axis(centre_y, own, layer.kernel, layer.height):
        for x, weight_x, inside_x in _axis(centre_x, own, layer.kernel, layer.width):
            y2, x2 = y[:, :, None], x[:, None, :]
            seen = inside_y[:, :, None] & inside_x[:, None, :]
            if guide is not None:
                at_centre = guide[image, centre_y[:, None, None], centre_x[:, None, None]]
                close = (guide[image, y2, x2] - at_centre).abs() <= tolerance
                seen = seen & (close | ~at_centre.isfinite())
            share = weight_y[:, :, None] * weight_x[:, None, :] * seen
            sampled = sampled + pixels_last[image, y2, x2] * share[..., None]
    assert isinstance(sampled, Tensor)
    groups = layer.groups
    columns = sampled.unflatten(-1, (groups, -1))
    filters = weight.unflatten(0, (groups, -1))
    output = torch.einsum("pyxgc,gocyx->pgo", columns, filters)
    return output.flatten(1) + bias


def off_kinks(layer: Layer, scale: Tensor, margin: float) -> Tensor:
    """Where no tap lies within `margin` of a pixel, so that all precisions agree on the slope."""
    taps = torch.arange(1, (layer.kernel - 1) // 2 + 1, device=scale.device)
    position = scale[..., None] * taps
    return ((position - position.round()).abs() > margin).all(-1)
