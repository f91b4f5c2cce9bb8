"""The results as data: one dictionary, written as results.json and results.csv."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gate import Check
from plan import Plan
from rows import COLUMNS, Row
from suites.job import Suite

FORMAT = "surfconv_ops benchmark"
VERSION = 2


@dataclass
class Report:
    """All that a run found out.

    Attributes:
        machine: from `machine.describe`.
        plan: the budgets.
        checks: the gate's; where one is red there are no rows.
        suites: those that were to run.
        rows: every measured number.
        unavailable: peers that could not run, and why.
        elapsed: seconds that each suite took, the gate included.
    """

    machine: dict[str, Any]
    plan: Plan
    checks: Sequence[Check]
    suites: Sequence[Suite]
    rows: list[Row] = field(default_factory=list)
    unavailable: dict[str, str] = field(default_factory=dict)
    elapsed: dict[str, float] = field(default_factory=dict)

    @property
    def green(self) -> bool:
        return all(check.passed for check in self.checks)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dictionaries, with a description of every column."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "machine": self.machine,
            "quick": self.plan.quick,
            "plan": asdict(self.plan),
            "elapsed_seconds": {
                **{name: round(seconds, 2) for name, seconds in self.elapsed.items()},
                "total": round(sum(self.elapsed.values()), 2),
            },
            "gate": {
                "passed": self.green,
                "about": "relative RMS errors at the timed shapes; a red gate reports no speed",
                "checks": [{**asdict(check), "passed": check.passed} for check in self.checks],
            },
            "suites": {
                suite.name: {"title": suite.title, "about": suite.about} for suite in self.suites
            },
            "unavailable": self.unavailable,
            "columns": COLUMNS,
            "rows": [asdict(row) for row in self.rows],
        }


def write_data(folder: Path, report: Report) -> list[Path]:
    """Write results.json and results.csv into the folder and return their paths."""
    json_path, csv_path = folder / "results.json", folder / "results.csv"
    json_path.write_text(json.dumps(report.to_dict(), indent=1) + "\n")
    with csv_path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(asdict(row) for row in report.rows)
    return [json_path, csv_path]


def read_rows(path: Path) -> tuple[dict[str, Any], list[Row]]:
    """The dictionary and the rows of a results.json.

    Raises:
        ValueError: the file is none, or one of another version.
    """
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as results: {error}") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ValueError(f"{path}: not a results.json of this benchmark")
    if data.get("version") != VERSION:
        raise ValueError(f"{path}: version {data.get('version')}, expected {VERSION}")
    return data, [Row(**row) for row in data["rows"]]
