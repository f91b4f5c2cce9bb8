"""``levels``: depth levels of equal importance for the depth files of a data set."""

from __future__ import annotations

import argparse
import functools
import math
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..d4 import D4
from ..depth_table import DepthTable, row_importance
from ..levels import DepthLevels
from .common import CommandError, count, counted, finite, need, positive
from .depth_files import find_files, read_counts, to_metres

DESCRIPTION = """\
Fit depth levels of equal importance z^gamma to the depth files of a data set (D4, Chu et al.,
SurfConv, CVPR 2018, section 3.3). Prints the levels, draws the histogram of depth with their
bands, and writes them as JSON for surfconv_ops.DepthLevels.load. One file is in memory at a time.
"""
EXAMPLES = """\
units:
  --unit is the depth in metres that one count of a file stands for: 0.001 where a count is a
  millimetre, 1/5000 for TUM RGB-D, 1/256 for KITTI's depth maps, 90/65535 where 65535 stands
  for 90 m, 1 for .npy and .npz files of metres. Counts of 0 are holes and count for nothing.

examples:
  python -m surfconv_ops levels 'data/depth/*.png' --unit 0.001
  python -m surfconv_ops levels 'kitti/depth/*.png' --unit 90/65535 --levels 4 --gamma 1
  python -m surfconv_ops levels 'scans/**/*.npy' --unit 1 --max-depth 10 --gamma 2 --out near.json

then, in Python:
  levels = surfconv_ops.DepthLevels.load('levels.json')
"""
PICTURES = {".png", ".pdf", ".svg", ".jpg"}
# A count that many 16-bit sensors give where they are saturated.
SATURATED = 65535
# Medians beyond these (in metres) are more likely a mistaken unit than a scene.
PLAUSIBLE = (0.01, 1000.0)


class Summary(NamedTuple):
    """The levels of a data set, and what they hold of it."""

    levels: DepthLevels
    table: DepthTable
    exact: bool
    files: int
    pixels: int
    median: float
    reference_depth: float
    reference_is_median: bool
    pixel_shares: list[float]
    importance_shares: list[float]

    @property
    def valid_pixels(self) -> int:
        return int(self.table.pixels.sum())

    @property
    def bounds(self) -> list[float]:
        """The N+1 ends of the levels, in metres: the smallest depth, the edges, the largest."""
        return [float(self.table.low[0]), *self.levels.edges, float(self.table.high[-1])]

    @property
    def scales(self) -> list[float]:
        return [self.reference_depth / center for center in self.levels.centers]


def add_parser(commands: argparse._SubParsersAction[Any]) -> None:
    """Add the command to the command line."""
    parser = commands.add_parser(
        "levels",
        help="fit depth levels to the depth files of a data set",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "files",
        nargs="+",
        metavar="GLOB",
        help="16-bit depth images, .npy or .npz files: names, or patterns in quotes",
    )
    add("--unit", type=positive, metavar="METRES_PER_COUNT", help="required; see below")
    add("--levels", type=count, default=4, metavar="N", help="number of levels (default: 4)")
    add(
        "--gamma",
        type=finite,
        default=1.0,
        metavar="G",
        help="importance of a pixel is depth^G: 0 for equal numbers of pixels in the levels, 2 for "
        "equal surface area (default: 1)",
    )
    add(
        "--reference-depth",
        type=positive,
        metavar="METRES",
        help="depth of scale 1, for the scales printed (default: the median of the valid pixels, "
        "so that half of them are nearer and half farther)",
    )
    add("--max-depth", type=positive, metavar="METRES", help="count larger depths as holes")
    add(
        "--invalid-counts",
        type=int,
        nargs="+",
        default=[],
        metavar="COUNT",
        help=f"counts besides 0 that mean no depth, such as {SATURATED}",
    )
    add(
        "--out",
        type=Path,
        default=Path("levels.json"),
        metavar="FILE",
        help="levels to write (default: %(default)s)",
    )
    add(
        "--plot",
        type=Path,
        default=Path("levels.png"),
        metavar="FILE",
        help="picture to write (default: %(default)s)",
    )
    add("--no-plot", action="store_true", help="write no picture")
    parser.set_defaults(run=run, command="levels", parser=parser)


def run(chosen: argparse.Namespace) -> None:
    """Do what the arguments say."""
    parser = chosen.parser
    if chosen.unit is None:
        parser.error(
            "--unit is missing: how many metres one count stands for, such as 0.001 where a count"
            " is a millimetre (--help lists others)"
        )
    if not chosen.no_plot and chosen.plot.suffix.lower() not in PICTURES:
        parser.error(f"--plot: expected a file ending in {', '.join(sorted(PICTURES))}, got"
                     f" {chosen.plot}")  # fmt: skip
    files = find_files(chosen.files)
    if not chosen.no_plot:
        # Known before hours of reading.
        need("matplotlib", "matplotlib")
    for path in [chosen.out] if chosen.no_plot else [chosen.out, chosen.plot]:
        _make_folder(path)
    summary = summarise(chosen, files)
    print(describe(summary))
    _write(chosen.out, summary.levels.save)
    written = [str(chosen.out)]
    if not chosen.no_plot:
        from .levels_picture import draw_picture

        _write(chosen.plot, functools.partial(draw_picture(summary).savefig, dpi=130))
        written.append(str(chosen.plot))
    print(f"\nWrote {' and '.join(written)}")


