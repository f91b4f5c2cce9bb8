"""The results as text: results.md, with the verdicts first and every number below."""

from __future__ import annotations

from collections.abc import Sequence

import document_device
from cases import LAYOUTS
from report import Report
from rows import Row
from suites.job import Suite
from tables import MISSED, number, table

_PAGES = (
    "Where freed blocks are kept (see allocator above), no call pays for fresh pages of memory, "
    "whatever the calls before it freed; a program with glibc's own settings sees both."
)


def _verdict(row: Row) -> str:
    return MISSED if row.verdict == "missed" else row.verdict


def _ratio(row: Row) -> str:
    if row.ratio is None:
        return ""
    spread = "" if row.ratio_low is None else f" ({row.ratio_low:.2f} .. {row.ratio_high:.2f})"
    return f"{row.ratio:.2f}{spread}"


def _target(row: Row) -> str:
    return "" if row.target is None else f"{row.target_sense} {row.target:g}"


def _verdicts(rows: Sequence[Row], suites: Sequence[Suite], on_gpu: bool) -> list[str]:
    """How many targets each suite met, and every missed one, the worst first."""
    judged = [row for row in rows if row.verdict]
    if not judged:
        return []
    counts = []
    for suite in suites:
        own = [row for row in judged if row.suite == suite.name]
        if own:
            missed = sum(row.verdict == "missed" for row in own)
            counts.append((suite.title, str(len(own) - missed), str(missed)))
    lines = ["## Targets", ""]
    lines += table(("measured", "met", "missed"), counts, ("met", "missed"))
    last = "threads"
    if on_gpu:
        last = "dtype"
        lines += ["", "Target by target:", "", *document_device.by_target(judged)]
    lost = [row for row in judged if row.verdict == "missed"]
    lost.sort(key=_shortfall, reverse=True)
    if not lost:
        return [*lines, ""]
    lines += ["", "Every missed target, the worst first:", ""]
    header = ("suite", "case", "what", "direction", "layout", "depth", last, "ratio", "target")
    cells = [
        (
            f"{row.suite}: {row.table}",
            row.case,
            row.subject,
            row.direction,
            row.layout,
            row.depth,
            str(getattr(row, last)),
            _ratio(row),
            _target(row),
        )
        for row in lost
    ]
    return [*lines, *table(header, cells, ("threads", "ratio", "target")), ""]


def _shortfall(row: Row) -> float:
    assert row.ratio is not None and row.target is not None
    part = row.ratio / row.target
    return 1 / part if row.target_sense == "at least" else part


def _prices(rows: Sequence[Row]) -> list[str]:
    """Prices only: one line a case, the layouts and directions side by side."""
    columns = [(direction, layout) for direction in ("forward", "backward") for layout in LAYOUTS]
    header = ["layer", "threads", "what", "depth", *(f"{d}, {layout}" for d, layout in columns)]
    lines: dict[tuple[str, ...], dict[tuple[str, str], str]] = {}
    for row in rows:
        if row.ratio is None or not row.depth:
            continue
        goal = "" if row.target is None else f" (≤ {row.target:.2f})"
        cell = f"{row.ratio:.2f}{goal}" + (f" {MISSED}" if row.verdict == "missed" else "")
        place = (row.case, str(row.threads), row.subject, row.depth)
        lines.setdefault(place, {})[row.direction, row.layout] = cell
    cells = [
        (*place, *(found.get(column, "") for column in columns)) for place, found in lines.items()
    ]
    return table(header, cells, header[4:])


def _distances(rows: Sequence[Row]) -> list[str]:
    """One line a case and subject, the distances side by side."""
    distances = list(dict.fromkeys(row.depth for row in rows))
    header = ["case", "what"]
    for name in distances:
        header += [f"at {name}", *(["of nn.Conv2d's"] if any(row.baseline for row in rows) else [])]
    lines: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        cells = lines.setdefault((row.case, row.subject), [])
        cells.append(f"{number(row.value)} ({number(row.low)} .. {number(row.high)})")
        if len(header) > 2 + len(distances):
            goal = "" if row.target is None else f" (≤ {row.target:g})"
            cells.append(_ratio(row).split(" (")[0] + goal)
            cells[-1] += f" {MISSED}" if row.verdict == "missed" else ""
    return table(header, [(*place, *cells) for place, cells in lines.items()], header[2:])


PIVOTS = {
    "prices": _prices,
    "distances": _distances,
    "device": document_device.side_by_side,
}


