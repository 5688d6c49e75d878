# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One recorded run of the observer as stamped series of numbers, read from a bag."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.diagnostics import DIAGNOSTICS, RecordedStatus, read_statuses
from tsobs_ros.bag.joint_series import Wanted, read_blocks
from tsobs_ros.bag.joint_states import JOINT_STATE, joint_names
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.design.signals import Signals, signals
from tsobs_ros.errors import BagReadError
from tsobs_ros.replay.designs import RecordedObserver, recorded_observer
from tsobs_ros.replay.health import as_of_now
from tsobs_ros.replay.places import places_of
from tsobs_ros.replay.source import MEASUREMENTS, UNNAMED_SYSTEM, passes
from tsobs_ros.report.quantities import QUANTITIES, Quantity, measured_states, quantities_of
from tsobs_ros.series import NANOSECONDS, Series, Stamps

MAX_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""

BLOCK = 2**17
"""Number of messages that are read at once, of all topics: some 80 s at 200 Hz."""

_FIRST_MESSAGES = 1000
_OWN = {
    "states": topics.STATES,
    "state_bounds": topics.STATE_BOUNDS,
    "disturbance": topics.DISTURBANCE,
    "disturbance_bounds": topics.DISTURBANCE_BOUND,
    "torque": topics.TORQUE_DISTURBANCE,
    "torque_bounds": topics.TORQUE_DISTURBANCE_BOUND,
    "innovations": topics.INNOVATION,
    "health": topics.HEALTH,
    "parameters": topics.PARAMETERS,
    "parameter_bounds": topics.PARAMETER_BOUNDS,
}
"""The observer's topics by the parts of a run."""
_TRUTH = {
    "truth": topics.TRUE_STATES,
    "true_disturbance": topics.TRUE_DISTURBANCE,
    "true_torque": topics.TRUE_TORQUE,
}
_REQUIRED = ("measurements", "states", "state_bounds", "disturbance", "disturbance_bounds")
_ALIGNED = (*_REQUIRED[1:], "torque", "torque_bounds")
# Numbers of a joint that is alone, and those of one among several, are in entries of other names.
_TWICE = ("health", "parameters", "parameter_bounds")


