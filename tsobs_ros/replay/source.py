# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recorded measurements of some joints, in the order of recording, and the bags that hold them."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Set
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias
from zlib import crc32

import numpy as np

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import TICK_LOG
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.metadata import TopicInfo
from tsobs_ros.bag.reader import UNCHECKED, BagReader, until_damage
from tsobs_ros.design.file import checksum, identity, load_design
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import AnyRequest, ArmRequest, TSRequest
from tsobs_ros.design.signals import Signals
from tsobs_ros.errors import BagReadError, DesignFileError, MessageError, ModelError
from tsobs_ros.estimation.records import USED
from tsobs_ros.model.arm import QUANTITIES
from tsobs_ros.replay.designs import RecordedObserver, recorded_observers
from tsobs_ros.replay.samples import MISSING, MeasurementReader
from tsobs_ros.series import NANOSECONDS, Spool, Stamps

MEASUREMENTS = "joint_measurements"
UNNAMED_SYSTEM = "system"
"""Name of a T–S system that a recording does not name."""

# Stamps that go back this far are not just late: time restarted (a looped bag, a new simulation).
_RESTART = NANOSECONDS
# No run pauses for a day: stamps that leap ahead so far are of another clock, as of the system's
# after a simulation's, or of another run.
_OTHER_CLOCK = 86_400 * NANOSECONDS
# This many messages in a row must lie there, because one straggler is no restart.
_RESTART_MESSAGES = 10
_SAME_CLOCK = NANOSECONDS
_BLOCK = 2**15
_MAX_OTHERS = 32

Records: TypeAlias = Any
"""Record arrays, one row per message or tick."""


def passes(stamps: Stamps) -> list[tuple[int, int]]:
    """Return the begin and end of each pass of time, from stamps [ns] in order of arrival.

    A new pass begins if stamps go back by more than a second, or ahead by more than a day, and stay
    there.
    """
    begins, steps = [0], np.diff(stamps)
    # Stamps hardly ever do so.
    known = stamps.tolist() if ((steps < -_RESTART) | (steps > _OTHER_CLOCK)).any() else []
    highest = 0
    for place, stamp in enumerate(known):
        if 0 < stamp < highest - _RESTART or 0 < highest < stamp - _OTHER_CLOCK:
            near = [one - highest for one in known[place : place + _RESTART_MESSAGES] if one]
            if max(near) < -_RESTART or min(near) > _OTHER_CLOCK:
                begins.append(place)
                highest = stamp
        highest = max(highest, stamp)
    return list(pairwise([*begins, len(stamps)]))


