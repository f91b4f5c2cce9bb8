"""Where the taps of all output pixels sample an image, and what they see there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from . import geometry
from .geometry import Pair

# Offsets beyond this many pixels reach no image, and still convert to int64 exactly.
_REACH = 2.0**40


class Corner(NamedTuple):
    """One of the four pixels around a sample; every tensor has shape (N, Ho*Wo)."""

    place: Tensor  # into the flattened image, inside it even where nothing is visible
    visible: Tensor
    weight_y: Tensor
    weight_x: Tensor
    slope_y: int | Tensor  # derivative of weight_y with respect to the sample's row
    slope_x: int | Tensor


class Tap(NamedTuple):
    """One tap of the kernel for all output pixels: its place, its offset, where it samples."""

    row: int
    column: int
    offset_y: float
    offset_x: float
    corners: list[Corner]


class _AxisCorner(NamedTuple):
    """A corner along one axis; every tensor has shape (N, Ho, Wo)."""

    pixel: Tensor
    inside: Tensor
    weight: Tensor
    slope: int | Tensor

    @property
    def flat_slope(self) -> int | Tensor:
        return self.slope if isinstance(self.slope, int) else self.slope.flatten(1)


@dataclass(frozen=True)
class _Axis:
    """One axis of the sampling grid: (N, Ho, Wo) scales around centres that broadcast to them."""

    size: int
    kernel: int
    dilation: int
    centre: Tensor
    scale: Tensor

    def offset(self, tap: int) -> float:
        return geometry.doubled_tap(tap, self.kernel, self.dilation) / 2

    def corners(self, tap: int) -> list[_AxisCorner]:
        """The two pixels around tap ``tap`` of every output pixel."""
        offset = self.offset(tap)
        if offset == 0:
            # It stays on the centre even where the scale is not finite. A kernel that has such a
            # tap has its centres on pixels.
            low = self.centre.expand(self.scale.shape)
            # Selecting nothing of the scale keeps it in the graph, with a gradient of zero.
            reached = torch.ones_like(self.scale, dtype=torch.bool)
            fraction = torch.where(reached, 0.0, self.scale)
        else:
            # NaN compares false. The scale is replaced before it is used: masking the result
            # would leave 0 * inf in the gradient.
            reached = (self.scale.detach() * offset).abs() <= _REACH
            safe = torch.where(reached, self.scale, 0.0)
            position = geometry.centre_fraction(self.kernel, self.dilation) + safe * offset
            # A sample on a pixel counts to the cell it moves into as the scale grows: then the
            # derivatives of all taps are the same one-sided derivative.
            at = position.detach()
            whole = at.floor() if offset > 0 else at.ceil() - 1
            low = self.centre + whole.to(torch.int64)
            fraction = position - whole
        return [
            self._corner(low, reached, 1 - fraction, -1),
            self._corner(low + 1, reached, fraction, 1),
        ]

    def _corner(self, pixel: Tensor, reached: Tensor, weight: Tensor, slope: int) -> _AxisCorner:
        inside = reached & (pixel >= 0) & (pixel < self.size)
        return _AxisCorner(pixel.clamp(0, self.size - 1), inside, weight, slope)


class _ClampedAxis(_Axis):
    """An axis whose samples are clamped into the image, as a maximum takes them.

    Where the scale is exactly 1, taps outside the image are left out instead, as nn's pools do:
    clamped, they would see pixels between the taps of a dilated kernel.
    """

    def corners(self, tap: int) -> list[_AxisCorner]:
        offset = self.offset(tap)
        scale = self.scale.detach()
        last = self.size - 1
        if offset == 0:
            # Selecting nothing of the scale keeps it in the graph, with a gradient of zero.
            low = self.centre.expand(scale.shape)
            fraction = torch.where(torch.ones_like(scale, dtype=torch.bool), 0.0, self.scale)
            inside = torch.ones_like(low, dtype=torch.bool)
            before, behind = low < 0, low >= last
        else:
            inside = scale.isfinite()
            far = scale * offset
            safe = torch.where(far.abs() <= _REACH, self.scale, 0.0)
            position = geometry.centre_fraction(self.kernel, self.dilation) + safe * offset
            at = position.detach()
            whole = at.floor() if offset > 0 else at.ceil() - 1
            low = self.centre + whole.to(torch.int64)
            fraction = position - whole
            before = (far < -_REACH) | ((far.abs() <= _REACH) & (low < 0))
            behind = (far > _REACH) | ((far.abs() <= _REACH) & (low >= last))
        pixel = low + (fraction.detach() == 1)
        inside = inside & ((scale != 1) | ((pixel >= 0) & (pixel <= last)))
        clamped = before | behind
        low = torch.where(before, 0, torch.where(behind, last, low)).clamp(0, last)
        fraction = torch.where(clamped, 0.0, fraction)
        moves = (~clamped).to(scale.dtype)
        return [
            _AxisCorner(low, inside, 1 - fraction, -moves),
            _AxisCorner((low + 1).clamp(max=last), inside & ~clamped, fraction, moves),
        ]


class Guide:
    """What every output pixel may see: pixels whose guide is within tolerance of its centre's."""

    def __init__(self, guide: Tensor, tolerance: float, rows: Tensor, columns: Tensor) -> None:
        height, width = guide.shape[-2:]
        centre = guide.index_select(1, rows.flatten().clamp(0, height - 1))
        centre = centre.index_select(2, columns.flatten().clamp(0, width - 1))
        self._values = guide.flatten(1)
        self._centre = centre.flatten(1)
        self._applies = self._centre.isfinite()
        self._tolerance = torch.full((), tolerance, dtype=guide.dtype, device=guide.device)

    def visible(self, index: Tensor) -> Tensor:
        near = (self._values.gather(1, index) - self._centre).abs() <= self._tolerance
        return near | ~self._applies


