# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where measurements come from: the topics of a bag, and what was estimated of them live."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.messages import estimate_topics as topics
from tsobs_ros.bag.messages.joint_series import (
    JointSeries,
    Wanted,
    read_joint_series,
    require_joint_states,
    until_damage,
)
from tsobs_ros.bag.messages.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.bag.reader import BagMessage, BagReader
from tsobs_ros.errors import BagReadError
from tsobs_ros.replay.samples import Samples, samples_of
from tsobs_ros.replay.schedule import in_order_of_use

MEASUREMENTS = "joint_measurements"
TRUE_STATES, TRUE_DISTURBANCE = "ground_truth/joint_states", "ground_truth/disturbance"
_FIRST_MESSAGES = 1000


@dataclass(frozen=True)
class TopicToCopy:
    """A topic that goes into the new bag as it is."""

    name: str
    type: str
    qos_profiles: tuple[QosProfile, ...]
    definition: MessageDefinition


@dataclass(frozen=True)
class Live:
    """What was recorded of a running observer.

    Attributes:
        states: Angles and velocities of every joint's link and motor.
        others: The other topics that were recorded of it, by the names in `estimate_topics`.
    """

    states: JointSeries
    others: dict[str, JointSeries]


class Truth(NamedTuple):
    """What a simulation knows; None where it was not recorded.

    Attributes:
        states: Angles and velocities of every joint's link and motor.
        disturbance: Of every joint's sensor.
    """

    states: JointSeries | None
    disturbance: JointSeries | None


