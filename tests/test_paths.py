"""Every specialised path of the kernels: pixels inside, on the grid and at the border; channels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from helpers import Problem, assert_same_bits, make_problem
from surfconv_ops import surf_conv2d

pytestmark = pytest.mark.core

SIZE = (9, 23)  # tiles of 48 pixels that start and end within rows
PLACES = ("inside", "grid", "holes", "far")


def lay_scale(problem: Problem, place: str) -> Problem:
    """A scale that puts the taps where a path of its own handles them."""
    scale = problem.scale.clone()
    rows = torch.linspace(0.55, 1.45, scale.shape[-2], dtype=scale.dtype)[:, None]
    smooth = rows + 0.013 * torch.arange(scale.shape[-1], dtype=scale.dtype)
    scale[...] = smooth
    if place == "grid":
        scale[...] = 1.0
    if place == "holes":  # short runs of each kind in one tile
        scale[..., 1::5] = 1.0
        scale[..., 3::7] = 2.0
        scale[..., 4::11] = torch.nan
        scale[..., 5::13] = 0.0
    if place == "far":
        scale[..., ::3] = 4.3
    return replace(problem, scale=scale)


def check(problem: Problem) -> None:
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("channels", [1, 4, 6, 8, 12, 16, 32, 64, 72])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_channels(place: str, channels: int, layout: str) -> None:
    check(lay_scale(make_problem(1, channels, 5, SIZE, layout=layout), place))


@pytest.mark.parametrize("out_channels", [1, 4, 7, 8, 12, 16, 20, 24, 40, 64])
@pytest.mark.parametrize("channels", [3, 8])
def test_outputs(out_channels: int, channels: int) -> None:
    problem = make_problem(1, channels, out_channels, SIZE, layout="channels_last")
    check(lay_scale(problem, "holes"))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kernel", [1, (1, 3), (3, 1), (2, 3), (3, 4), 5, (7, 3), (1, 70)])
def test_kernels(place: str, kernel: int | tuple[int, int]) -> None:
    padding = (0, 33) if kernel == (1, 70) else 1
    check(lay_scale(make_problem(1, 4, 5, SIZE, kernel, padding=padding), place))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kernel", [3, 7, (4, 3), 9])
@pytest.mark.parametrize(
    ("channels", "out_channels"), [(1, 1), (3, 4), (4, 4), (5, 1), (6, 4), (7, 8), (8, 3), (8, 8)]
)
def test_few_channels(
    place: str, kernel: int | tuple[int, int], channels: int, out_channels: int
) -> None:
    """Up to eight of both, without a gathered matrix where all taps are taken at a time."""
    problem = make_problem(
        2, channels, out_channels, SIZE, kernel, padding=2, layout="channels_last"
    )
    check(lay_scale(problem, place))


@pytest.mark.parametrize("channels", [44, 64])
@pytest.mark.parametrize("out_channels", [5, 16, 33])
def test_blocks_of_taps(channels: int, out_channels: int) -> None:
    """More taps than are gathered at a time, in blocks that leave part of a product's rows."""
    check(lay_scale(make_problem(1, channels, out_channels, (7, 8), 5, padding=2), "holes"))


@pytest.mark.parametrize("size", [(7, 7), (2, 60), (17, 3), (1, 1)])
@pytest.mark.parametrize("kernel", [3, (5, 3), (4, 3), (1, 5)])
@pytest.mark.parametrize(("channels", "out_channels"), [(12, 3), (16, 16), (72, 20)])
@pytest.mark.parametrize("guide", ["none", "depth"])
def test_rows_of_taps_outside(
    size: tuple[int, int],
    kernel: int | tuple[int, int],
    channels: int,
    out_channels: int,
    guide: str,
) -> None:
    """Blocks of pixels of which no tap of some rows sees anything, or none at all."""
    problem = make_problem(
        2, channels, out_channels, size, kernel, padding=2, guide=guide, guide_tolerance=1.0
    )
    scale = torch.linspace(1.3, 4.4, problem.scale.shape[-2])[:, None]
    check(replace(problem, scale=scale.expand(problem.scale.shape).contiguous()))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("per_group", [(1, 1), (1, 3), (2, 2), (3, 4), (4, 1), (4, 4), (5, 2)])
