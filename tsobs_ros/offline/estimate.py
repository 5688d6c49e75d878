# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers over a recording, as many as wanted in one pass, and a new bag of their estimates."""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.estimate_messages import INNOVATION, EstimateMessages
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.design.observers import ObserverSettings, make_tracker
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.joints import JointTrackers
from tsobs_ros.offline.replay import Afresh, Estimated, Replay, Used
from tsobs_ros.offline.samples import Samples
from tsobs_ros.offline.schedule import Schedule, as_recorded, at_rate, at_samples
from tsobs_ros.offline.source import Live, Source
from tsobs_ros.offline.table import Agreement, EstimateTable, Recorded

_PROGRESS = 256
_LOG_TIME = attrgetter("log_time")


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


class Run:
    """One observer over some samples.

    Args:
        observer: The observer.
        joints: The samples' joints.
        samples: What it is run over.
        schedule: When it estimates.
        live: What the live observer estimated, if the schedule is made of that.

    Attributes:
        observer: The observer.
        schedule: When it estimates.
        replay: Its counts.
        table: Its estimates and innovations.
    """

    def __init__(
        self,
        observer: Observer,
        joints: Sequence[str],
        samples: Samples,
        schedule: Schedule,
        live: Live | None = None,
    ) -> None:
        self.observer = observer
        self.schedule = schedule
        self._samples = samples
        trackers = [make_tracker(design, observer.settings) for design in observer.designs]
        stale_after = observer.settings.stale_after
        self.replay = Replay(JointTrackers(trackers), samples, schedule, stale_after)
        self.table = EstimateTable(schedule.count, samples.count, len(joints))
        self._recorded = None if live is None else Recorded(live, schedule)
        learnt = zip(joints, map(observer.settings.learnt, observer.designs), strict=True)
        self._sent: list[tuple[str, bytes]] = []
        self._encode = EstimateMessages(lambda *message: self._sent.append(message), dict(learnt))

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that there are messages of, under the observer's name."""
        return self._encode.topics

    def messages(self, prefix: str, progress: Callable[[int], None]) -> Iterator[BagMessage]:
        """Run the observer, and yield what it publishes, in order.

        Args:
            prefix: Of the topics' names, with a slash at its end.
            progress: Told now and then of how many measurements more have been taken.
        """
        stamps, samples, schedule = self._samples.stamps.tolist(), self._samples, self.schedule
        log_times = [*schedule.log_times.tolist(), 0]
        publish_times = [*schedule.publish_times.tolist(), 0]
        agrees = None if self._recorded is None else self._recorded.agrees
        for event in self.replay.run(agrees):
            log_time, publish_time = log_times[event.tick], publish_times[event.tick]
            match event:
                case Used(tick, message, outcomes):
                    if message % _PROGRESS == 0:
                        progress(_PROGRESS)
                    self.table.add_innovations(message, outcomes)
                    self._encode.innovations(stamps[message], outcomes)
                    if tick == schedule.count:
                        log_time = int(samples.log_times[message])
                        publish_time = int(samples.publish_times[message])
                case Estimated(tick, estimates):
                    self.table.add_estimates(tick, estimates)
                    self._encode.estimates(int(schedule.stamps[tick]), estimates)
                case Afresh():
                    self._encode.restart()
            for topic, data in self._sent:
                yield BagMessage(prefix + topic, JOINT_STATE, data, log_time, publish_time)
            self._sent.clear()

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
    return [Run(observer, source.joints, samples, schedule, live) for observer in observers]


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
    prefixes = [f"{source.namespace}/{run.observer.name}/" for run in runs]
    streams = [run.messages(prefix, progress) for run, prefix in zip(runs, prefixes, strict=True)]
    if output is None:
        for stream in streams:
            deque(stream, maxlen=0)
        return
    copied = [] if estimates_only else source.topics
    definition = _definition(source)
    with BagWriter(output, custom_data={"estimated from": str(source.path)}) as writer:
        for topic in copied:
            writer.add_topic(
                topic.name, topic.type, topic.qos_profiles, definition=topic.definition
            )
        for run, prefix in zip(runs, prefixes, strict=True):
            for name in run.topics:
                writer.add_topic(prefix + name, JOINT_STATE, [QosProfile()], definition=definition)
        if not estimates_only:
            streams.insert(0, source.messages())
        for one in heapq.merge(*streams, key=_LOG_TIME):
            writer.write(one.topic, one.data, one.log_time, one.publish_time)


def _definition(source: Source) -> MessageDefinition:
    """Return the definition that the source's own messages have, where it has any."""
    for topic in source.topics:
        if topic.type == JOINT_STATE:
            return topic.definition
    return find_definition(JOINT_STATE)