def summarise(chosen: argparse.Namespace, files: list[Path]) -> Summary:
    """Read the files and fit the levels."""
    tqdm = need("tqdm", "tqdm").tqdm
    d4 = D4(chosen.levels, chosen.gamma)
    saturated = 0
    for path in tqdm(files, desc="Reading depth", unit="file"):
        counts = read_counts(path)
        metres = to_metres(counts, chosen.unit, chosen.invalid_counts, chosen.max_depth)
        saturated += int(np.count_nonzero((counts == SATURATED) & (metres > 0)))
        d4.update(metres)
    if not d4.valid_pixels:
        raise CommandError(
            f"no valid depth in {counted(len(files), 'file')}: every pixel of {d4.pixels:,} is 0,"
            " negative, not finite, one of --invalid-counts, or beyond --max-depth"
        )
    if saturated > 0.001 * d4.valid_pixels:
        _note(
            f"{saturated / d4.valid_pixels:.1%} of the valid pixels have the count {SATURATED}; if"
            f" that is a saturated sensor, leave them out with --invalid-counts {SATURATED}"
        )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        levels = d4.fit()
    for warning in caught:
        _note(str(warning.message))
    table = d4.table
    level = levels.assign(torch.from_numpy(table.high)).numpy()
    median = _median(table)
    if not PLAUSIBLE[0] < median < PLAUSIBLE[1]:
        _note(f"the median depth is {median:.4g} m; is --unit {chosen.unit:.4g} right?")
    return Summary(
        levels=levels,
        table=table,
        exact=d4.exact,
        files=len(files),
        pixels=d4.pixels,
        median=median,
        reference_depth=chosen.reference_depth or median,
        reference_is_median=chosen.reference_depth is None,
        pixel_shares=_shares(level, table.pixels),
        importance_shares=_shares(level, row_importance(table, chosen.gamma)),
    )


def describe(summary: Summary) -> str:
    """The levels as text."""
    bounds = summary.bounds
    digits = max(3, 2 - math.floor(math.log10(bounds[0])))
    texts = [f"{bound:.{digits}f}" for bound in bounds]
    widths = max(map(len, texts))
    origin = "median of the valid pixels" if summary.reference_is_median else "--reference-depth"
    how = "exact" if summary.exact else "from bins: edges at most 0.025 % above the exact ones"
    valid = summary.valid_pixels / summary.pixels
    lines = [
        f"{counted(summary.files, 'file')}, {counted(summary.pixels, 'pixel')}: {valid:.1%} valid,"
        f" {texts[0]} to {texts[-1]} m, median {summary.median:.{digits}f} m",
        f"{counted(len(summary.levels), 'level')} of equal importance"
        f" depth^{summary.levels.gamma:g} ({how})",
        f"Scale 1 at {summary.reference_depth:.{digits}f} m ({origin})",
        "",
        f"{'level':<7}{'range (m)':^{2 * widths + 3}}  {'centre (m)':>10}  {'pixels':>8}"
        f"  {'importance':>10}  {'scale':>7}",
    ]
    for k, center in enumerate(summary.levels.centers):
        lines.append(
            f"{k:<7}{texts[k]:>{widths}} - {texts[k + 1]:>{widths}}  {center:>10.{digits}f}"
            f"  {summary.pixel_shares[k]:>8.1%}  {summary.importance_shares[k]:>10.1%}"
            f"  {summary.scales[k]:>7.3f}"
        )
    return "\n".join(lines)


def _median(table: DepthTable) -> float:
    """The smallest depth that at least half of the pixels do not exceed."""
    below = np.cumsum(table.pixels)
    return float(table.high[np.searchsorted(2 * below, below[-1])])


def _shares(level: np.ndarray[Any, Any], weight: np.ndarray[Any, Any]) -> list[float]:
    sums = np.bincount(level, weight)
    shares: list[float] = (sums / sums.sum()).tolist()
    return shares


def _make_folder(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CommandError(f"cannot make the folder of {path}: {error}") from error


def _write(path: Path, save: Callable[[Path], object]) -> None:
    try:
        save(path)
    except OSError as error:
        raise CommandError(f"cannot write {path}: {error}") from error


def _note(text: str) -> None:
    print(f"note: {text}", file=sys.stderr)