def _details(rows: Sequence[Row], per_pixel: bool) -> list[str]:
    """Every number of a table; columns in which nothing differs are left out."""
    unit = rows[0].unit
    single = all(row.samples == 1 for row in rows)
    every = {
        "case": [row.case for row in rows],
        "what": [row.subject for row in rows],
        "direction": [row.direction for row in rows],
        "layout": [row.layout for row in rows],
        "depth": [row.depth for row in rows],
        "dtype": [row.dtype for row in rows],
        "threads": [str(row.threads) for row in rows],
        unit if single else f"median {unit}": [number(row.value) for row in rows],
        "quartiles": [f"{number(row.low)} .. {number(row.high)}" for row in rows],
        "calls" if unit == "ms" else "samples": [str(row.samples) for row in rows],
        "ns per pixel": [
            number(1e6 * row.value / row.pixels) if row.pixels else "" for row in rows
        ],
        "ns per 1000 multiplications": [
            number(1e9 * row.value / row.macs) if row.macs else "" for row in rows
        ],
        "against": [row.baseline for row in rows],
        "ratio (quartiles)": [_ratio(row) for row in rows],
        "target": [_target(row) for row in rows],
        "verdict": [_verdict(row) for row in rows],
        "note": [row.note for row in rows],
    }
    always = {"case", "what"}
    names = [
        name
        for name, cells in every.items()
        if name in always
        or len({*cells, ""} - {""}) > 1
        or (name in ("target", "verdict", "note") and any(cells))
    ]
    if not per_pixel:
        names = [name for name in names if not name.startswith("ns per")]
    cells = zip(*(every[name] for name in names), strict=True)
    text = {"case", "what", "direction", "layout", "depth", "dtype", "against", "note"}
    return table(names, cells, [name for name in names if name not in text])


def _suite(suite: Suite, rows: Sequence[Row], charts: Sequence[str]) -> list[str]:
    lines = [f"## {suite.title}", "", suite.about, ""]
    for chart in charts:
        lines += [f"![{suite.title}]({chart})", ""]
    for name in dict.fromkeys(row.table for row in rows):
        own = [row for row in rows if row.table == name]
        lines += [f"### {name}", ""]
        details = _details(own, per_pixel=suite.name == "scaling")
        if suite.pivot:
            lines += [*PIVOTS[suite.pivot](own), ""]
            lines += ["<details><summary>Every number</summary>", "", *details, ""]
            lines += ["</details>", ""]
        else:
            lines += [*details, ""]
    return lines


def render(report: Report, charts: dict[str, list[str]]) -> str:
    """The whole document.

    Args:
        report: the results.
        charts: file names of charts by suite.

    Returns:
        Markdown.
    """
    lines = ["# surfconv_ops benchmark", ""]
    if report.plan.quick:
        lines += ["**A --quick run: it shows that everything works; its times are rough.**", ""]
    lines += [f"- {name.replace('_', ' ')}: {value}" for name, value in report.machine.items()]
    seconds = sum(report.elapsed.values())
    lines += [f"- took: {seconds:.0f} s of {report.plan.total:.0f} s planned", ""]
    worst = max(report.checks, key=lambda check: check.error / check.allowed)
    lines += [
        f"Gate: {len(report.checks)} checks at the timed shapes, "
        f"{'all passed' if report.green else 'FAILED'}; the closest to its limit is "
        f"{worst.what}: relative RMS error {worst.error:.1e}, allowed {worst.allowed:.0e}.",
        "",
    ]
    if not report.green:
        failed = [check for check in report.checks if not check.passed]
        lines += [f"- {check.what}: {check.error:.2e}" for check in failed]
        return "\n".join([*lines, "", "No speed is reported.", ""])
    lines += [
        "Times are medians of interleaved calls: every candidate of a table runs once a round. "
        "Ratios are ratios of medians, with the quartiles of the rounds' own ratios behind them. "
        + (_PAGES if "allocator" in report.machine else ""),
        "",
    ]
    lines += [line for suite in report.suites if suite.method for line in (suite.method, "")]
    lines += [f"Not measured: {name}, because {why}" for name, why in report.unavailable.items()]
    lines += ["", *_verdicts(report.rows, report.suites, "gpu" in report.machine)]
    for suite in report.suites:
        own = [row for row in report.rows if row.suite == suite.name]
        if own:
            lines += _suite(suite, own, charts.get(suite.name, []))
    return "\n".join(lines)
