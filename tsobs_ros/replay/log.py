# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from a log of one's own: a CSV file of time, outputs and inputs."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.joint_series import Times
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile, TopicInfo
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.bag.writer import MessageSeries
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import LogError
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.cells import Row, TextTable, is_nothing, plain_number
from tsobs_ros.replay.columns import UNITS, Column, Columns, is_unit, misread
from tsobs_ros.replay.fit import check_unit_of_angles
from tsobs_ros.replay.places import Layout
from tsobs_ros.replay.source import MEASUREMENTS, Part, Samples, Source, restarts
from tsobs_ros.replay.times import LATEST, NO_TIME, TimeReader, check_period
from tsobs_ros.series import NANOSECONDS

_BLOCK = 4096
# Lines that are not in order are sorted in memory.
_MAX_SORTED = 5_000_000
_LARGEST = 1e9
_MANY_EQUAL = 0.1
_ONLY = "elastic_joint"
_AFTER_RESTART = 1_000_000


class _Block(NamedTuple):
    """Lines of a log.

    Attributes:
        stamps: [ns], shape (n,).
        y: Outputs, NaN for an empty cell or if a joint has fewer, shape (n, J, p).
        u: Inputs and scheduled signals, 0 if a joint has fewer, shape (n, J, m).
    """

    stamps: Times
    y: Array
    u: Array


class _Cell(NamedTuple):
    """A column of numbers: where it belongs in the arrays of a block, and its unit's size."""

    column: Column
    factor: float
    in_inputs: bool
    joint: int
    place: int


