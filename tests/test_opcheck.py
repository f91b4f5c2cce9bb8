"""torch.library.opcheck on both operators: schema, autograd registration, fake and compiled."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import surfconv_ops
from helpers import make_problem
from operators import name_of

CASES: list[dict[str, Any]] = [
    {},
    {"axes": 2, "stride": (2, 1), "guide": "depth", "guide_tolerance": 0.5},
    {"groups": 3, "out_channels": 6, "bias": False, "layout": "channels_last"},
    {"dtype": torch.bfloat16, "scale_dtype": torch.float32},
    {"dtype": torch.float64, "kernel": (2, 3)},
]


def forward_arguments(requires_grad: bool, **case: Any) -> tuple[Any, ...]:
    p = make_problem(size=(5, 6), **case)
    tensors: list[Tensor | None] = [p.input, p.weight, p.bias, p.scale]
    leaves = [t if t is None else t.requires_grad_(requires_grad) for t in tensors]
    lists = [
        list(pair) for pair in (p.geometry.stride, p.geometry.padding[:2], p.geometry.dilation)
    ]
    return (*leaves, p.guide, p.guide_tolerance, *lists, p.groups)


@pytest.mark.parametrize("case", CASES, ids=name_of)
@pytest.mark.parametrize("requires_grad", [False, True])
def test_forward(case: dict[str, Any], requires_grad: bool) -> None:
    arguments = forward_arguments(requires_grad, **case)
    torch.library.opcheck(torch.ops.surfconv.surf_conv2d.default, arguments)


def backward_arguments(
    requires_grad: bool, needs: tuple[bool, ...], **case: Any
) -> tuple[Any, ...]:
    x, weight, _, scale, *rest = forward_arguments(requires_grad, **case)
    grad = torch.randn(x.shape[0], weight.shape[0], *scale.shape[2:]).to(x.dtype)
    return (grad.requires_grad_(requires_grad), x, weight, scale, *rest, *needs)


@pytest.mark.parametrize("case", CASES, ids=name_of)
@pytest.mark.parametrize(
    "needs", [(True,) * 4, (False, True, False, False), (True, False, False, True)]
)
def test_backward(case: dict[str, Any], needs: tuple[bool, ...]) -> None:
    arguments = backward_arguments(False, needs, **case)
    torch.library.opcheck(torch.ops.surfconv.surf_conv2d_backward.default, arguments)


# Tracing the derivative of every tap with symbolic sizes is slow: a kernel of two taps has it all.
@pytest.mark.parametrize(
    ("needs", "case"),
    [((True,) * 4, {"axes": 2}), ((False, True, False, True), {"guide": "depth"})],
)
def test_double_backward(needs: tuple[bool, ...], case: dict[str, Any]) -> None:
    arguments = backward_arguments(True, needs, kernel=(1, 2), padding=0, **case)
    torch.library.opcheck(torch.ops.surfconv.surf_conv2d_backward.default, arguments)


def test_gradients_not_needed_are_empty() -> None:
    x, weight, _, scale, *rest = forward_arguments(False)
    grad = torch.randn(x.shape[0], weight.shape[0], *scale.shape[2:])
    for index in range(4):
        needs = [i == index for i in range(4)]
        out = torch.ops.surfconv.surf_conv2d_backward(grad, x, weight, scale, *rest, *needs)
        full = [x.shape, weight.shape, weight.shape[:1], scale.shape]
        shapes = [shape if need else (0,) for need, shape in zip(needs, full, strict=True)]
        assert [tuple(t.shape) for t in out] == [tuple(shape) for shape in shapes]


@pytest.mark.parametrize("layout", ["contiguous", "channels_last"])
def test_meta_tensors_have_the_real_strides(layout: str) -> None:
    p = make_problem(2, 5, 6, layout=layout)
    real = p.run(surfconv_ops.surf_conv2d)
    x, weight, scale = (t.to("meta") for t in (p.input, p.weight, p.scale))
    meta = surfconv_ops.surf_conv2d(x, weight, scale=scale, padding=1)
    assert meta.device.type == "meta"
    assert (meta.shape, meta.stride(), meta.dtype) == (real.shape, real.stride(), real.dtype)
