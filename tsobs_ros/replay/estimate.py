# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers over a recording, many in one pass, and a new bag of their estimates.

The messages are those of the observer node, byte for byte; made a block at a time they cost a tenth
of what they cost one by one.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import encode_text
from tsobs_ros.bag.container import MAGIC
from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.joint_series import JointSeries, Times
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile
from tsobs_ros.bag.writer import Message, MessageSeries, whole_bag
from tsobs_ros.checks import Array, Flags
from tsobs_ros.design.file import DesignFile
from tsobs_ros.design.published import record_text
from tsobs_ros.design.record import Design
from tsobs_ros.errors import BagWriteError, LogError, ModelError
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.replay.designs import STRING
from tsobs_ros.replay.fit import check_unit_of_angles
from tsobs_ros.replay.health import EventFinder, Health, HealthSum, JointEvent
from tsobs_ros.replay.log import LogSource
from tsobs_ros.replay.output import EstimateBag
from tsobs_ros.replay.places import Layout, Places, places_of
from tsobs_ros.replay.replay import Replay
from tsobs_ros.replay.schedule import Schedule
from tsobs_ros.replay.source import BagSource, Samples, Source
from tsobs_ros.replay.table import Agreement, AgreementCount, EstimateTable
from tsobs_ros.replay.windows import Window, Windows

_OF_BAGS = (".mcap", ".yaml", ".db3")

_BLOCK = 4096
_LATCHED = QosProfile(durability="transient_local", depth=1)


@dataclass(frozen=True)
class Observer:
    """An observer to run.

    Attributes:
        name: Name of the node; its topics begin with it.
        settings: How it is run.
        files: Design file of each joint.
    """

    name: str
    settings: ObserverSettings
    files: tuple[DesignFile, ...]

    @property
    def designs(self) -> tuple[Design, ...]:
        """The design of each joint."""
        return tuple(file.design for file in self.files)


def without_misfits(observers: Iterable[Observer]) -> tuple[list[Observer], list[str]]:
    """Return the observers that can observe their arms, and remarks on the others.

    Raises:
        ModelError: None of them can.
    """
    fitting: list[Observer] = []
    remarks = []
    for one in observers:
        try:
            for design in one.designs:
                make_tracker(design, one.settings)
            if twin := next((other for other in fitting if _are_same(one, other)), None):
                raise ModelError(f"its design calls no parameter uncertain, so it is {twin.name}")
            fitting.append(one)
        except ModelError as error:
            remarks.append(f"{one.name} is left out: {error}")
    if not fitting:
        raise ModelError("; ".join(remarks))
    return fitting, remarks


def _are_same(one: Observer, other: Observer) -> bool:
    """Return whether observers differ at most in that one would learn what no design has."""
    learnt = any(each.settings.learnt(design) for each in (one, other) for design in each.designs)
    alike = replace(one.settings, adapt=other.settings.adapt) == other.settings
    return one.files == other.files and alike and not learnt


