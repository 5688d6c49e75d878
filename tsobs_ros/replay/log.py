# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from a log of one's own, a CSV file of time, outputs and inputs, as a bag."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from weakref import finalize

import numpy as np

from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import Place
from tsobs_ros.errors import LogError
from tsobs_ros.replay.csv_file import NO_TIME, Column, CsvFile, naming_file, plain_unit
from tsobs_ros.replay.places import Layout
from tsobs_ros.replay.source import MEASUREMENTS, BagSource, passes
from tsobs_ros.series import NANOSECONDS, Spool

_BLOCK = 4096
_ONLY = "elastic_joint"
_AFTER_RESTART = 1_000_000

_NAMES: Mapping[str, tuple[str, ...]] = {
    "time": ("header.stamp", "time", "t", "stamp", "timestamp"),
    "angle": ("angle", "position", "q"),
    "velocity": ("velocity", "dq"),
    "torque": ("torque", "effort", "tau"),
}
"""Usual names of columns by quantity; of a joint with `.JOINT` behind them."""
_KINDS = {"position": "angle", "velocity": "velocity", "effort": "torque"}


class _Signal(NamedTuple):
    """A number that a design measures: what it is in errors, possible titles, and where it goes."""

    label: str
    titles: tuple[str, ...]
    quantity: str
    unit: str
    joint: str
    place: Place


