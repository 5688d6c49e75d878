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
from tsobs_ros.bag.joint_series import Times
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile, TopicInfo
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest, Output, TSRequest
from tsobs_ros.errors import LogError
from tsobs_ros.replay.columns import (
    LATEST,
    NO_TIME,
    UNITS,
    CsvFile,
    LogColumn,
    naming_file,
    with_unit,
)
from tsobs_ros.replay.places import Layout
from tsobs_ros.replay.source import MEASUREMENTS, Records, Source
from tsobs_ros.series import NANOSECONDS, Spool

_BLOCK = 4096
_ONLY = "elastic_joint"
_AFTER_RESTART = 1_000_000
# No arm is measured more slowly, so the unit of the times is another [ns].
_MAX_PERIOD = NANOSECONDS // 4
_MIN_TIMES = 10
_MANY_EQUAL = 0.1

_NAMES: Mapping[str, tuple[str, ...]] = {
    "time": ("header.stamp", "time", "t", "stamp", "timestamp"),
    "angle": ("angle", "position", "q"),
    "velocity": ("velocity", "dq"),
    "torque": ("torque", "effort", "tau"),
}
"""Names of columns by quantity, without capitals; of a joint with `.JOINT` behind them."""


class _Signal(NamedTuple):
    """A number that a design measures: names in errors, options and titles, unit, and place."""

    label: str
    keys: Sequence[str]
    titles: Sequence[str]
    quantity: str
    unit: str
    field: str
    joint: int
    place: int

    def of(self, samples: Records) -> Array:
        """Return its numbers in samples, to read and to write, shape (n,)."""
        return np.asarray(samples[self.field])[:, self.joint, self.place]


