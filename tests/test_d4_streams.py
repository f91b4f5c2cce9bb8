"""D4 as something to stream, split, merge and store."""

from __future__ import annotations

import copy
import math
import pickle
import weakref
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import oracle_d4
from depth_samples import (
    BIN,
    depth_lists,
    few_levels,
    level_counts,
    metres,
    normal_depths,
    some_valid,
    stream,
    whole_gammas,
)
from surfconv_ops import D4, DepthLevels, d4, fit_depth_levels


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bins after the fifth distinct depth."""
    monkeypatch.setattr(d4, "EXACT_LIMIT", 5)


@few_levels
@pytest.mark.usefixtures("small_limit")
@given(some_valid, level_counts, whole_gammas, st.integers(1, 7))
def test_bins(depths: list[float], num_levels: int, gamma: int, chunk: int) -> None:
    expected = oracle_d4.fit(depths, num_levels, gamma)
    fitted = stream(depths, num_levels, gamma, chunk)
    valid = {z for z in depths if math.isfinite(z) and z > 0}
    assert fitted.exact == (len(valid) <= 5)
    levels = fitted.fit()
    for edge in levels.edges:
        assert edge in valid
        assert any(edge * (1 - BIN) <= target <= edge for target in expected.targets)
    for target in expected.targets:
        assert any(target <= edge <= target * (1 + BIN) for edge in (*levels.edges, max(valid)))
    level = levels.assign(torch.tensor(sorted(valid), dtype=torch.float64)).tolist()
    assert level == sorted(level) and set(level) == set(range(len(levels)))
    for index, center in enumerate(levels.centers):
        own = [z for z, k in zip(sorted(valid), level, strict=True) if k == index]
        assert min(own) <= center <= max(own)


@few_levels
@pytest.mark.usefixtures("small_limit")
@pytest.mark.parametrize("gamma", [-2.0, 0.0, 1.0, 2.0, 40.0])
def test_bins_of_many_pixels(gamma: float) -> None:
    depth = normal_depths()
    exact = fit_depth_levels(depth, 4, gamma)
    binned = D4(4, gamma).update(depth)
    assert not binned.exact and len(binned.table.pixels) < len(np.unique(depth))
    assert binned.fit().edges == pytest.approx(exact.edges, rel=BIN)
    # Levels are whole bins, so that the means are those of the pixels assigned.
    level = binned.fit().assign(torch.from_numpy(depth)).numpy()
    weights = (depth.astype(np.float64) / depth.max()) ** gamma
    means = np.bincount(level, weights * depth) / np.bincount(level, weights)
    assert binned.fit().centers == pytest.approx(means, rel=1e-10)


def test_the_limit_of_exact_counting() -> None:
    depth = torch.linspace(1.0, 2.0, d4.EXACT_LIMIT, dtype=torch.float64)
    fitted = D4(3).update(depth)
    assert fitted.exact and fitted.fit() == fit_depth_levels(depth, 3)
    assert not fitted.update(torch.tensor([3.0])).exact
    # A doubling of depth has 4096 bins; 2.0 itself begins the next one.
    assert len(fitted.table.pixels) == 4096 + 2
    assert not D4(3).merge(fitted).exact


def test_a_16_bit_sensor_is_exact() -> None:
    counts = np.arange(2**16)
    fitted = D4(4, 2.0).update(counts / 1000).update((counts * np.float32(0.001))[::-1])
    assert fitted.exact and fitted.valid_pixels == 2 * (2**16 - 1) and fitted.pixels == 2 * 2**16


@few_levels
@pytest.mark.parametrize("limit", [5, 2**17])
@given(st.lists(depth_lists, min_size=2, max_size=5), metres, whole_gammas, st.randoms())
def test_merging(
    limit: int, parts: list[list[float]], extra: float, gamma: int, random: object
) -> None:
    parts[0].append(extra)
    kept, d4.EXACT_LIMIT = d4.EXACT_LIMIT, limit
    try:
        whole = stream([z for part in parts for z in part], 4, gamma)
        pieces = [stream(part, 4, gamma) for part in parts]
        forward, backward = D4(4, gamma), D4(4, gamma)
        for piece in pieces:
            forward.merge(piece)
        for piece in reversed(pieces):
            backward.merge(piece)
        nested = copy.deepcopy(pieces[0]).merge(copy.deepcopy(pieces[1]).merge(D4(4, gamma)))
        for piece in pieces[2:]:
            nested.merge(piece)
    finally:
        d4.EXACT_LIMIT = kept
    for merged in (forward, backward, nested):
        assert merged.exact == whole.exact
        assert merged.pixels == whole.pixels and merged.valid_pixels == whole.valid_pixels
        for column, wanted in zip(merged.table, whole.table, strict=True):
            np.testing.assert_allclose(column, wanted, rtol=1e-13)
        assert merged.fit().edges == whole.fit().edges
        assert merged.fit().centers == pytest.approx(whole.fit().centers, rel=1e-13)


def test_merging_leaves_the_other_alone() -> None:
    one, two = D4(2).update(torch.tensor([1.0, 2.0])), D4(2).update(torch.tensor([4.0]))
    assert one.merge(two) is one
    one.update(torch.tensor([8.0]))
    assert (two.pixels, two.table.high.tolist()) == (1, [4.0])


@pytest.mark.parametrize(("other", "name"), [(D4(5), "num_levels"), (D4(4, 2.0), "gamma")])
def test_merging_what_does_not_fit(other: D4, name: str) -> None:
    with pytest.raises(ValueError, match=rf"other: .*{name} = (4|1\.0), got (5|2\.0)"):
        D4(4, 1.0).merge(other)
    with pytest.raises(TypeError, match="other: expected D4, got DepthLevels"):
        D4(4).merge(DepthLevels([], [1.0]))  # type: ignore[arg-type]


@pytest.mark.parametrize("limit", [5, 2**17])
def test_pickle_and_repr(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(d4, "EXACT_LIMIT", limit)
    fitted = D4(3, 0.5).update(normal_depths(100))
    twin = pickle.loads(pickle.dumps(fitted))
    assert twin.fit() == fitted.fit() and twin.exact == fitted.exact == (limit > 100)
    more = normal_depths(200)[100:]
    assert twin.update(more).fit() == fitted.update(more).fit()
    assert repr(fitted) == (
        "D4(num_levels=3, gamma=0.5): 200 valid of 200 pixels, "
        + ("exact" if limit > 200 else "in bins")
    )


def test_a_generator_is_read_one_map_at_a_time() -> None:
    seen: list[weakref.ref[np.ndarray]] = []

    def maps() -> Iterator[np.ndarray]:
        for i in range(20):
            # What yields a map and what takes it may each hold on to the last one.
            assert sum(reference() is not None for reference in seen) <= 2
            depth = np.full((8, 8), 1.0 + i)
            seen.append(weakref.ref(depth))
            yield depth

    assert len(fit_depth_levels(maps(), 4)) == 4
    assert len(seen) == 20
