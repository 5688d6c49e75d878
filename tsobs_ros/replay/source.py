# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recorded measurements of some joints, in order of arrival, and the bags that hold them."""

import math
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.copying import ChunkCopy
from tsobs_ros.bag.joint_series import (
    JointSeries,
    Times,
    Wanted,
    read_blocks,
    require_joint_states,
    until_damage,
)
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.metadata import TopicInfo
from tsobs_ros.bag.reader import UNCHECKED, BagMessage, BagReader
from tsobs_ros.checks import Array, Flags
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.design.signals import Signals, signals
from tsobs_ros.errors import BagReadError, ModelError
from tsobs_ros.replay.designs import RecordedObserver, recorded_observer
from tsobs_ros.replay.places import places_of
from tsobs_ros.series import NANOSECONDS

MEASUREMENTS = "joint_measurements"
UNNAMED_SYSTEM = "system"
"""Name of a T–S system that a recording does not name."""

# Stamps this far back are not late any more: time restarted (a looped bag, a new simulation).
_RESTART = NANOSECONDS
RESTART_MESSAGES = 10
"""So many messages in a row must lie back: one straggler is no restart."""
SAME_CLOCK = NANOSECONDS
"""Clocks that differ by this or more are not the same clock [ns]."""
_FIRST_MESSAGES = 1000
_SURVEYED = 2**15
UNKNOWN = np.iinfo(np.int64).max
"""Time of use of a measurement without innovation [ns], later than all others."""


@dataclass(frozen=True)
class Samples:
    """Messages with measurements of J joints, n of them in order of arrival.

    Attributes:
        stamps: Sampling times of the angles [ns], shape (n,).
        log_times: Recording times of the messages, ns since the epoch, shape (n,).
        publish_times: Publishing times, ns since the epoch, shape (n,).
        y: Outputs, NaN of one that is missing or that a joint does not have, shape (n, J, p).
        u: Inputs and scheduled signals, 0 of one that a joint does not have, shape (n, J, m).
        named: Whether the message has an entry of the joint, shape (n, J).
        complete: Whether it has an output and all inputs of it, shape (n, J).
        clock: Whether stamps and log times are of the same clock; None to judge by these messages.
        newest: Largest stamp before these messages since time restarted [ns].
    """

    stamps: Times
    log_times: Times
    publish_times: Times
    y: Array
    u: Array
    named: Flags
    complete: Flags
    clock: bool | None = None
    newest: int = 0

    @property
    def count(self) -> int:
        """The number of messages."""
        return len(self.stamps)

    @cached_property
    def passes(self) -> list[tuple[int, int]]:
        """The begin and end of each pass of time; the first may be empty, or go on."""
        return passes(self.stamps, self.newest)

    @property
    def usable(self) -> Flags:
        """Whether an observer may use a message of any joint, shape (n,)."""
        numbers = np.isfinite(self.y).any(axis=2) & np.isfinite(self.u).all(axis=2)
        return np.asarray((self.complete & numbers).any(axis=1) & (self.stamps > 0))

    @cached_property
    def same_clock(self) -> bool:
        """Whether stamps and log times seem to be of the same clock."""
        if self.clock is not None or not self.count:
            return self.clock is not False
        return abs(float(np.median(self.log_times - self.stamps))) < SAME_CLOCK

    @cached_property
    def arrivals(self) -> Times:
        """Arrival times on the clock of the stamps [ns], or the best guess at them."""
        if self.same_clock:
            return self.log_times
        # Log times of another clock give the order only: each arrives when it is sampled.
        latest = [np.maximum.accumulate(self.stamps[a:b]) for a, b in self.passes]
        np.maximum(latest[0], self.newest, out=latest[0])
        return np.concatenate(latest)

    def take(self, places: NDArray[np.intp] | slice) -> "Samples":
        """Return some of the messages, or all of them in another order."""
        return replace(self, **{name: getattr(self, name)[places] for name in _ARRAYS})

    def followed_by(self, *others: "Samples") -> "Samples":
        """Return these messages and others behind them."""
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(one, name) for one in (self, *others)])
            for name in _ARRAYS
        }
        return replace(self, **joined)

    def newest_before(self, message: int) -> int:
        """Return the largest stamp before a message, since time restarted [ns]."""
        begins = [begin for begin, _ in self.passes if begin < message]
        if not begins:
            return self.newest
        stamps = self.stamps[begins[-1] : message]
        return int(stamps.max(initial=self.newest if len(begins) == 1 else 0))

    def in_order_of_publishing(self) -> "Samples":
        """Return them as a subscriber receives them: each publisher's come in its order."""
        return self.take(np.argsort(self.publish_times, kind="stable"))


