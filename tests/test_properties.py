"""What must hold of the operator, without an oracle: the geometry, and linear algebra."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from helpers import assert_same_bits
from operators import OPERATORS
from surfconv_ops import DepthLevels, SurfConv2d

each_operator = pytest.mark.parametrize("operator", OPERATORS)
double = torch.float64


def surface(y: Tensor, x: Tensor) -> Tensor:
    """A texture in metres on a plane that faces the camera; smooth, so sampling errs little."""
    return torch.sin(3 * y) * torch.cos(2 * x) + 0.5 * torch.sin(5 * x + y)


@each_operator
@pytest.mark.parametrize(("spacing", "tolerance"), [(8.0, 1e-12), (9.1, 2e-3)])
def test_a_plane_at_twice_the_depth_gives_the_same_response(
    operator: str, spacing: float, tolerance: float
) -> None:
    """Filters live on the surface: how far away it is does not matter. Taps on whole pixels agree
    exactly; between pixels, to what bilinear sampling errs on the texture's curvature."""
    focal, weight = 400.0, torch.randn(2, 1, 3, 3, dtype=double)
    pixels = torch.arange(-60, 61, dtype=double)
    responses, ordinary = [], []
    for z in (1.0, 2.0):
        metres = pixels * z / focal
        frame = surface(metres[:, None], metres[None, :])[None, None]
        scale = torch.full((1, 121, 121), spacing / z, dtype=double)
        out = OPERATORS[operator](frame, weight, scale=scale, padding=1)
        plain = F.conv2d(frame, weight, padding=1)
        at = [60 + int(2 / z) * i for i in range(-20, 21)]
        responses.append(out[..., at, :][..., at])
        ordinary.append(plain[..., at, :][..., at])
    torch.testing.assert_close(responses[0], responses[1], rtol=0, atol=tolerance)
    assert (ordinary[0] - ordinary[1]).abs().max() > 5e-3


@each_operator
@pytest.mark.parametrize("kernel", [(3, 3), (2, 4), (5, 1)])
@pytest.mark.parametrize("scale", [(1.0, 1.0), (2.5, 0.75), (0.25, 3.0), (-1.5, 1.0)])
@pytest.mark.parametrize("dilation", [1, 2])
def test_each_tap_lands_where_the_relation_puts_it(
    operator: str, kernel: tuple[int, int], scale: tuple[float, float], dilation: int
) -> None:
    """With x the row and then the column number, a tap answers with its own position."""
    rows = torch.arange(60.0, dtype=double).view(1, 1, 60, 1).expand(1, 1, 60, 70)
    columns = torch.arange(70.0, dtype=double).view(1, 1, 1, 70).expand(1, 1, 60, 70)
    taps = kernel[0] * kernel[1]
    weight = torch.eye(taps, dtype=double).view(taps, 1, *kernel)
    reach = [dilation * (k - 1) for k in kernel]
    size = (60 - reach[0], 70 - reach[1])
    pair = torch.tensor(scale, dtype=double).view(1, 2, 1, 1).expand(1, 2, *size)
    for axis, image in enumerate((rows, columns)):
        out = OPERATORS[operator](image, weight, scale=pair, dilation=dilation)[0]
        for tap in range(taps):
            index = divmod(tap, kernel[1])[axis]
            offset = dilation * (index - (kernel[axis] - 1) / 2) * scale[axis]
            centre = torch.arange(size[axis], dtype=double) + reach[axis] / 2
            expected = (centre + offset).view((-1, 1) if axis == 0 else (1, -1)).expand(size)
            inside = (slice(22, size[0] - 22), slice(22, size[1] - 22))
            assert expected[inside].numel() > 0
            torch.testing.assert_close(out[tap][inside], expected[inside], rtol=1e-12, atol=1e-12)


@each_operator
def test_impulse_response(operator: str) -> None:
    """A single bright pixel shows, seen from one output, the bilinear weights of each tap."""
    weight = torch.arange(1.0, 10.0).view(1, 1, 3, 3)
    response = torch.zeros(9, 9)
    scale = torch.full((1, 9, 9), 2.25)
    for y in range(9):
        for x in range(9):
            impulse = torch.zeros(1, 1, 9, 9)
            impulse[0, 0, y, x] = 1.0
            out = OPERATORS[operator](impulse, weight, scale=scale, padding=1)
            response[y, x] = out[0, 0, 4, 4]
    # Taps at 4 - 2.25, 4 and 4 + 2.25, each shared between its two neighbours.
    share = {-1: {1: 0.25, 2: 0.75}, 0: {4: 1.0}, 1: {6: 0.75, 7: 0.25}}
    expected = torch.zeros(9, 9)
    for ty in (-1, 0, 1):
        for tx in (-1, 0, 1):
            for y, share_y in share[ty].items():
                for x, share_x in share[tx].items():
                    expected[y, x] = weight[0, 0, ty + 1, tx + 1] * share_y * share_x
    torch.testing.assert_close(response, expected)