class LogSource(BagSource):
    """A CSV log as a source of measurements: its lines become a temporary bag.

    Cells that are empty or NaN are measurements that will be rejected, and counted. A log whose
    times begin at zero or before is moved, so that it begins at 1 s: a stamp of zero means none.

    Args:
        path: The file.
        columns: Names of columns by their usual ones: `time`, `torque`, `angle` or `velocity`, or
            the name of an output or input; for several joints `angle.JOINT` and so on.
        units: Units by quantity, for columns whose title has none.
        joints: Names of the joints to read; all of them if empty. One name renames the joint of
            columns that name none.
        assume_zero_torque: Take torque as 0 if there is no such column.

    Attributes:
        moved_by: Shift of the times [ns].

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
    ) -> None:
        self.path, self.topic, self.guessed = path, f"/{MEASUREMENTS}", not joints
        self._assume_zero_torque = assume_zero_torque
        self._given, self._units = dict(columns or {}), dict(units or {})
        with naming_file(path):
            self._file = CsvFile(path)
        # Those that options name, else those of columns such as `angle.JOINT`.
        titles = (one.name.partition(".") for one in self._file.columns)
        measured = (*_NAMES["angle"], *_NAMES["velocity"], "link_angle", "motor_angle")
        found = [key.partition(".")[2] for key in self._given if "." in key]
        found = found or [joint for name, _, joint in titles if joint and name.lower() in measured]
        motors = {f"{joint}_motor" for joint in found}
        named = tuple(joint for joint in dict.fromkeys(found) if joint not in motors)
        self.joints = tuple(joints) or named or (_ONLY,)
        self._is_only = len(self.joints) == 1 and len(named) <= 1

    def _read(self) -> None:
        with naming_file(self.path):
            self._choose()
            self._write_bag()
        super()._read()

    def _choose(self) -> None:
        """Find the columns of what the designs measure."""
        time = _Signal("time", _NAMES["time"], "time", "", "", Place("", "position"))
        signals = [time]
        for joint in range(len(self.joints)):
            signals += self._signals(joint)
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
        columns = {one: self._column(one, self._given) for one in signals}
        found = {one: column for one, column in columns.items() if column is not None}
        driven = {one.joint for one in found if one.quantity == "torque"}
        for one in signals:
            is_silent = one.joint in driven or self._assume_zero_torque
            if one not in found and not (one.quantity == "torque" and is_silent):
                raise self._missing(one)
        self._time = found.pop(time)
        self._measured = found

    def _signals(self, joint: int) -> Iterator[_Signal]:
        """Yield what a joint's design measures, its torque at the places that it may have."""
        own, request, name = self.signals[joint], self._requests[joint], self.joints[joint]
        if isinstance(request, ArmRequest):
            torques = [("torque", place) for place in (*own.inputs, *own.other_inputs)]
            outputs = zip(request.output_names, own.outputs, strict=True)
            for label, place in (*outputs, *torques):
                quantity = _KINDS[place.field]
                titles = self._titles(label, quantity, name, place.name)
                yield _Signal(label, titles, quantity, "", name, place)
            return
        labels = request.output_names + request.input_names
        units = request.output_units + request.input_units
        for place, label, unit in zip(own.outputs + own.inputs, labels, units, strict=True):
            names = dict.fromkeys([place.name, f"{name}/{label}"])
            either = tuple(title for one in names for title in (one, f"position.{one}"))
            yield _Signal(label, either, "", unit, name, place)

    def _titles(self, label: str, quantity: str, joint: str, entry: str) -> tuple[str, ...]:
        """Return the titles that a joint's signal may have."""
        titles = [f"{label}.{joint}", *(f"{each}.{entry}" for each in _NAMES[quantity])]
        if self._is_only:
            titles += [label, *(_NAMES[quantity] if entry == joint else ())]
        return tuple(titles)

    def _missing(self, one: _Signal, option: str = "--columns") -> LogError:
        of = f" of {one.joint}" if one.joint not in ("", _ONLY) else ""
        zero = ", or take it for 0: --param assume_zero_torque=true"
        return LogError(
            f"no column is called {one.label}{of}; name it: {option} {one.label}=…"
            f"{zero if one.quantity == 'torque' else ''}; {self._file.described}"
        )

    def _column(self, one: _Signal, given: Mapping[str, str]) -> Column | None:
        """Return a signal's column with its unit: one that is given, else by its title."""
        for title in sorted(one.titles, key=lambda title: title not in given):
            name = given.get(title, title)
            column = self._file.find(name)
            if column is None and title in given:
                raise LogError(f"no column is called {name!r}; {self._file.described}")
            if column is None:
                continue
            if one.quantity:
                return column.in_units_of(one.quantity, self._units.get(one.quantity, ""))
            # An exported JointState's units are those of a joint.
            known = column.unit and one.unit and not column.name.startswith("position.")
            if known and plain_unit(column.unit) != plain_unit(one.unit):
                raise LogError(f"column {column.title!r}: {one.label} is in {one.unit!r}")
            return column._replace(unit=one.unit)
        return None

    def _write_bag(self) -> None:
        """Write the measurements into a temporary bag, in the order of the lines."""
        columns = list(self._measured.values())
        lines_type = np.dtype([("stamps", np.int64), ("values", np.float64, (len(columns),))])
        spool = Spool(lines_type)
        for _, stamps, values in self._file.read(self._time, columns):
            spool.add(np.rec.fromarrays([stamps, values], lines_type))
        lines = spool.read()
        there = lines.stamps != NO_TIME
        if not there.any():
            raise LogError("no line below the titles has a time")
        first = int(lines.stamps[there].min())
        self.moved_by = 0 if first > 0 else NANOSECONDS - first
        lines.stamps = np.where(there, lines.stamps + self.moved_by, 0)
        layout, last = Layout([one.place for one in self._measured]), first + self.moved_by
        folder = TemporaryDirectory()
        finalize(self, folder.cleanup)
        bag = Path(folder.name, "log")
        with BagWriter(bag) as writer:
            definition = find_definition(JOINT_STATE)
            qos = QosProfile(reliability="best_effort")
            writer.add_topic(self.topic, JOINT_STATE, [qos], definition=definition)
            for begin, end in passes(lines.stamps):
                # Log times rise from line to line: time that has gone back goes on after what was.
                shift = last + _AFTER_RESTART - int(lines.stamps[begin]) if begin else 0
                for place in range(begin, end, _BLOCK):
                    part = lines[place : min(place + _BLOCK, end)]
                    times = np.maximum.accumulate(np.append(last, part.stamps + shift))[1:]
                    last = int(times[-1])
                    data = layout.encode(part.stamps, part["values"])
                    writer.write_series(
                        [MessageSeries(self.topic, JOINT_STATE, times, times, data)]
                    )
        self.reader = BagReader(bag)
        if self._file.cut_off:
            self.remarks += ("note: the last line is cut off, and left out",)
        if self.moved_by:
            moved = f"{self.moved_by / NANOSECONDS:g} s"
            self.remarks += (f"note: {moved} was added to all times: 0 means no time",)

    def sensor(self, quantity: str, column: str = "") -> tuple[list[str], Array]:
        """Return a sensor's column for each joint and its readings line by line, shape (n, joints).

        Args:
            quantity: Name of a quantity of an arm.
            column: Its column; empty to find it by its name.

        Raises:
            LogError: There is no such column, or the observer uses it.
        """
        kind, found = quantity.partition("_")[2], list[Column]()
        used = {self._time.place, *(one.place for one in self._measured.values())}
        with naming_file(self.path):
            for joint in self.joints:
                titles = self._titles(quantity, kind, joint, joint)
                one = _Signal(quantity, titles, kind, "", joint, Place(joint, "position"))
                own = self._column(one, {quantity: column} if column else {})
                if own is None:
                    raise self._missing(one, "--held-out")
                if own.place in used:
                    raise LogError(
                        f"column {own.title!r} is used by the observer; name that of the held-out "
                        f"sensor: --held-out {quantity}=COLUMN"
                    )
                found.append(own)
            values = [part for _, _, part in self._file.read(self._time, found)]
        return [one.title for one in found], np.concatenate(values)