class BagSource:
    """Measurements of some joints in a bag.

    The designs decide what is read, so that `signals` and `samples` exist only after `observe`.

    Args:
        path: The bag's folder, or one MCAP file.
        topic: Full name of the measurements' topic; by default the one that the live observer
            used, or the only one that ends in `joint_measurements`, or the only one of JointStates.
        joints: By default the live observer's joints that are measured, else all that are measured.
        assume_zero_torque: Take a missing effort as torque 0; None: as the live observer did.
        held_out: Sensor that is kept from all observers: one of `QUANTITIES`, optionally with a
            place, as in `link_angle=/TOPIC`, `=/TOPIC:ENTRY` or `=:ENTRY`.

    Attributes:
        reader: The bag.
        signals: The places of each joint's signals.
        samples: The measurements in the order of recording, one record per message, in a temporary
            file: stamps and log times [ns], `y`, `u` and `codes` of `Batch` for all joints, 0 for
            an input that a joint does not have, and CRC-32 of the messages as `checksums`.
        ran: The designs and parameters of the recorded observer.
        same_clock: Whether stamps and log times seem to be of the same clock.
        observer: Full name of the recorded observer, or the one that it would have.
        namespace: Prefix of the topics' names: empty, or with a slash at its front only.
        was_observed: Whether the bag has output of an observer that ran during the recording.
        tick_log: Full name of the topic with this observer's ticks, empty if there is none.
        truth: Full names of the simulator's topics in the bag, by their names in `TRUTH`.
        damage: The error that ended reading early.
        remarks: Notes for the user.
        guessed: Whether the joints are those of the messages, as nothing else names them.
        requests: The requests of the designs, after `observe`.
        with_motors: Joints whose motor has its own entry, although a design may use one side only.
        held_out_columns: Title of the held-out sensor's column of each joint, in a log.

    Raises:
        BagReadError: There is no bag, no such topic, several topics fit, or no message names a
            joint.
    """

    reader: BagReader
    signals: tuple[Signals, ...] = ()
    samples: Records
    same_clock: bool
    ran = RecordedObserver()
    observer = "/observer"
    namespace = ""
    was_observed = False
    tick_log = ""
    truth: Mapping[str, str] = MappingProxyType({})
    damage: BagReadError | None = None
    remarks: tuple[str, ...] = ()
    requests: tuple[AnyRequest, ...] = ()
    with_motors: Set[str] = frozenset()
    held_out: str | None = None
    held_out_columns: tuple[str, ...] = ()
    _alone = True

    def __init__(
        self,
        path: Path,
        topic: str | None = None,
        joints: Sequence[str] = (),
        *,
        assume_zero_torque: bool | None = None,
        held_out: str | None = None,
    ) -> None:
        self.path, self.held_out = path, held_out
        self.reader = BagReader(path)
        observers = recorded_observers(self.reader)
        used = [ran.measurements for ran in observers.values() if ran.measurements]
        observed = self.reader.topics.keys() & used
        self.topic = self._find_measurements(observed) if topic is None else topic
        self.reader.require([self.topic], JOINT_STATE)
        self.observer = self._find_observer(observers)
        self.namespace = self.observer.rpartition("/")[0]
        self.ran = observers.get(self.observer, self.ran)
        names, only = self._names, len(self.ran.designs) <= 1
        entries = [f"{name}/" for name in names]
        ran = tuple(
            joint
            for joint in self.ran.designs
            if only or any(one.startswith((f"{joint}/", f"{joint}_motor/")) for one in entries)
        )
        self.guessed = not joints and not ran
        motors = {f"{name}_motor" for name in names}
        self.joints = tuple(joints) or ran or tuple(one for one in names if one not in motors)
        if not self.joints:
            raise BagReadError(f"{self.path}: no message of {self.topic} names a joint")
        self._alone = only and not any(
            name.startswith(f"{joint}/") for joint in self.joints for name in names
        )
        # A motor with its own entry is not the link, whichever of both the design measures, and
        # a held-out sensor without a place is the other one. A recorded observer chose itself.
        if not ran or held_out in QUANTITIES:
            named = {*self.joints, *names}
            self.with_motors = {one for one in named if topics.sides(one)[1] in names}
        if assume_zero_torque is None:
            assume_zero_torque = self.ran.settings().assume_zero_torque
        self._assume_zero_torque = assume_zero_torque
        states = self.there(self.observer, [topics.STATES]).values()
        self.was_observed = any(self.reader.topics[topic].count for topic in states)
        ticks = self.reader.topics.get(f"{self.observer}/{topics.TICKS}")
        if ticks is not None and ticks.type == TICK_LOG and ticks.count:
            self.tick_log = ticks.name
        self.truth = self.there(self.namespace, topics.TRUTH)

    def observe(self, requests: Sequence[AnyRequest]) -> None:
        """Read the data that the designs of the joints need.

        Raises:
            BagReadError: The bag does not have the measurements.
            LogError: The log does not have them.
            ModelError: Other signals were read already, or a sensor cannot be held out.
        """
        if not self.requests:
            self._check_held_out(requests)
            self.requests = tuple(requests)
            self.signals = self.signals_of(requests)
            self._read()
        has, wanted = (
            [name for one in each for name in (*one.output_names, *one.input_names)]
            for each in (self.requests, requests)
        )
        if has != wanted:
            raise ModelError(
                f"{self.path}: designs that are run together must measure the same, got one of "
                f"{', '.join(has)} and one of {', '.join(wanted)}: run them one after the other"
            )

    def _check_held_out(self, requests: Sequence[AnyRequest]) -> None:
        quantity, _, place = (self.held_out or "").partition("=")
        arms = [request for request in requests if isinstance(request, ArmRequest)]
        problem = ""
        if quantity not in QUANTITIES:
            problem = f"expected one of {', '.join(QUANTITIES)}, got {quantity!r}"
        elif len(arms) < len(requests):
            problem = "expected the design of an arm, got one of a T-S system"
        elif any(quantity in arm.output_names for arm in arms):
            problem = f"{quantity} is what the observer measures"
        elif len(arms) > 1 and place and (place[0] != "/" or ":" in place):
            problem = f"{place} is of one joint; choose it: --joints NAME"
        if self.held_out and problem:
            raise ModelError(f"held out: {problem}")

    @property
    def count(self) -> int:
        """Number of messages with measurements."""
        return len(self.samples)

    @property
    def span(self) -> tuple[int, int]:
        """Smallest and largest log time of the measurements, ns since the epoch."""
        return int(self.samples.log_times.min()), int(self.samples.log_times.max())

    def choose_designs(
        self, given: Sequence[str] = (), *, others_allowed: bool = False
    ) -> dict[str, tuple[Design, ...]]:
        """Return the designs to estimate with: for the name of each file, one design per joint.

        Args:
            given: Files that the user names, each for all joints, or `JOINT=FILE` for one of them;
                if empty, the designs of the recorded observer, else the shipped design.
            others_allowed: Whether given files may differ from the recorded observer's designs.

        Raises:
            DesignFileError: A file is no design, or not the one that the observer ran.
            BagReadError: The design in the bag is not valid.
        """
        own = dict(argument.split("=", 1) for argument in given if "=" in argument)
        shared = [argument for argument in given if "=" not in argument]
        for joint in own.keys() - set(self.joints):
            known = ", ".join(self.joints)
            raise DesignFileError(f"--design {joint}={own[joint]}: no such joint; joints: {known}")
        if own and len(shared) > 1:
            raise DesignFileError(
                "--design: expected one file for the joints without their own, got "
                f"{', '.join(shared)}"
            )
        bag, ran, load = self.path, self.ran, cache(load_design)
        if own and not shared and self.guessed and len(own) < len(self.joints):
            self.joints = tuple(joint for joint in self.joints if joint in own)
            names = ", ".join(self.joints)
            self.remarks += (f"note: --design is for {names}, so no other joint is estimated",)

        def design_of(joint: str, path: str | None) -> Design:
            recorded = ran.designs.get(joint, ())
            if path is not None:
                design = load(path)
                for each in recorded:
                    if not (others_allowed or each.sha256 == checksum(design)):
                        raise DesignFileError(
                            f"--design {path} (SHA-256 {identity(design)}): the observer of {bag} "
                            f"ran {each} for {joint}; leave --design out to use that one, or add "
                            "--other-design to use this one all the same"
                        )
                return design
            if not ran.designs:
                return load()
            if not recorded:
                raise DesignFileError(
                    f"{bag}: its observer ran no design for {joint}, but for "
                    f"{', '.join(ran.designs)}; name one with --design {joint}=FILE"
                )
            if len(recorded) > 1:
                raise DesignFileError(
                    f"{bag}: its observer ran {' and then '.join(map(str, recorded))} for "
                    f"{joint}; name one with --design FILE --other-design"
                )
            try:
                return load(f"{recorded[0].file:.200}", recorded[0].text)
            except DesignFileError as error:
                raise BagReadError(f"{bag}: {ran.source}: {error}") from error

        found = dict[str, tuple[Design, ...]]()
        for path in shared or (None,):
            stem = Path(path or "own").name.split(".")[0].replace("-", "_").replace(" ", "_")
            name = stem if stem not in found else f"{stem}_{len(found) + 1}"
            found[name] = tuple(design_of(joint, own.get(joint, path)) for joint in self.joints)
        if self.take_for_system([one.request for designs in found.values() for one in designs]):
            found = {name: designs[:1] for name, designs in found.items()}
        return found

    def take_for_system(self, requests: Sequence[AnyRequest]) -> bool:
        """Return whether the source is one unnamed T–S system, and if so, take it as such."""
        systems = self.guessed and all(isinstance(one, TSRequest) for one in requests)
        if systems:
            self.joints, self.guessed = (UNNAMED_SYSTEM,), False
        return systems

    @property
    def alone(self) -> bool:
        """Whether messages name the signals of the only joint without the joint's name."""
        return self._alone and len(self.joints) == 1

    def signals_of(self, requests: Sequence[AnyRequest]) -> tuple[Signals, ...]:
        """Return the places of the joints' signals if they have these designs."""
        each = zip(requests, self.joints, strict=True)
        motors = self.with_motors
        return tuple(one.signals(joint, self.alone, joint in motors) for one, joint in each)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """Topics that belong with estimates: measurements, and the truth of a simulation."""
        names = {self.topic, *self.truth.values()}
        return tuple(topic for name, topic in self.reader.topics.items() if name in names)

    def damaged(self, error: BagReadError) -> None:
        """Note damage that has ended reading."""
        self.damage = error

    def there(self, prefix: str, names: Iterable[str]) -> dict[str, str]:
        """Return the full names of the JointStates of these names below a node or namespace."""
        full = {name: f"{prefix}/{name}" for name in names}
        there = {name for name, topic in self.reader.topics.items() if topic.type == JOINT_STATE}
        return {key: name for key, name in full.items() if name in there}

    def _find_measurements(self, observed: Collection[str]) -> str:
        named = [name for name in self.reader.topics if f"/{name}".endswith(f"/{MEASUREMENTS}")]
        names = sorted(observed) or named
        states = [name for name, topic in self.reader.topics.items() if topic.type == JOINT_STATE]
        if not names and len(states) == 1:
            self.remarks += (f"note: the measurements are taken from {states[0]}",)
            names = states
        if len(names) == 1:
            return names[0]
        has = ", ".join(names or states or self.reader.topics) or "none"
        what = "several topics may be" if names else f"no topic ends in {MEASUREMENTS}, so none is"
        raise BagReadError(
            f"{self.path}: {what} the measurements; name one with --topic, there are: {has}"
        )

    def _find_observer(self, observers: Mapping[str, RecordedObserver]) -> str:
        """Return the full name of the observer of the measurements."""
        usual = f"{self.topic.rpartition('/')[0]}/observer"
        own = [name for name, ran in observers.items() if ran.measurements == self.topic]
        chosen = next((name for name in own if name.endswith("/observer")), (*own, usual)[0])
        if others := [name for name in own if name != chosen]:
            self.remarks += (
                f"note: of the bag's observers of {self.topic}, {chosen} is meant, not "
                f"{', '.join(others)}",
            )
        return chosen

    @cached_property
    def _names(self) -> Mapping[str, None]:
        """The names in all measurements, in the order of the messages."""
        names, decode = dict[str, None](), JointStateDecoder()
        for block in self.reader.blocks([self.topic], _BLOCK, on_damage=self.damaged):
            names |= decode.names(block[self.topic].groups)
        if not names:
            try:
                for message in until_damage(self.reader.messages([self.topic]), self.damaged):
                    decode(message.data)
            except MessageError as error:
                raise BagReadError(f"{self.path}: {self.topic}: {error}") from error
        return names

    def _read(self) -> None:
        joints = dict(zip(self.joints, self.signals, strict=True))
        read, without_input, mixed = MeasurementReader(joints, self._assume_zero_torque), 0, 0
        n, p = len(joints), max(len(own.outputs) for own in self.signals)
        m = max(len(own.inputs) for own in self.signals)
        numbers = [(name, np.int64) for name in ("stamps", "log_times", "checksums")]
        arrays = [("codes", np.int64, (n,)), ("y", np.float64, (n, p)), ("u", np.float64, (n, m))]
        samples = Spool(np.dtype([*numbers, *arrays]))
        for block in self.reader.blocks([self.topic], _BLOCK, on_damage=self.damaged):
            raw = block[self.topic]
            batch = read.read_raw(raw)
            some: Records = np.zeros(len(raw.log_times), samples.type).view(np.recarray)
            some.stamps, some.log_times, some.codes = batch.stamps, raw.log_times, batch.codes.T
            some.y = np.nan
            for joint, (y, u) in enumerate(zip(batch.y, batch.u, strict=True)):
                some.y[:, joint, : y.shape[1]] = y
                some.u[:, joint, : u.shape[1]] = u
            for places, data in raw.groups:
                some.checksums[places] = [crc32(row) for row in data]
            lack = (batch.codes == MISSING).any(axis=0) & ~(batch.codes == USED).any(axis=0)
            without_input += int(lack.sum())
            mixed += int((np.diff(raw.publish_times) < -_RESTART).sum())
            samples.add(some)
        self.samples = samples.read()
        if not self.count:
            raise self.damage or BagReadError(f"{self.path}: no message on {self.topic}")
        self._require_outputs(read.found())
        apart = self.samples.log_times - self.samples.stamps
        off = max((apart <= -_SAME_CLOCK).sum(), (apart >= _SAME_CLOCK).sum())
        self.same_clock = bool(2 * off < self.count)  # decided by the median of the differences
        if mixed > _RESTART_MESSAGES:
            self.remarks += (
                "warning: log times seem to have gone back with simulated time, so messages of "
                "several runs are mixed: record again, or each run in a bag of its own",
            )
        self.remarks += tuple(self._notes(without_input))

    def _require_outputs(self, there: Sequence[Sequence[bool]]) -> None:
        """Raise `BagReadError`, or note a warning, if some output is missing in all messages."""
        lacking, seen = list[str](), list[str]()
        each = zip(self.joints, self.requests, self.signals, there, strict=True)
        for joint, request, own, known in each:
            for name, place, given in zip(request.output_names, own.outputs, known, strict=True):
                (seen if given else lacking).append(f"{name} of {joint} ({place.described})")
        if not lacking:
            return
        text = f"no message of {self.topic} has {', '.join(lacking)}"
        if not self.was_observed:
            entries = frozenset().union(*(own.entries for own in self.signals))
            names = self._names
            others = [name for name in names if name not in entries]
            has = ", ".join([*seen, *others[:_MAX_OTHERS]]) or "none"
            text = f"{self.path}: {text}, which the design measures; it has: {has}"
            for name in names:
                own = self.requests[0].signals(
                    name, alone=False, both_sides=name in self.with_motors
                )
                if {place.name for place in own.outputs} <= {*names}:
                    raise BagReadError(f"{text}; all of it for --joints {name}")
            raise BagReadError(text)
        # The live observer continued with the other outputs.
        self.remarks += (f"warning: {text}",)

    def _notes(self, without_input: int) -> Iterator[str]:
        """Yield notes on the measurements."""
        if without_input and any(isinstance(one, ArmRequest) for one in self.requests):
            of = "all" if without_input == self.count else f"{without_input:,} of"
            yield (
                f"warning: effort is empty in {of} {self.count:,} messages, which are not used: if "
                "no torque acts, set assume_zero_torque: --param assume_zero_torque=true"
            )
        if not self.same_clock:
            yield (
                "note: stamps and log times are of different clocks, so each measurement is taken "
                "to have arrived when it was sampled"
            )
        if self.was_observed and not self.tick_log:
            yield (
                f"note: the bag has no tick log (topic {topics.TICKS} of the observer): estimates "
                "are made at the measurements' stamps, and not compared with the live ones"
            )
        if self.reader.unchecked:
            yield f"note: {UNCHECKED}"