class LogSource(Source):
    """A CSV log as a source of measurements, read line by line.

    Titles, units, separators and number formats are found in the first lines; see `cells` and
    `columns`. Cells that are empty or NaN are measurements that will be rejected, and counted.
    Lines that are not in order of time are sorted. A log whose times begin at zero or before is
    moved, so that it begins at 1 s: a stamp of zero means none.

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
        without_unit: Titles of each joint's angles if nobody stated the unit of any.
        liveliest: The part in which the outputs move most.

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
        try:
            self._table = table = TextTable(path, is_unit)
            self._columns = Columns(table.titles, table.units, columns or {}, units or {})
            given = {name.partition(".")[0] for name in columns or {}}
            if not table.has_titles and not ("time" in given and len(given) > 1):
                raise LogError(
                    "the first line has numbers and no titles: put a line such as 'time [s],angle "
                    "[rad],torque [N m]' before it, or give the columns' numbers: --columns "
                    "time=1,angle=2,torque=3"
                )
            self.guessed = not joints
            self.joints = tuple(joints) or self._columns.joints(_ONLY)
        except OSError as error:
            raise LogError(f"{path}: cannot read it: {error}") from error
        except LogError as error:
            raise LogError(f"{path}: {error}") from error

    def _observe(self) -> None:
        self.signals = self.signals_of(self._requests)
        try:
            self._choose()
            self._survey()
        except OSError as error:
            raise LogError(f"{self.path}: cannot read it: {error}") from error
        except LogError as error:
            raise LogError(f"{self.path}: {error}") from error

    def _choose(self) -> None:
        """Find the columns and what their numbers mean."""
        table, columns = self._table, self._columns
        names, quantities = {"time": None}, {"time": None}
        for one in self._requests:
            if isinstance(one, ArmRequest):
                kinds = [name.partition("_")[2] for name in one.output_names]
                names |= dict.fromkeys(kind for kind in kinds if kinds.count(kind) == 1)
                names |= {"torque": None, **dict.fromkeys(one.output_names if kinds[1:] else ())}
                quantities |= dict.fromkeys([*kinds, "torque"])
            else:
                names |= dict.fromkeys(one.output_names + one.input_names)
                quantities |= dict.fromkeys(one.output_names + one.input_names)
        columns.require_known(list(names), list(quantities))
        time = columns.time()
        self._cells: list[_Cell] = []
        self.without_unit: list[tuple[str, ...]] = []
        only = self.joints[0] if len(self.joints) == 1 else _ONLY
        for joint, request in enumerate(self._requests):
            if isinstance(request, ArmRequest):
                self._choose_of_arm(joint, request, only)
            else:
                self._choose_of_system(joint, request)
        self._places = [one.place for one in (*time, *(cell.column for cell in self._cells))]
        self._decimal = table.decimal(self._places)
        self._time = TimeReader(time, table, self._decimal)
        self.remarks = (*dict.fromkeys(columns.remarks), *self._time.remarks)

    def _choose_of_arm(self, joint: int, request: ArmRequest, only: str) -> None:
        columns, names, name = self._columns, request.output_names, self.joints[joint]
        angles = []
        for place, output in enumerate(names):
            found = columns.of_output(output, names, only)
            if name not in found:
                kind = output if len(names) > 1 else output.partition("_")[2]
                raise LogError(f"no {kind} of {name}; there are {kind}s of {', '.join(found)}")
            quantity = output.partition("_")[2]
            self._add(found[name], quantity, (False, joint, place))
            angles += [found[name]] if quantity == "angle" else []
        torques = columns.of_torque(self.joints, only, needed=self._torque_needed)
        if torques:
            self._add(torques[name], "torque", (True, joint, 0))
        if (motor := torques.get(f"{name}_motor")) is not None and motor != torques[name]:
            self._add(motor, "torque", (True, joint, 0))
        without = not any(one.unit for one in angles)
        self.without_unit.append(tuple(one.title for one in angles) if without else ())

    def _choose_of_system(self, joint: int, request: TSRequest) -> None:
        for is_input, names, units in (
            (False, request.output_names, request.output_units),
            (True, request.input_names, request.input_units),
        ):
            for place, (name, unit) in enumerate(zip(names, units, strict=True)):
                what = "input" if is_input else "output"
                column = self._columns.of_signal(name, unit, self.joints[joint], what)
                self._cells.append(_Cell(column, 1.0, is_input, joint, place))
        self.without_unit.append(())

    def _add(self, column: Column, quantity: str, where: tuple[bool, int, int]) -> None:
        units = UNITS[quantity]
        self._cells.append(_Cell(column, units[column.unit or next(iter(units))], *where))

    def check_unit_of_angles(self, settings: ObserverSettings, designs: Sequence[Design]) -> None:
        check_unit_of_angles(self, settings, tuple(designs))

    def _survey(self) -> None:
        """Read the whole log for what must be known before the first line is used."""
        clock, spread = _LogClock(NO_TIME), -1.0
        first, newest = LATEST, NO_TIME
        self.count = 0
        self._sorted: list[_Block] = []
        for block in self._lines():
            self.count += len(block.stamps)
            clock.times(block.stamps)
            there = block.stamps[block.stamps != NO_TIME]
            first, newest = int(there.min(initial=first)), int(there.max(initial=newest))
            if (own := _spread(block.y)) > spread:
                spread, self.liveliest = own, block
        if not self.count:
            raise LogError("no lines below the header")
        if newest == NO_TIME:
            raise LogError(f"no line has a time in column {self._time.title!r}")
        self.moved_by = 0 if first > 0 else NANOSECONDS - first
        self._first = first + self.moved_by
        remarks = [*self.remarks, *clock.remarks(self.count)]
        if clock.shuffled:
            self._sort()
        if self._table.cut_off:
            remarks.append("note: the last line is cut off, and left out")
        if self.moved_by:
            shift = f"{self.moved_by / NANOSECONDS:g} s"
            remarks.append(f"note: {shift} was added to all times: 0 means no time")
        self.remarks = tuple(remarks)
        self.same_clock = clock.shuffled or not clock.restarts
        end = newest if self.same_clock else clock.last
        self.span = self._first, end + self.moved_by

    @cached_property
    def samples(self) -> Samples:
        """All measurements."""
        return next(self.parts()).samples

    def _sort(self) -> None:
        if self.count > _MAX_SORTED:
            raise LogError(
                f"its {self.count:,} lines are not in order of time, and no more than "
                f"{_MAX_SORTED:,} are sorted here: sort the file by its time"
            )
        stamps, y, u = map(np.concatenate, zip(*self._lines(), strict=True))
        # A line without time stays behind the one before it.
        order = np.argsort(_filled(stamps, NO_TIME), kind="stable")
        for begin in range(0, self.count, _BLOCK):
            part = order[begin : begin + _BLOCK]
            self._sorted.append(_Block(stamps[part], y[part], u[part]))
        self.liveliest = max(self._sorted, key=lambda block: _spread(block.y))
        apart = np.diff(stamps[order])
        if self._time.guessed and (apart > 0).any():
            check_period(self._time.title, float(np.median(apart[apart > 0])) / NANOSECONDS)

    def _lines(self) -> Iterator[_Block]:
        """Yield the log block by block, as it is."""
        rows = self._table.rows(self._places)
        self._time.restart()
        times, joints = len(self._places) - len(self._cells), len(self.joints)
        p = max(len(one.outputs) for one in self.signals)
        # Inputs without a column are 0.
        inputs = np.zeros((1, joints, max(len(one.inputs) for one in self.signals)))
        for cell in self._cells:
            if cell.in_inputs:
                inputs[0, cell.joint, cell.place] = np.nan
        while block := list(islice(rows, _BLOCK)):
            stamps = self._time.read(block)
            y, u = np.full((len(block), joints, p), np.nan), inputs.repeat(len(block), axis=0)
            for number, cell in enumerate(self._cells):
                values = np.array(self._read(block, times + number, cell.column))
                with np.errstate(over="ignore"):
                    values *= cell.factor
                own = (u if cell.in_inputs else y)[:, cell.joint, cell.place]
                # A second column has what the first one lacks.
                own[:] = np.where(np.isnan(own), values, own)
            yield _Block(stamps, y, u)

    def _read(self, rows: Sequence[Row], place: int, column: Column) -> list[float]:
        if self._decimal != ",":
            with suppress(ValueError):
                return [float(cells[place]) for _, cells in rows]
        return [self._number(line, cells[place], column) for line, cells in rows]

    def _number(self, line: int, cell: str, column: Column) -> float:
        try:
            return math.nan if is_nothing(cell) else float(plain_number(cell, self._decimal))
        except ValueError as error:
            raise misread("number", line, column, cell) from error

    def _part(self, block: _Block, clock: "_LogClock") -> Samples:
        there = block.stamps != NO_TIME
        stamps = np.where(there, block.stamps + np.where(there, self.moved_by, 0), 0)
        times = clock.times(np.where(there, stamps, NO_TIME))
        there = np.ones(block.y.shape[:2], np.bool_)
        data = self._encoded(stamps, block.y, block.u)
        checksums = np.array([crc32(row) for row in data], np.int64)
        return Samples(stamps, times, block.y, block.u, there, there, checksums)

    def _encoded(self, stamps: Times, y: Array, u: Array) -> NDArray[np.uint8]:
        """Return the messages of measurements, shape (n, size)."""
        places = [place for own in self.signals for place in (*own.outputs, *own.inputs)]
        values = [
            part[:, joint, : len(names)]
            for joint, own in enumerate(self.signals)
            for part, names in ((y, own.outputs), (u, own.inputs))
        ]
        return Layout(places).encode(stamps, np.hstack(values))

    @property
    def topics(self) -> tuple[TopicInfo, ...]:  # type: ignore[override]
        qos = (QosProfile(reliability="best_effort"),)
        definition = find_definition(JOINT_STATE)
        return (
            TopicInfo(f"/{MEASUREMENTS}", JOINT_STATE, qos_profiles=qos, definition=definition),
        )

    def parts(self, size: int | None = None, with_live: bool = False) -> Iterator[Part]:
        clock = _LogClock(self._first)
        blocks = (self._part(block, clock) for block in self._sorted or self._lines())
        together = None if size is None else max(1, size // _BLOCK)
        following = list(islice(blocks, together))
        while part := following:
            following = list(islice(blocks, together))
            samples = part[0].followed_by(*part[1:])
            yield Part(samples, {}, float(samples.log_times[-1]) if following else math.inf)

    def messages(self) -> Iterator[BagMessage]:
        for samples, _, _ in self.parts(_BLOCK):
            times, data = samples.log_times, self._encoded(samples.stamps, samples.y, samples.u)
            series = MessageSeries(f"/{MEASUREMENTS}", JOINT_STATE, times, times, data)
            yield from map(BagMessage._make, series.messages())


class _LogClock:
    """Log times that rise from line to line, whatever the stamps do.

    Args:
        first: The first one [ns].

    Attributes:
        restarts: How often time has restarted.
        last: The last log time [ns].
    """

    def __init__(self, first: int) -> None:
        self.restarts = 0
        self._equal = self._back = self._late = self._shift = 0
        self._stamp = self._highest = NO_TIME
        self.last = first - 1

    def times(self, stamps: Times) -> Times:
        """Return the log times of the next lines.

        Args:
            stamps: Of the lines [ns], `NO_TIME` if there is none, shape (n,).
        """
        filled = _filled(stamps, self._stamp)
        apart = np.diff(filled, prepend=self._stamp)
        self._back += int((apart < 0).sum())
        self._equal += int(((apart == 0) & (stamps != NO_TIME)).sum())
        begins: list[int] = []
        if (apart < 0).any() or filled[0] < self._highest:
            begins = restarts((filled + LATEST).tolist(), max(self._highest + LATEST, 0))
        times = np.empty_like(stamps)
        for number, (begin, end) in enumerate(pairwise([0, *begins, len(stamps)])):
            if number:
                self.restarts += 1
                self._highest = NO_TIME
                self._shift = self.last + _AFTER_RESTART - int(filled[begin])
            if begin == end:
                continue
            part, place = filled[begin:end], np.arange(end - begin)
            highest = np.maximum.accumulate(np.append(self._highest, part))
            self._late += int((part < highest[:-1]).sum())
            self._highest = int(highest[-1])
            risen = np.maximum(part + self._shift - place, self.last + 1)
            times[begin:end] = np.maximum.accumulate(risen) + place
            self.last = int(times[end - 1])
        self._stamp = int(filled[-1])
        return times

    @property
    def shuffled(self) -> bool:
        """Whether the lines are not in order of time, other than by its restarts."""
        return self._late > 0 and (not self.restarts or self._back > 10 * self.restarts)

    def remarks(self, count: int) -> list[str]:
        """Return what is to be noted on the times of so many lines."""
        found = []
        if self.shuffled:
            found.append("note: the lines are not in order of time: they were sorted")
        elif self.restarts:
            times = "once" if self.restarts == 1 else f"{self.restarts:,} times"
            found.append(f"note: time restarts {times}, and each time the observer does")
        if self._equal > _MANY_EQUAL * count:
            found.append(
                f"note: {self._equal:,} of {count:,} lines have the time of the line before, and "
                "are rejected: write times with more digits"
            )
        return found


def _filled(stamps: Times, before: int) -> Times:
    """Return the stamps, with that of the line before for each that is none."""
    places = np.where(stamps != NO_TIME, np.arange(1, len(stamps) + 1), 0)
    return np.asarray(np.append(before, stamps)[np.maximum.accumulate(places)])


def _spread(outputs: Array) -> float:
    """Return the largest range of an output, but for a tenth of its values."""
    spreads = [0.0]
    for joint in outputs.reshape(len(outputs), -1).T:
        # Larger ones are no angles.
        there = joint[np.abs(joint) < _LARGEST]
        if len(there):
            spreads.append(float(np.subtract(*np.percentile(there, (95, 5)))))
    return max(spreads)
