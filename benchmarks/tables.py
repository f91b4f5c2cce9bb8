"""Tables and numbers in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

MISSED = "**missed**"


def table(
    header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[str]
) -> list[str]:
    """A Markdown table; the columns named in `numbers` are set to the right."""
    rule = ["---:" if name in numbers else "---" for name in header]
    return [
        "| " + " | ".join(header) + " |",
        "|" + "|".join(rule) + "|",
        *("| " + " | ".join(cells) + " |" for cells in rows),
    ]


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"
