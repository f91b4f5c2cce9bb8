"""Memory formats: any strides in, the contract's rule out, for the output and each gradient."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from helpers import DTYPES, GRADIENTS, LAYOUTS, Problem, lay_out, make_problem
from operators import OPERATORS
from surfconv_ops import surf_conv2d

pytestmark = pytest.mark.core


def follows_rule(result: Tensor, owner: Tensor) -> bool:
    """channels_last if the owner is so and not also contiguous; else contiguous."""
    last = owner.is_contiguous(memory_format=torch.channels_last) and not owner.is_contiguous()
    layout = torch.channels_last if last else torch.contiguous_format
    return result.stride() == torch.empty(result.shape).to(memory_format=layout).stride()


def problem_with(layout: str, **case: object) -> Problem:
    problem = make_problem(2, 4, 6, (6, 7), axes=2, **case)  # type: ignore[arg-type]
    return replace(problem, input=lay_out(problem.input, layout))


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_output(operator: str, layout: str, dtype: torch.dtype) -> None:
    problem = problem_with(layout, dtype=dtype)
    assert follows_rule(problem.run(OPERATORS[operator]), problem.input)


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_each_gradient_follows_its_own_tensor(
    operator: str, layout: str, dtype: torch.dtype
) -> None:
    for name in ("input", "weight", "scale"):
        problem = make_problem(2, 4, 6, (6, 7), axes=2, dtype=dtype)
        problem = replace(problem, **{name: lay_out(getattr(problem, name), layout)})
        grad = torch.randn(problem.output_shape()).to(dtype)
        for grad_layout in ("contiguous", "channels_last"):
            gradients = problem.gradients(OPERATORS[operator], lay_out(grad, grad_layout))
            for other in GRADIENTS:
                owner = getattr(problem, other)
                if owner.dim() == 4:
                    assert follows_rule(gradients[other], owner), (other, grad_layout)


@pytest.mark.parametrize(
    ("channels", "size"), [(1, (6, 7)), (4, (1, 1)), (1, (1, 1)), (4, (1, 7)), (4, (6, 1))]
)
def test_ambiguous_strides_stay_contiguous(channels: int, size: tuple[int, int]) -> None:
    """One channel, or one pixel, is both formats at once; then NCHW is what is handed on."""
    problem = make_problem(2, channels, 3, size)
    for layout in ("contiguous", "channels_last"):
        one = replace(problem, input=lay_out(problem.input, layout))
        out = one.run(surf_conv2d)
        assert follows_rule(out, one.input)
        grad = one.gradients(surf_conv2d, torch.randn_like(out))["input"]
        assert follows_rule(grad, one.input)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("case", ["input", "weight", "scale"])
def test_strided_arguments(layout: str, case: str) -> None:
    problem = make_problem(2, 3, 4, axes=2)
    problem = replace(problem, **{case: lay_out(getattr(problem, case), layout)})
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(
    ("channels", "outputs", "groups", "kernel"),
    [
        (70, 37, 1, 3),  # two blocks of channels, panels of every width, tails of both
        (13, 3, 1, 3),  # few outputs
        (18, 36, 2, 3),  # a block for each group
        (9, 18, 9, 3),  # two outputs of each channel
        (5, 21, 1, (9, 31)),  # rows of taps one after the other
        (1, 20, 1, 2),
    ],
)
def test_weights_of_any_layout(
    channels: int,
    outputs: int,
    groups: int,
    kernel: int | tuple[int, int],
    layout: str,
    dtype: torch.dtype,
) -> None:
    problem = make_problem(
        1, channels, outputs, (5, 6), kernel, padding=(4, 15), groups=groups, dtype=dtype
    )
    problem = replace(problem, weight=lay_out(problem.weight, layout))
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("layout", ["sliced", "transposed"])
def test_strided_bias_and_guide(layout: str) -> None:
    problem = make_problem(guide="levels")
    assert problem.bias is not None and problem.guide is not None
    bias = torch.stack([problem.bias, problem.bias], 1)[:, 0]
    guide = lay_out(problem.guide, layout)
    assert not bias.is_contiguous() and not guide.is_contiguous()
    problem = replace(problem, bias=bias, guide=guide)
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


@pytest.mark.parametrize("input_layout", ["contiguous", "channels_last"])
@pytest.mark.parametrize("grad_layout", LAYOUTS)
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_gradients_arriving_in_backward(
    input_layout: str, grad_layout: str, dtype: torch.dtype
) -> None:
    problem = make_problem(2, 3, 5, layout=input_layout, dtype=dtype)
    grad = lay_out(torch.randn(problem.output_shape()).to(dtype), grad_layout)
    problem.check_gradients(surf_conv2d, grad)


@pytest.mark.parametrize("input_layout", ["contiguous", "channels_last"])
def test_gradient_of_a_sum_has_no_strides_at_all(input_layout: str) -> None:
    problem = make_problem(2, 3, 5, layout=input_layout)
    grad = torch.ones(1, 1, 1, 1).expand(problem.output_shape())
    assert grad.stride() == (0, 0, 0, 0)
    problem.check_gradients(surf_conv2d, grad)
    leaf = problem.weight.detach().requires_grad_()
    replace(problem, weight=leaf).run(surf_conv2d).sum().backward()
    torch.testing.assert_close(leaf.grad, problem.gradients(surf_conv2d, grad)["weight"])


@pytest.mark.parametrize("batch_stride", ["expanded", "flipped", "window"])
def test_batches_that_share_or_skip_memory(batch_stride: str) -> None:
    problem = make_problem(3, 2, 4, (6, 7))
    if batch_stride == "expanded":
        image = problem.input[:1].expand(3, -1, -1, -1)
    elif batch_stride == "flipped":
        image = torch.randn(6, 2, 6, 7)[::2]
    else:
        image = torch.randn(3, 5, 9, 11)[:, 1:3, 2:8, 3:10]
    problem = replace(problem, input=image)
    problem.check_forward(surf_conv2d)
    problem.check_gradients(surf_conv2d)


def test_arguments_are_left_alone() -> None:
    problem = make_problem(guide="levels", layout="channels_last", scale="mixed")
    names = ("input", "weight", "bias", "scale", "guide")
    before = {name: getattr(problem, name).clone() for name in names}
    grad = torch.randn(problem.output_shape())
    kept = grad.clone()
    problem.gradients(surf_conv2d, grad)
    for name in names:
        assert torch.equal(getattr(problem, name).nan_to_num(7.5), before[name].nan_to_num(7.5))
    assert torch.equal(grad, kept)
