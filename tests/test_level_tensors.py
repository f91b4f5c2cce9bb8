"""The small tensors behind depth levels: kept from call to call, never where they may not be."""

from __future__ import annotations

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from helpers import assert_same_bits
from surfconv_ops import DepthLevels, depth_to_scale, levels

LEVELS = DepthLevels([2.0, 4.0], [1.0, 3.0, 5.0])
DEPTH = torch.tensor([[0.5, 2.0, 3.0, 9.0, 0.0, torch.nan]])


@pytest.fixture(autouse=True)
def _empty_cache() -> None:
    levels._kept_tensor.cache_clear()


def test_are_made_once() -> None:
    first = depth_to_scale(DEPTH, 2.0, levels=LEVELS)
    made = levels._kept_tensor.cache_info().misses
    assert made == 2
    assert_same_bits(depth_to_scale(DEPTH, 2.0, levels=LEVELS), first)
    assert levels._kept_tensor.cache_info().misses == made
    other = depth_to_scale(DEPTH.double(), 2.0, levels=LEVELS)
    assert other.dtype == torch.float64
    torch.testing.assert_close(other.float(), first)


def test_of_inference_mode_serve_training() -> None:
    with torch.inference_mode():
        depth_to_scale(DEPTH, 2.0, levels=LEVELS)
    assert not any(t.is_inference() for t in _kept())
    weight = torch.ones(1, requires_grad=True)
    (weight * depth_to_scale(DEPTH, 2.0, levels=LEVELS)).sum().backward()
    assert weight.grad is not None


def test_of_a_mode_do_not_stay() -> None:
    with FakeTensorMode():
        fake = depth_to_scale(torch.empty(1, 6), 2.0, levels=LEVELS)
    assert fake.shape == (1, 6)
    assert levels._kept_tensor.cache_info().currsize == 0
    torch.func.vmap(lambda z: depth_to_scale(z, 2.0, levels=LEVELS))(DEPTH)
    torch.func.functionalize(lambda z: depth_to_scale(z, 2.0, levels=LEVELS))(DEPTH)
    assert levels._kept_tensor.cache_info().currsize == 0


def _kept() -> list[torch.Tensor]:
    edges = levels._kept_tensor(LEVELS._single_edges, torch.float32, torch.device("cpu"))
    return [edges]