def centres(
    scale: Tensor, kernel: Pair, stride: Pair, padding: Pair, dilation: Pair
) -> tuple[Tensor, Tensor]:
    """Integer parts of all centres: (Ho, 1) rows and (1, Wo) columns."""
    rows, columns = (
        geometry.centre_pixels(
            scale.shape[i + 2], kernel[i], stride[i], padding[i], dilation[i], scale.device
        )
        for i in (0, 1)
    )
    return rows[:, None], columns[None, :]


def taps(
    size: Pair,
    kernel: Pair,
    scale: Tensor,
    guide: Tensor | None,
    guide_tolerance: float,
    stride: Pair,
    padding: Pair,
    dilation: Pair,
    clamped: bool = False,
) -> Iterator[Tap]:
    """Every tap of the kernel in row order; ``scale`` and ``guide`` in the compute dtype.

    ``clamped``: samples outside the image move to its edge, else nothing is seen there.
    """
    rows, columns = centres(scale, kernel, stride, padding, dilation)
    axis = _ClampedAxis if clamped else _Axis
    axis_y = axis(size[0], kernel[0], dilation[0], rows, scale[:, 0])
    axis_x = axis(size[1], kernel[1], dilation[1], columns, scale[:, -1])
    limits = None if guide is None else Guide(guide, guide_tolerance, rows, columns)
    for row in range(kernel[0]):
        ends_y = axis_y.corners(row)
        for column in range(kernel[1]):
            corners = []
            for y in ends_y:
                for x in axis_x.corners(column):
                    index = (y.pixel * size[1] + x.pixel).flatten(1)
                    visible = (y.inside & x.inside).flatten(1)
                    if limits is not None:
                        visible = visible & limits.visible(index)
                    weights = y.weight.flatten(1), x.weight.flatten(1)
                    slopes = y.flat_slope, x.flat_slope
                    corners.append(Corner(index, visible, *weights, *slopes))
            yield Tap(row, column, axis_y.offset(row), axis_x.offset(column), corners)


def seen(values: Tensor, corner: Corner) -> Tensor:
    """(N, C, Ho*Wo) values that go through a corner, 0 where it is not seen."""
    # Without weight a corner is not seen: 0 * inf must not appear. A finite value may stay, it
    # adds nothing but carries the derivative of a sample that lies exactly on a pixel.
    weighted = (corner.weight_y * corner.weight_x).detach() != 0
    counts = corner.visible[:, None] & (weighted[:, None] | values.detach().isfinite())
    return torch.where(counts, values, 0.0)


def pixels(image: Tensor, corner: Corner) -> Tensor:
    """(N, C, Ho*Wo) values of a corner, 0 where it is not seen; ``image`` is (N, C, H*W)."""
    return seen(image.gather(2, corner.place[:, None].expand(-1, image.shape[1], -1)), corner)


def sample(image: Tensor, tap: Tap) -> Tensor:
    """(N, C, Ho*Wo) bilinear samples of one tap."""
    total = image.new_zeros(())
    for corner in tap.corners:
        total = total + (corner.weight_y * corner.weight_x)[:, None] * pixels(image, corner)
    return total
