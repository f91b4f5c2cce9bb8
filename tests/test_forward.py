"""The forward pass, of the public function and of the reference, against the oracle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from helpers import DTYPES, GUIDES, SCALES, assert_matches, assert_same_bits, make_problem
from operators import GEOMETRIES, OPERATORS, name_of
from surfconv_ops import reference, surf_conv2d

pytestmark = pytest.mark.core
each_operator = pytest.mark.parametrize("operator", OPERATORS)


@each_operator
@pytest.mark.parametrize("case", GEOMETRIES, ids=name_of)
@pytest.mark.parametrize("axes", [1, 2])
def test_geometry(operator: str, case: dict[str, Any], axes: int) -> None:
    make_problem(axes=axes, **case).check_forward(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("kernel", [3, (2, 3)])
@pytest.mark.parametrize("axes", [1, 2])
def test_scale(operator: str, scale: str, kernel: Any, axes: int) -> None:
    problem = make_problem(scale=scale, kernel=kernel, axes=axes)
    problem.check_forward(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("scale_dtype", ["float32", "input's"])
@pytest.mark.parametrize("guide", ["none", "depth"])
def test_dtype(operator: str, dtype: torch.dtype, scale_dtype: str, guide: str) -> None:
    kind = torch.float32 if scale_dtype == "float32" else dtype
    problem = make_problem(
        2, 6, 8, (9, 11), dtype=dtype, scale_dtype=kind, guide=guide, guide_tolerance=0.8
    )
    problem.check_forward(OPERATORS[operator])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_half_types_round_once(dtype: torch.dtype, layout: str) -> None:
    """One rounding of a float32 sum leaves most results within half a unit in the last place."""
    problem = make_problem(1, 40, 24, (11, 13), dtype=dtype, layout=layout, bias=False)
    out, expected = surf_conv2d_of(problem), torch.from_numpy(problem.expected().value)
    rms = ((out.double() - expected).square().mean() / expected.square().mean()).sqrt()
    # 1/sqrt(3) of the unit roundoff bounds the RMS of one rounding; two exceed 0.6 of it.
    assert rms < 0.6 * torch.finfo(dtype).eps / 2


def surf_conv2d_of(problem: Any) -> torch.Tensor:
    return problem.run(surf_conv2d)


@each_operator
@pytest.mark.parametrize("guide", GUIDES)
@pytest.mark.parametrize("tolerance", [0.0, 0.7, float("inf")])
@pytest.mark.parametrize("case", [{}, {"kernel": (4, 3), "stride": (1, 2)}], ids=name_of)
def test_guide(operator: str, guide: str, tolerance: float, case: dict[str, Any]) -> None:
    problem = make_problem(guide=guide, guide_tolerance=tolerance, scale="smooth", **case)
    problem.check_forward(OPERATORS[operator])


@each_operator
@pytest.mark.parametrize("guide", ["levels", "holes"])
@pytest.mark.parametrize("scale", ["ones", "integers", "mixed"])
@pytest.mark.parametrize("axes", [1, 2])
def test_guide_on_pixels(operator: str, guide: str, scale: str, axes: int) -> None:
    make_problem(guide=guide, scale=scale, axes=axes).check_forward(OPERATORS[operator])


@each_operator
def test_guide_hides_some_corners_and_not_others(operator: str) -> None:
    problem = make_problem(guide="levels")
    free = replace(problem, guide=None)
    blind = replace(problem, guide=torch.arange(112.0).view(2, 7, 8))
    outs = [p.run(OPERATORS[operator]) for p in (problem, free, blind)]
    assert (outs[0] != outs[1]).any() and (outs[0] != outs[2]).any()


@each_operator
@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("guide", ["none", "levels"])
def test_unbatched(operator: str, axes: int, guide: str) -> None:
    problem = make_problem(1, axes=axes, guide=guide)
    alone = replace(
        problem,
        input=problem.input[0],
        scale=problem.scale[0],
        guide=None if problem.guide is None else problem.guide[0],
    )
    out = alone.check_forward(OPERATORS[operator])
    assert_same_bits(out[None], problem.run(OPERATORS[operator]))


@each_operator
def test_scale_without_a_channel_dimension(operator: str) -> None:
    problem = make_problem()
    flat = replace(problem, scale=problem.scale[:, 0])
    assert_same_bits(flat.check_forward(OPERATORS[operator]), problem.run(OPERATORS[operator]))
    alone = replace(flat, input=problem.input[0], scale=problem.scale[0, 0])
    assert_matches(alone.run(OPERATORS[operator]), alone.expected())


@each_operator
@pytest.mark.parametrize("channels", [1, 2])
def test_unbatched_scale_is_not_taken_for_a_batch(operator: str, channels: int) -> None:
    """(2, Ho, Wo) beside (C, H, W) is a (y, x) pair, not two images."""
    problem = make_problem(1, channels, axes=2)
    alone = replace(problem, input=problem.input[0], scale=problem.scale[0])
    assert_same_bits(alone.run(OPERATORS[operator])[None], problem.run(OPERATORS[operator]))


@each_operator
def test_without_bias(operator: str) -> None:
    make_problem(bias=False).check_forward(OPERATORS[operator])


@each_operator
def test_batches_are_independent(operator: str) -> None:
    problem = make_problem(3, guide="levels")
    out = problem.run(OPERATORS[operator])
    assert problem.guide is not None
    for n in range(3):
        one = replace(
            problem,
            input=problem.input[n : n + 1],
            scale=problem.scale[n : n + 1],
            guide=problem.guide[n : n + 1],
        )
        assert_same_bits(one.run(OPERATORS[operator])[0], out[n])


@pytest.mark.parametrize("size", [(23, 150), (150, 23), (1, 260), (260, 1)])
@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_precision_does_not_depend_on_place(size: tuple[int, int], layout: str) -> None:
    """Long images: an offset kept in float32 from the image's corner would lose bits here."""
    problem = make_problem(1, 2, 3, size, scale="random", layout=layout)
    problem.check_forward(surf_conv2d)