@pytest.mark.parametrize("groups", [2, 9, 32])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_groups(place: str, per_group: tuple[int, int], groups: int, layout: str) -> None:
    channels, out_channels = groups * per_group[0], groups * per_group[1]
    problem = make_problem(1, channels, out_channels, (5, 12), groups=groups, layout=layout)
    check(lay_scale(problem, place))


@pytest.mark.parametrize("channels", [8, 24, 36, 96, 160])
@pytest.mark.parametrize("kernel", [3, 5, 7])
def test_depthwise(channels: int, kernel: int) -> None:
    problem = make_problem(
        1, channels, channels, (11, 17), kernel, padding=2, groups=channels, layout="channels_last"
    )
    check(lay_scale(problem, "holes"))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("channels", [5, 8, 28, 60, 100])
@pytest.mark.parametrize("kernel", [(7, 3), (2, 4)])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_depthwise_forward(place: str, channels: int, kernel: tuple[int, int], layout: str) -> None:
    """Vectors of every width; taps of which one side, both or neither lie in the image."""
    problem = make_problem(
        1, channels, channels, (13, 19), kernel, padding=3, groups=channels, layout=layout
    )
    lay_scale(problem, place).check_forward(surf_conv2d)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("guide", ["levels", "depth", "holes"])
def test_depthwise_guides(place: str, guide: str) -> None:
    """Pixels that a guide leaves alone are done apart from those where it hides corners."""
    problem = make_problem(
        1,
        24,
        24,
        (13, 19),
        5,
        padding=2,
        groups=24,
        guide=guide,
        guide_tolerance=1.0,
        layout="channels_last",
    )
    lay_scale(problem, place).check_forward(surf_conv2d)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("channels", [12, 64])
def test_depthwise_dtypes(dtype: torch.dtype, place: str, channels: int) -> None:
    problem = make_problem(
        1,
        channels,
        channels,
        (9, 13),
        3,
        padding=1,
        groups=channels,
        dtype=dtype,
        layout="channels_last",
    )
    lay_scale(problem, place).check_forward(surf_conv2d)


@pytest.mark.parametrize("guide", ["levels", "depth", "holes"])
@pytest.mark.parametrize("channels", [4, 6, 16, 20])
@pytest.mark.parametrize("out_channels", [3, 6])
def test_guides(guide: str, channels: int, out_channels: int) -> None:
    problem = make_problem(1, channels, out_channels, SIZE, guide=guide, guide_tolerance=1.0)
    check(lay_scale(problem, "holes"))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("wanted", [("input",), ("weight",), ("input", "weight"), ("scale",)])
@pytest.mark.parametrize("groups", [1, 4])
def test_some_gradients(place: str, wanted: tuple[str, ...], groups: int) -> None:
    """A gradient asked for with fewer others is the same up to rounding."""
    problem = lay_scale(make_problem(1, 8, 8, SIZE, groups=groups, layout="channels_last"), place)
    grad = torch.randn(problem.output_shape())
    everything = problem.gradients(surf_conv2d, grad)
    leaves = {name: getattr(problem, name).detach().requires_grad_() for name in wanted}
    output = replace(problem, **leaves).run(surf_conv2d)
    for name, value in zip(
        wanted, torch.autograd.grad(output, list(leaves.values()), grad), strict=True
    ):
        torch.testing.assert_close(value, everything[name], rtol=2e-5, atol=2e-5, msg=name)


