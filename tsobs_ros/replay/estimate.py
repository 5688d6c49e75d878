# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers run over a recording, many in one pass, and a new bag of their estimates.

The messages are those of the observer node, byte for byte. Made a window at a time, they take a
tenth of the time that they take one by one.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, product
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import TICK_LOG, MessageSeries, encode_text, encode_ticks
from tsobs_ros.bag.container import MAGIC
from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.metadata import QosProfile
from tsobs_ros.bag.writer import BagWriter, whole_bag
from tsobs_ros.checks import Array, Flags
from tsobs_ros.design.file import record_text
from tsobs_ros.design.record import Design
from tsobs_ros.errors import BagReadError, LogError, ModelError, ParameterError
from tsobs_ros.estimation.estimator import Rows
from tsobs_ros.estimation.health import judge_rate, rate_of
from tsobs_ros.estimation.records import HEALTH, USED, RejectReason, rejections
from tsobs_ros.estimation.tracker import TrackerRun
from tsobs_ros.files import naming_path
from tsobs_ros.methods import ObserverSettings, make_estimator, make_tracker
from tsobs_ros.replay.designs import STRING
from tsobs_ros.replay.health import Health, JointEvent, find_events, health_of
from tsobs_ros.replay.log import LogSource
from tsobs_ros.replay.places import ESTIMATES, EstimateEncoder, places_of
from tsobs_ros.replay.source import BagSource, Records
from tsobs_ros.replay.windows import COMPARED, WINDOW, Agreement, Window, Windows, digests
from tsobs_ros.series import Series, SeriesSpool, Spool
from tsobs_ros.settings import values_of

_OF_BAGS = (".mcap", ".yaml", ".db3")


@dataclass(frozen=True)
class Observer:
    """An observer to run: the name of its node and topics, and the design of each joint."""

    name: str
    settings: ObserverSettings
    designs: tuple[Design, ...]


def make_observers(
    designs: Mapping[str, tuple[Design, ...]],
    methods: Sequence[str],
    settings: ObserverSettings,
) -> list[Observer]:
    """Return an observer for each design of `choose_designs` and each method.

    A name has the design if there are several designs, and the method if there are several methods.

    Raises:
        ParameterError: There is no such method.
    """
    found = []
    for stem, method in product(designs, methods):
        name = "_".join([stem] * (len(designs) > 1) + [method] * (len(methods) > 1))
        found.append(Observer(name or "observer", replace(settings, method=method), designs[stem]))
    return found


