# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers over a recording, many in one pass, and a new bag of their estimates.

The messages are those of the observer node, byte for byte; made a block at a time they cost a tenth
of what they cost one by one.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, repeat
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.joint_series import JointSeries, Times
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.metadata import QosProfile
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.tracker import JointTrackers
from tsobs_ros.methods import ObserverSettings, make_estimator, make_tracker
from tsobs_ros.replay.log import LogSource
from tsobs_ros.replay.replay import (
    Estimated,
    Estimates,
    Replay,
    Reset,
    Schedule,
    Used,
    as_recorded,
    at_rate,
    at_samples,
)
from tsobs_ros.replay.source import BagSource, Live, Source
from tsobs_ros.replay.table import Agreement, EstimateTable, Recorded

Record: TypeAlias = tuple[str, str, bytes, int, int]
"""A `BagMessage` as a plain tuple, whose class would cost more than the rest of it."""

LOGS = (".csv", ".tsv", ".txt")
"""Suffixes of logs."""

_BLOCK = 1024
_ANGLES, _RATES = [0, 2], [1, 3]
_log_time = itemgetter(3)


@dataclass(frozen=True)
class Observer:
    """An observer to run.

    Attributes:
        name: Name of the node; its topics begin with it.
        settings: How it is run.
        designs: One a joint.
    """

    name: str
    settings: ObserverSettings
    designs: tuple[Design, ...]


def without_misfits(observers: Iterable[Observer]) -> tuple[list[Observer], list[str]]:
    """Return the observers that can observe their arms, and remarks on the others.

    Raises:
        ModelError: None of them can.
    """
    fitting, remarks = [], []
    for one in observers:
        try:
            for design in one.designs:
                make_estimator(design, one.settings)
            fitting.append(one)
        except ModelError as error:
            remarks.append(f"{one.name} is left out: {error}")
    if not fitting:
        raise ModelError("; ".join(remarks))
    return fitting, remarks


class Run:
    """One observer over some samples.

    Args:
        observer: The observer.
        source: The samples and their joints.
        schedule: The ticks.
        live: Output of the live observer, if the schedule is made of that.

    Attributes:
        observer: The observer.
        schedule: The ticks.
        replay: Its counts.
        table: Its estimates and innovations.
        topics: The topics that there may be messages of.
    """

    def __init__(
        self, observer: Observer, source: Source, schedule: Schedule, live: Live | None = None
    ) -> None:
        self.observer, self.schedule = observer, schedule
        self._samples = source.samples
        estimators = {id(one): make_estimator(one, observer.settings) for one in observer.designs}
        trackers = [
            make_tracker(design, observer.settings, estimators[id(design)])
            for design in observer.designs
        ]
        stale_after = observer.settings.stale_after
        self.replay = Replay(JointTrackers(trackers), source.samples, schedule, stale_after)
        names = map(observer.settings.learnt, observer.designs)
        learnt = dict(zip(source.joints, names, strict=True))
        most = max(map(len, learnt.values()), default=0)
        self.table = EstimateTable(schedule.count, source.samples.count, len(learnt), most)
        self._recorded = None if live is None else Recorded(live, schedule, source.samples)
        self._publisher = _Publisher(f"{source.namespace}/{observer.name}/", learnt)
        self.topics = self._publisher.topics
        self._joint_count = len(learnt)
        self._restarts = None if live is None else live.others.get(topics.RESTARTS)

    def records(self, progress: Callable[[int], None]) -> Iterator[Record]:
        """Run the observer, and yield its messages in order of log time.

        Args:
            progress: Called with the number of measurements taken since its last call.
        """
        yield from heapq.merge(self._restart_records(), self._run(progress), key=_log_time)

    def _restart_records(self) -> Iterator[Record]:
        """Return the messages of the start and of the restarts, those recorded if there are any."""
        schedule = self.schedule
        if self._restarts is not None:
            at = _Times.of(self._restarts)
            return self._publisher.messages(topics.RESTARTS, at, self._restarts.values[..., :1])
        begins = schedule.reset_after >= 0
        begins[:1] = True
        ticks = np.flatnonzero(begins)
        numbers = np.repeat(np.arange(float(len(ticks))), self._joint_count)
        numbers = numbers.reshape(len(ticks), -1, 1)
        return self._publisher.messages(topics.RESTARTS, _Times.of(schedule).take(ticks), numbers)

    def _run(self, progress: Callable[[int], None]) -> Iterator[Record]:
        block = _Block()
        for event in self.replay.run(self._recorded):
            match event:
                case Used(tick, message, outcomes):
                    self.table.add_innovations(message, outcomes)
                    block.messages.append(message)
                    block.ticks_of_use.append(tick)
                    if len(block.messages) >= _BLOCK:
                        progress(len(block.messages))
                        yield from self._published(block)
                        block = _Block()
                case Estimated(tick, estimates):
                    block.ticks.append(tick)
                    block.estimates.append(estimates)
                case Reset():
                    yield from self._published(block)
                    block = _Block()
                    self._publisher.reset()
        progress(len(block.messages))
        yield from self._published(block)

    def _published(self, block: "_Block") -> list[Record]:
        """Return the messages of a block of events, which is also entered into the table."""
        table, schedule, publish = self.table, self.schedule, self._publisher.messages
        ticks = np.array(block.ticks, np.intp)
        table.add(block.ticks, block.estimates)
        at = _Times.of(schedule).take(ticks)
        records = list(publish(topics.INNOVATION, *self._innovations(block)))
        for topic, values in (
            (topics.STATES, table.states[ticks]),
            (topics.STATE_BOUNDS, table.state_bounds[ticks]),
        ):
            records += publish(topic, at, values[..., _ANGLES], values[..., _RATES])
        disturbances = table.disturbances[ticks]
        records += publish(topics.DISTURBANCE, at, disturbances[..., :1], disturbances[..., 1:])
        records += publish(topics.DISTURBANCE_BOUND, at, table.disturbance_bounds[ticks])
        records += self._publisher.parameters(at, block.estimates)
        records.sort(key=_log_time)
        return records

    def _innovations(self, block: "_Block") -> tuple["_Times", Array]:
        """Return the innovations of a block, published at the tick at which they were used."""
        messages, ticks = np.array(block.messages, np.intp), np.array(block.ticks_of_use, np.intp)
        samples, schedule = self._samples, self.schedule
        log_times, publish_times = samples.log_times[messages], samples.publish_times[messages]
        there = ticks < schedule.count
        log_times[there] = schedule.log_times[ticks[there]]
        publish_times[there] = schedule.publish_times[ticks[there]]
        at = _Times(samples.stamps[messages], log_times, publish_times)
        return at, self.table.innovations[messages][..., np.newaxis]

    def agreement(self) -> Agreement | None:
        """Return the comparison with the recorded estimates, if the run was made by them."""
        return None if self._recorded is None else self._recorded.compare(self.table, self.replay)


