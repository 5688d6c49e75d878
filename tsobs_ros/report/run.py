# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One recorded run of the observer as stamped series of numbers, read from a bag."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.cdr import DIAGNOSTICS, RecordedStatus, read_statuses
from tsobs_ros.bag.joint_series import Place, Wanted, read_blocks
from tsobs_ros.bag.joint_states import JOINT_STATE, joint_names
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.checks import Array, Flags
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.design.signals import Signals, signals
from tsobs_ros.errors import BagReadError
from tsobs_ros.replay.designs import RecordedObserver, recorded_observer
from tsobs_ros.replay.health import as_of_now
from tsobs_ros.replay.places import ESTIMATES, places_of
from tsobs_ros.replay.source import MEASUREMENTS, UNNAMED_SYSTEM, passes
from tsobs_ros.report.quantities import QUANTITIES, Quantity, quantities_of
from tsobs_ros.series import NANOSECONDS, Series, Spool, Stamps

MAX_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""

BLOCK = 2**17
"""Number of messages that are read at once, of all topics: some 80 s at 200 Hz."""

_FIRST_MESSAGES = 1000

ESTIMATED = (
    "state",
    "state_bound",
    "disturbance",
    "disturbance_bound",
    "torque_disturbance",
    "torque_disturbance_bound",
)
"""Fields of an `Estimate`, and parts of a run, that have a row for each estimate."""

TRUE = {
    "true_state": topics.TRUE_STATES,
    "true_disturbance": topics.TRUE_DISTURBANCE,
    "true_torque_disturbance": topics.TRUE_TORQUE,
}
"""The simulator's topics by the parts of a run."""

_OWN = {fields[0]: topic for topic, fields in ESTIMATES.items() if topic != topics.HEALTH}
_OWN |= {"health": topics.HEALTH, "innovation": topics.INNOVATION}
_REQUIRED = ("measurements", *ESTIMATED[:4])
# Numbers of a joint that is alone, and those of one among several, are in entries of other names.
_TWICE = ("health", "parameters", "parameter_bound")

Key = TypeVar("Key")

Rows: TypeAlias = Any
"""A record array: `stamps` and `log_times` [ns], and `values`, some per row."""


def row_type(width: int) -> np.dtype[np.void]:
    """Return the type of `Rows` with as many values each."""
    times = [("stamps", np.int64), ("log_times", np.int64)]
    return np.dtype([*times, ("values", np.float64, (width,))])


def rows_of(times: Any, values: Array) -> Rows:
    """Return rows of values, shape (n, width), with the `stamps` and `log_times` of records."""
    rows: Rows = np.recarray(len(values), row_type(values.shape[1]))
    rows.stamps, rows.log_times, rows.values = times.stamps, times.log_times, values
    return rows


class Estimated(NamedTuple):
    """A quantity of a run.

    Attributes:
        values: The estimates, shape (m,).
        bounds: 1σ bound of each, shape (m,).
        truth: As recorded, values (k, 1); None on a robot.
        true_values: At the estimates' stamps, NaN if unknown, shape (m,); None on a robot.
    """

    values: Array
    bounds: Array
    truth: Series | None
    true_values: Array | None

    @property
    def error(self) -> Array:
        """Estimate − truth, NaN if unknown, shape (m,)."""
        if self.true_values is None:
            return np.full(len(self.values), np.nan)
        return self.values - self.true_values


