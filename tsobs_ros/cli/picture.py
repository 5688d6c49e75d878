# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tables of `tsobs watch`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from tsobs_ros.errors import printable

if TYPE_CHECKING:
    from tsobs_ros.nodes.watcher import View

_SILENT = 1.0  # age of the last estimate beyond which the view shows it [s]
_TOO_FAR = 3.0  # number of 1σ bounds beyond which an error is marked
_STYLES = ("green", "bold dark_orange", "bold red", "dim")
_HEADINGS = {"value": "", "bound": "±1σ", "truth": "error"}
_ALWAYS = ("certificate", "innovation", "parameters", "measurements", "timing")
"""Concerns of diagnostics that are shown even at level OK."""
_DETAILS = ("received", "used", "rejected: ", "achieved rate", "measured rate", "tick time p99",
            "latency p99", "noise scale", "coloured power", "magnitude", "since")  # fmt: skip
"""Beginnings of the names of values that are shown with a concern."""


def picture(view: View) -> RenderableType:
    """Return a view as tables."""
    tables = [_table(title, rows) for title, rows in view.tables.items() if rows]
    return Group(_heading(view), *(part for table in tables for part in ("", table)), "",
                 _statuses(view))  # fmt: skip


def _heading(view: View) -> Text:
    text = Text().append(printable(view.observer), "bold")
    if (state := view.statuses.get("state")) is not None:
        text.append("  ").append(printable(state.message), _STYLES[state.level])
    elif not view.tables["estimate"]:
        text.append("  waiting for an observer of this name", "dim")
    if view.age > _SILENT:
        text.append(f"  no estimate for {view.age:.0f} s", _STYLES[2])
    return text


def _table(title: str, rows: dict[str, dict[str, dict[str, float]]]) -> Table:
    """Return a table with a row per entry: value, bound and error of each field, if present."""
    cells = [(field, what) for row in rows.values() for field, has in row.items() for what in has]
    columns = sorted(set(cells), key=lambda column: (column[0], list(_HEADINGS).index(column[1])))
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="dim")
    table.add_column(title, overflow="fold")
    for field, what in columns:
        table.add_column(_HEADINGS[what] or field, justify="right", no_wrap=True)
    for name, row in rows.items():
        numbers = (_number(row.get(field, {}), what) for field, what in columns)
        table.add_row(Text(printable(name)), *numbers)
    return table


def _number(has: dict[str, float], what: str) -> Text:
    """Return a number as text: for the truth its error, marked if beyond three bounds."""
    value = has.get(what, math.nan)
    if what == "truth":
        value = has["value"] - value
    if math.isnan(value):
        return Text("–", style="dim")
    plus = "" if what == "bound" else "+"
    text = Text(f"{value:{plus}.4f}" if abs(value) < 1e4 else f"{value:{plus}.3e}")
    if what == "truth" and abs(value) > _TOO_FAR * has.get("bound", math.inf):
        text.append("!")
        text.stylize(_STYLES[2])
    return text


def _statuses(view: View) -> RenderableType:
    """Return the concerns that are not OK, and the most important ones in any case."""
    table = Table.grid(padding=(0, 2))
    for name, status in view.statuses.items():
        if name != "state" and (status.level or name.rpartition(": ")[2] in _ALWAYS):
            details = [
                value if key == "since" else f"{key} {value}"
                for key, value in status.values.items()
                if key.startswith(_DETAILS) and value != "0"
            ]
            level = Text(status.level.name, style=_STYLES[status.level])
            text = printable("; ".join([status.message, *details]))
            table.add_row(level, Text(printable(name)), Text(text))
    return table
