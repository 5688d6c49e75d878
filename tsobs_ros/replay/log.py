# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from an arm's own log: a CSV file of time, angle and torque."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.joint_series import Times
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.metadata import QosProfile, TopicInfo
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.checks import Array
from tsobs_ros.errors import LogError
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.cells import Row, TextTable, is_nothing, plain_number
from tsobs_ros.replay.columns import UNITS, Column, Columns, is_unit, misread
from tsobs_ros.replay.source import MEASUREMENTS, Part, Samples, Source, restarts
from tsobs_ros.replay.times import LATEST, NO_TIME, TimeReader, check_period

_BLOCK = 4096
# Lines that are not in order are sorted in memory.
_MAX_SORTED = 5_000_000
_LARGEST = 1e9
_MANY_EQUAL = 0.1
_AFTER_RESTART = 1_000_000


class _Block(NamedTuple):
    """Lines of a log: stamps [ns], angles [rad] and torques [N m], NaN for an empty cell."""

    stamps: Times
    angles: Array
    torques: Array


class LogSource(Source):
    """A CSV log as a source of measurements, read line by line.

    Titles, units, separators and number formats are found in the first lines; see `cells` and
    `columns`. Cells that are empty or NaN are measurements that will be rejected, and counted.
    Lines that are not in order of time are sorted. A log whose times begin at zero or before is
    moved, so that it begins at 1 s: a stamp of zero means none.

    Args:
        path: The file.
        columns: Titles or numbers of columns by quantity: `time`, `angle` and `torque`, or
            `angle.JOINT` and `torque.JOINT` for several joints; the others are found by their
            usual names.
        units: Units by quantity, for columns whose title has none.
        joints: Names of the joints to read; all of them if empty. One name renames the joint of
            columns that name none.
        assume_zero_torque: Take torque as 0 if there is no such column.

    Attributes:
        moved_by: Shift of the times [ns].
        without_unit: Titles of the columns whose unit nobody stated, by quantity.
        liveliest: The part in which the angles move most.

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
        try:
            self._table = TextTable(path, is_unit)
            self._choose(columns or {}, units or {}, joints, not assume_zero_torque)
            self._survey()
        except OSError as error:
            raise LogError(f"{path}: cannot read it: {error}") from error
        except LogError as error:
            raise LogError(f"{path}: {error}") from error

    def _choose(
        self,
        wanted: Mapping[str, str],
        units: Mapping[str, str],
        joints: Sequence[str],
        torque_needed: bool,
    ) -> None:
        """Find the columns and what their numbers mean."""
        table = self._table
        columns = Columns(table.titles, table.units, wanted, units)
        if not table.has_titles and not {"time", "angle"} <= {n.partition(".")[0] for n in wanted}:
            raise LogError(
                "the first line has numbers and no titles: put a line such as 'time [s],angle "
                "[rad],torque [N m]' before it, or give the columns' numbers: --columns "
                "time=1,angle=2,torque=3"
            )
        time = columns.time()
        only = joints[0] if len(joints) == 1 else "elastic_joint"
        angles, torques = columns.of_joints(only, torque_needed=torque_needed)
        if missing := [joint for joint in joints if joint not in angles]:
            raise LogError(
                f"no angle of {', '.join(missing)}; there are angles of {', '.join(angles)}"
            )
        self.joints = tuple(joints) or tuple(angles)
        self._numbers = [
            (one, UNITS[quantity][one.unit or next(iter(UNITS[quantity]))])
            for quantity, of in (("angle", angles), ("torque", torques))
            for one in (of[joint] for joint in self.joints if of)
        ]
        self._places = [one.place for one in (*time, *(one for one, _ in self._numbers))]
        self._decimal = table.decimal(self._places)
        self._time = TimeReader(time, table, self._decimal)
        self.without_unit = {
            quantity: [one.title for one in of.values()]
            for quantity, of in (("angle", angles), ("torque", torques))
            if of and not any(one.unit for one in of.values())
        }
        self.remarks = (*columns.remarks, *self._time.remarks)

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
            if (own := _spread(block.angles)) > spread:
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
        stamps, angles, torques = map(np.concatenate, zip(*self._lines(), strict=True))
        # A line without time stays behind the one before it.
        order = np.argsort(_filled(stamps, NO_TIME), kind="stable")
        for begin in range(0, self.count, _BLOCK):
            part = order[begin : begin + _BLOCK]
            self._sorted.append(_Block(stamps[part], angles[part], torques[part]))
        self.liveliest = max(self._sorted, key=lambda block: _spread(block.angles))
        apart = np.diff(stamps[order])
        if self._time.guessed and (apart > 0).any():
            check_period(self._time.title, float(np.median(apart[apart > 0])) / NANOSECONDS)

    def _lines(self) -> Iterator[_Block]:
        """Yield the log block by block, as it is."""
        rows = self._table.rows(self._places)
        self._time.restart()
        times, joints = len(self._places) - len(self._numbers), len(self.joints)
        while block := list(islice(rows, _BLOCK)):
            stamps = self._time.read(block)
            values = np.zeros((len(block), 2 * joints))
            for place, (column, factor) in enumerate(self._numbers):
                values[:, place] = self._read(block, times + place, column)
                with np.errstate(over="ignore"):
                    values[:, place] *= factor
            yield _Block(stamps, values[:, :joints], values[:, joints:])

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
        there = np.ones(block.angles.shape, np.bool_)
        y, u = block.angles, block.torques
        return Samples(stamps, times, times, y, u, there, there, self.same_clock)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:  # type: ignore[override]
        qos = (QosProfile(reliability="best_effort"),)
        definition = find_definition(JOINT_STATE)
        return (
            TopicInfo(f"/{MEASUREMENTS}", JOINT_STATE, qos_profiles=qos, definition=definition),
        )

    def parts(self, size: int | None = None, with_live: bool = True) -> Iterator[Part]:
        clock = _LogClock(self._first)
        blocks = (self._part(block, clock) for block in self._sorted or self._lines())
        together = None if size is None else max(1, size // _BLOCK)
        following = list(islice(blocks, together))
        while part := following:
            following = list(islice(blocks, together))
            samples = part[0].followed_by(*part[1:])
            # Whether time restarts at a line shows in the next ones.
            horizon = samples.log_times[-samples.count // 4] if following else math.inf
            yield Part(samples, {}, float(horizon))

    def messages(self) -> Iterator[BagMessage]:
        encode = JointStateEncoder(self.joints)
        for samples, _, _ in self.parts(_BLOCK):
            data = encode.encode_all(samples.stamps, samples.y, samples.y[:, :0], samples.u)
            for one, time in zip(data, samples.log_times.tolist(), strict=True):
                yield BagMessage(f"/{MEASUREMENTS}", JOINT_STATE, one, time, time)


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


def _spread(angles: Array) -> float:
    """Return the largest range of a joint's angle [rad], but for a tenth of them."""
    spreads = [0.0]
    for joint in angles.T:
        # Larger ones are no angles.
        there = joint[np.abs(joint) < _LARGEST]
        if len(there):
            spreads.append(float(np.subtract(*np.percentile(there, (95, 5)))))
    return max(spreads)
