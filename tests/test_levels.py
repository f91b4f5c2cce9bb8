"""DepthLevels against the oracle, and as a value: stored, copied, compared."""

from __future__ import annotations

import copy
import json
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import oracle_depth
from surfconv_ops import DepthLevels

INVALID = [0.0, -0.0, -1.0, math.nan, math.inf, -math.inf]


@given(
    st.lists(st.floats(0.01, 80.0), min_size=1, max_size=9, unique=True).map(sorted),
    st.lists(st.floats(0.001, 100.0), max_size=20),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_assign_and_quantize(edges: list[float], depths: list[float], dtype: torch.dtype) -> None:
    centers = [edges[0] / 2, *(edges[i] * 1.0000001 for i in range(len(edges)))]
    levels = DepthLevels(edges, sorted(centers))
    depth = torch.tensor([*depths, *edges, *INVALID, 1e-30, 1e30], dtype=dtype)
    wanted = [oracle_depth.assign_level(float(z), edges) for z in depth]
    assigned = levels.assign(depth)
    assert assigned.dtype == torch.int64 and assigned.tolist() == wanted
    quantized = levels.quantize(depth)
    assert quantized.dtype == dtype
    table = torch.tensor([*levels.centers, math.nan], dtype=dtype)
    torch.testing.assert_close(quantized, table[wanted], rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3, 4), (2, 1, 3, 4), (0, 3)])
def test_shapes(shape: tuple[int, ...]) -> None:
    levels = DepthLevels([2.0], [1.0, 3.0])
    depth = torch.full(shape, 2.5)
    assert levels.assign(depth).shape == levels.quantize(depth).shape == shape


def test_one_level_needs_no_edge() -> None:
    levels = DepthLevels([], [2.0])
    assert len(levels) == 1
    assert levels.assign(torch.tensor([0.1, 99.0, 0.0])).tolist() == [0, 0, -1]


@pytest.mark.parametrize("kind", ["list", "tuple", "tensor", "array"])
def test_construction(kind: str) -> None:
    make = {"list": list, "tuple": tuple, "tensor": torch.tensor, "array": np.array}[kind]
    levels = DepthLevels(make([1.0, 2.0]), make([0.5, 1.5, 3.0]), gamma=2.0)
    assert list(levels.edges) == [1.0, 2.0] and list(levels.centers) == [0.5, 1.5, 3.0]
    assert len(levels) == 3 and levels.gamma == 2.0


@pytest.mark.parametrize("gamma", [None, 0.0, 1.5])
def test_json_keeps_every_bit(tmp_path: Path, gamma: float | None) -> None:
    levels = DepthLevels([0.1, 1 / 3, math.pi], [0.05, 0.2, 1.0, 1e3 / 7], gamma)
    path = tmp_path / "levels.json"
    levels.save(path)
    assert DepthLevels.load(path) == levels and DepthLevels.load(str(path)).gamma == gamma
    content = json.loads(path.read_text())
    assert content["edges"] == list(levels.edges) and content["centers"] == list(levels.centers)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"edges": [2.0, 1.0]}', "no json"])
def test_files_that_hold_no_levels(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"bad\.json"):
        DepthLevels.load(path)


def test_copies() -> None:
    levels = DepthLevels([1.0], [0.5, 2.0], 1.0)
    for twin in (pickle.loads(pickle.dumps(levels)), copy.deepcopy(levels)):
        assert twin == levels
        assert twin.assign(torch.tensor([1.5])).tolist() == [1]
    assert levels != DepthLevels([1.1], [0.5, 2.0], 1.0)


def test_no_gradient() -> None:
    depth = torch.tensor([1.0, 2.0], requires_grad=True)
    assert not DepthLevels([1.5], [1.0, 2.0]).quantize(depth).requires_grad
