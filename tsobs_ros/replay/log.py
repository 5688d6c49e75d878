# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from a user's log, a CSV file of time, outputs and inputs, as a bag."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from weakref import finalize

import numpy as np

from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import Field, Place
from tsobs_ros.errors import LogError
from tsobs_ros.replay.csv_file import NO_TIME, Column, CsvFile, naming_file, plain_unit
from tsobs_ros.replay.places import Layout
from tsobs_ros.replay.source import MEASUREMENTS, BagSource, passes
from tsobs_ros.series import NANOSECONDS

_BLOCK = 4096
_ONLY = "elastic_joint"
_AFTER_RESTART = 1_000_000
# Share of lines that may lie more than a second behind one before them, without a restart.
_LATE = 0.1

_NAMES: Mapping[str, tuple[str, ...]] = {
    "time": ("header.stamp", "time", "t", "stamp", "timestamp"),
    "angle": ("angle", "position", "q"),
    "velocity": ("velocity", "dq"),
    "torque": ("torque", "effort", "tau"),
}
"""Usual names of columns by quantity; `.JOINT` behind them names a joint."""
_FIELDS: Mapping[str, Field] = {"angle": "position", "velocity": "velocity", "torque": "effort"}
_KINDS = {field: kind for kind, field in _FIELDS.items()}


class _Signal(NamedTuple):
    """A number to read: its name in errors, possible titles, its joint, and its place in the bag.

    A number of an arm has a quantity, a number of a T-S system has a unit.
    """

    label: str
    titles: tuple[str, ...]
    quantity: str
    unit: str
    joint: str
    place: Place


_TIME = _Signal("time", _NAMES["time"], "time", "", "", Place("", "position"))


