# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers over a recording, as many as wanted in one pass, and a new bag of their estimates."""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.messages.estimate_topics import (
    DISTURBANCE,
    DISTURBANCE_BOUND,
    INNOVATION,
    STATE_BOUNDS,
    STATES,
)
from tsobs_ros.bag.messages.joint_states import JOINT_STATE
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.joints import JointTrackers
from tsobs_ros.methods import ObserverSettings, make_estimator, make_tracker
from tsobs_ros.replay.publishing import Publishing, Record, Stamped, by_log_time
from tsobs_ros.replay.replay import Afresh, Estimated, Estimates, Replay, Used
from tsobs_ros.replay.schedule import Schedule, as_recorded, at_rate, at_samples
from tsobs_ros.replay.source import Live, Source
from tsobs_ros.replay.table import Agreement, EstimateTable, Recorded

_BLOCK = 1024


@dataclass(frozen=True)
class Observer:
    """An observer to run.

    Attributes:
        name: As of a node: its topics begin with it.
        settings: How it is run.
        designs: One a joint.
    """

    name: str
    settings: ObserverSettings
    designs: tuple[Design, ...]


class _Block(NamedTuple):
    """Events whose messages are made at once: messages taken, and ticks estimated."""

    messages: list[int]
    ticks_of_use: list[int]
    ticks: list[int]
    estimates: list[Estimates]


class Run:
    """One observer over some samples.

    Args:
        observer: The observer.
        source: The samples and their joints.
        schedule: When it estimates.
        live: What the live observer estimated, if the schedule is made of that.

    Attributes:
        observer: The observer.
        schedule: When it estimates.
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
        self.table = EstimateTable(schedule.count, source.samples.count, len(source.joints))
        self._recorded = None if live is None else Recorded(live, schedule)
        learnt = zip(source.joints, map(observer.settings.learnt, observer.designs), strict=True)
        self._publishing = Publishing(f"{source.namespace}/{observer.name}/", dict(learnt))
        self.topics = self._publishing.topics

    def records(self, progress: Callable[[int], None]) -> Iterator[Record]:
        """Run the observer, and yield what it publishes, in order of log time.

        Args:
            progress: Told now and then of how many measurements more have been taken.
        """
        agrees = None if self._recorded is None else self._recorded.agrees
        block = _Block([], [], [], [])
        for event in self.replay.run(agrees):
            match event:
                case Used(tick, message, outcomes):
                    self.table.add_innovations(message, outcomes)
                    block.messages.append(message)
                    block.ticks_of_use.append(tick)
                    if len(block.messages) >= _BLOCK:
                        progress(len(block.messages))
                        yield from self._published(block)
                        block = _Block([], [], [], [])
                case Estimated(tick, estimates):
                    block.ticks.append(tick)
                    block.estimates.append(estimates)
                case Afresh():
                    yield from self._published(block)
                    block = _Block([], [], [], [])
                    self._publishing.restart()
        progress(len(block.messages))
        yield from self._published(block)

    def _published(self, block: "_Block") -> list[Record]:
        """Return the messages of a block of events, which is also kept in the table."""
        table, publishing, schedule = self.table, self._publishing, self.schedule
        ticks = np.array(block.ticks, np.intp)
        table.add(block.ticks, block.estimates)
        at = Stamped(schedule.stamps, schedule.log_times, schedule.publish_times).take(ticks)
        records = [
            *publishing.scalars(INNOVATION, *self._innovations(block)),
            *publishing.motion(STATES, at, table.states[ticks]),
            *publishing.motion(STATE_BOUNDS, at, table.state_bounds[ticks]),
            *publishing.scalars(DISTURBANCE, at, table.disturbances[ticks]),
            *publishing.scalars(DISTURBANCE_BOUND, at, table.disturbance_bounds[ticks]),
            *publishing.parameters(at, block.estimates),
        ]
        records.sort(key=by_log_time)
        return records

    def _innovations(self, block: "_Block") -> tuple[Stamped, Array]:
        """Return the innovations of a block, published at the tick at which they were used."""
        messages, ticks = np.array(block.messages, np.intp), np.array(block.ticks_of_use, np.intp)
        samples, schedule = self._samples, self.schedule
        log_times, publish_times = samples.log_times[messages], samples.publish_times[messages]
        there = ticks < schedule.count
        log_times[there] = schedule.log_times[ticks[there]]
        publish_times[there] = schedule.publish_times[ticks[there]]
        at = Stamped(samples.stamps[messages], log_times, publish_times)
        return at, self.table.innovations[messages][..., np.newaxis]

    def agreement(self) -> Agreement | None:
        """Return how the estimates compare with the recorded ones, if the run was made by them."""
        return None if self._recorded is None else self._recorded.compare(self.table, self._samples)


def make_runs(
    source: Source, observers: Iterable[Observer], *, rate: float | None, as_live: bool
) -> list[Run]:
    """Return a run of every observer over the same measurements.

    Args:
        source: The measurements.
        observers: What to run.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
    """
    samples = source.samples
    live = source.live if as_live else None
    if live is not None:
        innovations = live.others.get(INNOVATION)
        schedule = as_recorded(samples, live.states, innovations)
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
    """Run observers over the measurements and write what they publish.

    Args:
        source: The measurements.
        runs: From `make_runs`.
        output: Folder of the new bag, which must not exist; None to write none.
        estimates_only: Leave out the measurements, and the truth where it is known.
        progress: Told now and then of how many measurements more an observer has taken.

    Raises:
        BagWriteError: The folder exists, the definition of JointStates is not to be found, or the
            bag cannot be written.
    """
    streams: list[Iterator[Record]] = [run.records(progress) for run in runs]
    if output is None:
        for stream in streams:
            deque(stream, maxlen=0)
        return
    copied = [] if estimates_only else source.topics
    definition = _definition(source)
    with BagWriter(output, custom_data={"estimated from": str(source.path)}) as writer:
        for one in copied:
            writer.add_topic(one.name, one.type, one.qos_profiles, definition=one.definition)
        for name in chain.from_iterable(run.topics for run in runs):
            writer.add_topic(name, JOINT_STATE, [QosProfile()], definition=definition)
        if not estimates_only:
            streams.insert(0, source.messages())
        for topic, _, data, log_time, publish_time in heapq.merge(*streams, key=by_log_time):
            writer.write(topic, data, log_time, publish_time)


def _definition(source: Source) -> MessageDefinition:
    """Return the definition that the source's own messages have, where it has any."""
    for topic in source.topics:
        if topic.type == JOINT_STATE:
            return topic.definition
    return find_definition(JOINT_STATE)