def open_source(
    path: str | Path,
    *,
    topic: str | None = None,
    joints: Sequence[str] = (),
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    assume_zero_torque: bool = False,
) -> Source:
    """Open a bag, or a log if the suffix is one of `LOGS`.

    Args:
        path: The file or folder.
        topic: Of a bag, see `BagSource`.
        joints: Names of the joints; all that were measured if empty.
        columns: Of a log, see `LogSource`.
        units: Of a log, see `LogSource`.
        assume_zero_torque: Take measurements without torque as torque 0.

    Raises:
        BagReadError: The bag cannot be read, or does not have the measurements.
        LogError: The log cannot be read.
    """
    path, no_torque = Path(path), assume_zero_torque
    if path.is_file() and path.suffix.lower() in LOGS:
        return LogSource(
            path, columns=columns, units=units, joints=joints, assume_zero_torque=no_torque
        )
    return BagSource(path, topic=topic, joints=joints, assume_zero_torque=no_torque)


def make_runs(
    source: Source, observers: Iterable[Observer], *, rate: float | None, as_live: bool
) -> list[Run]:
    """Return a run of every observer over the same measurements.

    Args:
        source: The measurements.
        observers: The observers.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
    """
    samples = source.samples
    live = source.live if as_live else None
    if live is not None:
        innovations, restarts = map(live.others.get, (topics.INNOVATION, topics.RESTARTS))
        schedule = as_recorded(samples, live.states, innovations, restarts)
    else:
        schedule = at_samples(samples) if rate is None else at_rate(samples, rate)
    return [Run(observer, source, schedule, live) for observer in observers]


def run_all(
    source: Source,
    runs: Sequence[Run],
    output: Path | None,
    *,
    estimates_only: bool = False,
    progress: Callable[[int], None] = lambda _: None,
) -> None:
    """Run observers over the measurements and write their messages.

    Args:
        source: The measurements.
        runs: From `make_runs`.
        output: Folder of the new bag, which must not exist; None to write none.
        estimates_only: Leave out the measurements, and the truth of a simulation.
        progress: Called with the number of measurements that an observer has taken since.

    Raises:
        BagWriteError: The folder exists, the definition of JointStates is not to be found, or the
            bag cannot be written.
    """
    streams: list[Iterator[Record]] = [run.records(progress) for run in runs]
    if output is None:
        for stream in streams:
            deque(stream, maxlen=0)
        return
    own = (topic.definition for topic in source.topics if topic.type == JOINT_STATE)
    definition = next(own, None) or find_definition(JOINT_STATE)
    with BagWriter(output, custom_data={"estimated from": str(source.path)}) as writer:
        for one in () if estimates_only else source.topics:
            writer.add_topic(one.name, one.type, one.qos_profiles, definition=one.definition)
        for name in chain.from_iterable(run.topics for run in runs):
            writer.add_topic(name, JOINT_STATE, [QosProfile()], definition=definition)
        if not estimates_only:
            streams.insert(0, source.messages())
        for topic, _, data, log_time, publish_time in heapq.merge(*streams, key=_log_time):
            writer.write(topic, data, log_time, publish_time)


