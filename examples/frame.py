"""Run SurfConv2d on one RGB-D frame beside nn.Conv2d and save a picture that explains it.

    python examples/frame.py                                   the built-in synthetic scene
    python examples/frame.py --rgb rgb.png --depth depth.png --depth-scale 0.001 --focal 525

Depth files are 16-bit counts. --depth-scale is metres per count: 0.001 where a count is a
millimetre, 1e-4 where it is a tenth of one, 90/65535 where 65535 stands for 90 m.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from frame_input import SATURATED, FrameError, load_frame
from frame_net import CLASSES, DrawnLayer, FrameNet, Measured, measure, with_depth
from frame_picture import Explained, save_picture
from frame_points import NAMES, Footprint, choose_points, snap
from surfconv_ops import depth_to_scale, fit_depth_levels
from surfconv_ops.cli.common import count, positive
from synthetic_scene import Frame, crate_centers, make_frame

SMALLEST_SIDE = 64


def _pixel(text: str) -> tuple[int, int]:
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise argparse.ArgumentTypeError(f"expected ROW,COLUMN, got {text!r}")
    return int(parts[0]), int(parts[1])


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read and check the command line; a wrong one ends the program with a message."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--rgb", type=Path, metavar="FILE", help="colour image; default: the synthetic scene")
    add("--depth", type=Path, metavar="FILE", help="16-bit depth image of the same size; 0 = hole")
    add("--depth-scale", type=positive, metavar="S", help="metres per count of --depth")
    add("--focal", type=positive, metavar="F", help="focal length in pixels")
    add(
        "--invalid-counts",
        type=int,
        nargs="*",
        default=[SATURATED],
        metavar="N",
        help=f"counts besides 0 that mean no depth (default: {SATURATED}, a saturated sensor; "
        "give the option without a number to keep every count)",
    )
    add(
        "--reference-depth",
        type=positive,
        metavar="M",
        help="depth in metres at which SurfConv2d is nn.Conv2d (default: the frame's median)",
    )
    add("--levels", type=count, default=4, metavar="N", help="depth levels (default: 4)")
    add(
        "--pixels",
        type=_pixel,
        nargs=3,
        metavar="ROW,COLUMN",
        help="a near, a middle and a far pixel to explain (default: chosen on flat surfaces)",
    )
    add("--rounds", type=count, default=9, metavar="N", help="timed steps per net (default: 9)")
    add("--threads", type=count, metavar="N", help="threads (default: torch's own choice)")
    add(
        "--out",
        type=Path,
        default=Path("out/surfconv_frame.png"),
        metavar="FILE",
        help="picture to write (default: %(default)s)",
    )
    chosen = parser.parse_args(arguments)
    given = [chosen.rgb, chosen.depth, chosen.depth_scale, chosen.focal]
    if any(value is not None for value in given) and any(value is None for value in given):
        parser.error(
            "--rgb, --depth, --depth-scale and --focal describe one frame: give all or none"
        )
    if chosen.out.suffix.lower() not in {".png", ".pdf", ".svg", ".jpg"}:
        parser.error(f"--out: expected a .png, .pdf, .svg or .jpg file, got {chosen.out}")
    return chosen


def _load(chosen: argparse.Namespace) -> Frame:
    if chosen.rgb is None:
        return make_frame()
    frame = load_frame(
        chosen.rgb,
        chosen.depth,
        depth_scale=chosen.depth_scale,
        focal=chosen.focal,
        invalid_counts=chosen.invalid_counts,
    )
    if min(frame.depth.shape) < SMALLEST_SIDE:
        height, width = frame.depth.shape
        raise FrameError(
            f"--rgb is {width} x {height} pixels; expected at least {SMALLEST_SIDE} a side, "
            "because the net's last layer works at an eighth of it"
        )
    return frame


def _points(
    chosen: argparse.Namespace, frame: Frame, reference_depth: float
) -> list[tuple[int, int]]:
    shape, layer = frame.depth.shape, DrawnLayer()
    if chosen.pixels is None:
        pixels = (
            crate_centers(frame)
            if chosen.rgb is None
            else choose_points(frame, reference_depth, layer)
        )
    else:
        pixels = chosen.pixels
        for row, column in pixels:
            if row >= shape[0] or column >= shape[1]:
                raise FrameError(
                    f"--pixels: {row},{column} is outside the frame of {shape[0]} rows and "
                    f"{shape[1]} columns"
                )
    return [snap(pixel, (shape[0], shape[1]), layer) for pixel in pixels]


def _footprints(
    frame: Frame, points: list[tuple[int, int]], scale: NDArray[np.float32]
) -> list[Footprint]:
    return [
        Footprint(
            row, column, float(frame.depth[row, column]), float(scale[row, column]), DrawnLayer()
        )
        for row, column in points
    ]


def _report(results: dict[str, Measured], rounds: int) -> None:
    plain = results["nn.Conv2d"].medians()
    print(f"\nOne step of the same net, median of {rounds} interleaved rounds:")
    print(f"  {'':<24}{'forward':>18}{'backward':>18}{'peak extra memory':>20}")
    for name, result in results.items():
        cells = [
            f"{1e3 * own:7.1f} ms {own / base:5.2f}x"
            for own, base in zip(result.medians(), plain, strict=True)
        ]
        memory = "not available" if result.extra_mib is None else f"{result.extra_mib:.0f} MiB"
        print(f"  {name:<24}{cells[0]:>18}{cells[1]:>18}{memory:>20}")
    finite = all(result.finite for result in results.values())
    print(f"Outputs and gradients finite: {'yes' if finite else 'NO'}")


def run(chosen: argparse.Namespace) -> None:
    """Load the frame, run the three nets, print what happened and save the picture."""
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    if chosen.threads is not None:
        torch.set_num_threads(chosen.threads)
    frame = _load(chosen)
    valid = frame.depth > 0
    reference_depth = chosen.reference_depth or float(np.median(frame.depth[valid]))
    levels = fit_depth_levels(frame.depth, chosen.levels, gamma=0.0)

    depth = torch.from_numpy(frame.depth)[None]
    image = torch.from_numpy(frame.rgb).permute(2, 0, 1)[None].float().div(255).contiguous()
    scale = depth_to_scale(depth, reference_depth)[0].numpy()
    level_scale = depth_to_scale(depth, reference_depth, levels=levels)[0].numpy()
    level = levels.assign(depth)[0].numpy()

    name = "synthetic scene" if chosen.rgb is None else chosen.rgb.name
    print(
        f"Frame: {name}, {frame.depth.shape[1]} x {frame.depth.shape[0]}, focal {frame.focal:g} px"
    )
    shown_depth = frame.depth[valid]
    print(
        f"Depth: {100 * valid.mean():.1f} % valid, {shown_depth.min():.2f} to "
        f"{shown_depth.max():.2f} m, reference depth {reference_depth:.2f} m"
    )
    low, high = np.quantile(scale[valid], (0.01, 0.99))
    print(
        f"Scale: {scale[valid].min():.2f} to {scale[valid].max():.2f} "
        f"(98 % of pixels: {low:.2f} to {high:.2f}), 1 in holes"
    )
    bounds = [shown_depth.min(), *levels.edges, shown_depth.max()]
    for number, center in enumerate(levels.centers):
        share = 100 * (level == number).sum() / valid.sum()
        print(
            f"Level {number}: {bounds[number]:.2f} to {bounds[number + 1]:.2f} m, all taken as "
            f"{center:.2f} m, scale {reference_depth / center:.2f}, {share:.0f} % of valid pixels"
        )

    torch.manual_seed(0)
    nets = {
        "nn.Conv2d": (plain := FrameNet()),
        "SurfConv2d continuous": with_depth(plain, reference_depth),
        f"SurfConv2d {len(levels)} levels": with_depth(plain, reference_depth, levels),
    }
    results = measure(nets, image, depth, chosen.rounds)
    shape = results["nn.Conv2d"].output_shape
    print(f"Net: {tuple(image.shape)} to {shape}, {CLASSES} classes, the same weights in all three")
    _report(results, chosen.rounds)

    points = _points(chosen, frame, reference_depth)
    save_picture(
        Explained(
            frame=frame,
            reference_depth=reference_depth,
            scale=np.where(valid, scale, np.nan),
            level=np.where(valid, level, np.nan).astype(np.float32),
            edges=list(levels.edges),
            centers=list(levels.centers),
            names=NAMES,
            conv2d=_footprints(frame, points, np.ones_like(scale)),
            continuous=_footprints(frame, points, scale),
            levels=_footprints(frame, points, level_scale),
        ),
        chosen.out,
    )
    print(f"\nPicture: {chosen.out}")


def main(arguments: list[str] | None = None) -> int:
    chosen = parse_arguments(arguments)
    try:
        run(chosen)
    except (FrameError, OSError) as error:
        print(f"frame.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