@dataclass(frozen=True)
class RecordedRun:
    """Measurements, estimates and, from a simulation, the truth.

    Attributes:
        name: Its origin, for titles.
        joint: The joint's name.
        measurements: In order of arrival: outputs and then inputs at the sampling stamps, of an arm
            [y (rad), u (N m)], values (n, p + m).
        stamps: Of the estimates [ns], ascending, shape (m,).
        state: Estimated, of an arm [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (m, plant).
        state_bound: Published 1σ bound of each, NaN if lost, shape (m, plant).
        disturbance: Estimated disturbance of each output, NaN if lost, shape (m, p).
        disturbance_bound: Published 1σ bound of each, NaN if lost, shape (m, p).
        torque_disturbance: Estimated torque disturbances [N m], NaN if lost, shape (m, t).
        torque_disturbance_bound: Published 1σ bound of each [N m], NaN if lost, shape (m, t).
        innovation: y − ŷ at the measurements' stamps, NaN of outputs that were not used, values
            (n', p); None if not recorded.
        true_state: At the sampling stamps, values (k, plant); None on a robot.
        true_disturbance: Of the outputs at the sampling stamps, values (k', p); None on a robot.
        true_torque_disturbance: At the sampling stamps [N m], values (k'', t); None on a robot.
        health: Fields of `estimation.records.HEALTH` at their stamps, values (h, 7); None if
            not recorded.
        parameters: Learnt changes of the uncertain parameters, values (l, c); None if not recorded.
        parameter_bound: 1σ of each, values (l, c); None if not recorded.
        held_out: Readings of a sensor that no observer got, values (r, 1); None without one.
        topic: Name of the measurements' topic.
        passes: Number of passes over the recorded time; this is the longest one.
        request: Of the design, for names, units and places.
    """

    name: str
    joint: str
    measurements: Series
    stamps: Stamps
    state: Array
    state_bound: Array
    disturbance: Array
    disturbance_bound: Array
    torque_disturbance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    torque_disturbance_bound: Array = field(default_factory=lambda: np.zeros((0, 0)))
    innovation: Series | None = None
    true_state: Series | None = None
    true_disturbance: Series | None = None
    true_torque_disturbance: Series | None = None
    health: Series | None = None
    parameters: Series | None = None
    parameter_bound: Series | None = None
    held_out: Series | None = None
    topic: str = "joint_measurements"
    passes: int = 1
    request: ArmRequest | TSRequest = field(default_factory=ArmRequest)

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:
        """What the estimates are of."""
        return quantities_of(self.request)

    @cached_property
    def origin(self) -> int:
        """Stamp that times count from: the first measurement's, or estimate's if earlier [ns]."""
        stamped = self.measurements.stamps[self.measurements.stamps > 0]
        return int(np.append(stamped, self.stamps[0]).min())

    @cached_property
    def times(self) -> Array:
        """Times of the estimates since the origin [s], shape (m,)."""
        return np.asarray((self.stamps - self.origin) / NANOSECONDS, dtype=np.float64)

    @cached_property
    def _true_values(self) -> dict[str, Array | None]:
        """Truth at the estimates' stamps by kind, NaN if unknown."""
        rated = self.quantities[:4] == QUANTITIES[:4]
        return {
            kind: None if series is None else read(series, self.stamps)
            for kind, series, read in (
                ("state", self.true_state, partial(interpolate, rated=rated)),
                ("disturbance", self.true_disturbance, hold),
                ("torque_disturbance", self.true_torque_disturbance, hold),
            )
        }

    def of(self, quantity: Quantity) -> Estimated:
        """Return what is known of a quantity."""
        kind, column = quantity.kind, quantity.column
        truth: Series | None = getattr(self, f"true_{kind}")
        values = self._true_values[kind]
        return Estimated(
            getattr(self, kind)[:, column],
            getattr(self, f"{kind}_bound")[:, column],
            None if truth is None else truth.column(column),
            None if values is None else values[:, column],
        )


class Asked(NamedTuple):
    """What to read of a topic of JointStates.

    Attributes:
        topic: Its full name.
        groups: Places of numbers; a message counts if it has any entry of the first group.
        either: Whether each message has one of two groups, instead of all side by side.
    """

    topic: str
    groups: Wanted
    either: bool = False


def read_rows(
    reader: BagReader,
    asked: Mapping[Key, Asked],
    on_damage: Callable[[BagReadError], None] | None = None,
) -> dict[Key, Rows]:
    """Read numbers of a bag, all in one pass.

    Args:
        reader: The bag.
        asked: What to read.
        on_damage: Called with damage to the bag, up to which everything is returned; else it is
            raised.

    Raises:
        BagReadError: The bag has no such topic, a topic is of another type, or it is damaged.
    """
    wanted: dict[str, list[Sequence[Place]]] = {}
    spools: dict[Key, Spool] = {}
    places: dict[Key, slice] = {}
    for key, one in asked.items():
        spools[key] = Spool(row_type(sum(map(len, one.groups[: 1 if one.either else None]))))
        groups = wanted.setdefault(one.topic, [])
        places[key] = slice(len(groups), len(groups) + len(one.groups))
        groups += one.groups
    for block in read_blocks(reader, wanted, BLOCK, on_damage=on_damage):
        for key, one in asked.items():
            series, own = block.series[one.topic], places[key]
            named: Flags = series.named[:, own]
            parts = series.values[:, own].swapaxes(0, 1)
            values = [part[:, : len(group)] for part, group in zip(parts, one.groups, strict=True)]
            if one.either:
                values = [np.where(named[:, 1:], values[1], values[0])]
            there = named.any(axis=1) if one.either else named[:, 0]
            spools[key].add(rows_of(series, np.hstack(values))[there])
    return {key: spool.read() for key, spool in spools.items()}