_ARRAYS = [field.name for field in fields(Samples) if field.name not in ("clock", "newest")]


def wanted_measurements(joints: Sequence[Signals]) -> Wanted:
    """Return the places of the joints' outputs, of their inputs, and of those instead of these."""
    return [
        *(one.outputs for one in joints),
        *(one.inputs for one in joints),
        *(one.other_inputs for one in joints),
    ]


def samples_of(series: JointSeries, joints: Sequence[Signals], assume_zero_torque: bool) -> Samples:
    """Return the measurements in a topic's messages.

    Args:
        series: With the places of `wanted_measurements`.
        joints: The places of the signals of J joints.
        assume_zero_torque: Take messages without a number of an input as 0.
    """
    count = len(joints)
    p = max(len(one.outputs) for one in joints)
    m = max(len(one.inputs) for one in joints)
    y = series.values[:, :count, :p]
    outputs = series.given[:, :count].any(axis=2)
    own, other = slice(count, 2 * count), slice(2 * count, None)
    there: Flags = series.given[:, own, :m] | series.given[:, other, :m]
    u = series.values[:, own, :m]
    u = np.where(np.isnan(u), series.values[:, other, :m], u)
    for joint, one in enumerate(joints):
        torques = [assume_zero_torque and place.field == "effort" for place in one.inputs]
        silent = ~there[:, joint] & np.array([*torques, *[True] * (m - len(torques))])
        there[:, joint] |= silent
        u[:, joint][silent] = 0.0
    named: Flags = np.asarray(series.named.reshape(len(u), 3, count).any(axis=1))
    return Samples(
        series.stamps,
        series.log_times,
        series.publish_times,
        np.ascontiguousarray(y),
        u,
        named,
        np.asarray(outputs & there.all(axis=2)),
    )


def restarts(stamps: Sequence[int] | Times, highest: int = 0) -> list[int]:
    """Return the places where stamps [ns] go back by more than a second, and stay back.

    Args:
        stamps: In order of arrival [ns].
        highest: Largest one before these, since time restarted [ns].
    """
    found: list[int] = []
    if isinstance(stamps, np.ndarray):
        # They hardly ever go back.
        if (np.diff(stamps, prepend=highest) >= 0).all():
            return found
        stamps = stamps.tolist()
    for place, stamp in enumerate(stamps):
        floor = highest - _RESTART
        if 0 < stamp < floor and max(stamps[place : place + RESTART_MESSAGES]) < floor:
            found.append(place)
            highest = stamp
        highest = max(highest, stamp)
    return found


def passes(stamps: Sequence[int] | Times, highest: int = 0) -> list[tuple[int, int]]:
    """Return the begin and end of each pass of time; a second one follows a restart."""
    return list(pairwise([0, *restarts(stamps, highest), len(stamps)]))


@dataclass(frozen=True)
class Live:
    """The recorded output of a running observer.

    Attributes:
        states: States of every joint.
        others: Its other recorded topics, by the names in `estimate_topics`.
    """

    states: JointSeries
    others: dict[str, JointSeries]


class Truth(NamedTuple):
    """The recorded truth of a simulation; None where there is none.

    Attributes:
        states: Of every joint.
        disturbance: Of every joint's outputs.
        torque: Torque disturbances of every joint.
    """

    states: JointSeries | None
    disturbance: JointSeries | None
    torque: JointSeries | None


class Part(NamedTuple):
    """A part of a recording.

    Attributes:
        samples: Measurements in the order of recording.
        others: Output of the observer that ran during the recording, by the names in
            `estimate_topics`.
        horizon: Log time from which on messages of the next part may be [ns]; infinite in the last.
    """

    samples: Samples
    others: dict[str, JointSeries]
    horizon: float = math.inf