def without_misfits(observers: Iterable[Observer]) -> tuple[list[Observer], list[str]]:
    """Return the observers that can observe their arms, and remarks on the others.

    Raises:
        ModelError: None of them can.
    """
    fitting, remarks = list[Observer](), list[str]()
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
    """One observer over a recording, window by window.

    Attributes:
        signals: The places of each joint's signals.
        trackers: One per joint.
        estimates: Number of ticks with an estimate.
        outcomes: Number of measurements of each joint by outcome: `USED`, or a `RejectReason`.
        window: The last window, of n samples and m ticks.
        rows: Its estimates of each joint, NaN if there is none, shape (m,).
        done: Whether there is an estimate of any joint, shape (m,).
        innovations: y − ŷ of each joint, NaN for outputs that were not used, shape (n, p).
    """

    window: Window
    rows: list[Rows]
    done: Flags
    innovations: list[Array]

    def __init__(
        self, observer: Observer, source: BagSource, windows: Windows, *, keep: bool = False
    ) -> None:
        self.observer, self.windows, self._source = observer, windows, source
        self.trackers = [make_tracker(one, observer.settings) for one in observer.designs]
        self.estimates = 0
        self.outcomes = [Counter[int]() for _ in self.trackers]
        # How often each output was gated and missing.
        self._outputs = [np.zeros((one.estimator.shape.p, 2), int) for one in self.trackers]
        self.signals = source.signals_of([design.request for design in observer.designs])
        self._prefix = f"{source.namespace}/{observer.name}/"
        places, alone = [], len(source.joints) == 1
        each = zip(source.joints, self.signals, observer.designs, self.trackers, strict=True)
        for joint, own, design, tracker in each:
            learnt = observer.settings.learnt(design)
            rated = "disturbance_rate" not in tracker.estimator.lacking
            places.append(places_of(joint, own, alone=alone, learnt=learnt, rated=rated))
        self._encoder = EstimateEncoder(self._prefix, places)
        self._made = Spool(np.dtype(np.int64))
        times = [("stamps", np.int64), ("log_times", np.int64)]
        self._kept = [
            (Spool(np.dtype([*times, ("rows", one.row_type)])), SeriesSpool(one.shape.p))
            for one in (tracker.estimator for tracker in self.trackers if keep)
        ]
        # Stamps at which a node last published an estimate, and parameters and health.
        self._last, self._slow_since = 0, -topics.SLOW_PERIOD
        # Stamps and log times of published health, its numbers, and whether a restart precedes it.
        self._slow: list[tuple[NDArray[Any], ...]] = []
        # Number of restarts, and of ticks since the last one.
        self._restarts = self._ticks = 0
        self._is_first, self._has_restarted = True, False

    def begin(self, writer: BagWriter, definition: MessageDefinition | None) -> None:
        """Add its topics to a new bag, with JointState's definition, and write its `design`."""
        for name in self._encoder.topics:
            writer.add_topic(name, JOINT_STATE, [QosProfile()], definition=definition)
        latched = QosProfile(durability="transient_local", depth=1)
        writer.add_topic(self._prefix + topics.DESIGN, STRING, [latched])
        writer.add_topic(self._prefix + topics.TICKS, TICK_LOG, [QosProfile()])
        observer, source, (begin, _) = self.observer, self._source, self._source.span
        parameters = values_of(observer.settings)
        text = record_text(source.topic, source.joints, observer.designs, parameters)
        writer.write(self._prefix + topics.DESIGN, encode_text(text), begin, begin)
        for one in self.windows.live.restarts if self.windows.live else ():
            writer.write_series([one._replace(topic=self._prefix + topics.RESTARTS)])

    @property
    def rewinds(self) -> int:
        """Number of late measurements that were inserted by a rewind."""
        return sum(tracker.rewinds for tracker in self.trackers)

    def run(self, window: Window, *, encode: bool) -> list[MessageSeries]:
        """Run the observer over a window, and return the messages, if they are to be encoded."""
        self.window, ticks, live = window, window.ticks, self.windows.live
        if window.restarts:
            for tracker in self.trackers:
                tracker.forget()
            self._restarts, self._ticks, self._last = self._restarts + 1, 0, 0
            self._has_restarted = True
        self._estimate()
        for joint, (estimates, innovations) in enumerate(self._kept):
            columns = (ticks.stamps, ticks.log_times, self.rows[joint])
            some = [each[ticks.estimated] for each in columns]
            estimates.add(np.rec.fromarrays(some, estimates.type))
            samples = window.samples
            innovations.add(samples.stamps, samples.log_times, self.innovations[joint])
        made: list[MessageSeries] = []
        # Recorded messages of restarts were copied already.
        if (self._is_first or window.restarts) and not (live is not None and live.restarts):
            first = ticks[:1]
            restarts = [np.full((len(first), 1), float(self._restarts))] * len(self.trackers)
            made += self._encoder.messages(topics.RESTARTS, first, restarts)
        self._is_first = self._is_first and not len(ticks)
        if encode:
            made += self._tick_messages()
            of_use = ticks[np.searchsorted(ticks.known, np.arange(len(window.samples)), "right")]
            of_use.stamps = window.samples.stamps
            made += self._encoder.messages(topics.INNOVATION, of_use, self.innovations)
        for topic in COMPARED if encode or live is not None else ():
            messages = self._messages(topic)
            made += messages
            for one in messages if live is not None else ():
                self._made.add(digests(topic, one.data))
        due = self._due()
        if len(due):
            valid: Flags = np.array([own["parameters_valid"] == 1.0 for own in self.rows])
            for topic in topics.PARAMETER_TOPICS if encode else ():
                made += self._messages(topic, due, valid)
            made += self._messages(topics.HEALTH, due) if encode else []
            restarted = np.arange(len(due)) < self._has_restarted
            self._has_restarted = False
            health = [self.values(joint, *HEALTH)[due] for joint in range(len(self.rows))]
            times = ticks.stamps[due], ticks.log_times[due]
            self._slow.append((*times, np.stack(health, axis=1), restarted))
        return made if encode else []

    def kept(self, joint: int) -> tuple[Records, Series]:
        """Return a joint's estimates, as `stamps`, `log_times` and `rows`, and its innovations.

        There are rows at all ticks with estimates, and innovations of all measurements.
        """
        estimates, innovations = self._kept[joint]
        return estimates.read(), innovations.read()

    def values(self, joint: int, *names: str) -> Array:
        """Return some fields of a joint's estimates in the window side by side, shape (m, k)."""
        parts = [np.asarray(self.rows[joint][name]) for name in names]
        return np.hstack([part if part.ndim > 1 else part[:, np.newaxis] for part in parts])

    @property
    def used(self) -> int:
        """Number of measurements used, of all joints."""
        return sum(one[USED] for one in self.outcomes)

    @property
    def rejected(self) -> dict[RejectReason, int]:
        """Number of rejected measurements of all joints, by reason."""
        return rejections(sum(self.outcomes, Counter[int]()))

    def _estimate(self) -> None:
        """Make the estimates of the window, each joint on its own, and update the counts."""
        samples, ticks, _ = self.window
        joints = range(len(self.trackers))
        with ThreadPoolExecutor(min(len(joints), os.cpu_count() or 1)) as pool:
            results = list(pool.map(self._run_joint, joints))
        done: Flags = np.any([one.there for one in results], axis=0) & ticks.estimated
        if self.windows.at_samples:
            done &= np.any([one.newest == ticks.stamps for one in results], axis=0)
        # The stamps that a node publishes rise until a restart.
        stamps = np.where(done, ticks.stamps, 0)
        before = np.maximum.accumulate(np.append(self._last, stamps))
        self._last, self.done = int(before[-1]), done & (stamps > before[:-1])
        self.estimates += int(self.done.sum())
        self.rows, self.innovations = [], []
        for joint, one in enumerate(results):
            one.rows[~(self.done & one.there)] = np.nan
            self.rows.append(one.rows)
            innovations = np.full((len(samples), one.outcomes.innovations.shape[1]), np.nan)
            innovations[samples.codes[:, joint] == USED] = one.outcomes.innovations
            self.innovations.append(innovations)
            refused = samples.codes[samples.codes[:, joint] > USED, joint]
            codes = np.append(refused, one.outcomes.codes)
            for code, number in enumerate(np.bincount(codes).tolist()):
                self.outcomes[joint][code] += number
            for place, code in enumerate((RejectReason.GATED, RejectReason.NON_FINITE)):
                self._outputs[joint][:, place] += (one.outcomes.output_codes == code).sum(axis=0)

    def _run_joint(self, joint: int) -> TrackerRun:
        (samples, ticks, _), tracker = self.window, self.trackers[joint]
        own, shape = samples.codes[:, joint] == USED, tracker.estimator.shape
        known = np.append(0, np.cumsum(own))[ticks.known]
        y, u = samples.y[own, joint, : shape.p], samples.u[own, joint, : shape.m]
        at, stale_after = (ticks.stamps, ticks.now, known), self.observer.settings.stale_after
        return tracker.run(samples.stamps[own], y, u, at, stale_after)

    def _due(self) -> NDArray[np.intp]:
        """Return the ticks at which a node publishes parameters and health."""
        due = []
        for place in np.flatnonzero(self.done).tolist():
            stamp = int(self.window.ticks.stamps[place])
            if not 0 <= stamp - self._slow_since < topics.SLOW_PERIOD:
                due.append(place)
                self._slow_since = stamp
        return np.array(due, np.intp)

    def _messages(
        self, topic: str, rows: Any = slice(None), there: Flags | None = None
    ) -> list[MessageSeries]:
        """Return the messages of a topic at some of the ticks, with the joints that are `there`."""
        each = [self.values(joint, *ESTIMATES[topic])[rows] for joint in range(len(self.rows))]
        for own, known in zip(each, there[:, rows] if there is not None else (), strict=False):
            own[~known] = np.nan
        return self._encoder.messages(topic, self.window.ticks[rows], each)

    def _tick_messages(self) -> list[MessageSeries]:
        """Return the messages of the tick log."""
        ticks, done = self.window.ticks, self.done
        counts = np.diff(ticks.known, prepend=0)
        logged = done | (counts > 0)
        numbers = self._ticks + np.cumsum(logged)
        self._ticks = int(numbers[-1]) if len(numbers) else self._ticks
        # Without an estimate, the clock's time is logged: it decides which stamps are too new.
        stamps = np.where(done, ticks.stamps, ticks.now)
        found = []
        for count in np.unique(counts[logged]).tolist():
            rows = np.flatnonzero(logged & (counts == count))
            places = (ticks.known[rows] - count)[:, np.newaxis] + np.arange(count)
            front = [one[rows, np.newaxis] for one in (stamps, numbers, done)]
            data = encode_ticks(np.hstack([*front, self.window.samples.checksums[places]]))
            times = ticks.log_times[rows], ticks.publish_times[rows]
            found.append(MessageSeries(self._prefix + topics.TICKS, TICK_LOG, *times, data))
        return found

    def outputs(self) -> dict[str, dict[str, dict[str, int]]]:
        """Return how often each output was gated and missing, for joints with several."""
        each = zip(self._source.joints, self.observer.designs, self._outputs, strict=True)
        return {
            joint: {
                name: dict(zip(("gated", "missing"), counts, strict=True))
                for name, counts in zip(design.request.output_names, own.tolist(), strict=True)
            }
            for joint, design, own in each
            if len(own) > 1
        }

    def warnings(self) -> list[str]:
        """Return the warnings that the node would have logged: measurements at another rate."""
        found, samples = [], self._source.samples
        each = zip(self._source.joints, self.observer.designs, strict=True)
        for joint, (name, design) in enumerate(each):
            rate = rate_of(samples.stamps[samples.codes[:, joint] == USED])
            off, text = judge_rate(rate, design.request.rate)
            if isinstance(self._source, LogSource) and 700.0 < design.request.rate / rate < 1400.0:
                text += " For ms: --units time=ms"
            found += [f"{name}: {text}"] if off else []
        return found

    @cached_property
    def events(self) -> list[JointEvent]:
        """The events that the node would have logged, known after the last window."""
        found = list[JointEvent]()
        for joint, (health, restarted) in self._healths.items():
            found += find_events(
                joint,
                self._source.topic,
                health,
                restarted,
                stale_after=self.observer.settings.stale_after,
                same_clock=self._source.same_clock,
            )
        return sorted(found, key=attrgetter("log_time"))

    def health(self) -> dict[str, Health]:
        """Return the health of each joint that has estimates."""
        each = zip(self._healths.items(), self.trackers, strict=False)
        found = ((joint, health_of(own.values, tracker)) for (joint, (own, _)), tracker in each)
        return {joint: one for joint, one in found if one is not None}

    @cached_property
    def _healths(self) -> dict[str, tuple[Series, Flags]]:
        """The published health of each joint, and whether there was a restart before it, known
        after the last window."""
        if not self._slow:
            return {}
        stamps, log_times, values, restarted = map(np.concatenate, zip(*self._slow, strict=True))
        each = zip(self._source.joints, values.swapaxes(0, 1), strict=True)
        return {joint: (Series(stamps, own, log_times), restarted) for joint, own in each}

    def agreement(self) -> Agreement | None:
        """Return the comparison with the recorded estimates, if there is a tick log."""
        live = self.windows.live
        return None if live is None else live.compare(self._made.read())


