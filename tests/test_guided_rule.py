"""Which depth a layer gets at its own resolution."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import oracle_resize
from guided_nets import Probe
from helpers import assert_same_bits
from surfconv_ops import DepthGuided
from surfconv_ops.depth_resize import resize_depth

INVALID = (0.0, -1.0, float("nan"), float("inf"), -float("inf"))


def distinct_depth(shape: tuple[int, ...], holes: float, seed: int = 0) -> Tensor:
    """Every valid pixel has a depth of its own, so that a wrong choice shows."""
    rng = np.random.default_rng(seed)
    depth = 1.0 + rng.permutation(int(np.prod(shape))).reshape(shape) / 64
    bad = rng.choice(INVALID, shape)
    return torch.from_numpy(np.where(rng.random(shape) < holes, bad, depth)).float()


def through_a_layer(depth: Tensor, height: int, width: int) -> Tensor:
    out: Tensor = DepthGuided(Probe())(torch.zeros(len(depth), 1, height, width), depth=depth)
    return out


def traced(depth: Tensor, height: int, width: int) -> Tensor:
    """The form without shapes that depend on values, as under torch.func."""
    return torch.func.vmap(lambda d: resize_depth(d[None], height, width)[0])(depth)


SIZES = [
    ((8, 8), (4, 4)), ((8, 8), (2, 8)), ((7, 9), (3, 4)), ((5, 6), (10, 12)), ((7, 5), (3, 8)),
    ((9, 9), (1, 1)), ((1, 1), (3, 2)), ((2, 3), (3, 2)), ((12, 10), (5, 7)), ((6, 4), (6, 4)),
    ((5, 7), (4, 6)), ((33, 2), (2, 33)),
]  # fmt: skip


@pytest.mark.core
@pytest.mark.parametrize("call", [through_a_layer, resize_depth, traced])
@pytest.mark.parametrize(("full", "wanted"), SIZES)
@pytest.mark.parametrize("holes", [0.0, 0.3, 0.8, 1.0])
def test_rule(call: object, full: tuple[int, int], wanted: tuple[int, int], holes: float) -> None:
    depth = distinct_depth((2, *full), holes)
    expected = np.stack([oracle_resize.resize(d, *wanted) for d in depth.numpy()])
    out = call(depth, *wanted)  # type: ignore[operator]
    assert_same_bits(out, torch.from_numpy(expected))


@given(
    st.tuples(st.integers(1, 12), st.integers(1, 12)),
    st.tuples(st.integers(1, 14), st.integers(1, 14)),
    st.sampled_from([0.1, 0.5, 0.9]),
    st.integers(0, 10**6),
)
def test_rule_of_any_sizes(
    full: tuple[int, int], wanted: tuple[int, int], holes: float, seed: int
) -> None:
    depth = distinct_depth((1, *full), holes, seed)
    expected = torch.from_numpy(oracle_resize.resize(depth[0].numpy(), *wanted))
    assert_same_bits(through_a_layer(depth, *wanted)[0], expected)
    assert_same_bits(traced(depth, *wanted)[0], expected)


def test_ties_go_to_the_lower_row_then_to_the_lower_column() -> None:
    depth = torch.zeros(1, 4, 4)
    depth[0, 1, 2], depth[0, 2, 1] = 5.0, 7.0
    assert through_a_layer(depth, 1, 1).item() == 5.0
    depth[0, 0, 2], depth[0, 2, 0] = 8.0, 9.0
    assert through_a_layer(depth, 1, 1).item() == 8.0
    depth[0, 1, 1] = 3.0
    assert through_a_layer(depth, 1, 1).item() == 3.0


def test_picks_what_a_same_padded_odd_kernel_keeps() -> None:
    """A strided layer's centres are the pixels the rule picks, so depths go on being read there."""
    depth = distinct_depth((1, 12, 20), 0.0)
    assert_same_bits(through_a_layer(depth, 6, 10), depth[:, ::2, ::2])
    assert_same_bits(through_a_layer(depth, 3, 5), depth[:, ::4, ::4])


def test_whole_map_where_sizes_agree() -> None:
    depth = distinct_depth((2, 6, 5), 0.5)
    assert_same_bits(through_a_layer(depth, 6, 5), depth)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_dtype_of_the_layer(dtype: torch.dtype) -> None:
    depth = distinct_depth((1, 6, 6), 0.3).to(dtype)
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    out = DepthGuided(Probe())(torch.zeros(1, 1, 3, 3, dtype=dtype), depth=depth)
    expected = oracle_resize.resize(depth[0].to(wide).numpy(), 3, 3)
    assert_same_bits(out[0], torch.from_numpy(expected))
    out = DepthGuided(Probe())(torch.zeros(1, 1, 3, 3, dtype=torch.float64), depth=depth)
    assert out.dtype == torch.float64


def test_depth_beyond_the_layers_dtype_is_a_hole() -> None:
    depth = torch.tensor([[[1e300, 3.0], [1e-60, 4.0]]], dtype=torch.float64)
    assert through_a_layer(depth, 1, 1).item() == 3.0
    out = DepthGuided(Probe())(torch.zeros(1, 1, 1, 1, dtype=torch.float64), depth=depth)
    assert out.item() == 1e300


@pytest.mark.parametrize("traced_form", [False, True])
def test_gradient_flows_to_the_pixels_picked(traced_form: bool) -> None:
    depth = distinct_depth((1, 4, 4), 0.0)
    depth[0, 0, 0] = float("nan")
    depth.requires_grad_()
    call = traced if traced_form else through_a_layer
    weights = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])
    (grad,) = torch.autograd.grad((call(depth, 2, 2) * weights).sum(), depth)
    expected = torch.zeros(1, 4, 4)
    expected[0, 0, 1], expected[0, 0, 2], expected[0, 2, 0], expected[0, 2, 2] = 1, 2, 3, 4
    assert_same_bits(grad, expected)


@pytest.mark.parametrize("layout", ["sliced", "transposed", "expanded"])
def test_strides_do_not_matter(layout: str) -> None:
    depth = distinct_depth((2, 8, 8), 0.3)
    views = {
        "sliced": torch.stack([depth, depth], -1)[..., 0],
        "transposed": depth.transpose(1, 2).contiguous().transpose(1, 2),
        "expanded": depth[:1].expand(2, 8, 8),
    }
    view = views[layout]
    assert not view.is_contiguous()
    assert_same_bits(resize_depth(view, 3, 4), resize_depth(view.contiguous(), 3, 4))


def test_empty_batch() -> None:
    assert through_a_layer(torch.zeros(0, 8, 8), 4, 4).shape == (0, 4, 4)