class Source(ABC):
    """Measurements of some joints, from a bag or a log.

    What is read of each joint depends on its design: before anything else but the joints and what
    ran is asked for, `observe` has to be called.

    Attributes:
        path: The bag or the log.
        joints: Names of the joints.
        signals: The places of each joint's signals.
        ran: What the observer ran that was recorded.
        count: Number of messages with measurements.
        span: Smallest and largest log time of them, ns since the epoch.
        same_clock: Whether stamps and log times seem to be of the same clock.
        topic: Name of the measurements' topic, or of the log's file.
        namespace: Begin of the topics' names: empty, or with a slash at its front only.
        was_observed: Whether there is output of an observer that ran during the recording.
        damage: The error that ended reading early.
        remarks: Notes for the user.
        guessed: Whether the joints are those of the first messages, for want of anything better.
        topics: Topics that belong with estimates: measurements, and the truth of a simulation.
    """

    path: Path
    joints: tuple[str, ...]
    signals: tuple[Signals, ...] = ()
    ran = RecordedObserver()
    count: int
    span: tuple[int, int]
    same_clock: bool
    topic: str
    namespace = ""
    was_observed = False
    damage: BagReadError | None = None
    remarks: tuple[str, ...] = ()
    guessed = False
    topics: tuple[TopicInfo, ...] = ()
    _requests: tuple[ArmRequest | TSRequest, ...] = ()

    def observe(self, requests: Sequence[ArmRequest | TSRequest]) -> None:
        """Read from now on what the designs of the joints need, and survey it.

        Args:
            requests: Of the designs, one a joint.

        Raises:
            BagReadError: The bag does not have the measurements.
            LogError: The log does not.
            ModelError: Something else is read already.
        """
        names = [[(one.output_names, one.input_names) for one in them]
                 for them in (requests, self._requests or requests)]  # fmt: skip
        if names[0] != names[1]:
            has, wanted = (", ".join(n for o, i in own for n in o + i) for own in names[::-1])
            raise ModelError(
                f"{self.path}: designs that are run together must measure the same, got one of "
                f"{has} and one of {wanted}: run them one after the other"
            )
        if not self._requests:
            self._requests = tuple(requests)
            self._observe()

    def take_for_system(self, requests: Sequence[ArmRequest | TSRequest]) -> bool:
        """Return whether there is one T–S system instead of joints, which nothing in it names.

        Args:
            requests: Of the designs.
        """
        systems = self.guessed and all(isinstance(one, TSRequest) for one in requests)
        if systems:
            self.joints, self.guessed = (UNNAMED_SYSTEM,), False
        return systems

    @property
    def alone(self) -> bool:
        """Whether messages name the signals of the only joint without the joint's name."""
        return len(self.joints) == 1

    def signals_of(self, requests: Sequence[ArmRequest | TSRequest]) -> tuple[Signals, ...]:
        """Return the places of the joints' signals if they have these designs."""
        each = zip(requests, self.joints, strict=True)
        return tuple(signals(request, joint, self.alone) for request, joint in each)

    @abstractmethod
    def _observe(self) -> None:
        """Decide what is read, and survey it."""

    @abstractmethod
    def parts(self, size: int | None = None, with_live: bool = True) -> Iterator[Part]:
        """Yield the recording in parts.

        Args:
            size: Number of messages in a part, divisible by 4; None for a single part.
            with_live: Whether to read the live observer's output besides the innovations.
        """

    def in_order(self, samples: Samples, others: Mapping[str, JointSeries]) -> Samples:
        """Return measurements in the order in which an observer uses them.

        Args:
            samples: In the order of recording.
            others: Output of the observer that ran during the recording.
        """
        return samples

    @abstractmethod
    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages of `topics` in order of log time, up to any damage."""

    def chunks(self) -> ChunkCopy | None:
        """Return what copies the messages of `topics` chunk by chunk; None if nothing can."""
        return None

    def truth(self, size: int | None = None) -> Iterator[Truth]:
        """Yield the recorded truth in parts of some messages; in one part if None."""
        return iter(())


class BagSource(Source):
    """A bag as a source of measurements.

    Args:
        path: The bag's folder, or one MCAP file.
        topic: Full name of the measurements' topic; by default the only one that ends in
            `joint_measurements`, or the one that the live observer used.
        joints: Names of the joints to read; by default those that the live observer observed and
            the first messages have, else those of the first messages.
        observer: Name of the live observer, whose topics are read too.
        assume_zero_torque: Take messages without effort as torque 0; None: as the live observer.

    Raises:
        BagReadError: There is no bag, no such topic, or several topics fit.
    """

    def __init__(
        self,
        path: Path,
        *,
        topic: str | None = None,
        joints: Sequence[str] = (),
        observer: str = "observer",
        assume_zero_torque: bool | None = None,
    ) -> None:
        self.path = path
        self._reader = BagReader(path)
        of_topic = self._recorded_observers(observer)
        self.topic = self._find_measurements(list(of_topic)) if topic is None else topic
        require_joint_states(self._reader, self.topic)
        self.namespace = of_topic.get(self.topic, self.topic.rpartition("/")[0])
        self.ran = recorded_observer(self._reader, f"{self.namespace}/{observer}")
        first = self._first_names()
        self.joints, self.guessed = tuple(joints), not joints
        if not joints:
            self.joints = tuple(joint for joint in self.ran.designs if self._is_in(first, joint))
            self.guessed = not self.joints
        self.joints = self.joints or tuple(name for name in first if not _is_motor(name, first))
        self._alone = len(self.ran.designs) <= 1 and not any(
            name.startswith(f"{joint}/") for joint in self.joints for name in first
        )
        if assume_zero_torque is None:
            assume_zero_torque = self.ran.settings().assume_zero_torque
        names = [n for n in (*topics.TOPICS, *topics.TORQUE_TOPICS) if n != topics.HEALTH]
        self._live = self._there({name: f"{observer}/{name}" for name in names})
        states = self._live.get(topics.STATES)
        self.was_observed = states is not None and self._reader.topics[states].count > 0
        self._assume_zero_torque = assume_zero_torque
        shown = self.topic, *self._there({n: n for n in topics.TRUTH}).values()
        self.topics = tuple(self._reader.topics[name] for name in shown)

    @property
    def alone(self) -> bool:
        return self._alone and len(self.joints) == 1

    def _observe(self) -> None:
        self.signals = self.signals_of(self._requests)
        each = zip(self.joints, self.signals, strict=True)
        self._places = [places_of(joint, own, alone=self.alone) for joint, own in each]
        self._survey()
        if not self.same_clock:
            self.remarks = (
                "note: the bag's stamps and log times are of different clocks, so each measurement "
                "is taken to have arrived when it was sampled",
            )
        if self._reader.unchecked:
            self.remarks += (f"note: {UNCHECKED}",)

    def parts(self, size: int | None = None, with_live: bool = True) -> Iterator[Part]:
        live = {n: f for n, f in self._live.items() if with_live or n == topics.INNOVATION}
        wanted = {self.topic: self._wanted(MEASUREMENTS)}
        wanted |= {full: self._wanted(name) for name, full in live.items()}
        for series, horizon in read_blocks(self._reader, wanted, size, on_damage=self._damaged):
            samples = samples_of(series[self.topic], self.signals, self._assume_zero_torque)
            others = {name: series[full] for name, full in live.items()}
            yield Part(replace(samples, clock=self.same_clock), others, horizon)

    def in_order(self, samples: Samples, others: Mapping[str, JointSeries]) -> Samples:
        samples, innovations = samples.in_order_of_publishing(), others.get(topics.INNOVATION)
        return samples if innovations is None else in_order_of_use(samples, innovations)

    def messages(self) -> Iterator[BagMessage]:
        names = [topic.name for topic in self.topics]
        return until_damage(self._reader.messages(names), self._damaged)

    def chunks(self) -> ChunkCopy | None:
        # Of a damaged bag the messages before the damage are wanted, and no others.
        found = ChunkCopy(self._reader, [topic.name for topic in self.topics])
        return found if self.damage is None and found.is_sound(self.topic) else None

    def truth(self, size: int | None = None) -> Iterator[Truth]:
        there = self._there({name: name for name in topics.TRUTH})
        wanted = {full: self._wanted(name) for name, full in there.items()}
        for series, _ in read_blocks(self._reader, wanted, size, on_damage=self._damaged):
            yield Truth(*(series.get(there.get(name, "")) for name in topics.TRUTH))

    def _damaged(self, error: BagReadError) -> None:
        self.damage = error

    def _there(self, names: dict[str, str]) -> dict[str, str]:
        """Return the full names of those topics in the namespace that the bag has."""
        full = {key: f"{self.namespace}/{name}" for key, name in names.items()}
        there = {name for name, topic in self._reader.topics.items() if topic.type == JOINT_STATE}
        return {key: name for key, name in full.items() if name in there}

    def _recorded_observers(self, observer: str) -> dict[str, str]:
        """Return the namespaces of recorded observers of a name by their measurements' topics."""
        end = f"/{observer}/{topics.DESIGN}"
        found = {}
        for name in self._reader.topics:
            if name.endswith(end):
                namespace = name.removesuffix(end)
                ran = recorded_observer(self._reader, f"{namespace}/{observer}")
                if ran.measurements in self._reader.topics:
                    found[ran.measurements] = namespace
        return found

    def _find_measurements(self, observed: list[str]) -> str:
        names = [name for name in self._reader.topics if f"/{name}".endswith(f"/{MEASUREMENTS}")]
        names = names or observed
        if len(names) == 1:
            return names[0]
        has = ", ".join(names or self._reader.topics) or "none"
        what = "several topics end" if names else "no topic ends"
        raise BagReadError(f"{self.path}: {what} in {MEASUREMENTS}, choose one of: {has}")

    def _wanted(self, topic: str) -> Wanted:
        if topic == MEASUREMENTS:
            return wanted_measurements(self.signals)
        return [places[topic] for places in self._places]

    def _is_in(self, names: Sequence[str], joint: str) -> bool:
        """Return whether messages with some names may be about a joint of the live observer."""
        if len(self.ran.designs) == 1:
            return True
        motor = topics.sides(joint)[1]
        return any(name in (joint, motor) or name.startswith(f"{joint}/") for name in names)

    def _first_names(self) -> tuple[str, ...]:
        messages = until_damage(self._reader.messages([self.topic]), self._damaged)
        first = list(islice(messages, _FIRST_MESSAGES))
        groups, malformed = JointStateDecoder().decode_all([message.data for message in first])
        if malformed and not groups:
            raise BagReadError(f"{self.path}: {self.topic}: {next(iter(malformed.values()))}")
        return tuple(dict.fromkeys(name for group in groups for name in group.names))

    def _survey(self) -> None:
        """Read the measurements for what must be known before the first of them is used."""
        wanted = {self.topic: [own.outputs for own in self.signals]}
        count, before, after = 0, 0, 0
        outputs = max((len(own.outputs) for own in self.signals), default=0)
        there = np.zeros((len(self.joints), outputs), np.bool_)
        named = np.zeros(len(self.joints), np.bool_)
        others, times = dict[str, None](), []
        for block in read_blocks(self._reader, wanted, _SURVEYED, on_damage=self._damaged):
            measured = block.series[self.topic]
            if measured.count:
                times += [int(measured.log_times.min()), int(measured.log_times.max())]
            apart = measured.log_times - measured.stamps
            count += measured.count
            before += int((apart <= -SAME_CLOCK).sum())
            after += int((apart >= SAME_CLOCK).sum())
            there |= measured.given.any(axis=0)
            named |= measured.named.any(axis=0)
            others |= dict.fromkeys(measured.other_names)
        if not count:
            raise self.damage or BagReadError(f"{self.path}: no message on {self.topic}")
        missing = [
            joint
            for joint, request, one in zip(self.joints, self._requests, named, strict=True)
            if isinstance(request, ArmRequest) and not one
        ]
        if missing or not self.joints:
            seen = [joint for joint in self.joints if joint not in missing]
            names = ", ".join([*seen, *others]) or "none"
            raise BagReadError(
                f"{self.path}: no message of {self.topic} names {', '.join(missing) or 'a joint'}; "
                f"joints: {names}"
            )
        self._require_outputs(there, others)
        self.count, self.span = count, (min(times), max(times))
        # As of the median of the differences.
        self.same_clock = 2 * max(before, after) < count

    def _require_outputs(self, there: Flags, others: Iterable[str]) -> None:
        """Raise `BagReadError` if no message has some output, which none lacks by chance."""
        lacking = [
            f"{request.output_names[place]} of {joint} ({at.described})"
            for joint, request, own, known in zip(
                self.joints, self._requests, self.signals, there, strict=True
            )
            for place, at in enumerate(own.outputs)
            if not known[place]
        ]
        if not lacking:
            return
        text = f"no message of {self.topic} has {', '.join(lacking)}"
        if not self.was_observed:
            seen = [at.described for own, known in zip(self.signals, there, strict=True)
                    for place, at in enumerate(own.outputs) if known[place]]  # fmt: skip
            has = ", ".join([*seen, *others]) or "none"
            raise BagReadError(f"{self.path}: {text}, which the design measures; it has: {has}")
        # The live observer went on with the others.
        self.remarks += (f"warning: {text}",)


