"""Self-contained HTML of a report: its figures as tables, its pictures embedded."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

STYLE = (
    "body{font:15px sans-serif;max-width:70em;margin:2em auto;padding:0 1em}table{border-collapse:collapse}"
    "td,th{border:1px solid #ccc;padding:.2em .6em;text-align:left;vertical-align:top}img{max-width:100%}"
)

Pictures = Sequence[tuple[str, Path]]


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return _table(value)
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        return _rows(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    return html.escape("none" if value is None else str(value))


def _table(values: dict[str, Any]) -> str:
    rows = "".join(f"<tr><th>{html.escape(str(k))}</th><td>{_cell(v)}</td></tr>" for k, v in values.items())
    return f"<table>{rows}</table>"


def _rows(rows: list[dict[str, Any]]) -> str:
    """A table with a column for every key."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    head = "".join(f"<th>{html.escape(str(key))}</th>" for key in keys)
    body = "".join(
        "<tr>" + "".join(f"<td>{_cell(row.get(key))}</td>" for key in keys) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _figures(pictures: Pictures) -> str:
    return "".join(
        f"<h2>{html.escape(caption)}</h2>"
        f'<img alt="{html.escape(caption)}" src="data:image/png;base64,'
        f'{base64.b64encode(picture.read_bytes()).decode()}">'
        for caption, picture in pictures
    )


def write_report(
    path: Path,
    title: str,
    report: dict[str, Any],
    pictures: Pictures,
    chapters: Sequence[tuple[str, dict[str, Any], Pictures]] = (),
) -> None:
    """Write one HTML file that needs no other; chapters follow, each with its title, figures and pictures."""
    figures = _figures(pictures) + "".join(
        f"<h1>{html.escape(name)}</h1>{_table(values)}{_figures(own)}" for name, values, own in chapters
    )
    heading = html.escape(title)
    path.write_text(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{heading}</title>'
        f"<style>{STYLE}</style><h1>{heading}</h1>{_table(report)}{figures}</html>\n"
    )