class LogSource(Source):
    """A CSV log as a source of measurements, read line by line.

    Cells that are empty or NaN are measurements that will be rejected, and counted. A log whose
    times begin at zero or before is moved, so that it begins at 1 s: a stamp of zero means none.

    Args:
        path: The file.
        columns: Titles or numbers of columns by quantity: `time`, `torque`, `angle` or
            `velocity` if there is one such, or the name of an output or input; for several joints
            `angle.JOINT` and so on. The others are found by their usual names.
        units: Units by quantity, for columns whose title has none.
        joints: Names of the joints to read; all of them if empty. One name renames the joint of
            columns that name none.
        assume_zero_torque: Take torque as 0 if there is no such column.

    Attributes:
        moved_by: Shift of the times [ns].

    Raises:
        LogError: The file cannot be read, lacks a column, has a cell that is not a number, or
            times in another unit; the text names line and column.
    """

    def __init__(
        self,
        path: Path,
        *,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        joints: Sequence[str] = (),
        assume_zero_torque: bool = False,
    ) -> None:
        self.path, self.topic = path, path.name
        self._torque_needed = not assume_zero_torque
        self._wanted, self._units = dict(columns or {}), dict(units or {})
        with naming_file(path):
            self._file = CsvFile(path)
        self.guessed = not joints
        self._named = self._joints_named()
        self.joints = tuple(joints) or self._named or (_ONLY,)

    def _read(self) -> None:
        with naming_file(self.path):
            self._choose()
            self._read_lines()

    def _joints_named(self) -> tuple[str, ...]:
        """Return the joints that options name, else those of columns such as `angle.JOINT`."""
        keys = [key.partition(".") for key in self._wanted]
        titles = [one.name.partition(".") for one in self._file.columns]
        known = (*_NAMES["angle"], *_NAMES["velocity"], "link_angle", "motor_angle")
        found = [joint for _, _, joint in keys if joint]
        found = found or [joint for name, _, joint in titles if joint and name.lower() in known]
        motors = {f"{joint}_motor" for joint in found}
        return tuple(joint for joint in dict.fromkeys(found) if joint not in motors)

    def _choose(self) -> None:
        """Find the columns and what their numbers mean."""
        signals = [
            list(self._signals_of_arm(joint, one.output_names))
            if isinstance(one, ArmRequest)
            else list(self._signals_of_system(joint, one))
            for joint, one in enumerate(self._requests)
        ]
        self._require_known([one for own in signals for one in own])
        if not self._file.has_titles and not self._wanted:
            raise LogError(
                "the first line has numbers and no titles: put a line such as 'time [s],angle "
                "[rad],torque [N m]' before it, or give the columns' numbers: --columns "
                "time=1,angle=2,torque=3"
            )
        time = self._search("time", ["time"], _NAMES["time"])
        if time is None:
            raise self._missing("time")
        self._time = with_unit(time, "time", self._units.get("time", ""))
        self._measured: list[tuple[_Signal, LogColumn]] = []
        for joint, own in zip(self.joints, signals, strict=True):
            columns = [self._search(one.label, one.keys, one.titles, joint) for one in own]
            for one, column in zip(own, columns, strict=True):
                if column is not None:
                    self._measured.append((one, self._in_units(one, column)))
                elif one.quantity != "torque":
                    raise self._missing(one.label, joint if joint != _ONLY else "")
            torques = [column for one, column in zip(own, columns, strict=True)
                       if one.quantity == "torque"]  # fmt: skip
            if torques and not any(torques) and self._torque_needed:
                zero = ", or take it for 0: --param assume_zero_torque=true"
                raise self._missing("torque", joint, zero)

    def _require_known(self, signals: Sequence[_Signal]) -> None:
        """Raise `LogError` if an option is for something that is not measured."""
        names = dict.fromkeys(["time", *(key for one in signals for key in one.keys)])
        quantities = dict.fromkeys(["time", *(one.quantity or one.label for one in signals)])
        for option, keys, known in (
            ("--columns", [key.partition(".")[0] for key in self._wanted], list(names)),
            ("--units", list(self._units), list(quantities)),
        ):
            for key in keys:
                if key not in known:
                    expected = f"{', '.join(known[:-1])} or {known[-1]}"
                    raise LogError(f"{option}: expected {expected}, got {key!r}")

    def _signals_of_arm(self, joint: int, outputs: Sequence[str]) -> Iterator[_Signal]:
        """Yield its outputs, then its torque and that of the motor's entry, the first there is."""
        name = self.joints[joint]
        # Titles need not name the only joint.
        plain = len(self.joints) == 1 and len(self._named) <= 1
        sides = {output.partition("_")[0] for output in outputs}
        for place, output in enumerate(outputs):
            side, _, kind = output.partition("_")
            alone = sum(one.endswith(kind) for one in outputs) == 1
            of_side = len(sides) == 1 or side == "link"
            entry = name if of_side else f"{name}_motor"
            titles = [f"{output}.{name}", *(f"{one}.{entry}" for one in _NAMES[kind])]
            if plain:
                titles += [output, *(_NAMES[kind] if of_side else ())]
            label = output if len(outputs) > 1 else kind
            keys = [kind, output] if alone else [output]
            yield _Signal(label, keys, titles, kind, "", "y", joint, place)
        for keys, titles in (
            (["torque"], [f"{one}.{name}" for one in _NAMES["torque"]]),
            ([], [f"{one}.{name}_motor" for one in _NAMES["torque"]]),
        ):
            titles += _NAMES["torque"] if keys and plain else ()
            yield _Signal("torque", keys, titles, "torque", "", "u", joint, 0)

    def _signals_of_system(self, joint: int, request: TSRequest) -> Iterator[_Signal]:
        system = self.joints[joint]
        for field, names, units in (
            ("y", request.output_names, request.output_units),
            ("u", request.input_names, request.input_units),
        ):
            for place, (name, unit) in enumerate(zip(names, units, strict=True)):
                titles = (f"{system}/{name}", f"position.{system}/{name}", name, f"position.{name}")
                yield _Signal(name, [name], titles, "", unit, field, joint, place)

    def _missing(self, what: str, joint: str = "", instead: str = "") -> LogError:
        of = f" of {joint}" if joint else ""
        return LogError(
            f"no column is called {what}{of}; name it: --columns {what}=…{instead}; "
            f"{self._file.described}"
        )

    def _search(
        self, what: str, keys: Sequence[str], names: Sequence[str], joint: str = ""
    ) -> LogColumn | None:
        """Return the column that an option names, else the first of some names, if there is one."""
        for key in [f"{key}.{joint}" for key in keys] + list(keys):
            if key in self._wanted:
                return self._file.called(self._wanted[key])
        for name in names:
            found = self._file.named(name)
            if len(found) > 1:
                raise LogError(
                    f"several columns are called {name!r}; give the number of one: --columns "
                    f"{what}={found[0].place + 1}"
                )
            if found:
                return found[0]
        return None

    def _in_units(self, signal: _Signal, column: LogColumn) -> LogColumn:
        """Return a signal's column with its unit."""
        given = self._units.get(signal.quantity or signal.label, "")
        if signal.quantity:
            return with_unit(column, signal.quantity, given)
        given = column.unit or given
        # An exported JointState's units are those of a joint.
        exported = column.name.startswith("position.")
        if signal.unit and given and not exported and _plain(given) != _plain(signal.unit):
            raise LogError(
                f"column {column.title!r}: its unit is {given!r}, but {signal.label} of the design "
                f"is in {signal.unit!r}"
            )
        return column._replace(unit=signal.unit)

    def _read_lines(self) -> None:
        spool, first, equal = Spool(self._sample_type), LATEST, 0
        columns = [column for _, column in self._measured]
        for _, stamps, values in self._file.read(self._time, columns):
            there = stamps[stamps != NO_TIME]
            if first == LATEST:
                self._check_period(there)
            first = int(there.min(initial=first))
            equal += int((np.diff(there) == 0).sum())
            spool.add(self._samples_of(stamps, values))
        self.samples = spool.read()
        if not self.count:
            raise LogError("no lines below the header")
        if first == LATEST:
            raise LogError(f"no line has a time in column {self._time.title!r}")
        self.moved_by = 0 if first > 0 else NANOSECONDS - first
        clock = _LogClock(first + self.moved_by)
        for samples in self._blocks():
            there = samples.stamps != NO_TIME
            samples.stamps = np.where(there, samples.stamps + there * self.moved_by, 0)
            samples.log_times = clock.times(samples.stamps)
            samples.checksums = [crc32(row) for row in self._encoded(samples)]
        self.same_clock = not clock.restarts
        if self._file.cut_off:
            self.remarks += ("note: the last line is cut off, and left out",)
        if self.moved_by:
            shift = f"{self.moved_by / NANOSECONDS:g} s"
            self.remarks += (f"note: {shift} was added to all times: 0 means no time",)
        if equal > _MANY_EQUAL * self.count:
            self.remarks += (
                f"note: {equal:,} of {self.count:,} lines have the time of the line before, and "
                "are rejected: write times with more digits",
            )

    def _check_period(self, stamps: Times) -> None:
        """Raise `LogError` if the times of the first lines seem to have another unit."""
        apart, title = np.diff(stamps), self._time.title
        if (
            self._file.columns[self._time.place].unit
            or "time" in self._units
            or len(apart) < _MIN_TIMES
        ):
            return
        period = float(np.median(apart))
        for unit, size in UNITS["time"].items():
            if period >= _MAX_PERIOD and period * size < _MAX_PERIOD * NANOSECONDS:
                raise LogError(
                    f"column {title!r} has no unit, and its times are {period / NANOSECONDS:g} "
                    f"apart: no arm is measured every {period / NANOSECONDS:g} s; if they are "
                    f"{unit}, write '{title} [{unit}]' or --units time={unit}; if they are "
                    "seconds, --units time=s"
                )

    def _samples_of(self, stamps: Times, columns: Array) -> Records:
        samples: Records = np.recarray(len(stamps), self._sample_type)
        samples.stamps = stamps
        # Inputs without a column are 0.
        samples.y, samples.u, samples.complete, samples.refused = np.nan, 0.0, True, 0
        for signal, _ in self._measured:
            signal.of(samples)[:] = np.nan
        for (signal, _), values in zip(self._measured, columns.T, strict=True):
            # A second column has what the first one lacks.
            own = signal.of(samples)
            own[:] = np.where(np.isnan(own), values, own)
        return samples

    def _blocks(self) -> Iterator[Records]:
        """Yield all samples, some at a time."""
        begins = range(0, self.count, _BLOCK)
        return (self.samples[begin : begin + _BLOCK] for begin in begins)

    def _encoded(self, samples: Records) -> NDArray[np.uint8]:
        """Return the messages of measurements, shape (n, size)."""
        places = [place for own in self.signals for place in (*own.outputs, *own.inputs)]
        values = [
            part[:, joint, : len(names)]
            for joint, own in enumerate(self.signals)
            for part, names in ((samples.y, own.outputs), (samples.u, own.inputs))
        ]
        return Layout(places).encode(samples.stamps, np.hstack(values))

    @property
    def topics(self) -> tuple[TopicInfo, ...]:  # type: ignore[override]
        qos = (QosProfile(reliability="best_effort"),)
        definition = find_definition(JOINT_STATE)
        return (
            TopicInfo(f"/{MEASUREMENTS}", JOINT_STATE, qos_profiles=qos, definition=definition),
        )

    def sensor(self, quantity: str, column: str = "") -> tuple["LogSource", list[str]]:
        """Return the log as of a sensor that no design measures, and its column for each joint.

        Args:
            quantity: Name of a quantity of an arm.
            column: Its column; empty to find it by its name.

        Raises:
            LogError: There is no such column, or the observer uses it.
        """
        kind, common = quantity.partition("_")[2], ("time", "torque")
        columns = {key: name for key, name in self._wanted.items() if key.split(".")[0] in common}
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
            hint = str(error).replace(f"--columns {kind}=", f"--held-out {quantity}=")
            raise LogError(hint) from error
        own = [column for signal, column in found._measured if signal.field == "y"]
        used = [self._time.place, *(column.place for _, column in self._measured)]
        if taken := [column.title for column in own if column.place in used]:
            raise LogError(
                f"{self.path}: column {taken[0]!r} is used by the observer; name that of the "
                f"held-out sensor: --held-out {quantity}=COLUMN"
            )
        return found, [column.title for column in own]

    def messages(self) -> Iterator[BagMessage]:
        for samples in self._blocks():
            times, data = samples.log_times, self._encoded(samples)
            series = MessageSeries(f"/{MEASUREMENTS}", JOINT_STATE, times, times, data)
            yield from map(BagMessage._make, series.messages())


class _LogClock:
    """Log times that rise from line to line, whatever the stamps do.

    Attributes:
        restarts: How often time has gone back by more than a second.
    """

    def __init__(self, begin: int) -> None:
        self.restarts, self._shift, self._last = 0, 0, begin

    def times(self, stamps: Times) -> list[int]:
        """Return the log times of the next lines, those of the line before without a stamp."""
        times = []
        for stamp in stamps.tolist():
            if stamp:
                if stamp + self._shift < self._last - NANOSECONDS:
                    self.restarts += 1
                    self._shift = self._last + _AFTER_RESTART - stamp
                self._last = max(self._last, stamp + self._shift)
            times.append(self._last)
        return times


def _plain(unit: str) -> str:
    return "".join(unit.split()).translate({ord(sign): None for sign in ".*·⋅"})