def _is_motor(name: str, names: Sequence[str]) -> bool:
    """Return whether a name is that of the motor of another one's joint."""
    return any(name == topics.sides(other)[1] for other in names)


def in_order_of_use(samples: Samples, innovations: JointSeries) -> Samples:
    """Return the messages in the order in which a recorded observer used them.

    Those of one publisher come in its order. Between publishers the innovations decide, since
    messages may overtake each other. A message without innovation is taken to have been as long on
    its way as the others of the same joints are, which is the best guess there is.

    Args:
        samples: In the order of publishing.
        innovations: The recorded ones.
    """
    used_at = times_of_use(samples, innovations)
    keys = np.zeros(samples.count, np.int64)
    for joints in np.unique(samples.named, axis=0):
        own = np.flatnonzero((samples.named == joints).all(axis=1))
        keys[own] = _filled_in(used_at[own], samples.publish_times[own])
    return samples.take(np.argsort(keys, kind="stable"))


def _filled_in(used_at: Times, published: Times) -> Times:
    """Return the times of use of one publisher's messages, the unknown ones estimated."""
    known = used_at != UNKNOWN
    if not known.any():
        return published
    usual = published + int(np.median(used_at[known] - published[known]))
    after = np.maximum.accumulate(np.where(known, used_at, 0))
    before = np.minimum.accumulate(used_at[::-1])[::-1]
    return np.asarray(np.maximum.accumulate(np.clip(usual, after, before)))