class Run:
    """One observer over a recording, window by window.

    Args:
        observer: The observer.
        source: The measurements and their joints.
        windows: The recording's.

    Attributes:
        observer: The observer.
        windows: The recording's.
        signals: The places of each joint's signals.
        replay: Its counts.
        estimates: Number of ticks with an estimate.
        samples: The measurements of the window.
        schedule: The ticks of the window.
        table: The estimates and innovations of the window.
        made: The ticks of the window that were made, and the messages that were used by then.
        horizon: Smallest log time of what follows the window [ns].
        topics: The topics of JointStates that there may be messages of.
        record_topic: The topic of its record.
    """

    samples: Samples
    schedule: Schedule
    table: EstimateTable
    made: tuple[slice, slice]
    horizon: float

    def __init__(self, observer: Observer, source: Source, windows: Windows) -> None:
        self.observer, self.windows = observer, windows
        self.estimates = 0
        self._source = source
        estimators: dict[int, Any] = {}
        trackers = []
        for design in observer.designs:
            one = make_tracker(design, observer.settings, estimators.get(id(design)))
            estimators[id(design)] = one.estimator
            trackers.append(one)
        self.replay = Replay(trackers, observer.settings.stale_after)
        self._shapes = [each.estimator.shape for each in trackers]
        self.signals = source.signals_of([design.request for design in observer.designs])
        alone = len(source.joints) == 1
        prefix = f"{source.namespace}/{observer.name}/"
        each = zip(source.joints, self.signals, observer.designs, trackers, strict=True)
        self._publisher = _Publisher(
            prefix,
            [
                places_of(
                    joint,
                    own,
                    alone=alone,
                    learnt=observer.settings.learnt(design),
                    rated="disturbance_rate" not in tracker.estimator.lacking,
                )
                for joint, own, design, tracker in each
            ],
        )
        self.record_topic = prefix + topics.DESIGN
        self.topics = self._publisher.topics
        self._parameters_due, self._health_due = _Due(), _Due()
        self._agreement = AgreementCount()
        self._health = {joint: HealthSum() for joint in source.joints}
        self._events = EventFinder(
            source.joints,
            source.topic,
            observer.settings.stale_after,
            same_clock=source.same_clock,
        )
        # Numbers of restarts: published, until now, and before the last health.
        self._told, self._restarts, self._restarts_before = 0, 0, 0

    def record(self) -> Message:
        """Return the message of its record."""
        observer, source = self.observer, self._source
        parameters = observer.settings.as_parameters()
        text = record_text(source.topic, source.joints, observer.files, parameters)
        begin, _ = source.span
        return self.record_topic, STRING, encode_text(text), begin, begin

    def enter(self, window: Window, dropped: int) -> None:
        """Go on with a window.

        Args:
            window: The window.
            dropped: Number of the last window's samples that it is without.
        """
        self.samples, self.schedule = window.samples, window.schedule
        count = window.schedule.count
        self.table = EstimateTable(count, window.samples.count, self._shapes)
        self.replay.enter(self.samples, self.schedule, self.table, window.recorded, dropped)

    def restarts(self, window: Window) -> list[MessageSeries]:
        """Return the messages of the start and of the restarts, those recorded if there are any."""
        if window.restarts is not None:
            at, numbers = _Times.of(window.restarts), window.restarts.values
            return self._publisher.messages(topics.RESTARTS, at, numbers)
        ticks = np.flatnonzero(self.schedule.reset_after[: window.ticks] >= 0)
        if not self._told:
            ticks = np.union1d(ticks, [0])[: window.ticks]
        shape = (len(ticks), len(self.observer.designs), 1)
        numbers = self._told + np.arange(float(shape[0])).reshape(-1, 1, 1)
        self._told += len(ticks)
        at = _Times.of(self.schedule).take(ticks)
        return self._publisher.messages(topics.RESTARTS, at, np.broadcast_to(numbers, shape))

    def blocks(
        self, window: Window, progress: Callable[[int], None], *, encode: bool
    ) -> Iterator[list[MessageSeries]]:
        """Run the observer block by block of a window's ticks, and yield the messages of each.

        Args:
            window: The window, which has been entered.
            progress: Called with the number of measurements taken since its last call.
            encode: Whether there are to be messages.
        """
        begun = self.replay.taken
        for begin in range(0, max(1, window.ticks), _BLOCK):
            ticks = slice(begin, min(begin + _BLOCK, window.ticks))
            taken = self.replay.advance(ticks.stop)
            if ticks.stop == window.ticks:
                taken = slice(taken.start, self._use_rest(window, taken.stop))
            progress(taken.stop - taken.start)
            yield self._published(ticks, taken, encode=encode)
        messages = slice(begun, self.replay.taken)
        self.made, self.horizon = (slice(0, window.ticks), messages), window.horizon
        self._agreement.began(self.replay.began_without_past)
        if window.recorded is not None:
            ticks = self.made[0]
            same = window.recorded.same(self.table, ticks)
            self._agreement.add_ticks(self.schedule.stamps[ticks], same)
            self._agreement.add_messages(window.recorded.innovations, self.table, messages)
            self._agreement.add_not_recorded(window.not_recorded)

    def _use_rest(self, window: Window, taken: int) -> int:
        """Use what no tick takes, and return the number of samples that were taken."""
        if window.is_last:
            return int(self.replay.use(window.samples.count).stop)
        # Of a long time without ticks, all but the end.
        waiting = window.known - taken
        if 2 * waiting > window.samples.count:
            return int(self.replay.use(taken + waiting // 2).stop)
        return taken

    def _published(self, ticks: slice, taken: slice, *, encode: bool) -> list[MessageSeries]:
        """Return the messages of some ticks, and of the innovations of the samples taken there."""
        table = self.table
        publish = self._publisher.messages if encode else _no_messages
        at = _Times.of(self.schedule).take(ticks)
        messages = publish(topics.INNOVATION, self._times_of_use(taken), table.innovations[taken])
        for topic, values in table.of_topics.items():
            messages += publish(topic, at, values[ticks])
        valid = table.conditions["parameters_valid"][ticks] == 1.0
        due = self._parameters_due.among(at.stamps, valid.any(axis=1))
        for topic, values in (
            (topics.PARAMETERS, table.parameters[ticks]),
            (topics.PARAMETER_BOUNDS, table.parameter_bounds[ticks]),
        ):
            if len(due):
                known = np.where(valid[due, :, None], values[due], np.nan)
                messages += publish(topic, at.take(due), known)
        self.estimates += int(table.done[ticks].sum())
        conditions = table.health(ticks)
        for joint, health in enumerate(self._health.values()):
            health.add(conditions[:, joint])
        due = self._health_due.among(at.stamps, table.done[ticks])
        restarts = self._restarts + np.cumsum(self.schedule.reset_after[ticks] >= 0)
        if len(due):
            messages += publish(topics.HEALTH, at.take(due), conditions[due])
            restarted = np.diff(restarts[due], prepend=self._restarts_before) > 0
            self._events.add(at.stamps[due], at.log_times[due], conditions[due], restarted)
            self._restarts_before = int(restarts[due[-1]])
        self._restarts = int(restarts[-1]) if len(restarts) else self._restarts
        return messages

    def _times_of_use(self, taken: slice) -> "_Times":
        """Return the times of innovations, which are published at the tick that uses the sample."""
        at = _Times.of(self.samples).take(taken)
        of_use = self.table.times_of_use[taken]
        there = of_use[:, 0] >= 0
        for own, theirs in zip(at[1:], of_use.T, strict=True):
            own[there] = theirs[there]
        return at

    def outputs(self) -> dict[str, dict[str, dict[str, int]]]:
        """Return how often each output was gated and missing, of joints that have several."""
        each = zip(self._source.joints, self.observer.designs, self.replay.outputs, strict=True)
        return {
            joint: {
                name: {"gated": int(gated), "missing": int(missing)}
                for name, (gated, missing) in zip(
                    design.request.output_names, counts.tolist(), strict=True
                )
            }
            for joint, design, counts in each
            if len(counts) > 1
        }

    def events(self) -> list[JointEvent]:
        """Return the events that the node would have logged, in order."""
        return self._events.events

    def health(self) -> dict[str, Health]:
        """Return the health of each joint that has estimates."""
        found = {joint: one.result() for joint, one in self._health.items()}
        return {joint: one for joint, one in found.items() if one is not None}

    def agreement(self) -> Agreement | None:
        """Return the comparison with the recorded estimates, if the run was made by them."""
        return self._agreement.result() if self.windows.as_live else None


def is_log(path: Path) -> bool:
    """Return whether a path is of a file that is none of a bag's.

    Raises:
        LogError: The file cannot be read.
    """
    if not path.is_file() or path.suffix.lower() in _OF_BAGS:
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) != MAGIC
    except OSError as error:
        raise LogError(f"{path}: cannot read it: {error}") from error


def open_source(
    path: str | Path,
    *,
    topic: str | None = None,
    joints: Sequence[str] = (),
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    assume_zero_torque: bool | None = None,
) -> Source:
    """Open a bag, or a log if it is a file that is none of a bag's.

    Args:
        path: The file or folder.
        topic: Of a bag, see `BagSource`.
        joints: Names of the joints; all that were measured if empty.
        columns: Of a log, see `LogSource`.
        units: Of a log, see `LogSource`.
        assume_zero_torque: Take measurements without torque as torque 0; None: as the observer of
            a bag, of a log not.

    Raises:
        BagReadError: The bag cannot be read, or does not have the measurements.
        LogError: The log cannot be read.
    """
    path, no_torque = Path(path), assume_zero_torque
    if is_log(path):
        return LogSource(
            path, columns=columns, units=units, joints=joints, assume_zero_torque=bool(no_torque)
        )
    return BagSource(path, topic=topic, joints=joints, assume_zero_torque=no_torque)


def make_runs(
    source: Source,
    observers: Iterable[Observer],
    *,
    rate: float | None,
    as_live: bool,
    window: int | None = None,
) -> list[Run]:
    """Return a run of every observer over the same measurements.

    Args:
        source: The measurements.
        observers: The observers.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
        window: Number of messages in a window; None for one that has them all, so that the runs'
            tables have everything.

    Raises:
        LogError: The angles of a log seem to be in degrees, though nobody stated their unit.
    """
    observers = list(observers)
    for observer in observers:
        source.observe([design.request for design in observer.designs])
    if isinstance(source, LogSource) and observers:
        check_unit_of_angles(source, observers[0].settings, observers[0].designs)
    windows = Windows(source, rate, as_live, window)
    return [Run(observer, source, windows) for observer in observers]


def run_all(
    source: Source,
    runs: Sequence[Run],
    output: Path | None,
    *,
    estimates_only: bool = False,
    progress: Callable[[int], None] = lambda _: None,
    after_window: Callable[[], None] = lambda: None,
) -> None:
    """Run observers over the measurements and write their messages.

    Args:
        source: The measurements.
        runs: From `make_runs`.
        output: Folder of the new bag, which must not exist; None to write none.
        estimates_only: Leave out the measurements, and the truth of a simulation.
        progress: Called with the number of measurements that an observer has taken since.
        after_window: Called when all observers have made a window's ticks.

    Raises:
        BagWriteError: The folder exists, the definition of JointStates is not to be found, or the
            bag cannot be written.
    """
    if output is None:
        for window in runs[0].windows.over(runs):
            for _ in _blocks(runs, window, progress, encode=False):
                pass
            after_window()
        return
    own = (topic.definition for topic in source.topics if topic.type == JOINT_STATE)
    definition = next(own, None) or find_definition(JOINT_STATE)
    with whole_bag(output, custom_data={"estimated from": str(source.path)}) as writer:
        bag = EstimateBag(source, writer, estimates_only=estimates_only)
        for name in chain.from_iterable(run.topics for run in runs):
            writer.add_topic(name, JOINT_STATE, [QosProfile()], definition=definition)
        for run in runs:
            writer.add_topic(run.record_topic, STRING, [_LATCHED], definition=_text_definition())
        # First of all, so that they come first among the messages of their time.
        writer.write_all([run.record() for run in runs])
        for window in runs[0].windows.over(runs):
            bag.add(chain.from_iterable(run.restarts(window) for run in runs))
            for horizon, made in _blocks(runs, window, progress, encode=True):
                bag.add(made)
                bag.write(horizon)
            after_window()


def _text_definition() -> MessageDefinition:
    try:
        return find_definition(STRING)
    except BagWriteError:  # there need not be a ROS
        return MessageDefinition(STRING, "string data\n", "")


def _blocks(
    runs: Sequence[Run], window: Window, progress: Callable[[int], None], *, encode: bool
) -> Iterator[tuple[float, list[MessageSeries]]]:
    """Yield the messages of all runs in a window block by block.

    Each comes with the log time that the messages of later blocks have at least [ns].
    """
    times = window.schedule.log_times
    own = [run.blocks(window, progress, encode=encode) for run in runs]
    # The core runs for several observers at once.
    with ThreadPoolExecutor(min(len(runs), os.cpu_count() or 1)) as pool:
        together = iter(lambda: list(pool.map(_next, own)), [None] * len(own))
        for number, blocks in enumerate(together, 1):
            following = times[min(number * _BLOCK, window.ticks) :][:1].tolist()
            made = [series for block in blocks for series in block or ()]
            yield min([window.horizon, *following]), made


def _next(blocks: Iterator[list[MessageSeries]]) -> list[MessageSeries] | None:
    return next(blocks, None)


def _no_messages(*_: object) -> list[MessageSeries]:
    return []


class _Times(NamedTuple):
    """Header stamps, log times and publish times of m messages [ns], shape (m,) each."""

    stamps: Times
    log_times: Times
    publish_times: Times

    @classmethod
    def of(cls, one: Schedule | Samples | JointSeries) -> "_Times":
        return cls(one.stamps, one.log_times, one.publish_times)

    def take(self, places: NDArray[np.intp] | slice) -> "_Times":
        return _Times(*(array[places] for array in self))


class _Due:
    """Finds the ticks at which a node publishes what changes slowly."""

    def __init__(self) -> None:
        self._last = -topics.SLOW_PERIOD

    def among(self, stamps: Times, there: Flags) -> NDArray[np.intp]:
        """Return the places of those among the next ticks that have something to publish."""
        due = []
        for place in np.flatnonzero(there).tolist():
            stamp = int(stamps[place])
            if not 0 <= stamp - self._last < topics.SLOW_PERIOD:
                due.append(place)
                self._last = stamp
        return np.array(due, np.intp)


class _Publisher:
    """Makes the messages of one observer from arrays.

    Args:
        prefix: Of the topics' names, with a slash at its end.
        joints: The places of each joint's numbers.
    """

    def __init__(self, prefix: str, joints: Sequence[Places]) -> None:
        self._prefix = prefix
        optional = (*topics.TORQUE_TOPICS, *topics.PARAMETER_TOPICS)
        there = {name for places in joints for name in optional if places[name]}
        self._names = [*topics.TOPICS, *(name for name in optional if name in there)]
        self._layouts = {name: Layout([one[name] for one in joints]) for name in self._names}

    @property
    def topics(self) -> tuple[str, ...]:
        return tuple(self._prefix + name for name in self._names)

    def messages(self, topic: str, at: _Times, values: Array) -> list[MessageSeries]:
        """Return messages of the entries that have a number in each.

        Args:
            topic: One of `bag.estimate_topics`.
            at: Times of the messages.
            values: In the order of `places_of`, NaN for none, shape (m, J, width).
        """
        messages: list[MessageSeries] = []
        if topic not in self._layouts:
            return messages
        layout = self._layouts[topic]
        present = layout.present(values)
        if topic != topics.INNOVATION:
            # The first number of a joint decides on all of them.
            present = present[:, layout.first]
        for entries, rows in _alike(present):
            chosen = at.take(rows)
            data = layout.encode(chosen.stamps, values[rows], entries)
            name, times = self._prefix + topic, chosen[1:]
            messages.append(MessageSeries(name, JOINT_STATE, *times, data))
        return messages


def _alike(present: NDArray[np.bool_]) -> Iterator[tuple[list[int], NDArray[np.intp]]]:
    """Yield each set of entries that messages have, and the places of those messages."""
    for pattern in np.unique(present, axis=0):
        if pattern.any():
            yield np.flatnonzero(pattern).tolist(), np.flatnonzero((present == pattern).all(axis=1))
