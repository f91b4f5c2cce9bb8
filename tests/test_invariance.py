"""The scale-invariance benchmark: its renderer, its points and its figures against closed forms."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import charts
import document
import features
import scene
from gate import Check
from plan import Plan
from report import Report
from rows import Row
from scene import Camera, Waves, make_waves, render, slant, wall
from suites import invariance
from suites.invariance import BOXES, SLANT, WALL, Case

SIZE = 64
FOCAL = 64.0
# float32 images of values up to a few units.
ROUNDING = 1e-5
# The rounding of float32 features in standard deviations of the surface.
FEATURE_ROUNDING = 1e-5


class Ramp(NamedTuple):
    """Colours that grow evenly along the surface: a mean over any parallelogram is its middle's."""

    slopes: Tensor

    def __call__(self, place: Tensor, sides: Tensor) -> Tensor:
        return self.slopes @ place.T


RAMP = Ramp(torch.tensor([[1.0, 0.4], [-0.3, 0.8], [0.5, -0.9]], dtype=torch.float64))


def wave_values(texture: Waves, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(3, ...) values of a sum of waves at points of the surface."""
    waves = texture.waves.numpy()
    phase = u[..., None] * waves[:, 0] + v[..., None] * waves[:, 1]
    return np.einsum("ck,...k->c...", texture.cosine.numpy(), np.cos(phase)) + np.einsum(
        "ck,...k->c...", texture.sine.numpy(), np.sin(phase)
    )


@pytest.mark.parametrize("slope", [0.0, 0.75])
@pytest.mark.parametrize("back", [0.0, 6.0])
def test_a_pixel_is_the_mean_over_its_footprint(slope: float, back: float) -> None:
    texture = make_waves([1.0, 0.25, 0.06], seed=3)
    view = render(slant(2.0, slope), texture, Camera(SIZE, FOCAL, back))
    rng = np.random.default_rng(0)
    parts = (np.arange(40) + 0.5) / 40 - 0.5
    for row, column in rng.integers(0, SIZE, (12, 2)):
        x = (column + parts[None, :] - SIZE // 2) / FOCAL
        y = (row + parts[:, None] - SIZE // 2) / FOCAL
        z = (2.0 + back) / (1 - slope * x)
        middle = (2.0 + back) / (1 - slope * (column - SIZE // 2) / FOCAL)
        assert view.depth[row, column] == pytest.approx(middle, rel=1e-6)
        u, v = np.broadcast_arrays(z * x * math.hypot(1, slope), z * y)
        expected = wave_values(texture, u, v).mean((1, 2))
        # On a slant the footprint is no exact parallelogram, on a wall it is one; 40 x 40 samples.
        allowed = 0.01 if slope else 1e-3
        assert view.image[:, row, column].numpy() == pytest.approx(expected, abs=allowed)


def test_a_texture_has_unit_variance_and_the_wavelengths_asked_for() -> None:
    texture = make_waves([0.5, 0.05], seed=0)
    lengths = (2 * math.pi / texture.waves.norm(dim=1)).reshape(2, -1)
    for asked, found in zip((0.5, 0.05), lengths, strict=True):
        assert float((found / asked).log2().abs().max()) <= 0.2
    places = np.random.default_rng(1).uniform(-50, 50, (2, 40000))
    assert wave_values(texture, *places).std(1) == pytest.approx(np.ones(3), rel=0.03)


def test_the_camera_has_no_unit_of_length() -> None:
    views = []
    for scale in (1.0, 4.0):
        texture = make_waves([0.5, 0.11], seed=2)
        texture = dataclasses.replace(texture, waves=texture.waves / scale)
        views.append(render(slant(2 * scale, 0.5), texture, Camera(SIZE, FOCAL)))
    torch.testing.assert_close(views[1].image, views[0].image, rtol=0, atol=ROUNDING)
    torch.testing.assert_close(views[1].depth, 4 * views[0].depth)


def test_distance_is_a_larger_footprint_on_a_coarser_grid() -> None:
    texture = make_waves([0.5, 0.11], seed=2)
    near = render(wall(2.0), texture, Camera(SIZE, FOCAL), footprint=2.0).image
    far = render(wall(2.0), texture, Camera(SIZE, FOCAL, 2.0)).image
    quarter, half = SIZE // 4, SIZE // 2
    expected = far[:, quarter : quarter + half, quarter : quarter + half]
    torch.testing.assert_close(near[:, ::2, ::2], expected, rtol=0, atol=ROUNDING)


def test_a_wall_moved_by_whole_pixels_moves_its_image() -> None:
    texture = make_waves([0.5, 0.11], seed=2)
    facet = wall(2.0)[0]
    moved = facet._replace(middle=(5 * 2.0 / FOCAL, -3 * 2.0 / FOCAL, 2.0))
    images = [render([each], texture, Camera(SIZE, FOCAL)).image for each in (facet, moved)]
    torch.testing.assert_close(images[1][:, :-3, 5:], images[0][:, 3:, :-5], rtol=0, atol=ROUNDING)
    assert float((images[1] - images[0]).abs().max()) > 0.5


def test_a_box_hides_what_is_behind_it_and_its_edge_is_mixed() -> None:
    camera = Camera(SIZE, FOCAL)
    faces = [*wall(4.0), *scene.box((0.5, -0.5, 2.0), (1.5, 0.5, 4.0))]

    def flat(place: Tensor, sides: Tensor) -> Tensor:
        # The wall's places lie around 0, every other facet's are shifted by metres.
        return (place.abs().amax(1) < 3.0).double().repeat(3, 1)

    view = render(faces, flat, camera)
    # The front spans x = 16 .. 48 pixels from the axis, its near side (x = 0.5 m) 8 .. 16.
    row = view.facet[SIZE // 2]
    assert [int(row[32 + x]) for x in (-9, 4, 12, 20, 31)] == [0, 0, 2, 1, 1]
    assert view.depth[32, 32 + 12] == pytest.approx(0.5 / 12 * FOCAL)
    assert float(view.depth[32, 32 + 20]) == 2.0 and float(view.depth[32, 20]) == 4.0
    # The side's far edge runs through the middle of pixel 8: half of it is wall.
    assert view.image[:, 32, 32 + 8].tolist() == [0.5] * 3
    assert view.image[0, 32, 32 + 7] == 1.0 and view.image[0, 32, 32 + 9] == 0.0

    def width(place: Tensor, sides: Tensor) -> Tensor:
        return sides[:, 0, 0].abs().repeat(3, 1)

    # The parts of a pixel beside an edge have footprints of their own; a pixel of wall is 1/16 m.
    widths = render(faces, width, camera).image[0, :, 32 + 24]
    # The front's upper edge lies in row 16 above the axis.
    assert float(widths[32 - 18]) == 1 / 16
    assert float(widths[32 - 17]) == 1 / 16 / scene.EDGE_RAYS
    with pytest.raises(ValueError, match="rays meet none"):
        render(scene.box((0.0, 0.0, 2.0), (1.0, 1.0, 3.0)), flat, camera)


@pytest.mark.parametrize("name", [WALL, SLANT, BOXES])
def test_matches_are_the_same_surface_points(name: str) -> None:
    views = invariance.views_of(name, (16.0,), SIZE)
    points = features.match(views, reach=1, stride=1, reference_depth=4.0)
    assert len(points.inside) > 50
    first = None
    for view, at in zip(views, points.positions, strict=True):
        pixel = at.round().long()
        # The outermost tap's farther corner, from either pixel that a reading interpolates.
        radius = math.ceil(max(1.0, 4.0 / float(view.depth.min()))) + 1
        assert int(pixel.min()) >= 2 and int(pixel.max()) <= SIZE - 3
        # Casting the ray at the very position meets the same place of the same facet.
        hits = scene.cast(invariance.scene_of(name), view.camera, at)
        first = hits if first is None else first
        assert torch.equal(hits.facet, first.facet)
        # Far depth is kept as float32.
        torch.testing.assert_close(hits.place, first.place, rtol=0, atol=3e-6)
        for (x, y), own in zip(pixel[points.inside].tolist(), hits.facet[points.inside].tolist(),
                               strict=True):  # fmt: skip
            window = view.facet[y - radius : y + radius + 1, x - radius : x + radius + 1]
            assert bool((window == own).all())
    assert bool(points.inside.all()) == (name != BOXES) and bool(points.inside.any())
    if name == WALL:
        for at in points.positions:
            torch.testing.assert_close(at, at.round(), rtol=0, atol=1e-9)


@pytest.fixture
def ramp(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every scene textured by the ramp."""
    monkeypatch.setattr(invariance, "make_waves", lambda *_, **__: RAMP)
    invariance.view_of.cache_clear()
    yield
    invariance.view_of.cache_clear()


@pytest.mark.usefixtures("ramp")
@pytest.mark.parametrize("reference", list(invariance.REFERENCES))
@pytest.mark.parametrize("kernel", [3, 5])
def test_on_a_ramp_continuous_mode_does_not_change_and_conv2d_as_computed(
    reference: str, kernel: int
) -> None:
    net = features.Net("ramp", kernel)
    case = Case("t", "c", WALL, (16.0,), net, reference)
    found = {(row.subject, row.depth): row for row in invariance.measure(case, SIZE, 1)
             if row.unit == invariance.CHANGE}  # fmt: skip
    views = invariance.views_of(WALL, (16.0,), SIZE)
    points = invariance.points_of(case, views)
    weight = net.convolutions(0)[0].weight.detach().double().numpy()
    # A feature is a sum of weights times the ramp at the taps, so linear in place.
    place = scene.cast(wall(2.0), views[0].camera, points.positions[0]).place.numpy()
    taps = np.arange(kernel) - kernel // 2
    slopes = RAMP.slopes.numpy()
    gradient = np.einsum("ocyx,ck->ok", weight, slopes)
    spread = math.sqrt(np.square((place - place.mean(0)) @ gradient.T).sum(1).mean())
    arm_x = np.einsum("ocyx,c,x->o", weight, slopes[:, 0], taps)
    arm_y = np.einsum("ocyx,c,y->o", weight, slopes[:, 1], taps)
    for times in (2, 4):
        continuous = found[invariance.CONTINUOUS, f"{times}x"]
        assert continuous.high < FEATURE_ROUNDING
        assert found[invariance.LIMIT, f"{times}x"].high < FEATURE_ROUNDING
        wider = (times - 1) * invariance.DISTANCE / views[0].camera.focal
        expected = float(np.linalg.norm(wider * (arm_x + arm_y)) / spread)
        conv2d = found[invariance.BASELINE, f"{times}x"]
        for value in (conv2d.low, conv2d.value, conv2d.high):
            assert value == pytest.approx(expected, rel=1e-3)
        assert expected > 1e-3 and continuous.ratio == pytest.approx(0, abs=1e-2)
        levels = found[invariance.LEVELS, f"{times}x"]
        assert 10 * FEATURE_ROUNDING < levels.value < conv2d.value


def test_where_all_taps_are_on_pixels_continuous_mode_is_perfect_interpolation() -> None:
    rows = invariance.measure(Case("t", "c", reference="4x"), SIZE, 1)
    found = {(row.subject, row.depth, row.unit): row.value for row in rows}
    for distance in ("2x", "4x"):
        for unit in (invariance.CHANGE, invariance.CORRELATION):
            limit = found[invariance.LIMIT, distance, unit]
            own = found[invariance.CONTINUOUS, distance, unit]
            assert own == pytest.approx(limit, rel=1e-4) and own > 0.05


def test_changes_and_correlation_by_hand() -> None:
    near = torch.tensor([[0.0, 2.0, 4.0], [1.0, 1.0, 1.0]]).double()
    far = near + torch.tensor([[3.0, 0.0, 0.0], [4.0, 0.0, -1.0]])
    spread = math.sqrt(8 / 3)
    expected = torch.tensor([5.0, 0.0, 1.0]).double() / spread
    torch.testing.assert_close(features.changes(near, far), expected)
    assert features.correlation(near, 3 * near + 1) == pytest.approx(1.0)
    assert features.correlation(near, -near) == pytest.approx(-1.0)
    random = torch.randn(2, 16, 5000, generator=torch.Generator().manual_seed(0)).double()
    unrelated = features.changes(*random).square().mean().sqrt()
    assert float(unrelated) == pytest.approx(math.sqrt(2), rel=0.02)
    assert abs(features.correlation(*random)) < 0.02


def test_readings_are_bilinear() -> None:
    values = torch.arange(12.0).reshape(1, 3, 4)
    positions = torch.tensor([[0.0, 0.0], [3.0, 2.0], [0.5, 1.25]]).double()
    expected = torch.tensor([[0.0, 11.0, 5.5]]).double()
    torch.testing.assert_close(features.read(values, positions), expected)


@pytest.mark.parametrize(("count", "shift"), [(4, 0.0), (8, 0.4), (1, -0.5)])
def test_levels_are_equally_wide_in_log_depth(count: int, shift: float) -> None:
    levels = features.equal_log_levels(count, 4.0, shift)
    ratio = features.LEVEL_SPAN ** (1 / count)
    centers = np.array(levels.centers)
    assert centers[1:] / centers[:-1] == pytest.approx(np.full(count - 1, ratio))
    assert np.array(levels.edges) == pytest.approx(np.sqrt(centers[1:] * centers[:-1]))
    middle = math.exp(float(np.log(centers).mean()))
    assert middle == pytest.approx(4.0 * ratio**shift)


@pytest.mark.parametrize("net", [invariance.NET, *invariance.NETS])
def test_no_feature_at_a_matched_point_sees_the_border(net: features.Net) -> None:
    case = Case("t", "c", WALL, (16.0,), net)
    views = invariance.views_of(WALL, (16.0,), SIZE)
    points = invariance.points_of(case, views)
    assert len(points.inside) >= 9

    def everything() -> list[Tensor]:
        subjects = (invariance.BASELINE, invariance.LEVELS, invariance.CONTINUOUS)
        found = [invariance.responses(each, case, views, points, 0, 1) for each in subjects]
        return [one for each in found for one in each]

    before = everything()
    for view in views:
        frame = torch.ones_like(view.image, dtype=torch.bool)
        frame[:, 1:-1, 1:-1] = False
        view.image[frame] += 1e3
    try:
        for own, other in zip(before, everything(), strict=True):
            assert torch.equal(own, other)
    finally:
        invariance.view_of.cache_clear()


def test_coarse_texture_is_kept_by_continuous_mode_and_fine_texture_by_none() -> None:
    found = {}
    for taps in (32.0, 2.0):
        case = Case("texture", f"{taps:g}", wavelengths=(taps,))
        found[taps] = {(row.subject, row.depth, row.unit): row
                       for row in invariance.measure(case, SIZE, 2)}  # fmt: skip
    continuous, conv2d = (
        found[32.0][name, "4x", invariance.CHANGE]
        for name in (invariance.CONTINUOUS, invariance.BASELINE)
    )
    assert continuous.verdict == "met" and continuous.value < 0.05 < 0.15 < conv2d.value
    assert found[32.0][invariance.CONTINUOUS, "4x", "correlation"].value > 0.99
    fine = found[2.0][invariance.CONTINUOUS, "4x", invariance.CHANGE]
    assert fine.value > 0.7 and fine.verdict == ""


def test_the_report_shows_distances_side_by_side_and_the_chart_is_drawn(tmp_path: Path) -> None:
    plan = Plan(True, (1,), {"invariance": 0.0, "gate": 0.0}, minimum=1, maximum=1)
    rows: list[Row] = []
    for case in invariance.cases_of(quick=True):
        rows += invariance.measure(case, SIZE, 1)
    suite = invariance.SUITE
    report = Report({"cpu": "c"}, plan, [Check("fine", 0.0)], [suite], rows)
    lines = document.render(report, {"invariance": ["invariance.png"]}).splitlines()
    assert lines.index(suite.method) < lines.index(f"## {suite.title}")
    header = "| case | what | at 2x | of nn.Conv2d's | at 4x | of nn.Conv2d's |"
    assert lines.count(header) == 3 and lines.count("| case | what | at 2x | at 4x |") == 3
    row = next(row for row in rows if row.subject == invariance.CONTINUOUS and row.verdict)
    line = next(line for line in lines if line.startswith(f"| {row.case} | {row.subject} |"))
    assert f"| {row.ratio:.2f} (≤ 0.25) |" in line
    pytest.importorskip("matplotlib")
    about = {"cpu": "c", "surfconv_cpu_capability": "s", "torch": "t", "commit": "0"}
    assert charts.draw(tmp_path, rows, about) == {"invariance": ["invariance.png"]}
    assert (tmp_path / "invariance.png").read_bytes().startswith(b"\x89PNG")