@dataclass(frozen=True)
class _Block:
    """Events whose messages are made at once: messages taken, and ticks estimated."""

    messages: list[int] = field(default_factory=list)
    ticks_of_use: list[int] = field(default_factory=list)
    ticks: list[int] = field(default_factory=list)
    estimates: list[Estimates] = field(default_factory=list)


class _Times(NamedTuple):
    """Header stamps, log times and publish times of m messages [ns], shape (m,) each."""

    stamps: Times
    log_times: Times
    publish_times: Times

    @classmethod
    def of(cls, one: Schedule | JointSeries) -> "_Times":
        return cls(one.stamps, one.log_times, one.publish_times)

    def take(self, places: NDArray[np.intp]) -> "_Times":
        return _Times(*(array[places] for array in self))


class _Publisher:
    """Makes the messages of one observer from arrays.

    Args:
        prefix: Of the topics' names, with a slash at its end.
        learnt: Names of the learnt parameters of each joint, by its name.
    """

    def __init__(self, prefix: str, learnt: dict[str, tuple[str, ...]]) -> None:
        self._prefix = prefix
        own = [(joint,) for joint in learnt]
        arms = [topics.sides(joint) for joint in learnt]
        parameters = [
            topics.parameter_names(joint, names, alone=len(learnt) == 1)
            for joint, names in learnt.items()
        ]
        self._learns = any(learnt.values())
        self._names: dict[str, Sequence[tuple[str, ...]]] = {
            **dict.fromkeys((topics.STATES, topics.STATE_BOUNDS), arms),
            **dict.fromkeys(topics.OF_JOINTS, own),
            **dict.fromkeys(topics.PARAMETER_TOPICS, parameters),
        }
        self._encoders: dict[tuple[str, tuple[int, ...]], JointStateEncoder] = {}
        self.reset()

    @property
    def topics(self) -> tuple[str, ...]:
        names = topics.TOPICS + (topics.PARAMETER_TOPICS if self._learns else ())
        return tuple(self._prefix + name for name in names)

    def reset(self) -> None:
        """Publish parameters at the next chance, as stamps may have gone back."""
        self._parameters_due = 0

    def messages(
        self, topic: str, at: _Times, values: Array, rates: Array | None = None
    ) -> Iterator[Record]:
        """Yield messages of the joints that have a number in each.

        Args:
            topic: Of `_names`.
            at: Times of the messages.
            values: Positions, NaN for none, shape (m, J, k).
            rates: Velocities, shape (m, J, k); all NaN if the disturbance model has none.
        """
        for joints, rows in _alike(np.isfinite(values[..., 0])):
            position = values[rows][:, joints].reshape(len(rows), -1)
            velocity = position[:, :0]
            if rates is not None:
                chosen = rates[rows][:, joints].reshape(len(rows), -1)
                velocity = velocity if np.isnan(chosen).all() else chosen
            yield from self._records(topic, joints, at.take(rows), position, velocity)

    def parameters(self, at: _Times, estimates: list[Estimates]) -> Iterator[Record]:
        """Yield the learnt parameters, as often as they are published."""
        if not self._learns:
            return
        for place, (stamp, each) in enumerate(zip(at.stamps.tolist(), estimates, strict=True)):
            valid = [(joint, one) for joint, one in enumerate(each) if one and one.parameters_valid]
            if stamp < self._parameters_due or not valid:
                continue
            self._parameters_due = stamp + topics.PARAMETER_PERIOD
            joints, known = zip(*valid, strict=True)
            own = at.take(np.array([place]))
            for topic, arrays in (
                (topics.PARAMETERS, [one.parameters for one in known]),
                (topics.PARAMETER_BOUNDS, [one.parameter_bound for one in known]),
            ):
                values = np.concatenate(arrays)[np.newaxis]
                yield from self._records(topic, list(joints), own, values, values[:, :0])

    def _records(
        self, topic: str, joints: list[int], at: _Times, position: Array, velocity: Array
    ) -> Iterator[Record]:
        encode = self._encoders.get((topic, tuple(joints)))
        if encode is None:
            names = [name for joint in joints for name in self._names[topic][joint]]
            encode = self._encoders[topic, tuple(joints)] = JointStateEncoder(names)
        data = encode.encode_all(at.stamps, position, velocity)
        times = (at.log_times.tolist(), at.publish_times.tolist())
        return zip(repeat(self._prefix + topic), repeat(JOINT_STATE), data, *times)


def _alike(present: NDArray[np.bool_]) -> Iterator[tuple[list[int], NDArray[np.intp]]]:
    """Yield each set of joints that messages are about, and the places of those messages."""
    for pattern in np.unique(present, axis=0):
        if pattern.any():
            yield np.flatnonzero(pattern).tolist(), np.flatnonzero((present == pattern).all(axis=1))