def is_log(path: Path) -> bool:
    """Return whether a path is that of a file that does not belong to a bag.

    Raises:
        LogError: The file cannot be read.
    """
    if not path.is_file() or path.suffix.lower() in _OF_BAGS:
        return False
    with naming_path(path, LogError), path.open("rb") as file:
        return file.read(len(MAGIC)) != MAGIC


def open_source(
    path: str | Path,
    *,
    topic: str | None = None,
    joints: Sequence[str] = (),
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    assume_zero_torque: bool | None = None,
    held_out: str | None = None,
) -> BagSource:
    """Open a log if `is_log`, else a bag; the options are those of `LogSource` and `BagSource`.

    Raises:
        BagReadError: The bag cannot be read, or lacks the measurements.
        LogError: The log cannot be read.
        ParameterError: A joint is named twice, columns or units are named for a bag, or a topic
            for a log.
    """
    path, zero = Path(path), assume_zero_torque
    if len(set(joints)) < len(joints):
        raise ParameterError(f"joints: expected names, each once, got {list(joints)}")
    if is_log(path):
        if topic is not None:
            raise ParameterError(f"{path}: --topic is for bags, and this is a CSV log")
        return LogSource(
            path, columns, units, joints, assume_zero_torque=bool(zero), held_out=held_out
        )
    if columns or units:
        raise ParameterError(f"{path}: --columns and --units are for CSV logs, and this is a bag")
    return BagSource(path, topic, joints, assume_zero_torque=zero, held_out=held_out)


