"""Self-contained HTML of a report: its figures as tables, its pictures embedded."""

from __future__ import annotations

import base64
import html
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

STYLE = (
    "body{font:15px sans-serif;max-width:80em;margin:2em auto;padding:0 1em}table{border-collapse:collapse}"
    "td,th{border:1px solid #ccc;padding:.2em .6em;text-align:left;vertical-align:top}img{max-width:100%}"
    "section{overflow-x:auto}h1{border-bottom:2px solid #ccc}"  # a table that is too wide scrolls by itself
    "td.text{min-width:16em}"
)

LONG_TEXT = 30  # characters

Pictures = Sequence[tuple[str, Path]]


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return _entries(value)
    if _is_rows(value):
        return _rows(value)
    if isinstance(value, list | tuple) and value:
        return ("<br>" if any(isinstance(one, str) for one in value) else ", ").join(map(_cell, value))
    if isinstance(value, float):
        return f"{value:.4g}"
    return html.escape("none" if value is None or value == [] else str(value))


def _entries(values: dict[str, Any]) -> str:
    """Entries that are dicts of single values and have a key in common, such as the bars of an evaluation, as
    one table, its longer side downwards; all others in a table of their own after it."""
    plain = {name: value for name, value in values.items() if _is_plain(value)}
    if len(plain) < 2 or not set.intersection(*map(set, plain.values())):
        return _table(values)
    keys = list(dict.fromkeys(key for row in plain.values() for key in row))
    if len(keys) > len(plain):
        rows = [{"": key} | {n: row[key] for n, row in plain.items() if key in row} for key in keys]
    else:
        rows = [{"": name} | row for name, row in plain.items()]
    others = {name: value for name, value in values.items() if name not in plain}
    return _rows(rows) + (_table(others) if others else "")


def _is_plain(value: Any) -> bool:
    return isinstance(value, dict) and not any(isinstance(one, dict | list | tuple) for one in value.values())


def _is_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def _table(values: dict[str, Any]) -> str:
    rows = "".join(f"<tr><th>{html.escape(str(k))}</th><td>{_cell(v)}</td></tr>" for k, v in values.items())
    return f"<table>{rows}</table>"


def _sections(values: dict[str, Any], pictures: Pictures) -> str:
    """In their order: what is a table by itself under a heading, the rest in tables of two columns. Pictures
    follow the table that has their caption as its name, the others all tables."""
    parts = []
    for alone, some in itertools.groupby(values.items(), lambda item: _is_rows(item[1])):
        if not alone:
            parts.append(f"<section>{_table(dict(some))}</section>")
            continue
        for name, rows in some:
            own = "".join(map(_image, (picture for picture in pictures if picture[0] == name)))
            parts.append(f"<h2>{html.escape(name)}</h2>{own}<section>{_rows(rows)}</section>")
    others = (picture for picture in pictures if picture[0] not in values)
    parts += [f"<h2>{html.escape(picture[0])}</h2>{_image(picture)}" for picture in others]
    return "".join(parts)


def _image(picture: tuple[str, Path]) -> str:
    caption, path = picture
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'


def _rows(rows: list[dict[str, Any]]) -> str:
    """A table with a column for every key."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    head = "".join(f"<th>{html.escape(str(key))}</th>" for key in keys)
    body = "".join("<tr>" + "".join(_column(row.get(key, "")) for key in keys) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _column(value: Any) -> str:
    """Long text beside many figures would be a word wide."""
    wide = ' class="text"' if isinstance(value, str) and len(value) > LONG_TEXT else ""
    return f"<td{wide}>{_cell(value)}</td>"


def write_report(
    path: Path,
    title: str,
    report: dict[str, Any],
    pictures: Pictures,
    chapters: Sequence[tuple[str, dict[str, Any], Pictures]] = (),
) -> None:
    """Write one HTML file that needs no other; chapters follow, each with its title, figures and pictures."""
    body = _sections(report, pictures) + "".join(
        f"<h1>{html.escape(name)}</h1>{_sections(values, own)}" for name, values, own in chapters
    )
    heading = html.escape(title)
    path.write_text(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{heading}</title>'
        f"<style>{STYLE}</style><h1>{heading}</h1>{body}</html>\n"
    )