class FoundObserver:
    """A recorded observer, found in a bag by how the names of its topics end.

    Args:
        bag: Bag folder or MCAP file.
        namespace: Namespace of all topics, for a bag with several arms.
        observer: Name of the observer node.

    Attributes:
        ran: What it ran, as far as the bag has it.
        joints: All that there are estimates of.

    Raises:
        BagReadError: The bag cannot be read, or has several topics that could be meant.
    """

    def __init__(
        self, bag: Path, *, namespace: str | None = None, observer: str = "observer"
    ) -> None:
        reader = self._reader = BagReader(bag)
        own = {key: f"{observer}/{topic}" for key, topic in _OWN.items()}
        self._ends = {"measurements": MEASUREMENTS, **own, **TRUE}
        names = {key: _find(reader, end, namespace) for key, end in self._ends.items()}
        self.ran, self._entries, self._names = RecordedObserver(), tuple[str, ...](), names
        if (states := names["state"]) is not None:
            self.ran = recorded_observer(reader, states.removesuffix(f"/{topics.STATES}"))
            info = reader.topics.get(self.ran.measurements or "")
            if names["measurements"] is None and info is not None and info.type == JOINT_STATE:
                names["measurements"] = info.name
            messages = islice(reader.messages([states]), _FIRST_MESSAGES)
            self._entries = joint_names(message.data for message in messages)
        entries, designs = self._entries, self.ran.designs
        self._named = {one.partition("/")[0] for one in entries if "/" in one}
        links = [one.removesuffix("_link") for one in entries if one.endswith("_link")]
        arms = [joint for joint in links if topics.sides(joint)[1] in entries]
        systems = [one for one in designs if one in self._named or (entries and len(designs) == 1)]
        self.joints = tuple(dict.fromkeys([*arms, *systems]))
        if entries and not self.joints:
            self.joints = (UNNAMED_SYSTEM,)

    def choose(self, joint: str | None) -> str:
        """Return the joint of a name, the only one if it is None.

        Raises:
            BagReadError: There are no estimates of such a joint, or of several.
        """
        path = self._reader.path
        self._require(["state"])
        if not self._entries:
            made = self._reader.topics.get(self._names["measurements"] or "")
            of = "" if made is None else f" of {made.count} measurements on {made.name}"
            raise BagReadError(
                f"{path}: the observer made no estimate{of}; its design may be of another arm or "
                "system, and its log and /diagnostics say why measurements were rejected"
            )
        if joint in self.joints or (joint is None and len(self.joints) == 1):
            return joint or self.joints[0]
        has = ", ".join(self.joints)
        if joint is None:
            raise BagReadError(f"{path}: estimates of several joints, choose one of: {has}")
        raise BagReadError(f"{path}: no estimate of joint '{joint}'; joints: {has}")

    def run(self, joint: str, request: ArmRequest | TSRequest) -> RecordedRun:
        """Return the estimates of a joint.

        If the recorded time restarts, as in a looped bag, the pass with the longest estimates is
        read.

        Args:
            joint: The joint.
            request: Of its design.

        Raises:
            BagReadError: The bag lacks a topic that is needed, or messages of the joint on it.
        """
        self._require(_REQUIRED)
        own = signals(request, joint, joint not in self._named)
        found = read_rows(self._reader, self._asked(joint, own, request.uncertainty_model.names))
        if empty := [str(self._names[key]) for key in _REQUIRED if not len(found[key])]:
            raise BagReadError(
                f"{self._reader.path}: no message about joint '{joint}' on {', '.join(empty)}"
            )
        parts = [part for part in Path(self._reader.path).absolute().parts if part != "bag"]
        name = f"{joint}, {parts[-1]}" if len(parts) > 1 else joint
        return run_of(found, name, joint, request, str(self._names["measurements"]))

    def _asked(self, joint: str, own: Signals, learnt: tuple[str, ...]) -> dict[str, Asked]:
        """Return for each part of a run that there is what to read."""
        alone, named = (
            places_of(joint, own, alone=alone, learnt=learnt, rated=False)
            for alone in (True, False)
        )
        groups: dict[str, Wanted] = {
            key: [alone[topic], named[topic]] if key in _TWICE else [alone[topic]]
            for key, topic in (_OWN | TRUE).items()
        }
        groups["measurements"] = [own.outputs, own.inputs]
        return {
            key: Asked(name, groups[key], key in _TWICE)
            for key, name in self._names.items()
            if name is not None and any(groups[key])
        }

    def statuses(self, joint: str) -> Iterator[RecordedStatus]:
        """Yield the recorded statuses of the observer that are of a joint, or of all joints."""
        topic = self._reader.topics.get("/diagnostics")
        node = str(self._names["state"]).removesuffix(f"/{topics.STATES}").strip("/")
        if topic is None or topic.type != DIAGNOSTICS:
            return
        mark = f"{node}: ".encode()
        for message in self._reader.messages([topic.name]):
            for status in read_statuses(message.data) if mark in message.data else ():
                of_all = status.name[-1] == "timing" or len(self.joints) == 1
                if status.name[0] == node and (of_all or status.hardware == joint):
                    yield status

    def _require(self, keys: Sequence[str]) -> None:
        if missing := [self._ends[key] for key in keys if self._names[key] is None]:
            has = ", ".join(self._reader.topics) or "none"
            raise BagReadError(
                f"{self._reader.path}: no topic ends in {', '.join(missing)}; topics: {has}"
            )