class Rows:
    """Rows of numbers that grow in a temporary file, so that long recordings need little memory.

    Args:
        width: Number of values of a row, which come with a stamp and a log time.
    """

    def __init__(self, width: int) -> None:
        times = [("stamps", np.int64), ("log_times", np.int64)]
        self._type = np.dtype([*times, ("values", np.float64, (width,))])
        self._file = TemporaryFile()  # noqa: SIM115
        finalize(self, self._file.close)

    def add(self, stamps: Stamps, log_times: Stamps, values: Array) -> None:
        """Add rows: times [ns] of shape (n,), values of shape (n, width)."""
        rows = np.empty(len(stamps), self._type)
        rows["stamps"], rows["log_times"], rows["values"] = stamps, log_times, values
        self._file.write(rows.tobytes())

    def read(self) -> NDArray[Any]:
        """Return all rows, a structured array of these fields that is paged in as it is used."""
        self._file.flush()
        if not self._file.tell():
            return np.zeros(0, self._type)
        return np.memmap(self._file, self._type, "r")

    def passes(self) -> list[NDArray[Any]]:
        """Return the passes over the recorded time, of which a looped bag has several."""
        rows = self.read()
        return [rows[begin:end] for begin, end in passes(rows["stamps"]) if begin < end]


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
        states: Estimated, of an arm [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (m, plant).
        state_bounds: Published 1σ bound of each, NaN if lost, shape (m, plant).
        disturbance: Estimated disturbance of each output, NaN if lost, shape (m, p).
        disturbance_bounds: Published 1σ bound of each, NaN if lost, shape (m, p).
        torque: Estimated torque disturbances [N m], NaN if lost, shape (m, t).
        torque_bounds: Published 1σ bound of each [N m], NaN if lost, shape (m, t).
        innovations: y − ŷ at the measurements' stamps, NaN of outputs that were not used, values
            (n', p); None if not recorded.
        truth: True states at the sampling stamps, values (k, plant); None on a robot.
        true_disturbance: Of the outputs at the sampling stamps, values (k', p); None on a robot.
        true_torque: Torque disturbances at the sampling stamps [N m], values (k'', t); None on a
            robot.
        health: Fields of `estimation.records.HEALTH` at their stamps, values (h, 7); None if
            not recorded.
        parameters: Learnt changes of the uncertain parameters, values (l, c); None if not recorded.
        parameter_bounds: 1σ of each, values (l, c); None if not recorded.
        topic: Name of the measurements' topic.
        passes: Number of passes over the recorded time; this is the longest one.
        quantities: What the estimates are of.
        measured: The place of the output that measures a state, by the state's key.
    """

    name: str
    joint: str
    measurements: Series
    stamps: Stamps
    states: Array
    state_bounds: Array
    disturbance: Array
    disturbance_bounds: Array
    torque: Array = field(default_factory=lambda: np.zeros((0, 0)))
    torque_bounds: Array = field(default_factory=lambda: np.zeros((0, 0)))
    innovations: Series | None = None
    truth: Series | None = None
    true_disturbance: Series | None = None
    true_torque: Series | None = None
    health: Series | None = None
    parameters: Series | None = None
    parameter_bounds: Series | None = None
    topic: str = "joint_measurements"
    passes: int = 1
    quantities: tuple[Quantity, ...] = QUANTITIES
    measured: Mapping[str, int] = field(default_factory=lambda: {"link_angle": 0})

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
                ("state", self.truth, partial(interpolate, rated=rated)),
                ("disturbance", self.true_disturbance, hold),
                ("torque", self.true_torque, hold),
            )
        }

    def of(self, quantity: Quantity) -> Estimated:
        """Return what is known of a quantity."""
        values, bounds, series = {
            "state": (self.states, self.state_bounds, self.truth),
            "disturbance": (self.disturbance, self.disturbance_bounds, self.true_disturbance),
            "torque": (self.torque, self.torque_bounds, self.true_torque),
        }[quantity.kind]
        truth, column = self._true_values[quantity.kind], quantity.column
        return Estimated(
            values[:, column],
            bounds[:, column],
            None if series is None else series.column(column),
            None if truth is None else truth[:, column],
        )


def find_observer(
    bag: Path, *, namespace: str | None = None, observer: str = "observer"
) -> "FoundObserver":
    """Find a recorded observer in a bag, by how the names of its topics end.

    Args:
        bag: Bag folder or MCAP file.
        namespace: Namespace of all topics, for a bag with several arms.
        observer: Name of the observer node.

    Raises:
        BagReadError: The bag cannot be read, or has several topics that could be meant.
    """
    reader = BagReader(bag)
    own = {key: f"{observer}/{topic}" for key, topic in _OWN.items()}
    ends = {"measurements": MEASUREMENTS, **own, **_TRUTH}
    names = {key: _find(reader, end, namespace) for key, end in ends.items()}
    ran, entries = RecordedObserver(), tuple[str, ...]()
    if names["states"] is not None:
        ran = recorded_observer(reader, names["states"].removesuffix(f"/{topics.STATES}"))
        info = reader.topics.get(ran.measurements or "")
        if names["measurements"] is None and info is not None and info.type == JOINT_STATE:
            names["measurements"] = info.name
        messages = islice(reader.messages([names["states"]]), _FIRST_MESSAGES)
        entries = joint_names(message.data for message in messages)
    return FoundObserver(reader, ends, names, ran, entries)


@dataclass(frozen=True)
class FoundObserver:
    """A recorded observer.

    Attributes:
        reader: The bag.
        ends: Ends of the names of its topics, by what they are of.
        names: Their names; None for one that the bag does not have.
        ran: What it ran, as far as the bag has it.
        entries: Names in its first estimates.
    """

    reader: BagReader
    ends: Mapping[str, str]
    names: dict[str, str | None]
    ran: RecordedObserver
    entries: tuple[str, ...]

    @property
    def _named(self) -> set[str]:
        return {one.partition("/")[0] for one in self.entries if "/" in one}

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """All that there are estimates of."""
        links = [one.removesuffix("_link") for one in self.entries if one.endswith("_link")]
        arms = [joint for joint in links if topics.sides(joint)[1] in self.entries]
        alone = len(self.ran.designs) == 1 and bool(self.entries)
        systems = [one for one in self.ran.designs if one in self._named or alone]
        found = tuple(dict.fromkeys([*arms, *systems]))
        return (UNNAMED_SYSTEM,) if self.entries and not found else found

    def choose(self, joint: str | None) -> str:
        """Return the joint of a name, the only one if it is None.

        Raises:
            BagReadError: There are no estimates of such a joint, or of several.
        """
        path = self.reader.path
        self._require(["states"])
        if not self.entries:
            made = self.reader.topics.get(self.names["measurements"] or "")
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
        wanted = _wanted(joint, own, request.uncertainty_model.names)
        found = {key: rows.passes() for key, rows in self._rows(wanted).items()}
        if empty := [str(self.names[key]) for key in _REQUIRED if not found[key]]:
            raise BagReadError(
                f"{self.reader.path}: no message about joint '{joint}' on {', '.join(empty)}"
            )
        parts = [part for part in Path(self.reader.path).absolute().parts if part != "bag"]
        name = f"{joint}, {parts[-1]}" if len(parts) > 1 else joint
        return run_of(found, name, joint, request, str(self.names["measurements"]))

    def _rows(self, wanted: Mapping[str, Wanted]) -> dict[str, Rows]:
        """Read what is there of a joint."""
        there = {name: (key, wanted[key]) for key, name in self.names.items()
                 if name is not None and any(wanted[key])}  # fmt: skip
        found = {
            key: Rows(sum(map(len, groups[: 1 if key in _TWICE else None])))
            for key, groups in there.values()
        }
        blocks = read_blocks(self.reader, {name: own for name, (_, own) in there.items()}, BLOCK)
        for block in blocks:
            for name, (key, groups) in there.items():
                one = block.series[name]
                parts = [one.values[:, place, : len(own)] for place, own in enumerate(groups)]
                there_is = one.named[:, 0]
                if key in _TWICE:
                    several = one.named[:, 1]
                    parts = [np.where(several[:, np.newaxis], parts[1], parts[0])]
                    there_is = there_is | several
                values = np.hstack(parts)[there_is]
                found[key].add(one.stamps[there_is], one.log_times[there_is], values)
        return found

    def statuses(self, joint: str) -> Iterator[RecordedStatus]:
        """Yield the recorded statuses of the observer that are of a joint, or of all joints."""
        topic = self.reader.topics.get("/diagnostics")
        node = str(self.names["states"]).removesuffix(f"/{topics.STATES}").strip("/")
        if topic is None or topic.type != DIAGNOSTICS:
            return
        mark = f"{node}: ".encode()
        for message in self.reader.messages([topic.name]):
            for status in read_statuses(message.data) if mark in message.data else ():
                of_all = status.name[-1] == "timing" or len(self.joints) == 1
                if status.name[0] == node and (of_all or status.hardware == joint):
                    yield status

    def _require(self, keys: Sequence[str]) -> None:
        if missing := [self.ends[key] for key in keys if self.names[key] is None]:
            has = ", ".join(self.reader.topics) or "none"
            raise BagReadError(
                f"{self.reader.path}: no topic ends in {', '.join(missing)}; topics: {has}"
            )


def run_of(
    found: Mapping[str, Sequence[NDArray[Any]]],
    name: str,
    joint: str,
    request: ArmRequest | TSRequest,
    topic: str = "",
) -> RecordedRun:
    """Return the run with the longest pass of estimates, and what is nearest to it.

    Args:
        found: Passes of `Rows` by the parts of a run; there are some of its states.
        name: Its origin.
        joint: The joint.
        request: Of its design.
        topic: Name of the measurements' topic.
    """
    longest = max(found["states"], key=lambda one: float(np.ptp(one["stamps"])))
    log_time = int(longest["log_times"][0])
    series: dict[str, Any] = {}
    for key, all_of_it in found.items():
        # Each topic restarts at its own moment, but all of them at about the same.
        for one in sorted(all_of_it, key=lambda one: abs(int(one["log_times"][0]) - log_time))[:1]:
            series[key] = Series(one["stamps"], one["values"])
    stamps, states, _ = series.pop("states").ordered()
    quantities, measurements = quantities_of(request), series.pop("measurements")
    nothing = np.full((len(stamps), sum(one.kind == "torque" for one in quantities)), np.nan)
    parts: dict[str, Any] = {
        key: align(series.pop(key), stamps) if key in series else nothing for key in _ALIGNED[1:]
    }
    if "health" in series:
        series["health"] = series["health"]._replace(values=as_of_now(series["health"].values))
    return RecordedRun(
        name=name,
        joint=joint,
        measurements=measurements,
        stamps=stamps,
        states=states,
        topic=topic,
        passes=len(found["states"]),
        quantities=quantities,
        measured=measured_states(request),
        **parts,
        **{key: one.ordered() for key, one in series.items()},
    )


def _wanted(joint: str, own: Signals, learnt: tuple[str, ...]) -> dict[str, Wanted]:
    """Return for each part of a run what to read of its topic."""
    alone, named = (
        places_of(joint, own, alone=alone, learnt=learnt, rated=False) for alone in (True, False)
    )
    return {
        "measurements": [own.outputs, own.inputs],
        **{
            key: [alone[topic], named[topic]] if key in _TWICE else [alone[topic]]
            for key, topic in (_OWN | _TRUTH).items()
        },
    }


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


def interpolate(
    series: Series, stamps: Stamps, max_gap: float = MAX_GAP, *, rated: bool = False
) -> Array:
    """Return values between their samples, NaN outside of them and in gaps.

    They follow the cubic that has the values and slopes of both neighbours. If slopes are sampled,
    then of a smooth motion an angle is off by at most h⁴/384 max|q⁗| and a velocity by at most
    √3 h³/216 max|q⁗|: 10⁻⁹ rad and 10⁻⁶ rad/s for the elastic-joint arm at h = 5 ms. A white
    acceleration of density s makes the truth between samples random; the cubic is then its
    conditional mean, with a 1σ of √(s h)/4 in velocity half way: 2·10⁻⁴ rad/s at
    s = 10⁻⁴ rad²/s³, a hundredth of the estimation error.

    Args:
        series: Samples in ascending order, values of shape (n, k).
        stamps: Where to evaluate [ns], shape (m,).
        max_gap: Distance of neighbouring samples that still counts as sampled [s].
        rated: Whether each value is followed by its rate, as in [q₁, q̇₁, q₂, q̇₂]; else slopes are
            those to the next samples.

    Returns:
        The values, shape (m, k).
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
        inside &= known.stamps[right] - known.stamps[right - 1] <= max_gap * NANOSECONDS
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


def hold(series: Series, stamps: Stamps, max_gap: float = MAX_GAP) -> Array:
    """Return the newest value at or before each stamp, NaN if it is older than the gap, (m, k).

    A disturbance may jump, so nothing is assumed between its samples; of one that moves at a
    rate r this is late by at most one period h, an error of at most r h.
    """
    if np.array_equal(series.stamps, stamps):
        return series.values
    result = np.full((len(stamps), series.values.shape[1]), np.nan)
    places = np.searchsorted(series.stamps, stamps, side="right") - 1
    recent = places >= 0
    age = stamps[recent] - series.stamps[places[recent]]
    recent[recent] = age <= max_gap * NANOSECONDS
    result[recent] = series.values[places[recent]]
    return result