def run_observers(
    source: BagSource,
    observers: Sequence[Observer],
    output: Path | None = None,
    *,
    rate: float | None = None,
    as_live: bool = True,
    window: int = WINDOW,
    keep: bool = False,
    estimates_only: bool = False,
    progress: Callable[[int], None] = lambda _: None,
) -> list[Run]:
    """Run observers over the same measurements; write their messages to a new bag, if one is given.

    `rate`, `as_live` and `window` are those of `Windows`. If `keep`, runs keep their estimates in
    temporary files. `estimates_only` leaves out the measurements, and the truth of a simulation.
    `progress` is called with the number of measurements that observers took since its last call.

    Raises:
        BagReadError: The bag lacks signals that the designs measure.
        LogError: The log lacks such signals.
        ModelError: The designs measure different signals.
        BagWriteError: The folder exists, or the bag cannot be written.
    """
    for observer in observers:
        source.observe([design.request for design in observer.designs])
    windows = Windows(source, rate, as_live, window)
    runs = [Run(observer, source, windows, keep=keep) for observer in observers]
    with ExitStack() as stack:
        # The core runs for several observers at once.
        pool = stack.enter_context(ThreadPoolExecutor(min(len(runs), os.cpu_count() or 1)))
        writer = None
        if output is not None:
            note = {"estimated from": str(source.path)}
            writer = stack.enter_context(whole_bag(output, custom_data=note))
            recorded = () if estimates_only else source.topics
            writer.add_topics(recorded)
            known = source.reader.topics[source.topic].definition
            # Before any copy, so that designs come first among the messages of equal log times.
            for run in runs:
                run.begin(writer, known)
            try:
                writer.copy_topics(source.reader, [topic.name for topic in recorded])
            except BagReadError as error:
                source.damaged(error)
        for part in windows:
            work = partial(Run.run, window=part, encode=writer is not None)
            made = list(chain.from_iterable(pool.map(work, runs)))
            if writer is not None:
                writer.write_series(made)
            progress(len(part.samples) * len(runs))
    return runs