def times_of_use(samples: Samples, innovations: JointSeries) -> Times:
    """Return the publishing time of each measurement's innovation [ns], shape (n,).

    It is `UNKNOWN` of a measurement without innovation.
    """
    places = places_of_innovations(samples, innovations)
    return np.append(innovations.publish_times, UNKNOWN)[places]


def places_of_innovations(samples: Samples, innovations: JointSeries) -> NDArray[np.intp]:
    """Return the place of each measurement's recorded innovation, -1 without, shape (n,)."""
    found = np.full(samples.count, -1)
    # Messages with the same stamp, each of another joint, have an innovation each.
    for joints in np.unique(samples.named, axis=0):
        own = np.flatnonzero((samples.named == joints).all(axis=1))
        theirs = np.flatnonzero(innovations.named[:, joints].any(axis=1))
        places = match(samples.take(own), innovations.take(theirs))
        found[own[places >= 0]] = theirs[places[places >= 0]]
    return found


class Stamped(Protocol):
    """What has stamps and publishing times [ns], shape (n,) each."""

    @property
    def stamps(self) -> Times: ...

    @property
    def publish_times(self) -> Times: ...


def match(wanted: Stamped, there: Stamped) -> NDArray[np.intp]:
    """Return the place of each stamp, -1 for none, and no place twice, shape (n,).

    After a restart of time stamps occur again: those belong together that were published at about
    the same time. Of those in the same pass of time it is the first.
    """
    found = np.full(len(wanted.stamps), -1)
    stamps, inverse = np.unique(np.concatenate([wanted.stamps, there.stamps]), return_inverse=True)
    own, others = inverse[: len(found)], inverse[len(found) :]
    counts = [np.bincount(each, minlength=len(stamps)) for each in (own, others)]
    single = (counts[0] == 1) & (counts[1] == 1)
    place = np.full(len(stamps), -1)
    place[others] = np.arange(len(others))
    once = single[own]
    found[once] = place[own[once]]
    several = np.flatnonzero(~single[others] & (counts[0][others] > 0))
    if not len(several):
        return found
    candidates: dict[int, list[int]] = defaultdict(list)
    for row in np.flatnonzero(~once & (counts[1][own] > 0)).tolist():
        candidates[own[row]].append(row)
    begins = [begin for begin, _ in passes(wanted.stamps.tolist())]
    pass_of = np.searchsorted(begins, np.arange(len(found)), side="right")
    for row in several[np.argsort(there.publish_times[several], kind="stable")].tolist():
        if rows := candidates[others[row]]:
            apart = np.abs(wanted.publish_times[rows] - there.publish_times[row])
            alike = pass_of[rows] == pass_of[rows[int(np.argmin(apart))]]
            found[rows.pop(int(np.argmax(alike)))] = row
    return found
