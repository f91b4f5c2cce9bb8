"""Two results.json side by side: python benchmarks/compare.py OLD NEW"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from report import read_rows
from rows import Row
from tables import table

#: Facts without which times of two runs say nothing about a change of the code.
SAME_MACHINE = (
    *("cpu", "cores", "torch", "torch_cpu_capability", "surfconv_cpu_capability"),
    *("gpu", "driver", "cuda", "cudnn", "triton", "torchvision"),
)
SLOWER, FASTER, MORE, LESS, WITHIN = "SLOWER", "faster", "MORE", "less", ""


@dataclass(frozen=True)
class Change:
    """One row in both runs."""

    old: Row
    new: Row

    @property
    def ratio(self) -> float:
        return self.new.value / self.old.value if self.old.value else float("inf")

    @property
    def mark(self) -> str:
        """What happened, if the interquartile ranges do not overlap; else nothing."""
        timed = self.new.unit == "ms"
        if self.new.low > self.old.high:
            return SLOWER if timed else MORE
        if self.new.high < self.old.low:
            return FASTER if timed else LESS
        return WITHIN


def match(old: Sequence[Row], new: Sequence[Row]) -> list[Change]:
    """Rows that both runs have, in the order of the new one."""
    before = {row.key: row for row in old}
    return [Change(before[row.key], row) for row in new if row.key in before]


def render(
    old: tuple[dict[str, Any], Sequence[Row]], new: tuple[dict[str, Any], Sequence[Row]]
) -> str:
    """A Markdown table of new / old for every common row, with real changes marked."""
    changes = match(old[1], new[1])
    machines = old[0]["machine"], new[0]["machine"]
    lines = [
        "# New against old",
        "",
        *(
            f"- {name}: {m['commit']}, {m['time']}"
            for name, m in zip(("old", "new"), machines, strict=True)
        ),
    ]
    for fact in SAME_MACHINE:
        values = [machine.get(fact) for machine in machines]
        if values[0] != values[1]:
            lines.append(f"- **not the same {fact}**: {values[0]} and {values[1]}")
    if old[0].get("quick") != new[0].get("quick"):
        lines.append("- **one of the two is a --quick run**")
    counts = Counter(change.mark for change in changes)
    told = ", ".join(
        f"{counts[mark]} {mark}" for mark in (SLOWER, FASTER, MORE, LESS) if counts[mark]
    )
    lines += [
        "",
        f"{len(changes)} rows in both; {told or 'none'} beyond the interquartile ranges; "
        f"{len(old[1]) - len(changes)} only in old, {len(new[1]) - len(changes)} only in new. "
        "Where nn.Conv2d's own rows changed, the machine did: then the last two columns, each "
        "row's ratio to its baseline of the same run, tell more than the times.",
        "",
    ]
    header = ["case", "what", "direction", "layout", "depth", "dtype", "threads"]
    header += ["old", "new", "unit", "new / old", "changed", "its ratio, old", "new ratio"]
    for name in dict.fromkeys((change.new.suite, change.new.table) for change in changes):
        own = [change for change in changes if (change.new.suite, change.new.table) == name]
        cells = [
            (
                row.case,
                row.subject,
                row.direction,
                row.layout,
                row.depth,
                row.dtype,
                str(row.threads),
                f"{change.old.value:.3g}",
                f"{row.value:.3g}",
                row.unit,
                f"{change.ratio:.2f}",
                change.mark,
                *("" if each.ratio is None else f"{each.ratio:.2f}" for each in (change.old, row)),
            )
            for change in own
            for row in (change.new,)
        ]
        numbers = ("threads", "old", "new", "new / old", "its ratio, old", "new ratio")
        lines += [f"## {name[0]}: {name[1]}", "", *table(header, cells, numbers), ""]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Print the comparison of two files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("old", type=Path, help="an earlier results.json")
    parser.add_argument("new", type=Path, help="a later one")
    chosen = parser.parse_args(arguments)
    try:
        print(render(read_rows(chosen.old), read_rows(chosen.new)))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