@each_operator
@pytest.mark.parametrize("kernel", [3, (5, 3), (1, 5)])
@pytest.mark.parametrize("factor", [2, 3, (1, 3)])
@pytest.mark.parametrize("stride", [1, 2])
def test_integer_scale_is_a_dilated_convolution(
    operator: str, kernel: Any, factor: Any, stride: int
) -> None:
    size = (kernel, kernel) if isinstance(kernel, int) else kernel
    factors = (factor, factor) if isinstance(factor, int) else factor
    x = torch.randn(1, 3, 40, 44, dtype=double)
    weight = torch.randn(4, 3, *size, dtype=double)
    padding = tuple(k // 2 for k in size)
    wide = tuple(f * (k // 2) for f, k in zip(factors, size, strict=True))
    expected = F.conv2d(x, weight, None, stride, wide, factors)
    pair = torch.tensor(factors, dtype=double).view(1, 2, 1, 1).expand(1, 2, *expected.shape[2:])
    out = OPERATORS[operator](x, weight, scale=pair, stride=stride, padding=padding)
    # Odd kernels pad alike on every side, so even the border agrees.
    torch.testing.assert_close(out, expected, rtol=1e-12, atol=1e-12)


@each_operator
def test_integer_scale_of_even_kernels_away_from_the_border(operator: str) -> None:
    """An even kernel keeps its half-pixel centre: three times wider is dilation 3, one pixel on."""
    x, weight = torch.randn(1, 2, 20, 20, dtype=double), torch.randn(3, 2, 2, 2, dtype=double)
    scale = torch.full((1, 19, 19), 3.0, dtype=double)
    out = OPERATORS[operator](x, weight, scale=scale)
    expected = F.conv2d(x, weight, dilation=3)
    torch.testing.assert_close(out[..., 1:-1, 1:-1], expected, rtol=1e-12, atol=1e-12)


@each_operator
@pytest.mark.parametrize("ratio", [Fraction(3, 2), Fraction(2, 3), Fraction(5, 4), Fraction(1, 2)])
def test_rational_scale_is_conv2d_on_the_resampled_frame(operator: str, ratio: Fraction) -> None:
    """The pyramid's layer: resized pixel r lies at r * scale, and where both grids meet and no
    tap crosses the border, the number is the same."""
    scale = float(ratio)
    x, weight = torch.randn(1, 3, 31, 37, dtype=double), torch.randn(4, 3, 3, 3, dtype=double)
    rows, columns = (torch.arange(int((n - 1) / scale) + 1, dtype=double) * scale for n in (31, 37))
    resized = x
    for axis, positions in ((2, rows), (3, columns)):
        low = positions.floor().long()
        high = (low + 1).clamp(max=x.shape[axis] - 1)
        shape = [1, 1, 1, 1]
        shape[axis] = -1
        share = (positions - low).view(shape)
        first, second = resized.index_select(axis, low), resized.index_select(axis, high)
        resized = first * (1 - share) + second * share
    pyramid = F.conv2d(resized, weight, padding=1)
    scales = torch.full((1, 31, 37), scale, dtype=double)
    out = OPERATORS[operator](x, weight, scale=scales, padding=1)
    met = 0
    for y in range(0, 31, ratio.numerator):
        for column in range(0, 37, ratio.numerator):
            r = int(y / ratio), int(column / ratio)
            if 0 < r[0] < len(rows) - 1 and 0 < r[1] < len(columns) - 1:
                torch.testing.assert_close(out[0, :, y, column], pyramid[0, :, r[0], r[1]],
                                           rtol=1e-12, atol=1e-12)  # fmt: skip
                met += 1
    assert met >= 30


def test_levels_mode_is_the_layer_of_its_level() -> None:
    """Two levels at once: every pixel's number is the one of a frame wholly in its level."""
    levels = DepthLevels([2.5], [2.0, 4.0])
    conv = SurfConv2d(2, 3, 3, padding=1, reference_depth=4.0, levels=levels)
    x, depth = torch.randn(1, 2, 16, 18), torch.rand(1, 16, 18) * 3 + 1
    mixed = conv(x, depth)
    near, far = conv(x, torch.full_like(depth, 2.0)), conv(x, torch.full_like(depth, 4.0))
    assert_same_bits(mixed, torch.where((depth <= 2.5)[:, None], near, far))


@each_operator
@pytest.mark.parametrize("guide", [False, True])
def test_linearity(operator: str, guide: bool) -> None:
    scale = torch.rand(2, 9, 9, dtype=double) * 3
    x, other = torch.randn(2, 2, 3, 9, 9, dtype=double)
    weight, more = torch.randn(2, 4, 3, 3, 3, dtype=double)
    hidden = torch.randint(0, 2, (2, 9, 9)).double() if guide else None

    def apply(image: Tensor, kernel: Tensor) -> Tensor:
        return OPERATORS[operator](image, kernel, scale=scale, padding=1, guide=hidden)

    left = apply(2 * x - 3 * other, weight)
    torch.testing.assert_close(left, 2 * apply(x, weight) - 3 * apply(other, weight))
    left = apply(x, 2 * weight - 3 * more)
    torch.testing.assert_close(left, 2 * apply(x, weight) - 3 * apply(x, more))


@each_operator
@pytest.mark.parametrize("guide", [False, True])
@pytest.mark.parametrize("stride", [1, 2])
def test_adjointness(operator: str, guide: bool, stride: int) -> None:
    """<A x, y> = <x, A' y>, for A as a map of the input and as a map of the weight."""
    x = torch.randn(2, 4, 10, 9, dtype=double, requires_grad=True)
    weight = torch.randn(6, 2, 3, 3, dtype=double, requires_grad=True)
    size = tuple((n - 1) // stride + 1 for n in (10, 9))
    scale = torch.randn(2, 2, *size, dtype=double) * 2
    hidden = torch.randint(0, 2, (2, 10, 9)).double() if guide else None
    out = OPERATORS[operator](
        x, weight, scale=scale, padding=1, groups=2, stride=stride, guide=hidden
    )
    y = torch.randn_like(out)
    image, kernel = torch.autograd.grad(out, (x, weight), y)
    left = (out * y).sum()
    torch.testing.assert_close(left, (x * image).sum(), rtol=1e-12, atol=1e-10)
    torch.testing.assert_close(left, (weight * kernel).sum(), rtol=1e-12, atol=1e-10)


@each_operator
@pytest.mark.parametrize("shift", [(3, 0), (0, 5), (7, 2)])
def test_translation(operator: str, shift: tuple[int, int]) -> None:
    """Moving image, scale and guide together moves the output, to the bit."""
    big, weight = torch.randn(1, 3, 40, 40), torch.randn(4, 3, 3, 3)
    scales = torch.rand(1, 1, 40, 40) * 4
    guides = torch.randint(0, 2, (1, 40, 40)).float()

    def window(dy: int, dx: int) -> Tensor:
        rows, columns = slice(dy, dy + 30), slice(dx, dx + 30)
        return OPERATORS[operator](
            big[:, :, rows, columns], weight, scale=scales[:, :, rows, columns], padding=1,
            guide=guides[:, rows, columns],
        )  # fmt: skip

    dy, dx = shift
    moved, still = window(dy, dx), window(0, 0)
    # Scale stays under 4, so from 5 pixels inside no tap sees the border.
    torch.testing.assert_close(
        moved[..., 5 : 25 - dy, 5 : 25 - dx], still[..., 5 + dy : 25, 5 + dx : 25],
        rtol=0, atol=0,
    )  # fmt: skip


@each_operator
def test_a_guide_stops_taps_at_an_occlusion_edge(operator: str) -> None:
    """With the window on, what lies behind an edge cannot change the near side's response."""
    depth = torch.full((1, 12, 16), 1.0)
    depth[..., 8:] = 5.0
    conv = SurfConv2d(1, 2, 3, padding=1, reference_depth=2.0, depth_window=0.5)
    x = torch.randn(1, 1, 12, 16)
    changed = x.clone()
    changed[..., 8:] += 10.0
    scale = 2.0 / depth
    options = {"padding": 1, "guide": depth, "guide_tolerance": 0.5}
    for image in (x, changed):
        out = OPERATORS[operator](image, conv.weight, conv.bias, scale=scale, **options)
        torch.testing.assert_close(out, conv(image, depth), rtol=1e-5, atol=1e-6)
    near, far = conv(x, depth)[..., :8], conv(x, depth)[..., 8:]
    assert_same_bits(conv(changed, depth)[..., :8], near)
    assert (conv(changed, depth)[..., 8:] != far).any()