class Source(Protocol):
    """Measurements of some joints, whatever they come from."""

    @property
    def path(self) -> Path:
        """The bag or the log."""
        ...

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints' names."""
        ...

    @property
    def namespace(self) -> str:
        """What the topics' names begin with: empty, or with a slash at its front only."""
        ...

    @property
    def samples(self) -> Samples:
        """The measurements."""
        ...

    @property
    def live(self) -> Live | None:
        """What an observer made of them when they were recorded."""
        ...

    @property
    def topics(self) -> Sequence[TopicToCopy]:
        """Topics that belong with estimates: measurements, and the truth where it is known."""
        ...

    @property
    def damage(self) -> BagReadError | None:
        """Where reading ended early, if it did."""
        ...

    @property
    def remarks(self) -> Sequence[str]:
        """What its user should know about it."""
        ...

    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages of those topics in order of log time."""
        ...

    def truth(self) -> Truth:
        """Read what a simulation knows of the joints."""
        ...


class BagSource:
    """A bag with a topic of measurements.

    Args:
        path: Bag folder or MCAP file.
        topic: The measurements; None for the one topic that ends in `joint_measurements`.
        joints: Whose; all that the first messages name if empty.
        observer: Name of the node whose estimates may have been recorded.
        assume_zero_torque: Take messages without effort as torque 0.

    Attributes:
        path: The bag.
        topic: The measurements.
        namespace: What the names of its topics begin with.
        joints: Whose measurements.
        samples: The measurements, in the order in which a subscriber got them.
        live: What the observer made of them when they were recorded, if that was recorded.
        damage: Where reading ended early, if it did.

    Raises:
        BagReadError: There is no bag, no such topic, nothing on it about such joints, or several
            topics could be meant.
    """

    def __init__(
        self,
        path: Path,
        *,
        topic: str | None = None,
        joints: Sequence[str] = (),
        observer: str = "observer",
        assume_zero_torque: bool = False,
    ) -> None:
        self.path = path
        self.damage: BagReadError | None = None
        self._reader = BagReader(path)
        self.topic = self._find_measurements() if topic is None else topic
        require_joint_states(self._reader, self.topic)
        self.namespace = self.topic.rpartition("/")[0]
        self.joints = tuple(joints) or self._first_joints()
        wanted = {self.topic: Wanted(self.joints, ("position", "effort"))}
        own = {name: f"{self.namespace}/{observer}/{name}" for name in topics.TOPICS}
        there = {name: full for name, full in own.items() if self._has(full)}
        wanted |= {full: self._wanted(name) for name, full in there.items()}
        series = read_joint_series(self._reader, wanted, on_damage=self._damaged)
        measured = series[self.topic]
        self._check_joints(measured)
        samples = samples_of(measured, assume_zero_torque).in_order_of_publishing()
        others = {name: series[full] for name, full in there.items()}
        innovations = others.get(topics.INNOVATION)
        self.samples = samples if innovations is None else in_order_of_use(samples, innovations)
        states = others.pop(topics.STATES, None)
        self.live = None if states is None or not states.count else Live(states, others)

    @property
    def topics(self) -> tuple[TopicToCopy, ...]:
        """The measurements, and the truth where it was recorded."""
        names = [
            self.topic,
            *(f"{self.namespace}/{name}" for name in (TRUE_STATES, TRUE_DISTURBANCE)),
        ]
        return tuple(
            TopicToCopy(
                name,
                info.type,
                info.qos_profiles,
                MessageDefinition(
                    info.type, info.definition, info.type_hash, info.definition_encoding
                ),
            )
            for name, info in self._reader.topics.items()
            if name in names
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return that stamps and log times are of different clocks, if they are."""
        if self.samples.same_clock:
            return ()
        return (
            "note: the bag's stamps and log times are of different clocks, so each measurement is "
            "taken to have come when it was sampled",
        )

    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages of those topics in order of log time, up to any damage."""
        names = [topic.name for topic in self.topics]
        return until_damage(self._reader.messages(names), self._damaged)

    def truth(self) -> Truth:
        """Read what a simulation knows of the joints."""
        arms = [side for joint in self.joints for side in topics.sides(joint)]
        own = {
            f"{self.namespace}/{TRUE_STATES}": Wanted(arms, ("position", "velocity")),
            f"{self.namespace}/{TRUE_DISTURBANCE}": Wanted(self.joints, ("position",)),
        }
        there = {name: wanted for name, wanted in own.items() if self._has(name)}
        series = read_joint_series(self._reader, there, on_damage=self._damaged)
        return Truth(*(series.get(name) for name in own))

    def _damaged(self, error: BagReadError) -> None:
        self.damage = error

    def _has(self, topic: str) -> bool:
        info = self._reader.topics.get(topic)
        return info is not None and info.type == JOINT_STATE

    def _find_measurements(self) -> str:
        names = [name for name in self._reader.topics if f"/{name}".endswith(f"/{MEASUREMENTS}")]
        if len(names) == 1:
            return names[0]
        has = ", ".join(names or self._reader.topics) or "none"
        what = "several topics end" if names else "no topic ends"
        raise BagReadError(f"{self.path}: {what} in {MEASUREMENTS}, choose one of: {has}")

    def _wanted(self, topic: str) -> Wanted:
        if topic in (topics.STATES, topics.STATE_BOUNDS):
            names = [side for joint in self.joints for side in topics.sides(joint)]
            return Wanted(names, ("position", "velocity"))
        return Wanted(self.joints, ("position", "velocity"))

    def _first_joints(self) -> tuple[str, ...]:
        messages = until_damage(self._reader.messages([self.topic]), self._damaged)
        first = list(islice(messages, _FIRST_MESSAGES))
        groups, malformed = JointStateDecoder().decode_all([message.data for message in first])
        if malformed and not groups:
            raise BagReadError(f"{self.path}: {self.topic}: {next(iter(malformed.values()))}")
        return tuple(dict.fromkeys(name for group in groups for name in group.names))

    def _check_joints(self, measured: JointSeries) -> None:
        if not measured.count:
            raise self.damage or BagReadError(f"{self.path}: no message on {self.topic}")
        missing = [
            joint
            for joint, there in zip(self.joints, np.any(measured.named, axis=0), strict=True)
            if not there
        ]
        if missing or not self.joints:
            seen = [joint for joint in self.joints if joint not in missing]
            names = ", ".join([*seen, *measured.other_names]) or "none"
            raise BagReadError(
                f"{self.path}: no message of {self.topic} names {', '.join(missing) or 'a joint'}; "
                f"joints: {names}"
            )
