"""Sets training runs beside the paper's table: mean and spread over seeds.

    python examples/kitti/table.py runs/*
    python examples/kitti/table.py runs/* --md table.md --csv table.csv --figure table.png

Runs that differ in nothing but their seed make one row. A run that has not ended is named below the
table and counted nowhere. All figures are percentages of the validation frames; `--at` chooses
between each run's best epoch (by what training selected on) and its last one.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from runs import (
    METRICS,
    SETTING_KEYS,
    Group,
    Run,
    RunError,
    Spread,
    baseline_of,
    group_runs,
    load_run,
    short,
    varying_keys,
)

NAMES = {"acc_img": "Acc_img", "iou_img": "IOU_img", "acc_surf": "Acc_surf", "iou_surf": "IOU_surf"}
#: Chu et al., "SurfConv", CVPR 2018, Table 2, KITTI's best setting: percent on its 37 test frames.
PAPER: tuple[tuple[str, dict[str, float]], ...] = (
    ("the paper, single level", {"iou_surf": 26.56}),
    ("the paper, 4 levels", {"iou_surf": 30.65}),
)
NOTHING = "–"


def _cell(spread: Spread | None, sign: bool = False) -> str:
    if spread is None:
        return NOTHING
    values = [100 * value for value in spread.values]
    mean = f"{100 * spread.mean:{'+' if sign else ''}.2f}"
    if spread.std is None:
        return mean
    return f"{mean} ± {100 * spread.std:.2f} ({min(values):.2f} to {max(values):.2f})"


def _other(group: Group, keys: Sequence[str]) -> str:
    parts = [f"{key}={short(group.setting[key])}" for key in keys if key in group.setting]
    return ", ".join(parts) or NOTHING


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [_row(head), "|" + "---|" * len(head), *(_row(row) for row in rows)]


def _progress(run: Run) -> str:
    return f"{run.epochs_done} of {run.config.get('epochs', '?')}"


def markdown(groups: Sequence[Group], at: str) -> str:
    """The table of settings, the paper's rows, and the runs that have not ended.

    Args:
        groups: settings with their runs.
        at: 'best' or 'last': the epoch of each run to report.
    """
    shown = [group for group in groups if group.finished]
    others = [key for key in varying_keys(shown) if key not in SETTING_KEYS]
    head = [key.replace("_", " ") for key in SETTING_KEYS]
    head += ["other settings"] if others else []
    head += ["parameters", "seeds", *NAMES.values(), "IOU_surf over conv2d", "minutes a run"]
    rows = []
    for group in shown:
        runs = group.finished
        cells = [short(group.setting.get(key)) for key in SETTING_KEYS]
        cells += [_other(group, others)] if others else []
        cells.append(short(runs[0].config.get("parameters")))
        cells.append(f"{len(runs)} ({', '.join(run.seed for run in runs)})")
        cells += [_cell(group.spread(metric, at)) for metric in METRICS]
        baseline = baseline_of(group, groups)
        gain = group.gain(baseline, "iou_surf", at) if baseline else None
        cells.append(_cell(gain, sign=True))
        minutes = [run.minutes for run in runs if run.minutes is not None]
        cells.append(f"{sum(minutes) / len(minutes):.1f}" if minutes else NOTHING)
        rows.append(cells)
    for name, figures in PAPER:
        cells = [name, *[""] * (len(SETTING_KEYS) - 1 + bool(others)), "", ""]
        cells += [f"{figures[m]:.2f}" if m in figures else NOTHING for m in METRICS]
        more = figures["iou_surf"] - PAPER[0][1]["iou_surf"]
        rows.append([*cells, f"{more:+.2f}" if more else NOTHING, NOTHING])
    text = [
        f"Percent at each run's {at} epoch: mean ± standard deviation (least to greatest) over "
        "seeds. The gain over conv2d is taken seed by seed, against runs trained in the same "
        "way. The paper's rows are for its 37 test frames and its best setting on KITTI (Table 2).",
        "",
        *_table(head, rows),
    ]
    unfinished = [run for group in groups for run in group.runs if not run.finished]
    if unfinished:
        listed = []
        for run in unfinished:
            best = run.value("iou_surf", "best")
            figure = NOTHING if best is None else f"{100 * best:.2f}"
            mode = short(run.config.get("mode"))
            listed.append([str(run.folder), mode, run.seed, _progress(run), figure])
        text += ["", "Unfinished or incomplete, counted nowhere above:", ""]
        text += _table(("run", "mode", "seed", "epochs", "best IOU_surf so far"), listed)
    return "\n".join(text) + "\n"


def write_csv(groups: Sequence[Group], at: str, path: Path) -> None:
    """One line per setting: its keys, the seeds, and mean, std, min and max of each metric."""
    keys = list(dict.fromkeys((*SETTING_KEYS, *(k for group in groups for k in group.setting))))
    statistics = [f"{m}_{s}" for m in METRICS for s in ("mean", "std", "min", "max")]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*keys, "at", "seeds", *statistics], restval="")
        writer.writeheader()
        for group in groups:
            if not group.finished:
                continue
            line: dict[str, Any] = {k: short(v) for k, v in group.setting.items()}
            line |= {"at": at, "seeds": " ".join(run.seed for run in group.finished)}
            for metric in METRICS:
                spread = group.spread(metric, at)
                if spread is not None:
                    values = (spread.mean, spread.std, min(spread.values), max(spread.values))
                    names = (f"{metric}_{s}" for s in ("mean", "std", "min", "max"))
                    line |= dict(zip(names, values, strict=True))
            writer.writerow(line)


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("runs", type=Path, nargs="+", metavar="RUN", help="folder that train.py wrote")
    add("--at", choices=("best", "last"), default="best", help="epoch to report (default: best)")
    add("--ignore", nargs="*", default=[], metavar="KEY", help="settings that make no difference")
    add("--md", type=Path, metavar="FILE", help="write the Markdown here as well")
    add("--csv", type=Path, metavar="FILE", help="write the figures as CSV (fractions)")
    add("--figure", type=Path, metavar="FILE", help="draw seeds and validation curves")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    chosen = parse_arguments(arguments)
    try:
        groups = group_runs([load_run(folder) for folder in chosen.runs], chosen.ignore)
        text = markdown(groups, chosen.at)
        print(text, end="")
        for path in (chosen.md, chosen.csv, chosen.figure):
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
        if chosen.md is not None:
            chosen.md.write_text(text)
        if chosen.csv is not None:
            write_csv(groups, chosen.at, chosen.csv)
        if chosen.figure is not None:
            from table_figure import save_figure

            save_figure(groups, chosen.at, chosen.figure)
    except (RunError, OSError) as error:
        print(f"table.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
