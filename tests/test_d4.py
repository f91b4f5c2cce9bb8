"""D4 and fit_depth_levels against exact fractions, and on real frames."""

from __future__ import annotations

import doctest
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import oracle_d4
from depth_samples import (
    BIN,
    INVALID,
    few_levels,
    level_counts,
    normal_depths,
    some_valid,
    stream,
    whole_gammas,
)
from surfconv_ops import D4, DepthLevels, d4, fit_depth_levels

# The figures for 70 KITTI frames, N = 4; metres = value / 65535 * 90.
KITTI = {
    0.0: [8.732, 12.000, 19.556],
    1.0: [11.640, 20.005, 36.376],
    2.0: [20.900, 36.567, 52.883],
}


@few_levels
@given(some_valid, level_counts, whole_gammas)
def test_exact(depths: list[float], num_levels: int, gamma: int) -> None:
    expected = oracle_d4.fit(depths, num_levels, gamma)
    for levels in (
        fit_depth_levels(torch.tensor(depths, dtype=torch.float64), num_levels, gamma),
        fit_depth_levels(np.array(depths), num_levels, gamma),
        fit_depth_levels([np.array(depths[:2]), np.array(depths[2:])], num_levels, gamma),
        fit_depth_levels((np.array([z]) for z in depths), num_levels, gamma),
        stream(depths, num_levels, gamma).fit(),
    ):
        assert list(levels.edges) == expected.edges
        assert levels.centers == pytest.approx(expected.centers, rel=1e-12)
        assert levels.gamma == gamma


@few_levels
@given(some_valid, level_counts, st.floats(-6.0, 6.0))
def test_every_level_holds_its_share(depths: list[float], num_levels: int, gamma: float) -> None:
    levels = fit_depth_levels(np.array(depths), num_levels, gamma)
    valid = [z for z in depths if math.isfinite(z) and z > 0]
    weights = [z**gamma for z in valid]
    share = math.fsum(weights) / num_levels
    largest = max(math.fsum(w for w, z in zip(weights, valid, strict=True) if z == depth)
                  for depth in set(valid))  # fmt: skip
    level = levels.assign(torch.tensor(valid, dtype=torch.float64)).tolist()
    held = [math.fsum(w for w, k in zip(weights, level, strict=True) if k == index)
            for index in range(len(levels))]  # fmt: skip
    for index, weight in enumerate(held):
        assert weight > 0
        # Equal edges merge, so a level may hold the share of several.
        assert weight <= num_levels * share - (len(levels) - 1 - index) * share + largest
        if len(levels) == num_levels:
            assert abs(weight - share) <= largest + 1e-9 * share
        own = [z for z, k in zip(valid, level, strict=True) if k == index]
        assert min(own) <= levels.centers[index] <= max(own)


@pytest.mark.parametrize("gamma", [-1.5, 0.0, 0.5, 1.0, 2.0, 3.7])
def test_shares_of_many_pixels(gamma: float) -> None:
    depth = normal_depths()
    weights = depth.astype(np.float64) ** gamma
    levels = fit_depth_levels(depth, 5, gamma)
    level = levels.assign(torch.from_numpy(depth)).numpy()
    held = np.bincount(level, weights, minlength=5) / weights.sum()
    assert np.abs(held - 0.2).max() <= weights.max() / weights.sum() + 1e-12
    means = np.bincount(level, weights * depth) / np.bincount(level, weights)
    assert levels.centers == pytest.approx(means, rel=1e-12)


@few_levels
@pytest.mark.parametrize("num_levels", [1, 2, 7])
@pytest.mark.parametrize("gamma", [-2.0, 0.0, 0.3, 1.0])
@pytest.mark.parametrize("depth", [1e-30, 0.1, 7.3, 1e30])
def test_constant_depth(depth: float, gamma: float, num_levels: int) -> None:
    levels = fit_depth_levels(torch.full((4, 5), depth, dtype=torch.float64), num_levels, gamma)
    assert levels == DepthLevels((), (depth,), gamma)


def test_one_level() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        levels = fit_depth_levels(torch.tensor([1.0, 2.0, 3.0]), 1, 2.0)
    assert levels == DepthLevels((), ((1 + 8 + 27) / (1 + 4 + 9),), 2.0)


