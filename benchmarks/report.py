"""Write what was measured: JSON with everything, Markdown with the tables a reader wants."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path

import torch

import surfconv_ops
from cases import BASELINE, CONV3D, SURF_NAMES
from gate import TOLERANCE, Check
from suites.layers import Plan
from suites.layers import Row as LayerRow
from suites.memory import HOW
from suites.memory import Row as MemoryRow


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _commit() -> str:
    """The commit of the checkout, with + where files differ from it; 'unknown' outside one."""
    root = Path(__file__).parents[1]

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    try:
        return git("rev-parse", "--short=12", "HEAD") + (
            "+" if git("status", "--porcelain") else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def environment() -> dict[str, object]:
    """The machine and the software that a result belongs to."""
    try:
        capability = str(torch.ops.surfconv.cpu_capability())
    except (AttributeError, RuntimeError):
        capability = "no compiled operator"
    return {
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torch_cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "surfconv_ops": getattr(surfconv_ops, "__version__", "unknown"),
        "surfconv_cpu_capability": capability,
        "commit": _commit(),
        "command": " ".join(["python", *sys.argv]),
    }


def _layer_tables(rows: Sequence[LayerRow], plan: Plan) -> list[str]:
    lines = []
    keys = dict.fromkeys((row.shape, row.threads, row.direction, row.depth) for row in rows)
    for shape, threads, direction, depth in keys:
        chosen = [
            row
            for row in rows
            if (row.shape, row.threads, row.direction, row.depth)
            == (shape, threads, direction, depth)
        ]
        plural = "thread" if threads == 1 else "threads"
        lines += [
            f"### {shape}, {direction}, {threads} {plural}, {depth} depth",
            "",
            "| layer | layout | median ms | quartiles ms | runs | x nn.Conv2d, same layout "
            "| x nn.Conv2d, its faster layout |",
            "|---|---|---:|---:|---:|---:|---:|",
        ]
        for row in chosen:
            note = f" ({plan.slices} depth slices)" if row.candidate == CONV3D else ""
            lines.append(
                f"| {row.candidate}{note} | {row.layout} | {row.median_ms:.2f} "
                f"| {row.low_ms:.2f} .. {row.high_ms:.2f} | {row.samples} | {row.ratio:.2f} "
                f"| {row.fastest_ratio:.2f} |"
            )
        lines.append("")
    return lines


def _summary(rows: Sequence[LayerRow]) -> list[str]:
    """Ratios only: one line a shape, thread count and layout."""
    lines = [
        "| shape | threads | layout | depth | mode | forward | backward |",
        "|---|---:|---|---|---|---:|---:|",
    ]
    forward = [row for row in rows if row.direction == "forward" and row.candidate in SURF_NAMES]
    for row in forward:
        pair = [
            other
            for other in rows
            if other.direction == "backward"
            and (other.shape, other.threads, other.layout, other.depth, other.candidate)
            == (row.shape, row.threads, row.layout, row.depth, row.candidate)
        ]
        backward = f"{pair[0].fastest_ratio:.2f}x" if pair else "not run"
        mode = row.candidate.removeprefix("SurfConv2d ")
        lines.append(
            f"| {row.shape} | {row.threads} | {row.layout} | {row.depth} | {mode} "
            f"| {row.ratio:.2f}x | {backward} |"
        )
    return lines


def _memory_table(rows: Sequence[MemoryRow], plan: Plan) -> list[str]:
    methods = dict.fromkeys(row.method for row in rows)
    lines = ["## Peak extra memory of one call", ""]
    how = "; ".join(HOW[method] for method in methods)
    lines += [
        f"Measured in a fresh process for each call, 1 thread: {how}. Outputs and gradients are "
        "included; backward means forward and backward together.",
        "",
        "| shape | layer | layout | direction | MiB | x nn.Conv2d |",
        "|---|---|---|---|---:|---:|",
    ]
    plain = {
        (row.shape, row.layout, row.direction): row.extra_mib
        for row in rows
        if row.candidate == BASELINE
    }
    for row in rows:
        base = plain[row.shape, row.layout, row.direction]
        ratio = f"{row.extra_mib / base:.2f}" if base > 0 else "n/a"
        note = f" ({plan.slices} depth slices)" if row.candidate == CONV3D else ""
        lines.append(
            f"| {row.shape} | {row.candidate}{note} | {row.layout} | {row.direction} "
            f"| {row.extra_mib:.1f} | {ratio} |"
        )
    return [*lines, ""]


def write(
    folder: Path,
    *,
    plan: Plan,
    checks: Sequence[Check],
    layers: Sequence[LayerRow],
    memory: Sequence[MemoryRow],
    quick: bool,
) -> tuple[Path, Path]:
    """Write results.json and results.md into the folder and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    about = environment()
    data = {
        "environment": about,
        "quick": quick,
        "plan": asdict(plan),
        "gate": [{**asdict(check), "passed": check.passed} for check in checks],
        "layers": [asdict(row) for row in layers],
        "memory": [asdict(row) for row in memory],
    }
    json_path, markdown_path = folder / "results.json", folder / "results.md"
    json_path.write_text(json.dumps(data, indent=1) + "\n")
    worst = max(check.error for check in checks)
    green = all(check.passed for check in checks)
    lines = ["# surfconv_ops benchmark", ""]
    if quick:
        lines += ["**A --quick run: it shows that everything works; its times are rough.**", ""]
    lines += [f"- {key.replace('_', ' ')}: {value}" for key, value in about.items()]
    lines += [
        "",
        f"Gate: {len(checks)} checks at the timed shapes, "
        f"{'all passed' if green else 'FAILED'}; largest relative RMS error {worst:.1e}, "
        f"allowed {TOLERANCE:.0e}.",
        "",
    ]
    if not green:
        lines += [f"- {check.what}: {check.error:.2e}" for check in checks if not check.passed]
        lines += ["", "No speed is reported.", ""]
    else:
        lines += [
            "## Price of SurfConv2d, in times of nn.Conv2d",
            "",
            "3 x 3, stride 1, padding 1, float32. Ratios of medians of interleaved runs. Forward: "
            "the layer from depth to output against nn.Conv2d in the same layout. Backward: "
            "gradients of input, weight, bias and depth against nn.Conv2d's three in its faster "
            "layout.",
            "",
            *_summary(layers),
            "",
            "## Times",
            "",
            *_layer_tables(layers, plan),
            *(_memory_table(memory, plan) if memory else []),
        ]
    markdown_path.write_text("\n".join(lines))
    return json_path, markdown_path
