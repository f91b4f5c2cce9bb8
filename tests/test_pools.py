"""Values and gradients of the pools against the oracle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from helpers import DTYPES, GUIDES, LAYOUTS, SCALES, assert_same_bits
from operators import name_of
from pools import CASES, make
from surfconv_ops import surf_avg_pool2d, surf_max_pool2d

MODES = ("max", "avg")
# Patterns whose samples lie on pixels, or within rounding of one: there slopes have two sides.
ON_PIXELS = ("ones", "integers", "zero", "mixed", "tiny", "smooth")
pytestmark = pytest.mark.core
each_mode = pytest.mark.parametrize("mode", MODES)
both_counts = pytest.mark.parametrize("count_include_pad", [True, False])


@pytest.mark.parametrize("case", CASES, ids=name_of)
@pytest.mark.parametrize("axes", [1, 2])
def test_geometry(case: dict[str, Any], axes: int) -> None:
    problem = make(**case, axes=axes)
    problem.check_forward()
    problem.check_gradients()


@pytest.mark.parametrize("case", CASES, ids=name_of)
@pytest.mark.parametrize("scale", SCALES)
def test_scale(case: dict[str, Any], scale: str) -> None:
    problem = make(**case, scale=scale, batch=1, axes=2)
    problem.check_forward()
    problem.check_gradients(scale=scale not in ON_PIXELS)


@each_mode
@both_counts
@pytest.mark.parametrize("kernel", [2, 3, (2, 3)])
@pytest.mark.parametrize("guide", GUIDES[1:])
@pytest.mark.parametrize("tolerance", [0.0, 0.8])
def test_guide(
    mode: str, count_include_pad: bool, kernel: Any, guide: str, tolerance: float
) -> None:
    others = {} if mode == "max" else {"count_include_pad": count_include_pad}
    problem = make(mode, kernel=kernel, stride=1, guide=guide, guide_tolerance=tolerance,
                   axes=1 if kernel == 3 else 2, dtype=torch.float64, **others)  # fmt: skip
    problem.check_forward()
    problem.check_gradients()
    blind = replace(problem, guide=None)
    assert guide == "nan" or not torch.equal(problem.run(), blind.run())


@each_mode
@pytest.mark.parametrize("channels", [1, 3, 4, 5, 8, 17, 36, 70])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_channels(mode: str, channels: int, layout: str) -> None:
    problem = make(mode, 1, channels, (5, 6), layout=layout, axes=2)
    problem.check_forward()
    problem.check_gradients()


@each_mode
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("channels", [5, 16])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_dtype_and_layout(mode: str, dtype: torch.dtype, channels: int, layout: str) -> None:
    problem = make(mode, channels=channels, dtype=dtype, layout=layout)
    problem.check_forward()
    half = dtype in (torch.bfloat16, torch.float16)
    if not (half and layout == "expanded"):
        problem.check_gradients()
    last = layout == "channels_last"
    out = problem.run()
    wanted = torch.channels_last if last else torch.contiguous_format
    assert out.is_contiguous(memory_format=wanted)
    grads = problem.gradients(torch.ones_like(out))
    assert grads["input"].is_contiguous(memory_format=wanted) and grads["scale"].is_contiguous()


@each_mode
def test_scale_in_half_types(mode: str) -> None:
    for dtype in (torch.bfloat16, torch.float16):
        problem = make(mode, dtype=dtype, scale_dtype=dtype, guide="levels")
        problem.check_forward()
        assert problem.gradients(problem.run())["scale"].dtype == dtype


@each_mode
@pytest.mark.parametrize("kernel", [17, (16, 16), (1, 300)])
def test_more_taps_than_eight_bits_number(mode: str, kernel: Any) -> None:
    problem = make(mode, 1, 2, (20, 300), kernel=kernel, stride=(3, 40), padding=0, axes=2,
                   dtype=torch.float64)  # fmt: skip
    problem.check_forward()
    problem.check_gradients()


@pytest.mark.parametrize("kernel", [(5, 51), (16, 16)])
def test_numbers_of_winners(kernel: tuple[int, int]) -> None:
    """255 taps and the number that means none fit 8 bits."""
    x = torch.arange(51.0 * 16).reshape(1, 1, 16, 51)
    scale = torch.ones(1, 1, 16 - kernel[0] + 1, 51 - kernel[1] + 1)
    _, winner = torch.ops.surfconv.surf_max_pool2d(x, scale, None, 0.0, kernel, [1, 1], [0, 0],
                                                   [1, 1])  # fmt: skip
    taps = kernel[0] * kernel[1]
    assert winner.dtype == (torch.uint8 if taps <= 255 else torch.int32)
    assert winner.eq(taps - 1).all()


def test_a_window_without_a_tap_is_zero() -> None:
    """nn gives -inf where a dilated window steps over the whole image."""
    x = torch.randn(1, 2, 1, 1, requires_grad=True)
    scale = torch.ones(1, 1, 1, requires_grad=True)
    out = surf_max_pool2d(x, 2, 1, 1, 2, scale=scale)
    assert out.eq(0).all()
    assert not any(g.any() for g in torch.autograd.grad(out.sum(), (x, scale)))
    clamped = surf_max_pool2d(x, 2, 1, 1, 2, scale=scale * 1.5)
    assert_same_bits(clamped, x)


def test_maximum_of_dilated_taps_at_scale_one_only_leaves_out() -> None:
    """Beside scale 1 the outer taps are clamped; at it they are not there."""
    x = torch.tensor([[[[9.0, 0.0, 1.0, 2.0, 3.0]]]])
    scale = torch.ones(1, 1, 3)
    out = [surf_max_pool2d(x, (1, 3), (1, 1), (0, 1), (1, 2), scale=s)[0, 0, 0, 0]
           for s in (scale, scale * 1.001)]  # fmt: skip
    assert out[0] == 2.0 and out[1] == 9.0


@pytest.mark.parametrize(("mode", "options"), [("max", {}), ("avg", {}),
                                               ("avg", {"count_include_pad": False})])  # fmt: skip
@pytest.mark.parametrize("kernel", [3, 2])
@pytest.mark.parametrize("axes", [1, 2])
def test_gradient_of_the_scale_on_pixels_is_one_sided(
    mode: str, options: dict[str, Any], kernel: int, axes: int
) -> None:
    for scale in ("ones", "integers"):
        problem = make(mode, 1, 1, dtype=torch.float64, scale=scale, axes=axes, stride=1,
                       kernel=kernel, **options)  # fmt: skip
        if mode == "max":
            # At 0 and right beside 1 the winner changes with the scale.
            problem.scale += 2
        grad = torch.rand(problem.run().shape, dtype=torch.float64)
        problem.check_gradients()
        step = torch.full_like(problem.scale, 1e-7)
        ahead = replace(problem, scale=problem.scale + step)
        change = ((ahead.run() - problem.run()) * grad).sum(1) / 1e-7
        both = problem.gradients(grad)["scale"].sum(1)
        torch.testing.assert_close(change, both, rtol=1e-4, atol=1e-5)


def test_the_first_of_equal_taps_wins() -> None:
    x = torch.ones(1, 1, 4, 4, requires_grad=True)
    out = surf_max_pool2d(x, 2, scale=torch.ones(1, 2, 2))
    (grad,) = torch.autograd.grad(out.sum(), x)
    assert grad[0, 0, ::2, ::2].eq(1).all() and grad.sum() == 4


@pytest.mark.parametrize("channels", [1, 8])
@pytest.mark.parametrize("scale", [1.0, 0.7])
def test_nan_wins(channels: int, scale: float) -> None:
    problem = make("max", 1, channels, (6, 6), stride=1, scale="ones")
    problem.scale.fill_(scale)
    problem.input[0, :, 2, 3] = float("nan")
    out, expected = problem.run(), torch.from_numpy(problem.expected())
    assert torch.equal(out.isnan(), expected.isnan()) and out.isnan().any()
    if scale == 1.0:
        x = problem.input.requires_grad_()
        ours, theirs = (torch.autograd.grad(call().sum(), x)[0]
                        for call in (problem.run, problem.run_nn))  # fmt: skip
        assert_same_bits(ours, theirs)


def test_all_minus_infinity_is_a_maximum() -> None:
    problem = make("max", 1, 5, (6, 6), stride=1, scale="ones")
    x = problem.input.fill_(-float("inf")).requires_grad_()
    assert_same_bits(problem.run(), problem.run_nn())
    ours, theirs = (torch.autograd.grad(call().sum(), x)[0]
                    for call in (problem.run, problem.run_nn))  # fmt: skip
    assert_same_bits(ours, theirs)


@each_mode
def test_hidden_pixels_count_as_zero(mode: str) -> None:
    """One by one, as those outside the image do in an average, whose divisor they are a part of."""
    x = torch.tensor([-1.0, -2.0, -4.0, -8.0]).view(1, 1, 1, 4)
    guide = torch.tensor([[[1.0, 1.0, 5.0, 1.0]]])
    if mode == "max":
        out = surf_max_pool2d(x, (1, 3), 1, (0, 1), scale=torch.full((1, 1, 4), 0.75), guide=guide)
        # Samples at 0, 0, 0.75; 0.25, 1, 1.75; 1.25, 2, 2.75; 2.25, 3, 3.
        torch.testing.assert_close(out.flatten(), torch.tensor([-1.0, -0.5, -1.0, -2.0]))
    for counts in (True, False) if mode == "avg" else ():
        out = surf_avg_pool2d(x, (1, 3), 1, (0, 1), count_include_pad=counts,
                              scale=torch.ones(1, 1, 4), guide=guide)  # fmt: skip
        first, last = (3.0, 3.0) if counts else (2.0, 2.0)
        expected = torch.tensor([-3 / first, -3 / 3, -4 / 3, -8 / last])
        torch.testing.assert_close(out.flatten(), expected)


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_a_guide_that_hides_every_tap_leaves_zeros(layout: str) -> None:
    problem = make("max", kernel=2, stride=1, padding=0, guide="depth", layout=layout, channels=4,
                   dtype=torch.float64)  # fmt: skip
    # Taps of a kernel of 2 then lie further from the centre than its own pixel.
    problem.scale += 3.1
    problem.check_forward()
    problem.check_gradients()
    out = problem.run()
    # Clamped into the first row and column, a tap meets the first window's own pixel.
    assert out[..., 1:, :].eq(0).all() and out[..., 0, 0].ne(0).any()
    gradient = problem.gradients(torch.ones_like(out))["input"]
    assert gradient[..., 1:, :].eq(0).all()
    assert replace(problem, mode="avg").run().eq(0).all()


@each_mode
def test_unbatched_and_shapes_of_scale(mode: str) -> None:
    problem = make(mode, guide="levels")
    out = problem.run()
    assert_same_bits(replace(problem, scale=problem.scale[:, 0]).run(), out)
    both = replace(problem, scale=problem.scale.expand(-1, 2, -1, -1)).run()
    assert_same_bits(both, out)
    assert problem.guide is not None
    one = replace(problem, input=problem.input[0], scale=problem.scale[0], guide=problem.guide[0])
    assert_same_bits(one.run(), out[0])
    assert_same_bits(replace(one, scale=one.scale[0]).run(), out[0])


@each_mode
def test_empty_batch(mode: str) -> None:
    problem = make(mode, guide="levels")
    assert problem.guide is not None
    empty = replace(problem, input=problem.input[:0], scale=problem.scale[:0],
                    guide=problem.guide[:0])  # fmt: skip
    out = empty.run()
    assert out.shape == (0, *problem.run().shape[1:])
    for name, value in empty.gradients(out).items():
        assert value.shape == getattr(empty, name).shape


@each_mode
def test_arguments_are_those_of_the_functions_of_nn(mode: str) -> None:
    x, scale = torch.randn(1, 2, 6, 6), torch.ones(1, 3, 3)
    if mode == "max":
        ours = surf_max_pool2d(x, 2, 2, 1, 3, True, scale=torch.ones(1, 4, 4)[:, :3, :3])
        theirs = torch.nn.functional.max_pool2d(x, 2, 2, 1, 3, True)
    else:
        ours = surf_avg_pool2d(x, 2, None, 0, True, False, 3, scale=scale)
        theirs = torch.nn.functional.avg_pool2d(x, 2, None, 0, True, False, 3)
    torch.testing.assert_close(ours, theirs)