def test_fewer_depths_than_levels() -> None:
    depth = torch.tensor([1.0, 1.0, 2.0])
    with pytest.warns(
        UserWarning, match="asked for 5, made 2, .* how many distinct depths"
    ) as seen:
        assert fit_depth_levels(depth, 5) == DepthLevels((1.0,), (1.0, 2.0), 1.0)
    assert seen[0].filename == __file__
    with pytest.warns(UserWarning, match="asked for 5, made 2") as seen:
        D4(5).update(depth).fit()
    assert seen[0].filename == __file__


def test_one_depth_with_more_than_its_share() -> None:
    depth = torch.tensor([1.0, 2.0, 3.0, 4.0, *[65.535] * 4])
    with pytest.warns(UserWarning, match=r"65\.535 m alone, 50\.0% of the valid .*saturated"):
        levels = fit_depth_levels(depth, 4, 0.0)
    assert levels.edges == (2.0, 4.0)
    # Fewer depths than levels, and still fewer levels than depths.
    near = torch.tensor([1.0] * 20 + [2.0, 3.0, 4.0])
    with pytest.warns(UserWarning, match=r"asked for 6, made 2, because 1 m alone, 87\.0%"):
        levels = fit_depth_levels(near, 6, 0.0)
    assert levels == DepthLevels((1.0,), (1.0, 3.0), 0.0)


@pytest.mark.parametrize("limit", [5, 2**17])
@pytest.mark.parametrize("gamma", [0.5, -0.5, 0.1, 1 / 3, 2.7])
def test_equal_halves_are_parted_at_the_gap(
    gamma: float, limit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(d4, "EXACT_LIMIT", limit)
    # Twice the importance a pixel, half the pixels: equal but for the rounding of powers.
    many = np.linspace(1.0, 1.1, 11)
    few = many * 2 ** (1 / gamma)
    levels = D4(2, gamma).update(np.concatenate([few, many, many])).fit()
    assert levels.edges == (min(many.max(), few.max()),)


@few_levels
@pytest.mark.parametrize("limit", [1, 2**17])
@pytest.mark.parametrize("gamma", [1e308, -1e308, 1e7, -1e7, 3000.0, -3000.0, 30.0, -30.0, 1e-300])
def test_huge_powers(gamma: float, limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(d4, "EXACT_LIMIT", limit)
    depth = np.array([1e-300, 1e-30, 0.5, 1.0, 1.00001, 3.0, 1e30, 1e300, *INVALID])
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        levels = D4(3, gamma).update(depth).fit()
    if gamma > 1:
        assert levels == DepthLevels((), (1e300,), gamma)
    elif gamma < -1:
        assert levels.edges == (1e-300,)
        assert levels.centers == pytest.approx((1e-300, 1e-30), rel=1e-9)
    else:
        # Eight depths of equal importance in three levels.
        assert levels.edges == pytest.approx((0.5, 3.0), rel=BIN)


def test_examples() -> None:
    results = doctest.testmod(d4, optionflags=doctest.ELLIPSIS)
    assert results.attempted > 10 and results.failed == 0


@pytest.fixture(scope="module")
def kitti(data_folder: Path) -> list[np.ndarray]:
    image = pytest.importorskip("PIL.Image", reason="Pillow reads the frames")
    files = sorted((data_folder / "kitti" / "depth").glob("img_*.png"))
    assert len(files) == 70
    return [np.asarray(image.open(file)) / np.float32(65535 / 90) for file in files]


@pytest.mark.parametrize("gamma", KITTI)
def test_kitti(gamma: float, kitti: list[np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    exact = fit_depth_levels(np.stack(kitti), 4, gamma)
    assert [round(edge, 3) for edge in exact.edges] == KITTI[gamma]
    monkeypatch.setattr(d4, "EXACT_LIMIT", 1000)
    binned = D4(4, gamma)
    for frame in kitti:
        binned.update(frame)
    assert not binned.exact and binned.valid_pixels == 11_463_538
    assert binned.fit().edges == pytest.approx(exact.edges, rel=1e-3)
    assert binned.fit().centers == pytest.approx(exact.centers, rel=1e-3)


def test_kitti_as_a_stream(kitti: list[np.ndarray]) -> None:
    assert fit_depth_levels(iter(kitti), 4) == fit_depth_levels(kitti, 4)
