"""SurfConvPyramid against loops and against levels mode."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import oracle_pyramid
from helpers import to_numpy
from pyramids import LEVELS, double, make_frame, make_net
from surfconv_ops import DepthLevels, SurfConv2d, SurfConvPyramid


def expected_of(pyramid: SurfConvPyramid, image: Tensor, depth: Tensor) -> np.ndarray:
    """The oracle's answer with the pyramid's options."""

    def net(frame: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return to_numpy(pyramid.net(torch.from_numpy(frame)[None])[0])

    return np.stack([
        oracle_pyramid.pyramid(
            net,
            to_numpy(image[n]),
            to_numpy(depth[n]),
            list(pyramid.levels.edges),
            list(pyramid.levels.centers),
            pyramid.reference_depth,
            pyramid.same_level_only,
            pyramid.antialias,
            pyramid.invalid_scale,
        )
        for n in range(image.shape[0])
    ])  # fmt: skip


@pytest.mark.parametrize("number", LEVELS)
@pytest.mark.parametrize("same_level_only", [False, True])
@pytest.mark.parametrize("antialias", [False, True])
def test_the_loops(number: int, same_level_only: bool, antialias: bool) -> None:
    image, depth = make_frame()
    pyramid = SurfConvPyramid(
        make_net(),
        LEVELS[number],
        4.0,
        same_level_only=same_level_only,
        antialias=antialias,
        invalid_scale=1.7,
    )
    with torch.no_grad():
        actual = to_numpy(pyramid(image, depth))
    np.testing.assert_allclose(actual, expected_of(pyramid, image, depth), rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (8, 1), (2, 3)])
@pytest.mark.parametrize("antialias", [False, True])
def test_small_frames(size: tuple[int, int], antialias: bool) -> None:
    image, depth = make_frame(4, *size)
    pyramid = SurfConvPyramid(make_net(), LEVELS[4], 7.3, antialias=antialias, invalid_scale=0.6)
    with torch.no_grad():
        actual = to_numpy(pyramid(image, depth))
    np.testing.assert_allclose(actual, expected_of(pyramid, image, depth), rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", [0.3, 0.5, 2 / 3, 1.0, 1.001, 1.25, 3.0, 1e6])
def test_the_frame_that_the_net_sees(scale: float) -> None:
    """A ramp of positions: resized pixel r lies at r * scale, floor((H-1)/scale)+1 of them."""
    y, x = torch.meshgrid(torch.arange(10.0), torch.arange(13.0), indexing="ij")
    seen = []

    class Net(nn.Module):
        def forward(self, frame: Tensor) -> Tensor:
            seen.append(frame)
            return frame

    pyramid = SurfConvPyramid(Net(), DepthLevels([], [1.0]), scale)
    out = pyramid(torch.stack((y, x))[None].to(double), torch.ones(1, 10, 13))
    rows, columns = math.floor(9 / scale) + 1, math.floor(12 / scale) + 1
    assert seen[0].shape == (1, 2, rows, columns)
    expected_y = (torch.arange(rows).to(double) * scale)[:, None].expand(rows, columns)
    expected_x = (torch.arange(columns).to(double) * scale).expand(rows, columns)
    torch.testing.assert_close(
        seen[0][0], torch.stack((expected_y, expected_x)), rtol=1e-14, atol=1e-13
    )
    # Read back, the ramp is itself up to the last resized pixel, and flat beyond it.
    torch.testing.assert_close(
        out[0, 0, :, 0], torch.arange(10.0).to(double).clamp(max=(rows - 1) * scale)
    )
    torch.testing.assert_close(
        out[0, 1, 0], torch.arange(13.0).to(double).clamp(max=(columns - 1) * scale)
    )


@pytest.mark.parametrize("same_level_only", [False, True])
@pytest.mark.parametrize(
    ("center", "scale", "step"), [(4.0, 1.0, 1), (2.0, 2.0, 2), (8.0, 0.5, 1), (8 / 3, 1.5, 3)]
)
def test_one_layer_is_levels_mode_where_the_grids_meet(
    same_level_only: bool, center: float, scale: float, step: int
) -> None:
    """Also with points of another level in between, which the masked ones of both do not see."""
    levels = DepthLevels([10.0], [center, 20.0])
    conv = nn.Conv2d(2, 3, 3, padding=1).to(double)
    options: dict[str, Any] = {"levels": levels, "reference_depth": 4.0}
    pyramid = SurfConvPyramid(conv, same_level_only=same_level_only, **options)
    fused = SurfConv2d.from_conv2d(conv, same_level_only=same_level_only, **options)
    image = torch.randn(2, 2, 25, 31, dtype=double)
    other = torch.rand(2, 25, 31) < 0.2
    depth = torch.where(other, 15.0, 5.0).to(double)
    ours, theirs = pyramid(image, depth), fused(image, depth)
    meets = torch.zeros(2, 25, 31, dtype=torch.bool)
    margin = step * max(1, math.ceil(scale / step))
    meets[:, margin : 25 - margin : step, margin : 31 - margin : step] = True
    meets &= ~other
    assert meets.sum() > 60
    meets = meets[:, None].expand_as(ours)
    torch.testing.assert_close(ours[meets], theirs[meets], rtol=1e-12, atol=1e-12)


def test_elsewhere_it_is_levels_mode_resampled() -> None:
    """At scale 2 every other pixel is the mean of its neighbours in levels mode."""
    conv = nn.Conv2d(2, 3, 3, padding=1).to(double)
    options: dict[str, Any] = {"levels": DepthLevels([], [2.0]), "reference_depth": 4.0}
    image, depth = torch.randn(1, 2, 25, 31, dtype=double), torch.ones(1, 25, 31)
    ours = SurfConvPyramid(conv, **options)(image, depth)[..., 2:-2, 2:-2]
    theirs = SurfConv2d.from_conv2d(conv, **options)(image, depth)[..., 2:-2, 2:-2]
    met = theirs[..., ::2, ::2]
    close = {"rtol": 1e-12, "atol": 1e-12}
    torch.testing.assert_close(ours[..., ::2, ::2], met, **close)
    between = ours[..., 1::2, ::2], ours[..., ::2, 1::2]
    torch.testing.assert_close(between[0], (met[..., :-1, :] + met[..., 1:, :]) / 2, **close)
    torch.testing.assert_close(between[1], (met[..., :-1] + met[..., 1:]) / 2, **close)
    assert (between[0] - theirs[..., 1::2, ::2]).abs().mean() > 0.05


@pytest.mark.parametrize("scale", [0.37, 1.0, 2.6, 5.0, 100.0])
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, double, torch.bfloat16, torch.float16])
def test_a_constant_stays_constant(scale: float, antialias: bool, dtype: torch.dtype) -> None:
    pyramid = SurfConvPyramid(
        nn.Identity(), DepthLevels([], [1.0]), scale, antialias=antialias, invalid_scale=scale
    )
    image = torch.full((1, 2, 13, 17), 0.7, dtype=dtype)
    out = pyramid(image, torch.randn(1, 13, 17))
    assert out.dtype == dtype
    accuracy = {torch.float32: 3e-7, double: 1e-15}.get(dtype, 0.0)
    torch.testing.assert_close(out, image, rtol=accuracy, atol=0)


def test_antialias_takes_fine_patterns_out_of_smaller_frames_only() -> None:
    seen: list[Tensor] = []

    class Net(nn.Module):
        def forward(self, frame: Tensor) -> Tensor:
            seen.append(frame)
            return frame

    y, x = torch.meshgrid(torch.arange(40), torch.arange(40), indexing="ij")
    checkers = (1.0 - 2.0 * ((y + x) % 2))[None, None].to(double)
    for scale, kept in ((3.0, False), (0.5, True)):
        seen.clear()
        for antialias in (False, True):
            level = DepthLevels([], [1.0])
            SurfConvPyramid(Net(), level, scale, antialias=antialias)(
                checkers, torch.ones(1, 40, 40)
            )
        plain, filtered = (frame[..., 3:-3, 3:-3].square().mean() for frame in seen)
        if kept:
            assert torch.equal(*seen)
        else:
            # Taps 3 apart keep alternating signs.
            assert plain == 1
            assert filtered < 0.02


@pytest.mark.parametrize("same_level_only", [False, True])
@pytest.mark.parametrize("antialias", [False, True])
def test_gradcheck(same_level_only: bool, antialias: bool) -> None:
    image, depth = make_frame(2, 3, 4, channels=1)
    depth[0, 0, :3] = torch.tensor([1.0, 3.0, math.nan])
    pyramid = SurfConvPyramid(
        nn.Sequential(nn.Conv2d(1, 1, (3, 1), padding=(1, 0)), nn.Tanh()).to(double),
        LEVELS[2],
        5.0,
        same_level_only=same_level_only,
        antialias=antialias,
        invalid_scale=1.3,
    )
    parameters = dict(pyramid.named_parameters())

    def call(image: Tensor, *values: Tensor) -> Tensor:
        named = dict(zip(parameters, values, strict=True))
        return torch.func.functional_call(pyramid, named, (image, depth))

    inputs = (image.requires_grad_(), *parameters.values())
    assert torch.autograd.gradcheck(call, inputs)
    assert torch.autograd.gradgradcheck(call, inputs)