def run_of(
    found: Mapping[str, Rows],
    name: str,
    joint: str,
    request: ArmRequest | TSRequest,
    topic: str = "",
) -> RecordedRun:
    """Return the run with the longest pass of estimates, and what is nearest to it.

    A looped bag has several passes over the recorded time.

    Args:
        found: Rows of the parts of a run; there are some of its states.
        name: Its origin.
        joint: The joint.
        request: Of its design.
        topic: Name of the measurements' topic.
    """
    each = {
        key: [rows[begin:end] for begin, end in passes(rows.stamps) if begin < end]
        for key, rows in found.items()
    }
    longest = max(each["state"], key=lambda one: float(np.ptp(one.stamps)))
    # Each topic restarts at its own moment, but all of them at about the same.
    near = {
        key: min(own, key=lambda one: abs(one.log_times[0] - longest.log_times[0]))
        for key, own in each.items()
        if own
    }
    series: dict[str, Any] = {key: Series(one.stamps, one.values) for key, one in near.items()}
    measurements, (stamps, state) = series.pop("measurements"), series.pop("state").ordered()
    parts: dict[str, Any] = {}
    for key in ESTIMATED[1:]:
        width = found[key].values.shape[1] if key in found else len(request.torque_sides)
        nothing = Series(stamps[:0], np.zeros((0, width)))
        parts[key] = align(series.pop(key, nothing), stamps)
    if "health" in series:
        series["health"] = series["health"]._replace(values=as_of_now(series["health"].values))
    return RecordedRun(
        name=name,
        joint=joint,
        measurements=measurements,
        stamps=stamps,
        state=state,
        topic=topic,
        passes=len(each["state"]),
        request=request,
        **parts,
        **{key: one.ordered() for key, one in series.items()},
    )


def _find(reader: BagReader, suffix: str, namespace: str | None) -> str | None:
    if namespace is None:
        matches = [name for name in reader.topics if f"/{name}".endswith(f"/{suffix}")]
    else:
        exact = f"/{namespace.strip('/')}/{suffix}".replace("//", "/")
        matches = [name for name in reader.topics if name == exact]
    if len(matches) > 1:
        raise BagReadError(
            f"{reader.path}: several topics end in {suffix}: {', '.join(matches)}; choose one by "
            "its namespace"
        )
    if matches and (type_ := reader.topics[matches[0]].type) != JOINT_STATE:
        raise BagReadError(f"{reader.path}: {matches[0]} is {type_}, expected {JOINT_STATE}")
    return matches[0] if matches else None