@pytest.mark.parametrize("place", ["inside", "grid", "holes"])
@pytest.mark.parametrize("channels", [4, 8, 16, 20])
@pytest.mark.parametrize("depthwise", [False, True])
def test_values_beyond_the_footprint_are_never_read(
    place: str, channels: int, depthwise: bool
) -> None:
    """Inf and NaN in the input show where conv2d shows them at scale 1, and nowhere else inside."""
    outputs, groups = (channels, channels) if depthwise else (3, 1)
    problem = make_problem(1, channels, outputs, SIZE, groups=groups, layout="channels_last")
    problem = lay_scale(problem, place)
    clean = problem.run(surf_conv2d)
    poisoned = problem.input.clone()
    poisoned[..., 4, 11] = torch.inf
    output = replace(problem, input=poisoned).run(surf_conv2d)
    if place == "grid":
        plain = torch.nn.functional.conv2d(
            poisoned, problem.weight, problem.bias, padding=1, groups=groups
        )
        assert torch.equal(output.isfinite(), plain.isfinite())
    touched = ~output.isfinite().all(1)
    assert touched.any() and touched[0, 4, 11]
    assert_same_bits(output[:, :, ~touched[0]], clean[:, :, ~touched[0]])
    reach = 4  # scale at most 2.0, a tap's far corner one more
    assert not touched[:, : 4 - reach + 1].any()
    assert not touched[..., : 11 - reach].any() and not touched[..., 11 + reach + 1 :].any()


@pytest.mark.parametrize("groups", [1, 8])
def test_centres_outside_the_image_see_none_of_it(groups: int) -> None:
    """A tap of zero offset lies where its centre does: beyond a border of Inf it reads nothing."""
    problem = make_problem(1, 8, 8, SIZE, padding=3, groups=groups, layout="channels_last")
    problem.input[..., 0, :] = torch.inf
    problem.input[..., :, 0] = torch.inf
    problem.scale[...] = 1.0
    plain = torch.nn.functional.conv2d(
        problem.input, problem.weight, problem.bias, padding=3, groups=groups
    )
    assert torch.equal(problem.run(surf_conv2d).isfinite(), plain.isfinite())
    problem.scale[...] = torch.nan  # taps of non-zero offset contribute nothing
    alone = torch.nn.functional.conv2d(
        problem.input, problem.weight[..., 1:2, 1:2], problem.bias, padding=2, groups=groups
    )
    assert torch.equal(problem.run(surf_conv2d).isfinite(), alone.isfinite())


@pytest.mark.parametrize("channels", [4, 16, 20])
@pytest.mark.parametrize("seen", [1.0, 1.5])
def test_places_of_zero_weight_count_for_the_slope_alone(channels: int, seen: float) -> None:
    """On the grid along y, a tap's second row has no weight: what it holds and gets is nobody's."""
    problem = make_problem(
        1, channels, 3, (9, 11), stride=(4, 1), padding=1, axes=2, layout="channels_last"
    )
    problem.scale[:, 0], problem.scale[:, 1] = 1.0, seen
    beyond = [2, 6]  # rows next to those that the taps of output rows 0, 4 and 8 lie on
    values = {name: getattr(problem, name).clone() for name in ("input", "weight", "scale")}
    values["input"][:, :, beyond] = torch.inf
    leaves = {name: value.requires_grad_() for name, value in values.items()}
    output = replace(problem, **leaves).run(surf_conv2d)
    assert output.isfinite().all()
    grad = torch.ones_like(output)
    grads = dict(zip(leaves, torch.autograd.grad(output, list(leaves.values()), grad), strict=True))
    assert grads["weight"].isfinite().all()
    assert not grads["scale"][:, 0].isfinite().all()

    values["input"].data[:, :, beyond] = 0.0
    output = replace(problem, **leaves).run(surf_conv2d)
    grad[...] = torch.inf
    grads = dict(zip(leaves, torch.autograd.grad(output, list(leaves.values()), grad), strict=True))
    assert grads["input"][:, :, beyond].eq(0).all() and not grads["input"].isfinite().all()
