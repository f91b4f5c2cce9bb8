"""The operator that looks up depth levels, against numpy's searchsorted and its own plain form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from surfconv_ops import DepthLevels, _fallback

ODD = [0.0, -0.0, -1.0, 1e-38, math.nan, math.inf, -math.inf, 2.0, 5.0, 3.4e38]


def make_depth(dtype: torch.dtype, size: int) -> torch.Tensor:
    depth = torch.rand(size, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 12
    depth[: len(ODD)] = torch.tensor(ODD, dtype=torch.float64)[:size]
    return depth.to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("count", [1, 2, 5, 40])
@pytest.mark.parametrize("size", [0, 1, 9, 257, 70000])
def test_against_searchsorted(dtype: torch.dtype, count: int, size: int) -> None:
    depth = make_depth(dtype, size)
    edges = torch.linspace(1, 10, count + 1, dtype=dtype)[1:-1]
    values = torch.arange(count + 1, dtype=dtype) * 1.5 - 2
    z = depth.numpy()
    with np.errstate(invalid="ignore"):
        level = np.where((z > 0) & np.isfinite(z), np.searchsorted(edges.numpy(), z), count)
    expected = values[torch.from_numpy(level)]
    for operator in (torch.ops.surfconv.level_values, _fallback.level_values):
        assert torch.equal(operator(depth, edges, values), expected)


def test_strides_and_threads() -> None:
    depth = make_depth(torch.float32, 300 * 400).reshape(300, 400)
    levels = DepthLevels([2.0, 5.0], [1.0, 3.0, 7.0])
    expected = levels.assign(depth)
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        assert torch.equal(levels.assign(depth.t()), expected.t())
        assert torch.equal(levels.assign(depth[::3, 1::2]), expected[::3, 1::2])
        assert torch.equal(levels.assign(depth[:1].expand(5, 400)), expected[:1].expand(5, 400))


def test_is_a_good_operator() -> None:
    depth = make_depth(torch.float32, 30)
    edges, values = torch.tensor([2.0, 5.0]), torch.tensor([1.0, 3.0, 7.0, 9.0])
    torch.library.opcheck(torch.ops.surfconv.level_values, (depth, edges, values))


@pytest.mark.parametrize(
    ("edges", "values"),
    [
        (torch.ones(2), torch.ones(3)),
        (torch.ones(2, dtype=torch.float64), torch.ones(4)),
        (torch.ones(1, 2), torch.ones(4)),
    ],
    ids=["too few values", "another dtype", "two dimensions"],
)
def test_refuses(edges: torch.Tensor, values: torch.Tensor, compiled: None) -> None:
    with pytest.raises(RuntimeError, match="level_values"):
        torch.ops.surfconv.level_values(torch.ones(3), edges, values)