def align(series: Series, stamps: Stamps) -> Array:
    """Return the values that have exactly these stamps, NaN if there is none, (m, k)."""
    source = series.ordered()
    if np.array_equal(source.stamps, stamps):
        return source.values
    result = np.full((len(stamps), source.values.shape[1]), np.nan)
    _, here, there = np.intersect1d(stamps, source.stamps, return_indices=True)
    result[here] = source.values[there]
    return result


def interpolate(series: Series, stamps: Stamps, *, rated: bool = False) -> Array:
    """Return values between their samples, NaN outside of them and in gaps, shape (m, k).

    They follow the cubic that has the values and slopes of both neighbours. If slopes are sampled,
    then of a smooth motion an angle is off by at most h⁴/384 max|q⁗| and a velocity by at most
    √3 h³/216 max|q⁗|: 10⁻⁹ rad and 10⁻⁶ rad/s for the elastic-joint arm at h = 5 ms.

    Args:
        series: Samples in ascending order, values of shape (n, k).
        stamps: Where to evaluate [ns], shape (m,).
        rated: Whether each value is followed by its rate, as in [q₁, q̇₁, q₂, q̇₂]; else slopes are
            those to the next samples.
    """
    if np.array_equal(series.stamps, stamps):
        return series.values
    result = np.full((len(stamps), series.values.shape[1]), np.nan)
    series = series.take(np.flatnonzero(np.isfinite(series.values).all(axis=1)))
    for begin in range(0, len(stamps), BLOCK):
        own = stamps[begin : begin + BLOCK]
        first, last = np.searchsorted(series.stamps, own[[0, -1]]).tolist()
        known = series.take(slice(max(first - 2, 0), last + 2))
        if len(known.stamps) < 2:
            continue
        inside = (own >= known.stamps[0]) & (own <= known.stamps[-1])
        right = np.searchsorted(known.stamps, own, side="right").clip(1, len(known.stamps) - 1)
        inside &= np.diff(known.stamps)[right - 1] <= MAX_GAP * NANOSECONDS
        origin = int(known.stamps[0])
        times, wanted = known.seconds(origin), (own[inside] - origin) / NANOSECONDS
        if rated:
            pair = _hermite(times, known.values[:, 0::2], known.values[:, 1::2], wanted)
            found = np.stack(pair, axis=2).reshape(len(wanted), -1)
        else:
            slopes = np.gradient(known.values, times, axis=0)
            found = _hermite(times, known.values, slopes, wanted)[0]
        result[begin : begin + BLOCK][inside] = found
    return result


def _hermite(times: Array, values: Array, slopes: Array, wanted: Array) -> tuple[Array, Array]:
    """Return the cubics through values with slopes, and their slopes; SciPy weighs 140 MB."""
    k = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 2)
    step = (times[k + 1] - times[k])[:, np.newaxis]
    part = (wanted - times[k])[:, np.newaxis] / step
    mean = (values[k + 1] - values[k]) / step
    square = 3.0 * mean - 2.0 * slopes[k] - slopes[k + 1]
    cube = slopes[k] + slopes[k + 1] - 2.0 * mean
    curve = values[k] + step * part * (slopes[k] + part * (square + part * cube))
    return curve, slopes[k] + part * (2.0 * square + 3.0 * part * cube)


def hold(series: Series, stamps: Stamps) -> Array:
    """Return the newest value at or before each stamp, NaN if it is older than a gap, (m, k).

    A disturbance may jump, so nothing is assumed between its samples.
    """
    if np.array_equal(series.stamps, stamps):
        return series.values
    result = np.full((len(stamps), series.values.shape[1]), np.nan)
    places = np.searchsorted(series.stamps, stamps, side="right") - 1
    recent = places >= 0
    recent[recent] = stamps[recent] - series.stamps[places[recent]] <= MAX_GAP * NANOSECONDS
    result[recent] = series.values[places[recent]]
    return result
