"""SurfConvPyramid on odd frames and nets, and as a module among others."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from helpers import assert_same_bits
from pyramids import LEVELS, double, make_frame, make_net
from surfconv_ops import DepthLevels, SurfConvPyramid


def test_depth_gets_no_gradient_and_none_is_nan() -> None:
    image, depth = make_frame()
    image.requires_grad_()
    depth.requires_grad_()
    pyramid = SurfConvPyramid(make_net(), LEVELS[3], 4.0, same_level_only=True)
    out = pyramid(image, depth)
    out.square().sum().backward()
    assert depth.grad is None
    for tensor in (out, image.grad, *(p.grad for p in pyramid.parameters())):
        assert tensor is not None
        assert tensor.isfinite().all()
        assert tensor.abs().sum() > 0


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
def test_what_is_masked_is_not_seen(poison: float) -> None:
    """A level's output does not change with the others' pixels, be they infinite."""
    image, depth = make_frame()
    pyramid = SurfConvPyramid(make_net(), LEVELS[3], 4.0, same_level_only=True)
    own = (LEVELS[3].assign(depth) == 1)[:, None]
    poisoned = torch.where(own, image, poison)
    with torch.no_grad():
        expected, actual = pyramid(image, depth), pyramid(poisoned, depth)
    assert own.sum() > 20
    mask = own.expand_as(actual)
    assert actual[mask].isfinite().all()
    assert torch.equal(actual[mask], expected[mask])


@pytest.mark.parametrize(
    ("reference", "center", "step"),
    [(1.0, 2.0, 1), (2.0, 1.0, 2), (3.0, 2.0, 3), (0.7, 0.3, 7), (0.1, 0.3, 1)],
)
def test_infinities_stay_where_they_are(reference: float, center: float, step: int) -> None:
    """A pixel that is read alone passes as it is, and a neighbour of no weight is not seen.

    0.1 / 0.3 is above 1/3 in float64: pixels meet in spite of it.
    """
    pyramid = SurfConvPyramid(nn.Identity(), DepthLevels([], [center]), reference)
    image = torch.full((1, 1, 15, 15), -math.inf)
    depth = torch.ones(1, 15, 15)
    assert (pyramid(image, depth) == -math.inf).all()
    image = torch.zeros(1, 1, 15, 15)
    image[..., 8, 8] = math.nan
    met = pyramid(image, depth)[0, 0, ::step, ::step]
    alone = torch.zeros_like(met, dtype=torch.bool)
    if 8 % step == 0:
        alone[8 // step, 8 // step] = True
    assert torch.equal(met.isnan(), alone)


def test_levels_that_do_not_occur_are_not_run() -> None:
    sizes: list[tuple[int, ...]] = []

    class Net(nn.Module):
        def forward(self, frame: Tensor) -> Tensor:
            sizes.append(tuple(frame.shape[2:]))
            return frame

    pyramid = SurfConvPyramid(Net(), LEVELS[2], 4.0, invalid_scale=0.5)
    image = torch.randn(2, 1, 9, 9)
    far, near = torch.full((2, 9, 9), 8.0), torch.full((2, 9, 9), 1.0)
    pyramid(image, near)
    pyramid(image, far)
    pyramid(image, torch.zeros(2, 9, 9))
    pyramid(image, torch.stack((near[0], far[0])))
    assert sizes == [(5, 5), (17, 17), (17, 17), (5, 5), (17, 17)]


def test_a_batch_is_its_images() -> None:
    image, depth = make_frame(3)
    depth[1] = 1.0
    pyramid = SurfConvPyramid(make_net(), LEVELS[4], 4.0)
    with torch.no_grad():
        batch = pyramid(image, depth)
        for n in range(3):
            torch.testing.assert_close(batch[n], pyramid(image[n], depth[n]))
            torch.testing.assert_close(batch[n], pyramid(image[n], depth[n : n + 1]))
        assert_same_bits(pyramid(image, depth.unsqueeze(1)), batch)


def test_depth_at_the_reference_is_the_net_itself() -> None:
    net = make_net(dtype=torch.float32)
    image, depth = torch.randn(2, 2, 9, 12), torch.full((2, 9, 12), 3.9)
    depth[:, :, ::3] = math.nan
    for antialias in (False, True):
        pyramid = SurfConvPyramid(net, LEVELS[1], 4.0, antialias=antialias)
        assert_same_bits(pyramid(image, depth), net(image))


def test_a_pair_of_reference_depths_is_y_x() -> None:
    image, depth = torch.randn(1, 1, 9, 13, dtype=double), torch.ones(1, 9, 13)
    pyramid = SurfConvPyramid(nn.Identity(), DepthLevels([], [1.0]), (1.0, 2.0))
    assert pyramid.scales == ((1.0, 2.0), 1.0)
    out = pyramid(image, depth)
    torch.testing.assert_close(out[..., ::2], image[..., ::2])
    torch.testing.assert_close(out[..., 1::2], (image[..., :-2:2] + image[..., 2::2]) / 2)


@pytest.mark.parametrize("shape", [(0, 2, 6, 7), (2, 6, 7)])
def test_empty_and_unbatched(shape: tuple[int, ...]) -> None:
    image = torch.randn(shape)
    pyramid = SurfConvPyramid(make_net(dtype=torch.float32), LEVELS[3], 4.0)
    out = pyramid(image, torch.rand(*shape[:-3], 6, 7) * 9)
    assert out.shape == (*shape[:-3], 3, 6, 7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_dtypes_round_once(dtype: torch.dtype) -> None:
    """Resampling in a half type is float32's, rounded."""
    image, depth = make_frame(1, 20, 40)
    image = image.to(dtype)
    pyramid = SurfConvPyramid(nn.Identity(), LEVELS[1], 1.3 * 4)
    seen: list[Tensor] = []
    pyramid.net.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
    out = pyramid(image, depth.float().abs())
    assert out.dtype == dtype
    exact = pyramid(image.double(), depth.abs())
    assert seen[0].dtype == dtype
    error = (seen[0].double() - seen[-2].double()).abs().max()
    assert error <= torch.finfo(dtype).eps * image.abs().max()
    assert (out.double() - exact).abs().max() <= 2 * torch.finfo(dtype).eps * image.abs().max()


