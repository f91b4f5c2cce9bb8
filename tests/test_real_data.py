"""Real frames, with their holes, outliers and edges: SURFCONV_DATA names the folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from helpers import assert_matches, geometry, to_numpy
from oracle import forward
from surfconv_ops import DepthLevels, SurfConv2d, reference

pytestmark = pytest.mark.filterwarnings("ignore:depth_to_scale")
FRAMES = {
    "kitti 1": ("kitti/rgb/img_1.png", "kitti/depth/img_1.png", 90 / 65535, 715.0, 1.5),
    "kitti 40": ("kitti/rgb/img_40.png", "kitti/depth/img_40.png", 90 / 65535, 715.0, 1.5),
    "indoor": ("indoor/rgb.png", "indoor/depth.png", 1 / 10000, 365.0, 0.05),
}
MODES: dict[str, dict[str, Any]] = {
    "continuous": {},
    "window": {"depth_window": 0.5},
    "levels": {"levels": DepthLevels([8.0, 16.0], [5.0, 11.0, 25.0])},
    "same level": {"levels": DepthLevels([2.0, 10.0], [1.0, 4.0, 20.0]), "same_level_only": True},
}


class Frame(NamedTuple):
    rgb: Tensor
    depth: Tensor
    focal: float
    radius: float


@pytest.fixture(params=FRAMES)
def frame(request: pytest.FixtureRequest, data_folder: Path) -> Frame:
    image = pytest.importorskip("PIL.Image", reason="Pillow reads the frames")
    colour, depth, unit, focal, radius = FRAMES[request.param]
    rgb = np.asarray(image.open(data_folder / colour).convert("RGB"), dtype=np.float32)
    metres = np.asarray(image.open(data_folder / depth), dtype=np.float64) * unit
    pixels = torch.from_numpy(rgb).permute(2, 0, 1)[None] / 255
    return Frame(pixels, torch.from_numpy(metres).float()[None], focal, radius)


def test_the_frames_are_what_they_should_be(frame: Frame) -> None:
    valid = frame.depth > 0
    assert 0.5 < valid.float().mean() < 0.95
    assert 0.3 < frame.depth[valid].median() < 30.0


@pytest.mark.parametrize("mode", MODES)
def test_against_the_reference(frame: Frame, mode: str) -> None:
    conv = SurfConv2d.from_radius(3, 8, 3, padding=1, radius=frame.radius, focal_length=frame.focal,
                                  **MODES[mode])  # fmt: skip
    depth = frame.depth.clone().requires_grad_()
    out = conv(frame.rgb, depth)
    exact = exact_layer(conv, frame)
    torch.testing.assert_close(out.double(), exact, rtol=1e-4, atol=1e-4)
    if conv.levels is None:
        (grad,) = torch.autograd.grad(out.square().mean(), depth)
        assert grad.isfinite().all() and grad.any()
        assert not grad[frame.depth <= 0].any()


def exact_layer(conv: SurfConv2d, frame: Frame) -> Tensor:
    """The layer in float64 from the relation's parts: scale, guide, reference operator."""
    depth = frame.depth.double()
    valid = (depth > 0) & depth.isfinite()
    used = depth if conv.levels is None else conv.levels.quantize(depth)
    scale = torch.where(valid, conv.reference_depth / used, 1.0)
    guide, tolerance = None, 0.0
    if conv.same_level_only:
        guide = conv.levels.assign(depth).double().where(valid, torch.nan)
    if conv.depth_window is not None:
        guide, tolerance = depth.where(valid, torch.nan), conv.depth_window
    return reference.surf_conv2d(
        frame.rgb.double(), conv.weight.double(), conv.bias.double(), scale=scale, guide=guide,
        guide_tolerance=tolerance, padding=1,
    )  # fmt: skip


def test_against_the_oracle_around_a_few_pixels(frame: Frame) -> None:
    conv = SurfConv2d.from_radius(3, 4, 3, padding=1, radius=frame.radius, focal_length=frame.focal)
    out = conv(frame.rgb, frame.depth).detach()
    height, width = frame.depth.shape[1:]
    scale = to_numpy(torch.where(frame.depth > 0, conv.reference_depth / frame.depth, 1.0))
    rng = np.random.default_rng(0)
    for y, x in zip(rng.integers(0, height, 12), rng.integers(0, width, 12), strict=True):
        # A padding that puts the first output's centre on this pixel: one output, no others.
        row = np.full((1, 1, 1, 1), scale[0, y, x])
        shape = geometry(3, 1, (1 - int(y), 1 - int(x)))
        one = forward(to_numpy(frame.rgb), to_numpy(conv.weight), to_numpy(conv.bias), row, shape)
        assert_matches(out[:, :, y : y + 1, x : x + 1], one)


def test_holes_are_the_ordinary_convolution(frame: Frame) -> None:
    conv = SurfConv2d.from_radius(3, 8, 3, padding=1, radius=frame.radius, focal_length=frame.focal)
    plain = nn.functional.conv2d(frame.rgb, conv.weight, conv.bias, padding=1)
    hole = (frame.depth <= 0)[:, None].expand_as(plain)
    out = conv(frame.rgb, frame.depth)
    torch.testing.assert_close(out[hole], plain[hole], rtol=1e-4, atol=1e-5)
    assert (out[~hole] - plain[~hole]).abs().mean() > 1e-3


def test_training_step(frame: Frame) -> None:
    net = [
        SurfConv2d.from_radius(3, 8, 3, 2, 1, radius=frame.radius, focal_length=frame.focal),
        SurfConv2d.from_radius(
            8, 8, 3, padding=1, radius=frame.radius, focal_length=frame.focal / 2
        ),
    ]
    optimizer = torch.optim.Adam([p for conv in net for p in conv.parameters()], 1e-2)
    target = frame.rgb.mean(1, keepdim=True)[..., ::2, ::2]
    losses = []
    for _ in range(4):
        hidden = torch.relu(net[0](frame.rgb, frame.depth))
        out = net[1](hidden, frame.depth[:, ::2, ::2])
        loss = (out.mean(1, keepdim=True) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