@each_operator
@pytest.mark.parametrize("reach", [100, 1_000, 40_000, 200_000])
@pytest.mark.parametrize("axis", [0, 1])
def test_taps_that_reach_far(operator: str, reach: int, axis: int) -> None:
    """Offsets that no 8-, 16- or 17-bit number holds still find their pixels."""
    length = 2 * reach + 40
    size, kernel, stride, padding = ((length, 1), (3, 1), (length // 7, 1), (1, 0))
    if axis == 1:
        size, kernel, stride, padding = (v[::-1] for v in (size, kernel, stride, padding))
    problem = make_problem(
        1, 2, 3, size, kernel, stride=stride, padding=padding, dtype=torch.float64
    )
    problem.scale.uniform_(-reach, reach)
    run = OPERATORS[operator]
    problem.check_forward(run)
    problem.check_gradients(run)
    # In float32 whole offsets are exact, and so the sums are as good as near taps' are.
    single = problem.to(torch.float32)
    single.scale.round_()
    single.check_forward(run)


def test_precision_far_from_the_origin() -> None:
    width = 300_000
    x = torch.zeros(1, 1, 1, width)
    x[..., -64:] = torch.randn(64)
    weight, scale = torch.randn(1, 1, 1, 3), torch.full((1, 1, 1, width), 1.37)
    out = surf_conv2d(x, weight, scale=scale, padding=(0, 1))
    near = surf_conv2d(x[..., -64:], weight, scale=scale[..., -64:], padding=(0, 1))
    assert_same_bits(out[..., -60:], near[..., -60:])


def test_reference_is_close_on_larger_maps() -> None:
    problem = make_problem(2, 20, 24, (33, 41), (3, 5), padding="same", guide="depth",
                           guide_tolerance=1.0, dtype=torch.float64)  # fmt: skip
    fast, slow = problem.run(surf_conv2d), problem.run(reference.surf_conv2d)
    torch.testing.assert_close(fast, slow, rtol=1e-12, atol=1e-12)
