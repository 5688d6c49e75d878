# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from a log of one's own: a CSV file of time, outputs and inputs."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile, TopicInfo
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest, Output
from tsobs_ros.design.signals import Place
from tsobs_ros.errors import LogError
from tsobs_ros.replay.csv_file import NO_TIME, Column, CsvFile, naming_file, plain_unit
from tsobs_ros.replay.places import Layout
from tsobs_ros.replay.source import MEASUREMENTS, Records, Source, passes
from tsobs_ros.series import NANOSECONDS, Spool, Stamps

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
    at: tuple[str, int, int]


class LogSource(Source):
    """A CSV log as a source of measurements, read line by line.

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
        self.path, self.topic, self.guessed = path, path.name, not joints
        self._torque_needed = not assume_zero_torque
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
            self._read_lines()

    def _choose(self) -> None:
        """Find the columns of what the designs measure."""
        time = _Signal("time", _NAMES["time"], "time", "", ("", 0, 0))
        signals = [one for joint in range(len(self.joints)) for one in self._signals(joint)]
        labels = {one.label: one.titles for one in (time, *signals)}
        quantities = {one.quantity: [one.quantity] for one in (time, *signals) if one.quantity}
        for option, given, known in (
            ("--columns", self._given, labels),
            ("--units", self._units, quantities),
        ):
            for key in given:
                if not any(key in names for names in known.values()):
                    raise LogError(f"{option}: expected some of {', '.join(known)}, got {key!r}")
        found = {one: column for one in (time, *signals) if (column := self._column(one))}
        there = {one.at for one in found}
        for one in (time, *signals):
            if one.at not in there and (one.quantity != "torque" or self._torque_needed):
                raise self._missing(one)
        self._time = found.pop(time)
        self._measured = found

    def _signals(self, joint: int) -> Iterator[_Signal]:
        """Yield what a joint's design measures, its torque at the places that it may have."""
        own, request, name = self.signals[joint], self._requests[joint], self.joints[joint]
        if isinstance(request, ArmRequest):
            torques = [("torque", place) for place in (*own.inputs, *own.other_inputs)]
            outputs = zip(request.output_names, own.outputs, strict=True)
            for number, (label, place) in enumerate([*outputs, *torques]):
                quantity = _KINDS[place.field]
                titles = [f"{each}.{place.name}" for each in _NAMES[quantity]]
                titles.insert(0, f"{label}.{name}")
                if self._is_only:
                    titles += [label, *(_NAMES[quantity] if place.name == name else ())]
                at = ("u", joint, 0) if quantity == "torque" else ("y", joint, number)
                yield _Signal(label, tuple(titles), quantity, "", at)
            return
        for field, places, labels, units in (
            ("y", own.outputs, request.output_names, request.output_units),
            ("u", own.inputs, request.input_names, request.input_units),
        ):
            for number, (place, label, unit) in enumerate(zip(places, labels, units, strict=True)):
                names = dict.fromkeys([place.name, f"{name}/{label}"])
                titles = [title for one in names for title in (one, f"position.{one}")]
                yield _Signal(label, tuple(titles), "", unit, (field, joint, number))

    def _missing(self, one: _Signal) -> LogError:
        joint = self.joints[one.at[1]]
        of = f" of {joint}" if one.label != "time" and joint != _ONLY else ""
        zero = ", or take it for 0: --param assume_zero_torque=true"
        return LogError(
            f"no column is called {one.label}{of}; name it: --columns {one.label}=…"
            f"{zero if one.quantity == 'torque' else ''}; {self._file.described}"
        )

    def _column(self, one: _Signal) -> Column | None:
        """Return a signal's column with its unit: one that an option names, else by its title."""
        for title in sorted(one.titles, key=lambda title: title not in self._given):
            name = self._given.get(title, title)
            column = self._file.find(name)
            if column is None and title in self._given:
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

    def _read_lines(self) -> None:
        spool = Spool(self._sample_type)
        for _, stamps, values in self._file.read(self._time, list(self._measured.values())):
            spool.add(self._samples_of(stamps, values))
        samples = self.samples = spool.read()
        there = samples.stamps != NO_TIME
        if not there.any():
            raise LogError("no line below the titles has a time")
        first = int(samples.stamps[there].min())
        self.moved_by = 0 if first > 0 else NANOSECONDS - first
        samples.stamps = np.where(there, samples.stamps + self.moved_by, 0)
        parts, last = passes(samples.stamps), first + self.moved_by
        for begin, end in parts:
            # Log times rise from line to line: time that has gone back goes on after what was.
            shift = last + _AFTER_RESTART - int(samples.stamps[begin]) if begin else 0
            times = np.append(last, samples.stamps[begin:end] + shift)
            samples.log_times[begin:end] = np.maximum.accumulate(times)[1:]
            last = int(samples.log_times[end - 1])
        self.same_clock = len(parts) == 1
        for part in self._blocks():
            part.checksums = [crc32(row) for row in self._encoded(part)]
        if self._file.cut_off:
            self.remarks += ("note: the last line is cut off, and left out",)
        if self.moved_by:
            moved = f"{self.moved_by / NANOSECONDS:g} s"
            self.remarks += (f"note: {moved} was added to all times: 0 means no time",)

    def _samples_of(self, stamps: Stamps, values: Array) -> Records:
        samples: Records = np.recarray(len(stamps), self._sample_type)
        samples.stamps, samples.complete, samples.refused = stamps, True, 0
        # Inputs without a column are 0.
        samples.y, samples.u = np.nan, 0.0
        filled = set[tuple[str, int, int]]()
        for one, column in zip(self._measured, values.T, strict=True):
            field, joint, place = one.at
            own = np.asarray(samples[field])[:, joint, place]
            # A second column has what the first one lacks.
            own[:] = np.where(np.isnan(own), column, own) if one.at in filled else column
            filled.add(one.at)
        return samples

    def _blocks(self) -> Iterator[Records]:
        """Yield all samples, some at a time."""
        begins = range(0, self.count, _BLOCK)
        return (self.samples[begin : begin + _BLOCK] for begin in begins)

    def _encoded(self, samples: Records) -> NDArray[np.uint8]:
        """Return the messages of measurements, shape (n, size)."""
        places, values = list[Place](), list[Array]()
        for joint, own in enumerate(self.signals):
            places += [*own.outputs, *own.inputs]
            values += [
                samples.y[:, joint, : len(own.outputs)],
                samples.u[:, joint, : len(own.inputs)],
            ]
        return Layout(places).encode(samples.stamps, np.hstack(values))

    @property
    def topics(self) -> tuple[TopicInfo, ...]:  # type: ignore[override]
        qos = (QosProfile(reliability="best_effort"),)
        definition = find_definition(JOINT_STATE)
        return (
            TopicInfo(f"/{MEASUREMENTS}", JOINT_STATE, qos_profiles=qos, definition=definition),
        )

    def messages(self) -> Iterator[BagMessage]:
        for samples in self._blocks():
            times, data = samples.log_times, self._encoded(samples)
            series = MessageSeries(f"/{MEASUREMENTS}", JOINT_STATE, times, times, data)
            yield from map(BagMessage._make, series.messages())

    def sensor(self, quantity: str, column: str = "") -> tuple["LogSource", list[str]]:
        """Return the log as of a sensor that no design measures, and its column for each joint.

        Args:
            quantity: Name of a quantity of an arm.
            column: Its column; empty to find it by its name.

        Raises:
            LogError: There is no such column, or the observer uses it.
        """
        kind, common = quantity.partition("_")[2], ("time", "torque")
        columns = {key: name for key, name in self._given.items() if key.split(".")[0] in common}
        found = LogSource(
            self.path,
            columns=columns | ({quantity: column} if column else {}),
            units={key: unit for key, unit in self._units.items() if key in (*common, kind)},
            joints=self.joints,
            assume_zero_torque=True,
        )
        request = ArmRequest(outputs=[Output(quantity, ArmRequest.measurement_std)])
        try:
            found.observe([request] * len(self.joints))
        except LogError as error:
            raise LogError(str(error).replace("--columns", "--held-out")) from error
        own = [column for one, column in found._measured.items() if one.quantity != "torque"]
        used = {self._time.place, *(each.place for each in self._measured.values())}
        if taken := [each.title for each in own if each.place in used]:
            raise LogError(
                f"{self.path}: column {taken[0]!r} is used by the observer; name that of the "
                f"held-out sensor: --held-out {quantity}=COLUMN"
            )
        return found, [each.title for each in own]
