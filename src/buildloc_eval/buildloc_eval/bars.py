"""What an evaluation must reach, and whether it did."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from buildloc_eval.sections import Scores

Judged = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Bar:
    """What must be reached: a figure of a section by its path, at least or at most."""

    section: str
    figure: str
    limit: float
    at_least: bool = False

    def judge(self, sections: dict[str, Scores]) -> dict[str, Any] | None:
        """Limit, measured, held; None when the section was not run."""
        if self.section not in sections:
            return None
        value: Any = sections[self.section]
        for part in self.figure.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        return judged(value, self.limit, self.at_least)


def judged(value: float | None, limit: float, at_least: bool = False) -> dict[str, Any]:
    """Limit, measured, held."""
    held = holds(value, limit, at_least)
    return {"at least" if at_least else "at most": limit, "measured": value, "held": held}


def holds(value: float | None, limit: float, at_least: bool) -> bool:
    """Whether a limit is kept; by what was not measured (None) it is not."""
    return value is not None and (value >= limit if at_least else value <= limit)


def judge(bars: Iterable[Bar], sections: dict[str, Scores]) -> Judged:
    """Every bar whose section was run: limit, measured, held."""
    return {f"{bar.section}: {bar.figure}": answer for bar in bars if (answer := bar.judge(sections))}


def bar_table(judged: Judged) -> str:
    """One line per bar."""
    rows = [
        (name, f"{limit} {answer[limit]:g}", answer["measured"], "held" if answer["held"] else "MISSED")
        for name, answer in judged.items()
        for limit in answer.keys() & {"at least", "at most"}
    ]
    return table(("bar", "", "measured", ""), rows)


def table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    """Columns for a terminal, right-aligned."""
    shown = [head, *(tuple(_cell(value) for value in row) for row in rows)]
    widths = [max(len(row[i]) for row in shown) for i in range(len(head))]
    return "\n".join("  ".join(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=True)) for row in shown)


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
