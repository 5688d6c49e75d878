# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The tables of `tsobs watch`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import chain
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from tsobs_ros.errors import printable

if TYPE_CHECKING:
    from tsobs_ros.estimation.health import Status
    from tsobs_ros.nodes.watcher import Quantity, Snapshot

_SILENT = 1.0  # age of the last estimate from which on it is shown [s]
_TOO_FAR = 3.0  # bounds beyond which an error is marked
_STYLES = ("green", "bold dark_orange", "bold red", "dim")
_RATES = {
    "measurements": "measurements",
    "joint_states": "estimates",
    "innovation": "innovations",
    "health": "health",
    "ground_truth/joint_states": "truth",
}
_ALWAYS = ("certificate", "parameters", "measurements", "timing")
"""Concerns of diagnostics that are shown even if all is well."""
_LEVELS = ("OK", "WARN", "ERROR", "STALE")


def picture(snapshot: Snapshot) -> RenderableType:
    """Return a snapshot as tables."""
    tables = [_estimates(snapshot), _sensors(snapshot), _further(snapshot)]
    parts = [part for table in tables if table.row_count for part in ("", table)]
    return Group(_heading(snapshot), *parts, "", _statuses(snapshot))


def _heading(snapshot: Snapshot) -> Text:
    text = Text().append(printable(snapshot.observer), "bold")
    state = snapshot.statuses.get("state")
    if state is not None:
        text.append("  ").append(printable(state.message), _STYLES[state.level])
    elif not snapshot.positions:
        text.append("  waiting for an observer of this name", "dim")
    if snapshot.age > _SILENT:
        text.append(f"  no estimate for {snapshot.age:.0f} s", _STYLES[2])
    if snapshot.problem:
        text.append(f"\n{printable(snapshot.problem)}", _STYLES[1])
    found = snapshot.rates
    rates = [f"{name} {found[key]:.1f}" for key, name in _RATES.items() if key in found]
    return text.append(f"\nmessages a second: {', '.join(rates)}" if rates else "", "dim")


def _estimates(snapshot: Snapshot) -> Table:
    unit = (" [rad]", " [rad/s]") if snapshot.in_radians else ("", "")
    kinds = [(f"position{unit[0]}", snapshot.positions)]
    if snapshot.velocities:
        kinds.append((f"velocity{unit[1]}", snapshot.velocities))
    known = _is_known(snapshot.positions)
    titles = [title for name, _ in kinds for title in (name, "±1σ", *["error"] * known)]
    table = _table("estimate", *titles)
    for name in snapshot.positions:
        cells = [_cells(quantities.get(name), known) for _, quantities in kinds]
        table.add_row(_text(name), *chain.from_iterable(cells))
    return table


def _sensors(snapshot: Snapshot) -> Table:
    unit, known = " [rad]" * snapshot.in_radians, _is_known(snapshot.disturbances)
    table = _table("sensor", f"disturbance{unit}", "±1σ", *["error"] * known, "innovation")
    table.add_column("fault")
    for name, each in snapshot.disturbances.items():
        innovation = _number(snapshot.innovations.get(name))
        table.add_row(_text(name), *_cells(each, known), innovation, _fault(snapshot, name))
    return table


def _further(snapshot: Snapshot) -> Table:
    """Return torques, learnt parameters and health, which are not there with every design."""
    table = Table.grid(padding=(0, 2))
    for title, quantities in (
        ("torque [N m]", snapshot.torques),
        ("learnt change", snapshot.parameters),
    ):
        for name, each in quantities.items():
            truth = "" if math.isnan(each.truth) else f"  true {_number(each.truth)}"
            value = f"{_number(each.value)} ± {_number(each.bound, sign=False)}{truth}"
            table.add_row(_text(title, "dim"), _text(name), value)
    for name, number in snapshot.health.items():
        if name.rpartition("/")[2] in ("noise_scale", "coloured_power"):
            table.add_row(_text("noise", "dim"), _text(name.replace("_", " ")), f"{number:+.2f}")
    return table


def _statuses(snapshot: Snapshot) -> RenderableType:
    """Return what is not well, and what is rejected and measured."""
    table = Table.grid(padding=(0, 2))
    for name, status in snapshot.statuses.items():
        concern = name.rpartition(": ")[2]
        shown_above = name == "state" or (snapshot.disturbances and "sensor fault" in concern)
        if not shown_above and (status.level or concern in _ALWAYS):
            level = _text(_LEVELS[status.level], _STYLES[status.level])
            words = [status.message, *_details(status, concern)]
            table.add_row(level, _text(name), _text("; ".join(filter(None, words))))
    return table


def _details(status: Status, concern: str) -> list[str]:
    """Return the values of a status that people watch."""
    values = status.values
    if concern == "timing":
        wanted = ("achieved rate [Hz]", "tick time p99 [ms]", "latency p99 [ms]")
        return [f"{key} {values[key]}" for key in wanted if key in values]
    if concern != "measurements":
        return []
    rejected = ", ".join(
        f"{key.removeprefix('rejected: ')} {count}"
        for key, count in values.items()
        if key.startswith("rejected: ") and count != "0"
    )
    used = f"{values.get('used', '?')} of {values.get('received', '?')} used"
    return [f"{used}, rejected: {rejected}" if rejected else used]


def _fault(snapshot: Snapshot, entry: str) -> Text:
    """Return the fault of a sensor, whose status' name depends on how many there are."""
    joint, _, output = entry.partition("/")
    of = f"sensor fault of {output or entry}"
    names = (f"{joint}: {of}", f"{joint}: sensor fault", of, "sensor fault")
    status = next((snapshot.statuses[n] for n in names if n in snapshot.statuses), None)
    if status is None:
        return _text("?", "dim")
    sizes = [value for key, value in status.values.items() if key.startswith("magnitude")]
    words = [_LEVELS[status.level], status.message]
    if status.message != "none":
        words += [*sizes, status.values.get("since", "")]
    return _text(" ".join(filter(None, words)), _STYLES[status.level])


def _table(first: str, *titles: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="dim")
    table.add_column(first, overflow="fold")
    for title in titles:
        table.add_column(Text(title), justify="right", no_wrap=True)
    return table


def _is_known(quantities: Mapping[str, Quantity]) -> bool:
    """Return whether the truth of one of them is known."""
    return any(not math.isnan(each.truth) for each in quantities.values())


def _text(text: str, style: str = "") -> Text:
    return Text(printable(text), style=style)


def _number(value: float | None, *, sign: bool = True) -> Text:
    if value is None or math.isnan(value):
        return _text("–", "dim")
    plus = "+" if sign else ""
    return _text(f"{value:{plus}.4f}" if abs(value) < 1e4 else f"{value:{plus}.3e}")


def _cells(each: Quantity | None, is_known: bool) -> list[Text]:
    """Return a value, its bound and, if the truth is known, its error, marked beyond 3 sigma."""
    if each is None:
        return [_number(None)] * (2 + is_known)
    error = _number(each.value - each.truth)
    if abs(each.value - each.truth) > _TOO_FAR * each.bound:
        error.append("!")
        error.stylize(_STYLES[2])
    return [_number(each.value), _number(each.bound, sign=False), *[error] * is_known]
