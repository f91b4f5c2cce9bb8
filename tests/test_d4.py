"""D4 and fit_depth_levels against exact fractions, and as something to stream, split and merge."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import oracle_d4
from surfconv_ops import D4, DepthLevels, d4, fit_depth_levels

INVALID = [0.0, -0.0, -2.0, math.nan, math.inf, -math.inf]
# The figures for 70 KITTI frames, N = 4; metres = value / 65535 * 90.
KITTI = {
    0.0: [8.732, 12.000, 19.556],
    1.0: [11.640, 20.005, 36.376],
    2.0: [20.900, 36.567, 52.883],
}
# What a bin of depths can be off by: 12 bits of the mantissa.
BIN = 2.0**-12
few_levels = pytest.mark.filterwarnings("ignore:depth levels. asked for")

coarse = st.integers(1, 12).map(float)
metres = st.floats(2.0**-10, 2.0**10, width=32)
depth_lists = st.lists(st.one_of(coarse, metres, st.sampled_from(INVALID)), max_size=40)
some_valid = st.tuples(depth_lists, metres).map(lambda parts: [*parts[0], parts[1]])
level_counts = st.integers(1, 9)
whole_gammas = st.integers(-3, 4)


@pytest.fixture
def small_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bins after the fifth distinct depth."""
    monkeypatch.setattr(d4, "EXACT_LIMIT", 5)


def stream(depths: list[float], num_levels: int, gamma: float, chunk: int = 3) -> D4:
    fitted = D4(num_levels, gamma)
    for start in range(0, len(depths), chunk):
        fitted.update(np.array(depths[start : start + chunk]))
    return fitted


def normal_depths(count: int = 6000) -> np.ndarray:
    return np.random.default_rng(0).lognormal(2.0, 0.8, count).astype(np.float32)


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_dtypes_and_layouts(dtype: torch.dtype) -> None:
    depth = torch.from_numpy(normal_depths(60)).to(dtype).reshape(3, 1, 4, 5)
    wanted = oracle_d4.fit(depth.double().flatten().tolist(), 4, 1)
    shapes = {
        "batch": depth,
        "flat": depth.flatten(),
        "transposed": depth.transpose(0, 3),
        "strided": depth.repeat_interleave(2, -1)[..., ::2],
        "with grad": depth.clone().requires_grad_(),
    }
    for name, shaped in shapes.items():
        levels = fit_depth_levels(shaped, 4)
        assert list(levels.edges) == wanted.edges, name
        assert levels.centers == pytest.approx(wanted.centers, rel=1e-12), name
    assert fit_depth_levels(depth[0, 0, 0, 0], 1).centers == (float(depth[0, 0, 0, 0]),)


@pytest.mark.parametrize("kind", ["float16", "float32", "float64", "longdouble", ">f4"])
def test_arrays(kind: str) -> None:
    depth = normal_depths(60).astype(kind).reshape(5, 12)
    depth.flags.writeable = False
    wanted = oracle_d4.fit(depth.ravel().tolist(), 3, 2)
    assert list(fit_depth_levels(depth, 3, 2.0).edges) == wanted.edges
    assert list(fit_depth_levels(depth[:, ::-1].T, 3, 2.0).edges) == wanted.edges


def test_masked_pixels_are_holes() -> None:
    depth = np.ma.masked_greater(np.array([1.0, 2.0, 65.535]), 60.0)
    assert fit_depth_levels(depth, 1, 0.0).centers == (1.5,)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda() -> None:
    depth = torch.from_numpy(normal_depths(500))
    for dtype in (torch.float32, torch.bfloat16):
        assert fit_depth_levels(depth.to(dtype).cuda(), 4) == fit_depth_levels(depth.to(dtype), 4)


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


@pytest.mark.parametrize("depth", [torch.empty(0), torch.tensor(INVALID), torch.empty(0, 4, 5)])
def test_no_valid_depth(depth: torch.Tensor) -> None:
    reason = f"none of {depth.numel()} pixels" if depth.numel() else "there are none"
    for fit in (
        lambda: fit_depth_levels(depth, 4),
        lambda: fit_depth_levels([depth], 4),
        lambda: fit_depth_levels(iter([depth, depth[:0]]), 4),
        lambda: D4(4).update(depth).fit(),
    ):
        with pytest.raises(ValueError, match=f"at least one valid depth, but {reason}"):
            fit()


@pytest.mark.parametrize("nothing", [[], (), iter(())])
def test_no_maps_at_all(nothing: object) -> None:
    with pytest.raises(ValueError, match="at least one valid depth, but there are none"):
        fit_depth_levels(nothing, 4)  # type: ignore[arg-type]


def test_maps_without_depth_do_no_harm() -> None:
    fitted = D4(2, 0.0).update(torch.tensor(INVALID)).update(torch.tensor([1.0, 3.0]))
    fitted.update(torch.empty(0)).merge(D4(2, 0.0))
    assert fitted.fit() == DepthLevels((1.0,), (1.0, 3.0), 0.0)
    assert (fitted.pixels, fitted.valid_pixels) == (8, 2)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (torch.ones(3, dtype=torch.int16), r"torch\.int16; .*\.float\(\) / 1000"),
        (torch.ones(3, dtype=torch.bool), r"torch\.bool"),
        (np.ones(3, np.uint16), r"uint16; .*\.astype\('float32'\) / 1000"),
        (np.ones(3, complex), "complex128"),
        (np.array(["a"]), "<U1"),
        (3.0, "got float"),
        (None, "got NoneType"),
    ],
)
def test_wrong_types(depth: object, message: str) -> None:
    with pytest.raises(TypeError, match=f"depth: expected .*{message}"):
        D4(4).update(depth)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=f"depths: expected .*{message}"):
        fit_depth_levels(depth, 4)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=rf"depths\[1\]: expected .*{message}"):
        fit_depth_levels([torch.ones(2), depth], 4)  # type: ignore[list-item]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((0,), ValueError, "num_levels: expected at least 1, got 0"),
        ((2.0,), TypeError, "num_levels: expected an integer"),
        ((True,), TypeError, "num_levels: expected an integer"),
        ((4, math.nan), ValueError, "gamma: expected a number, got NaN"),
        ((4, math.inf), ValueError, "gamma: expected a finite number"),
        ((4, "1"), TypeError, "gamma: expected a number"),
    ],
)
def test_wrong_numbers(arguments: tuple[object, ...], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        D4(*arguments)  # type: ignore[arg-type]
    with pytest.raises(error, match=message):
        fit_depth_levels(torch.ones(3), *arguments)  # type: ignore[arg-type]


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


def test_edges_and_float32() -> None:
    depth = torch.from_numpy(normal_depths())
    levels = fit_depth_levels(depth, 6)
    assert torch.equal(levels.assign(depth), levels.assign(depth.double()))


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