def test_positions_are_exact_in_wide_frames() -> None:
    """float32 images are read at float64 positions, however far out."""
    image = torch.randn(1, 1, 1, 5001)
    pyramid = SurfConvPyramid(nn.Identity(), DepthLevels([], [1.0]), 2.5)
    out = pyramid(image, torch.ones(1, 1, 5001))
    torch.testing.assert_close(out[..., ::5], image[..., ::5], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_the_net_sees_the_inputs_memory_format(layout: torch.memory_format) -> None:
    seen: list[bool] = []

    class Net(nn.Conv2d):
        def forward(self, frame: Tensor) -> Tensor:
            seen.append(frame.is_contiguous(memory_format=layout))
            return super().forward(frame)

    net = Net(3, 5, 3, padding=1).to(memory_format=layout)
    pyramid = SurfConvPyramid(net, LEVELS[4], 4.0)
    image = torch.randn(2, 3, 9, 11).contiguous(memory_format=layout).requires_grad_()
    out = pyramid(image, torch.rand(2, 9, 11) * 9)
    assert seen == [True] * 4
    assert out.is_contiguous(memory_format=layout)
    strided = torch.randn(2, 3, 11, 9).transpose(2, 3)
    depth = torch.rand(2, 9, 11) * 9
    assert_same_bits(
        pyramid(strided, depth), pyramid(strided.contiguous(memory_format=layout), depth)
    )


def test_autocast() -> None:
    image, depth = torch.randn(1, 2, 9, 9), torch.rand(1, 9, 9) * 9
    pyramid = SurfConvPyramid(make_net(dtype=torch.float32), LEVELS[3], 4.0)
    exact = pyramid(image, depth)
    with torch.autocast("cpu", torch.bfloat16):
        out = pyramid(image, depth)
    assert out.dtype == torch.bfloat16
    assert ((out - exact).square().mean() / exact.square().mean()).sqrt() < 0.02


def test_depth_is_float32_unless_the_input_is_float64() -> None:
    """As in SurfConv2d: a depth just above an edge falls on it as float32."""
    levels = DepthLevels([2.0], [1.0, 4.0])
    pyramid = SurfConvPyramid(nn.Identity(), levels, 1.0)
    depth = torch.full((1, 4, 5), 2.0 + 1e-12, dtype=double)
    image = torch.randn(1, 1, 4, 5, dtype=double)
    far = SurfConvPyramid(nn.Identity(), DepthLevels([], [4.0]), 1.0)
    torch.testing.assert_close(pyramid(image, depth), far(image, depth))
    assert_same_bits(pyramid(image.float(), depth), image.float())


def test_batch_norm_sees_every_frame() -> None:
    """Running statistics are updated once per level that occurs."""
    net = nn.BatchNorm2d(1)
    pyramid = SurfConvPyramid(net, LEVELS[2], 4.0)
    pyramid(torch.randn(1, 1, 8, 8), torch.rand(1, 8, 8) * 4 + 1)
    assert int(net.num_batches_tracked) == 2


def test_state_pickle_and_copies() -> None:
    pyramid = SurfConvPyramid(make_net(), LEVELS[3], 4.0, antialias=True)
    assert list(pyramid.state_dict()) == [f"net.{key}" for key in pyramid.net.state_dict()]
    image, depth = make_frame()
    expected = pyramid(image, depth)
    for again in (pickle.loads(pickle.dumps(pyramid)), copy.deepcopy(pyramid)):
        assert_same_bits(again(image, depth), expected)
    other = SurfConvPyramid(make_net(), LEVELS[3], 5.0, antialias=True)
    with pytest.warns(UserWarning, match="reference_depth=4.0"):
        other.load_state_dict(pyramid.state_dict())
    text = repr(pyramid)
    assert text.startswith("SurfConvPyramid(\n  reference_depth=4.0, levels=3, antialias=True")


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        ((3, LEVELS[1], 1.0), {}, TypeError, "net: expected a module, got int"),
        ((nn.Identity(), None, 1.0), {}, TypeError, "levels: .*NoneType"),
        ((nn.Identity(), LEVELS[1], 0.0), {}, ValueError, "reference_depth: .*0.0"),
        ((nn.Identity(), LEVELS[1], math.inf), {}, ValueError, "reference_depth: .*inf"),
        ((nn.Identity(), LEVELS[1], 1.0), {"invalid_scale": 0.0}, ValueError, "invalid_scale"),
        ((nn.Identity(), LEVELS[1], 1.0), {"invalid_scale": -1}, ValueError, "invalid_scale"),
        ((nn.Identity(), LEVELS[1], 1.0), {"invalid_scale": math.inf}, ValueError, "invalid_scale"),
        ((nn.Identity(), LEVELS[1], 1.0), {"invalid_scale": "1"}, TypeError, "invalid_scale"),
    ],
)
def test_wrong_arguments(
    arguments: Any, options: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        SurfConvPyramid(*arguments, **options)


@pytest.mark.parametrize(
    ("net", "error", "message"),
    [
        (nn.Conv2d(2, 3, 3, stride=2, padding=1), ValueError, r"\(1, O, 6, 8\) .*got \(1, 3, 3, 4"),
        (nn.Flatten(), ValueError, r"net: .*got \(1, 96\)"),
        (lambda frame: {"out": frame}, TypeError, "net: .*got dict"),
    ],
)
def test_a_net_that_gives_something_else(net: Any, error: type[Exception], message: str) -> None:
    pyramid = SurfConvPyramid(net, LEVELS[1], 4.0)
    with pytest.raises(error, match=message):
        pyramid(torch.randn(1, 2, 6, 8), torch.ones(1, 6, 8))


@pytest.mark.parametrize(
    ("depth", "error", "message"),
    [
        (None, ValueError, "depth: SurfConvPyramid needs the depth"),
        (torch.ones(1, 6, 7), ValueError, "depth: expected"),
        (torch.ones(1, 6, 8, dtype=torch.int32), TypeError, "depth: .*metres"),
    ],
)
def test_wrong_depth(depth: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        SurfConvPyramid(nn.Identity(), LEVELS[1], 4.0)(torch.randn(1, 2, 6, 8), depth)
