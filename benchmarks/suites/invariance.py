"""How much features change with distance, before training: the property the operator exists for.

Expected, and written down before anything was measured. On a surface that faces the camera the taps
of continuous mode fall on the same surface points from any distance, so that only two things
change: the pixel's own footprint, which grows and blurs, and bilinear interpolation, which blurs
where taps fall between pixels. Both are small while the texture is coarse against tap spacing and
pixel (a wave of 8 pixels loses about a tenth, one of 4 pixels half) and everything is lost at 2
pixels. Where taps are farther apart than pixels, they sample a sharper texture than the distant
pixel averages, so that what is finer than two tap spacings aliases. A level is off by up to half
its width, a factor of 1.3 with 4 levels and 1.14 with 8 here. nn.Conv2d's taps cover 4 times the
surface from 4 times the distance: it changes unless the texture is flat over the larger window too.
A slanted surface adds the error of local planarity, and a step in depth adds parallax.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import median
from typing import Any

import torch

import targets
from candidates import BASELINE, CONTINUOUS, LEVELS, WINDOW
from features import (
    Matches,
    Net,
    changes,
    convert,
    correlation,
    equal_log_levels,
    features,
    match,
    read,
)
from plan import Plan
from rows import Row, judge
from scene import Camera, Facet, View, box, make_waves, render, slant, wall
from suites.job import Job, Suite
from timing import quartiles, thread_count

#: What is left if taps read the surface itself and each view keeps its pixels' blur alone.
LIMIT = "perfect interpolation"
EIGHT_LEVELS = "SurfConv2d 8 levels"
SUBJECTS = (BASELINE, LEVELS, EIGHT_LEVELS, CONTINUOUS)
LEVEL_COUNTS = {LEVELS: 4, EIGHT_LEVELS: 8}

#: Metres from the nearest camera to the middle of the scene, and the views' distances in these.
DISTANCE = 2.0
DISTANCES = (1, 2, 4)
#: Focal length in pixels of a view of SIZE x SIZE; a smaller view has the same field of view.
SIZE, FOCAL = 128, 128.0
LEAST_SIZE = 64
MIDDLE = 2 * DISTANCE
REFERENCES = {"1x": DISTANCE, "2x": MIDDLE, "4x": 4 * DISTANCE}
#: Wavelengths in spacings of a layer's taps with its reference depth at 2x.
OCTAVES = (64.0, 32.0, 16.0, 8.0, 4.0, 2.0)
SLOPE = 0.75
SEEDS, QUICK_SEEDS = 4, 2

WALL, SLANT, BOXES = "wall", "slanted wall", "boxes"
TEXTURES = {"coarse octaves": OCTAVES[:3], "all octaves": OCTAVES}
NET = Net("3x3")
NETS = (
    Net("3x3, zero-sum filters", zero_sum=True),
    Net("5x5", kernel=5),
    Net("7x7, stride 2", kernel=7, stride=2),
    Net("three layers 3x3", layers=3),
)
CHANGE, CORRELATION = "spreads", "correlation"


@dataclass(frozen=True)
class Case:
    """One line of a table.

    Attributes:
        table: where it stands.
        name: what it says there.
        scene: what is looked at.
        wavelengths: of the texture, in tap spacings; one, or `OCTAVES`.
        net: the layers.
        reference: where reference_depth is, a key of `REFERENCES`.
        across: compares the points next to steps in depth, not those on one facet alone.
    """

    table: str
    name: str
    scene: str = WALL
    wavelengths: tuple[float, ...] = OCTAVES
    net: Net = NET
    reference: str = "2x"
    across: bool = False

    @property
    def coarse(self) -> bool:
        """Held against the target: a wall and a texture that pixels and taps resolve."""
        return self.scene == WALL and min(self.wavelengths) >= targets.COARSE_TAPS


def scene_of(name: str) -> list[Facet]:
    """The facets of a scene, DISTANCE metres from the nearest camera."""
    if name == WALL:
        return wall(DISTANCE)
    if name == SLANT:
        return slant(DISTANCE, SLOPE)
    behind = 2.6
    corners = (
        ((-0.68, -0.64, 1.6), (-0.08, -0.08)),
        ((0.10, -0.76, 2.2), (0.74, -0.16)),
        ((-0.66, 0.12, 2.0), (-0.06, 0.72)),
        ((0.12, 0.04, 1.7), (0.66, 0.62)),
    )
    boxes = [box(low, (*high, behind)) for low, high in corners]
    return [*wall(behind), *(facet for facets in boxes for facet in facets)]


def size_of(plan: Plan) -> int:
    """Rows and columns of a plan's views."""
    return max(LEAST_SIZE, SIZE // ((2 if plan.quick else 1) * plan.shrink))


@lru_cache(maxsize=64)
def view_of(
    scene: str, wavelengths: tuple[float, ...], size: int, times: int, footprint: float = 1.0
) -> View:
    """A scene from `times` the distance."""
    focal = FOCAL * size / SIZE
    texture = make_waves([taps * MIDDLE / focal for taps in wavelengths], seed=1)
    return render(scene_of(scene), texture, Camera(size, focal, (times - 1) * DISTANCE), footprint)


def views_of(scene: str, wavelengths: tuple[float, ...], size: int) -> list[View]:
    """A scene from every distance, nearest first."""
    return [view_of(scene, wavelengths, size, times) for times in DISTANCES]


def options_of(subject: str, case: Case, focal: float, shift: float) -> dict[str, Any]:
    """SurfConv2d's depth arguments."""
    reference = REFERENCES[case.reference]
    options: dict[str, Any] = {"reference_depth": reference}
    if subject in LEVEL_COUNTS:
        options["levels"] = equal_log_levels(LEVEL_COUNTS[subject], MIDDLE, shift)
    if subject == WINDOW:
        # The third side of the cube (Eq. 4): as deep as the kernel is wide.
        options["depth_window"] = case.net.kernel * reference / (2 * focal)
    return options


def cases_of(quick: bool) -> list[Case]:
    """Every line of every table."""
    scenes = []
    for name, octaves in TEXTURES.items():
        scenes += [Case("scenes", f"{scene}, {name}", scene, octaves) for scene in (WALL, SLANT)]
        for where, across in (("inside faces", False), ("across steps", True)):
            text = f"{BOXES} {where}, {name}"
            scenes.append(Case("scenes", text, BOXES, octaves, across=across))
    waves = OCTAVES[1::2] if quick else OCTAVES[1:]
    textures = [Case("texture", f"wavelength {taps:g} taps", WALL, (taps,)) for taps in waves]
    places = [Case("reference depth", f"at {at}", reference=at) for at in REFERENCES]
    nets = [Case("layers", net.name, net=net) for net in (NET, *NETS)]
    return [*scenes, *textures, *([] if quick else places), *(nets[-1:] if quick else nets)]


def subjects_of(case: Case) -> tuple[str, ...]:
    """What a case compares."""
    more = {WALL: (LIMIT,), BOXES: (WINDOW,)}
    return (*SUBJECTS, *more.get(case.scene, ()))


def jobs(plan: Plan) -> list[Job]:
    """One job a case; nothing is timed, so that no job looks at its seconds."""

    def job(case: Case) -> Job:
        return Job(
            f"{case.table}: {case.name}",
            1.0 + case.net.layers,
            lambda _: measure(case, size_of(plan), QUICK_SEEDS if plan.quick else SEEDS),
        )

    return [job(case) for case in cases_of(plan.quick)]


def responses(
    subject: str, case: Case, views: Sequence[View], points: Matches, seed: int, seeds: int
) -> list[torch.Tensor]:
    """Features (FILTERS, points) in every view."""
    convs: Any = case.net.convolutions(seed)
    positions = points.positions
    if subject == LIMIT:
        # From its reference depth a plain layer's taps are those of continuous mode from anywhere.
        place = list(REFERENCES).index(case.reference)
        at, size = DISTANCES[place], views[0].camera.size
        views = [view_of(case.scene, case.wavelengths, size, at, times / at) for times in DISTANCES]
        positions = [positions[place]] * len(views)
    elif subject != BASELINE:
        # Else the figure would depend on how far from a level's middle the distances happen to be.
        shift = (seed + 0.5) / seeds - 0.5
        convs = convert(convs, **options_of(subject, case, views[0].camera.focal, shift))
    return [
        read(features(convs, view), at / case.net.stride)
        for view, at in zip(views, positions, strict=True)
    ]


def points_of(case: Case, views: Sequence[View]) -> Matches:
    """The surface points that a case compares."""
    net = case.net
    points = match(views, net.reach, net.stride, REFERENCES[case.reference])
    chosen = points.inside != case.across
    return Matches([at[chosen] for at in points.positions], chosen[chosen])


def measure(case: Case, size: int, seeds: int) -> list[Row]:
    """Changes and correlations of every subject at every distance but the first."""
    rows: list[Row] = []
    with thread_count(1):
        views = views_of(case.scene, case.wavelengths, size)
        points = points_of(case, views)
        base: dict[int, list[float]] = {}
        for subject in subjects_of(case):
            found = [responses(subject, case, views, points, seed, seeds) for seed in range(seeds)]
            for number, times in enumerate(DISTANCES[1:], 1):
                moved = [changes(each[0], each[number]) for each in found]
                alike = [correlation(each[0], each[number]) for each in found]
                each_seed = [float(values.median()) for values in moved]
                base.setdefault(times, each_seed)
                rows += _rows(case, subject, times, torch.cat(moved), alike, each_seed, base[times])
    return sorted(rows, key=lambda row: row.table)


def _rows(
    case: Case,
    subject: str,
    times: int,
    moved: torch.Tensor,
    alike: list[float],
    each_seed: list[float],
    base: list[float],
) -> list[Row]:
    ratios = [own / other for own, other in zip(each_seed, base, strict=True)]
    plain = subject == BASELINE
    ratio = None if plain else median(ratios)
    low, high = quartiles(ratios)
    target = targets.INVARIANCE if subject == CONTINUOUS and case.coarse else None
    parts = [float(part) for part in moved.quantile(torch.tensor((0.25, 0.5, 0.75)).double())]
    where = {"case": case.name, "subject": subject, "direction": "forward", "depth": f"{times}x"}
    change = Row(
        "invariance",
        f"{case.table}: change",
        **where,
        unit=CHANGE,
        value=parts[1],
        low=parts[0],
        high=parts[2],
        samples=len(moved),
        baseline="" if plain else BASELINE,
        ratio=ratio,
        ratio_low=None if plain else low,
        ratio_high=None if plain else high,
        **judge(ratio, target),
    )
    low, high = quartiles(alike)
    together = Row(
        "invariance",
        f"{case.table}: correlation",
        **where,
        unit=CORRELATION,
        value=median(alike),
        low=low,
        high=high,
        samples=len(alike),
    )
    return [change, together]


SUITE = Suite(
    "invariance",
    "How features change with distance, before training",
    "A camera moves back from 2 m to 4 m and 8 m (1x, 2x, 4x). Features of untrained layers, "
    "random weights alike, are compared at the same surface points, away from the views' borders. "
    "Change: |f_s(p) - f_1(p)| over the standard deviation of f_1 over the surface, norms over 16 "
    "filters, median and quartiles over points and seeds; 0 is the same feature, about 1.41 one "
    "that has nothing to do with it. Correlation: of f_s and f_1 over points and filters. "
    "Reference depth is at 2x unless the case says otherwise; tap spacings are those of such a "
    "layer. Textures are sums of waves: one wavelength, coarse octaves (16, 32, 64 taps) or all "
    "octaves (2 to 64), of which no pixel at 4x can hold the finest. *Perfect interpolation* is "
    "what a layer would do that read the surface itself under each view's pixel blur. Levels are "
    "equally wide in log depth, a factor of 8 in all, shifted from seed to seed. Expected before "
    "it was measured: next to no change in continuous mode where texture is coarse against taps "
    "and pixels, some in levels mode (half a level), much in nn.Conv2d; all fail on texture finer "
    "than the distant pixel.",
    jobs,
    pivot="distances",
    method="The invariance suite times nothing: it renders views (benchmarks/scene.py) and "
    "compares features at the same surface points (benchmarks/features.py), with figures that "
    "every run repeats but for rounding: `python benchmarks/run.py --suites invariance`.",
)
