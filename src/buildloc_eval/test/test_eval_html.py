"""Reports as pages: which figures become a table, and of what shape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from buildloc_eval.html import write_report


def page(tmp_path: Path, report: dict[str, Any]) -> str:
    write_report(tmp_path / "report.html", "title", report, [])
    return (tmp_path / "report.html").read_text()


def test_like_entries_are_rows_of_one_table(tmp_path: Path) -> None:
    bars = {
        "recall": {"at least": 0.5, "held": True},
        "error": {"at most": 2.0, "held": False},
        "time": {"at most": 3.0, "held": True},
    }
    text = page(tmp_path, {"bars": bars})
    assert text.count("<table>") == 2  # the report, and the bars in it
    assert "<th>at least</th><th>held</th><th>at most</th>" in text
    assert "<td>error</td><td></td><td>False</td><td>2</td>" in text


def test_what_has_many_values_is_a_column(tmp_path: Path) -> None:
    text = page(tmp_path, {"methods": {"a": {"x": 1, "y": 2, "z": 3}, "b": {"x": 4, "y": 5}}})
    assert "<th></th><th>a</th><th>b</th>" in text
    assert "<td>y</td><td>2</td><td>5</td>" in text and "<td>z</td><td>3</td><td></td>" in text


def test_what_is_not_alike_follows_what_is(tmp_path: Path) -> None:
    text = page(tmp_path, {"scene": {"ratio": 0.25, "found": {"n": 1}, "true": {"n": 2}, "sizes": [3, 4]}})
    assert text.count("<table>") == 3
    assert text.index("<td>true</td><td>2</td>") < text.index("<th>ratio</th><td>0.25</td>")
    assert "<th>sizes</th><td>3, 4</td>" in text


def test_entries_that_are_not_alike_keep_their_own_tables(tmp_path: Path) -> None:
    assert page(tmp_path, {"of": {"a": {"x": 1}, "b": {"y": 2}}}).count("<table>") == 4
    assert page(tmp_path, {"of": {"a": {"x": 1}}}).count("<table>") == 3
    assert page(tmp_path, {"of": {"a": {"x": [1, 2]}, "b": {"x": [3, 4]}}}).count("<table>") == 4