class LogSource(BagSource):
    """A CSV log as a source of measurements: its lines become a temporary bag.

    Empty or NaN cells are measurements that will be rejected, and counted. If the times of a log
    begin at zero or before, they are moved to begin at 1 s, as a stamp of zero means no time.

    Args:
        path: The file.
        columns: Names of columns by their usual ones: `time`, `torque`, `angle` or `velocity`, or
            the name of an output or input; for several joints `angle.JOINT` and so on.
        units: Units by quantity, for columns whose title has none.
        joints: All joints if empty. A single name renames the joint of columns that name no joint.
        assume_zero_torque: Take torque as 0 if there is no such column.
        held_out: Sensor that is kept from all observers, with its column: `link_angle=COLUMN`.

    Raises:
        LogError: The file cannot be read, lacks a column, or has a cell that is not a number; the
            text names line and column.
    """

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        joints: Sequence[str] = (),
        *,
        assume_zero_torque: bool = False,
        held_out: str | None = None,
    ) -> None:
        self.path, self.topic, self.guessed = path, f"/{MEASUREMENTS}", not joints
        self.held_out = held_out
        self._assume_zero_torque = assume_zero_torque
        self._given, self._units = dict(columns or {}), dict(units or {})
        with naming_file(path):
            self._file = CsvFile(path)
        # The joints that options name, else those of columns such as `angle.JOINT`.
        titles = (one.name.partition(".") for one in self._file.columns)
        measured = (*_NAMES["angle"], *_NAMES["velocity"], "link_angle", "motor_angle")
        found = [key.partition(".")[2] for key in self._given if "." in key]
        found = found or [joint for name, _, joint in titles if joint and name.lower() in measured]
        motors = {f"{joint}_motor" for joint in found}
        named = tuple(joint for joint in dict.fromkeys(found) if joint not in motors)
        self.joints = tuple(joints) or named or (_ONLY,)
        self._motor_titles = {joint for joint in found if f"{joint}_motor" in found}
        self.with_motors = {*self.joints} if held_out is not None else self._motor_titles
        self._is_only = len(self.joints) == 1 and len(named) <= 1

    def _read(self) -> None:
        with naming_file(self.path):
            self._write_bag(*self._choose())
        super()._read()

    def _choose(self) -> tuple[Column, list[tuple[Place, Column]]]:
        """Return the time's column, and the other columns to read with their places in the bag."""
        sensor, _, place = (self.held_out or "").partition("=")
        self._given |= {sensor: place} if place else {}
        signals = [_TIME]
        for joint in range(len(self.joints)):
            signals += self._signals(joint, sensor)
        labels = dict.fromkeys(one.label for one in signals)
        quantities = dict.fromkeys(one.quantity for one in signals if one.quantity)
        titles = {title for one in signals for title in one.titles}
        for option, given, shown, known in (
            ("--columns", self._given, labels, titles),
            ("--units", self._units, quantities, quantities),
        ):
            for key in given:
                if key not in known:
                    raise LogError(f"{option}: expected some of {', '.join(shown)}, got {key!r}")
        found = {one: column for one in signals if (column := self._column(one)) is not None}
        driven = {one.joint for one in found if one.quantity == "torque"}
        for one in signals:
            is_silent = one.joint in driven or self._assume_zero_torque
            if one not in found and not (one.quantity == "torque" and is_silent):
                raise self._missing(one, "--held-out" if one.label == sensor else "--columns")
        used = {column.place for one, column in found.items() if one.label != sensor}
        for column in (column for one, column in found.items() if one.label == sensor):
            if column.place in used:
                raise LogError(
                    f"column {column.title!r} is used by the observer; name that of the held-out "
                    f"sensor: --held-out {sensor}=COLUMN"
                )
            self.held_out_columns += (column.title,)
        users = dict[int, _Signal]()
        for one, column in found.items():
            other = users.setdefault(column.place, one)
            # A scheduled signal of a T-S system may be one of its outputs.
            is_other = (other.label, other.quantity) != (one.label, one.quantity)
            if is_other and (other.quantity or one.quantity):
                raise LogError(
                    f"column {column.title!r} is taken for {other.label} and for {one.label}; name "
                    f"another one: --columns {one.label}=COLUMN"
                )
        return found.pop(_TIME), [(one.place, column) for one, column in found.items()]

    def _signals(self, joint: int, sensor: str) -> Iterator[_Signal]:
        """Yield the signals of a joint's design, its torque once for each place that it may have.

        The signal of a held-out sensor comes last.
        """
        own, request, name = self.signals[joint], self.requests[joint], self.joints[joint]
        if isinstance(request, ArmRequest):
            # With a held-out sensor, the entry of the only encoder may have the name of its side.
            titled = request.signals(name, self.alone, name in self._motor_titles)
            entries = [place.name for place in titled.outputs]
            outputs = zip(request.output_names, own.outputs, entries, strict=True)
            # An entry of the motor would be read as its sensor's, too.
            others = () if own.other_outputs else own.other_inputs
            torques = [("torque", one, one.name) for one in (*own.inputs, *others)]
            side, _, kind = sensor.partition("_")
            entry = f"{name}_motor" if side == "motor" else name
            held_out = [(sensor, Place(entry, _FIELDS[kind]), name)] if sensor else []
            for label, place, entry in (*outputs, *torques, *held_out):
                quantity = _KINDS[place.field]
                titles = [f"{label}.{name}", *(f"{each}.{entry}" for each in _NAMES[quantity])]
                if self._is_only:
                    titles += [label, *(_NAMES[quantity] if entry == name else ())]
                yield _Signal(label, tuple(titles), quantity, "", name, place)
            return
        labels = request.output_names + request.input_names
        units = request.output_units + request.input_units
        for place, label, unit in zip(own.outputs + own.inputs, labels, units, strict=True):
            names = dict.fromkeys([place.name, f"{name}/{label}"])
            either = tuple(title for one in names for title in (one, f"position.{one}"))
            yield _Signal(label, either, "", unit, name, place)

    def _missing(self, one: _Signal, option: str) -> LogError:
        of = f" of {one.joint}" if one.joint not in ("", _ONLY) else ""
        zero = ", or take it for 0: --param assume_zero_torque=true"
        return LogError(
            f"no column is called {one.label}{of}; name it: {option} {one.label}=…"
            f"{zero if one.quantity == 'torque' else ''}; {self._file.described}"
        )

    def _column(self, one: _Signal) -> Column | None:
        """Return a signal's column with its unit: a given one, else the one with its title."""
        for title in sorted(one.titles, key=lambda title: title not in self._given):
            name = self._given.get(title, title)
            column = self._file.find(name)
            if column is None and title in self._given:
                raise LogError(f"no column is called {name!r}; {self._file.described}")
            if column is None:
                continue
            if one.quantity:
                return column.in_units_of(one.quantity, self._units.get(one.quantity, ""))
            # An exported JointState has units of a joint, also for the signals of a system.
            known = column.unit and one.unit and not column.name.startswith("position.")
            if known and plain_unit(column.unit) != plain_unit(one.unit):
                raise LogError(f"column {column.title!r}: {one.label} is in {one.unit!r}")
            return column._replace(unit=one.unit)
        return None

    def _write_bag(self, time: Column, measured: Sequence[tuple[Place, Column]]) -> None:
        """Write the measurements into a temporary bag, in the order of the lines."""
        lines, stamps, values = self._file.read(time, [column for _, column in measured])
        there = stamps != NO_TIME
        if not there.any():
            raise LogError("no line below the titles has a time")
        first = int(stamps[there].min())
        moved_by = 0 if first > 0 else NANOSECONDS - first
        stamps = np.where(there, stamps + moved_by, 0)
        parts = passes(stamps)
        newest = np.concatenate([np.maximum.accumulate(stamps[slice(*ends)]) for ends in parts])
        behind = np.where(there, newest - stamps, 0) / NANOSECONDS
        if (late := behind > 1.0).mean() > _LATE:
            place = int(late.argmax())
            raise LogError(
                f"line {lines[place]}: its time is {behind[place]:.6g} s behind that of a line "
                "before it, as in many lines: sort them by time"
            )
        layout, last = Layout([place for place, _ in measured]), first + moved_by
        folder = TemporaryDirectory()
        finalize(self, folder.cleanup)
        bag = Path(folder.name, "log")
        with BagWriter(bag) as writer:
            writer.add_topic(self.topic, JOINT_STATE, [QosProfile(reliability="best_effort")])
            for begin, end in parts:
                # Log times rise from line to line: if time goes back, they go on from the last one.
                shift = last + _AFTER_RESTART - int(stamps[begin]) if begin else 0
                for place in range(begin, end, _BLOCK):
                    part = slice(place, min(place + _BLOCK, end))
                    times = np.maximum.accumulate(np.append(last, stamps[part] + shift))[1:]
                    last = int(times[-1])
                    data = layout.encode(stamps[part], values[part])
                    writer.write_series(
                        [MessageSeries(self.topic, JOINT_STATE, times, times, data)]
                    )
        self.reader = BagReader(bag)
        if self._file.cut_off:
            self.remarks += ("note: the last line is cut off, and left out",)
        if moved_by:
            moved = f"{moved_by / NANOSECONDS:g} s"
            self.remarks += (f"note: {moved} was added to all times: 0 means no time",)
