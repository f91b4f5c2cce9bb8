"""The operator that finds the valid depth nearest to each pixel of a smaller view."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import oracle_resize
from surfconv_ops import depth_resize

nearest_depth = torch.ops.surfconv.nearest_depth
SIZES = [((33, 47), (16, 24)), ((40, 60), (10, 15)), ((6, 200), (1, 1)), ((200, 6), (3, 9))]


def make_depth(shape: tuple[int, ...], holes: float, dtype: torch.dtype) -> torch.Tensor:
    """Every valid pixel has a depth of its own, so that a wrong choice shows."""
    rng = np.random.default_rng(3)
    depth = 1.0 + rng.permutation(int(np.prod(shape))).reshape(shape) / 64
    bad = rng.choice([0.0, -0.0, -2.0, np.nan, np.inf, -np.inf], shape)
    return torch.from_numpy(np.where(rng.random(shape) < holes, bad, depth)).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(("full", "wanted"), SIZES)
@pytest.mark.parametrize("holes", [0.0, 0.5, 0.97, 1.0])
def test_against_the_rule(
    full: tuple[int, int], wanted: tuple[int, int], holes: float, dtype: torch.dtype
) -> None:
    depth = make_depth((3, *full), holes, dtype)
    expected = np.stack([oracle_resize.resize(image, *wanted) for image in depth.numpy()])
    plain = depth_resize._nearest(depth, *wanted)
    for threads in (1, 3):
        torch.set_num_threads(threads)
        at = nearest_depth(depth, *wanted)
        assert at.dtype == torch.int64
        np.testing.assert_array_equal(depth.reshape(-1)[at].numpy(), expected)
        assert torch.equal(at, plain)


def test_many_rows_are_shared_out() -> None:
    depth = make_depth((2, 600, 320), 0.6, torch.float32)
    torch.set_num_threads(1)
    alone = nearest_depth(depth, 301, 157)
    torch.set_num_threads(4)
    assert torch.equal(nearest_depth(depth, 301, 157), alone)
    assert torch.equal(alone, depth_resize._nearest(depth, 301, 157))


def test_strides_do_not_matter() -> None:
    depth = make_depth((2, 24, 30), 0.4, torch.float32)
    view = depth.transpose(1, 2).contiguous().transpose(1, 2)
    assert not view.is_contiguous()
    assert torch.equal(nearest_depth(view, 7, 11), nearest_depth(depth, 7, 11))


def test_empty_batch() -> None:
    assert nearest_depth(torch.zeros(0, 5, 5), 2, 3).shape == (0, 2, 3)


def test_is_a_good_operator() -> None:
    depth = make_depth((2, 9, 8), 0.3, torch.float32)
    torch.library.opcheck(nearest_depth, (depth, 4, 3))


@pytest.mark.parametrize(
    ("depth", "height", "width"),
    [
        (torch.ones(4, 4), 2, 2),
        (torch.ones(1, 0, 4), 2, 2),
        (torch.ones(1, 4, 4), 0, 2),
        (torch.ones(1, 4, 4), 2, -1),
        (torch.ones(1, 4, 4), 2**40, 2**40),
        (torch.ones(1, 4, 4, dtype=torch.float16), 2, 2),
        (torch.ones(1, 4, 4, dtype=torch.int64), 2, 2),
    ],
    ids=["no batch", "no rows", "no height", "width", "overflow", "half", "counts"],
)
def test_refuses(depth: torch.Tensor, height: int, width: int, compiled: None) -> None:
    with pytest.raises(RuntimeError, match="nearest_depth"):
        nearest_depth(depth, height, width)
