"""Measure SurfConv2d beside nn.Conv2d, the readable reference and nn.Conv3d.

    python benchmarks/run.py --out results           the full run
    python benchmarks/run.py --quick --out results   a short one that shows everything works

First a gate checks correctness at the timed shapes; if it fails, nothing is timed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import report
from cases import CANDIDATES, LAYOUTS, SHAPES, Shape
from gate import Check, gate
from suites import layers, memory


def _bar(total: int, title: str) -> tuple[Callable[[], None], Callable[[], None]]:
    """Advance and close functions of a progress bar; without tqdm, a line of text."""
    try:
        from tqdm import tqdm
    except ImportError:
        print(title, file=sys.stderr)
        return (lambda: None), (lambda: None)
    bar = tqdm(total=total, desc=title, dynamic_ncols=True)
    return (lambda: bar.update() and None), bar.close


def _count(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text!r}") from None
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {value}")
    return value


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="few rounds, smooth depth only")
    parser.add_argument(
        "--out", type=Path, default=Path("out/benchmark"), metavar="DIR",
        help="folder for results.json and results.md (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--threads", type=_count, nargs="+", default=[1, 2], metavar="N",
        help="thread counts (default: 1 2)",
    )  # fmt: skip
    parser.add_argument(
        "--shapes", nargs="+", choices=sorted(SHAPES), default=sorted(SHAPES),
        help="layers to time (default: all)",
    )  # fmt: skip
    parser.add_argument("--no-memory", action="store_true", help="leave the memory suite out")
    return parser.parse_args(arguments)


def _memory_rows(shapes: list[Shape], slices: int, quick: bool) -> list[memory.Row]:
    layouts = list(LAYOUTS)[:1] if quick else list(LAYOUTS)
    jobs = [
        (name, shape, layout, direction)
        for shape in shapes
        for layout in layouts
        for direction in ("forward", "backward")
        for name in (CANDIDATES[:2] if quick else layers.candidate_names(layout, True))
    ]
    tick, close = _bar(len(jobs), "memory")
    rows = []
    for name, shape, layout, direction in jobs:
        rows.append(memory.measure(name, shape, layout, direction, slices))
        tick()
    close()
    return rows


def main(arguments: list[str] | None = None) -> int:
    chosen = parse_arguments(arguments)
    plan = layers.QUICK if chosen.quick else layers.FULL
    shapes = [SHAPES[name] for name in chosen.shapes]
    threads = tuple(dict.fromkeys(chosen.threads))

    checks: list[Check] = []
    tick, close = _bar(len(shapes), "gate")
    for shape in shapes:
        checks += gate(shape, threads, chosen.quick)
        tick()
    close()
    layer_rows: list[layers.Row] = []
    memory_rows: list[memory.Row] = []
    green = all(check.passed for check in checks)
    if green:
        tick, close = _bar(layers.count_rounds(plan, shapes, threads), "layers")
        for shape in shapes:
            for count in threads:
                layer_rows += layers.measure(plan, shape, count, tick)
        close()
        if not chosen.no_memory:
            memory_rows = _memory_rows(shapes, plan.slices, chosen.quick)
    paths = report.write(
        chosen.out,
        plan=plan,
        checks=checks,
        layers=layer_rows,
        memory=memory_rows,
        quick=chosen.quick,
    )
    print(f"\nWrote {paths[0]} and {paths[1]}")
    if not green:
        for check in checks:
            if not check.passed:
                print(f"FAILED {check.what}: relative error {check.error:.2e}", file=sys.stderr)
        print("The gate is red: no speed is reported.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
