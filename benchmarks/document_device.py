"""What results.md shows of a device: its targets one by one, and everything beside everything."""

from __future__ import annotations

from collections.abc import Sequence

from candidates import BASELINE
from frames import RANDOM
from rows import Row
from suites.series import LAYOUT, OWN_LAYOUTS
from tables import MISSED, number, table


def series_name(row: Row) -> str:
    """Subject, random depth, and the layout where it is not the one that all have."""
    parts = [row.subject]
    if row.depth == RANDOM:
        parts.append("random depth")
    if row.layout != OWN_LAYOUTS.get(row.subject, LAYOUT):
        parts.append(row.layout)
    return ", ".join(parts)


def by_target(rows: Sequence[Row]) -> list[str]:
    """Wins and losses: one line for every limit and what it holds for, with the best and worst."""
    groups: dict[tuple[str, str, str, str], list[Row]] = {}
    for row in rows:
        if row.verdict:
            base = row.baseline.split(", channels_last")[0]
            measured = "time" if row.unit == "ms" else "peak memory"
            limit = f"{row.target_sense} {row.target:g} x {base}'s {measured}"
            place = (row.suite, series_name(row), row.direction, limit)
            groups.setdefault(place, []).append(row)
    header = ("suite", "what", "direction", "target", "met", "missed", "best", "worst")
    lines = []
    for place, own in groups.items():
        leads = own[0].target_sense == "at least"
        ordered = sorted(own, key=lambda row: row.ratio or 0.0, reverse=leads)
        missed = sum(row.verdict == "missed" for row in own)
        ends = [
            f"{row.ratio:.2f} ({row.case.split(' ')[0].rstrip(',')}, {row.dtype})"
            for row in (ordered[0], ordered[-1])
        ]
        told = f"**{missed}**" if missed else "0"
        lines.append((*place, str(len(own) - missed), told, *ends))
    return table(header, lines, ("met", "missed"))


def side_by_side(rows: Sequence[Row]) -> list[str]:
    """For each direction a line a layer and dtype: nn.Conv2d, then ratios of everything else."""
    lines: list[str] = []
    for direction in dict.fromkeys(row.direction for row in rows):
        own = [row for row in rows if row.direction == direction]
        others = list(dict.fromkeys(series_name(row) for row in own if row.ratio is not None))
        against = {series_name(row): row.baseline.split(",")[0] for row in own if row.baseline}
        unit = own[0].unit
        header = ["layer", "dtype", f"{BASELINE}, {unit}"]
        header += [f"{name}, x {against[name]}" for name in others]
        places: dict[tuple[str, str], dict[str, Row]] = {}
        for row in own:
            places.setdefault((row.case, row.dtype), {})[series_name(row)] = row
        cells = [
            (
                *place,
                number(found[BASELINE].value) if BASELINE in found else "",
                *(_ratio(found.get(name)) for name in others),
            )
            for place, found in places.items()
        ]
        lines += [f"#### {direction}", "", *table(header, cells, header[2:]), ""]
    return lines


def _ratio(row: Row | None) -> str:
    if row is None or row.ratio is None:
        return ""
    sign = "≥" if row.target_sense == "at least" else "≤"
    goal = "" if row.target is None else f" ({sign} {row.target:g})"
    return f"{row.ratio:.2f}{goal}" + (f" {MISSED}" if row.verdict == "missed" else "")
