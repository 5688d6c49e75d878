# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One recorded run of the observer as stamped series of numbers, read from a bag."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import JointSeries, Wanted, read_joint_series
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.checks import Array
from tsobs_ros.errors import BagReadError
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.designs import RecordedObserver, recorded_observer
from tsobs_ros.replay.source import passes

Stamps = NDArray[np.int64]
"""Integer nanoseconds, shape (n,)."""

MAX_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""


_FIRST_MESSAGES = 1000
_OPTIONAL = ("innovations", "truth", "true_disturbance", "health")


class Series(NamedTuple):
    """Values with their stamps.

    Attributes:
        stamps: [ns], shape (n,).
        values: Shape (n, k).
    """

    stamps: Stamps
    values: Array

    def ordered(self) -> "Series":
        """Return the series by ascending stamp; of equal stamps the first that came is kept."""
        stamps, places = np.unique(self.stamps, return_index=True)
        return Series(stamps, self.values[places])

    def seconds(self, origin: int) -> Array:
        """Return the stamps as seconds since `origin` [ns], shape (n,)."""
        return np.asarray((self.stamps - origin) / NANOSECONDS, dtype=np.float64)


@dataclass(frozen=True)
class RecordedRun:
    """Measurements, estimates and, from a simulation, the truth.

    Attributes:
        name: Its origin, for titles.
        joint: The joint's name.
        measurements: In order of arrival: [y (rad), u (N m)] at the sampling stamps, (n, 2).
        stamps: Of the estimates [ns], ascending, shape (m,).
        states: Estimated [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (m, 4).
        state_bounds: Published 1σ bound of each, NaN if lost, shape (m, 4).
        disturbance: Estimated sensor disturbance [rad], NaN if lost, shape (m,).
        disturbance_bounds: Published 1σ bound of it [rad], NaN if lost, shape (m,).
        innovations: y − ŷ [rad] at the measurements' stamps, values (n', 1); None if not recorded.
        truth: True [q₁, q̇₁, q₂, q̇₂] at the sampling stamps, values (k, 4); None on a robot.
        true_disturbance: [rad] at the sampling stamps, values (k', 1); None on a robot.
        health: Numbers of `estimation.events.Condition` at their stamps, values (h, 6); None if
            not recorded.
        topic: Name of the measurements' topic.
        joints: All that there are estimates of.
        ran: What the observer ran, as far as the bag has it.
        passes: Number of passes over the recorded time; this is the longest one.
    """

    name: str
    joint: str
    measurements: Series
    stamps: Stamps
    states: Array
    state_bounds: Array
    disturbance: Array
    disturbance_bounds: Array
    innovations: Series | None = None
    truth: Series | None = None
    true_disturbance: Series | None = None
    health: Series | None = None
    topic: str = "joint_measurements"
    joints: tuple[str, ...] = ()
    ran: RecordedObserver = field(default_factory=RecordedObserver)
    passes: int = 1

    @cached_property
    def origin(self) -> int:
        """Stamp that times count from: the first measurement's, or estimate's if earlier [ns]."""
        first = int(self.stamps[0])
        stamped = self.measurements.stamps[self.measurements.stamps > 0]
        return min(first, int(stamped.min())) if len(stamped) else first

    @cached_property
    def times(self) -> Array:
        """Times of the estimates since the origin [s], shape (m,)."""
        return np.asarray((self.stamps - self.origin) / NANOSECONDS, dtype=np.float64)

    @cached_property
    def true_states(self) -> Array | None:
        """Truth at the estimates' stamps, NaN if unknown, shape (m, 4)."""
        return None if self.truth is None else interpolate_motion(self.truth, self.stamps)

    @cached_property
    def true_disturbance_held(self) -> Array | None:
        """True disturbance at the estimates' stamps, NaN if unknown [rad], shape (m,)."""
        if self.true_disturbance is None:
            return None
        return hold(self.true_disturbance, self.stamps)[:, 0]


def read_run(
    bag: Path,
    joint: str | None = None,
    *,
    namespace: str | None = None,
    observer: str = "observer",
) -> RecordedRun:
    """Read a run from a bag.

    The topics are found by how their names end, so that any namespace will do. If the recorded
    time restarts, as in a looped bag, the pass with the longest estimates is read.

    Args:
        bag: Bag folder or MCAP file.
        joint: Name of the joint; None if there are estimates of one only.
        namespace: Namespace of all topics, for a bag with several arms.
        observer: Name of the observer node.

    Raises:
        BagReadError: The bag cannot be read, lacks a topic that is needed or messages of the
            joint on it, or has several topics or joints that could be meant.
    """
    reader = BagReader(bag)
    suffixes = {key: suffix for key, (suffix, _) in _wanted("", observer).items()}
    names = {key: _find(reader, suffix, namespace) for key, suffix in suffixes.items()}
    ran, joints = RecordedObserver(), tuple[str, ...]()
    if names["states"] is not None:
        ran = recorded_observer(reader, names["states"].removesuffix(f"/{topics.STATES}"))
        names["measurements"] = names["measurements"] or _there(reader, ran.measurements)
        joints = _observed_joints(reader, names["states"])
        joint = _choose_joint(reader.path, joints, joint)
    wanted = _wanted(joint or "", observer)
    required = {key: names[key] for key in wanted if key not in _OPTIONAL}
    if missing := [wanted[key][0] for key, name in required.items() if name is None]:
        has = ", ".join(reader.topics) or "none"
        raise BagReadError(f"{bag}: no topic ends in {', '.join(missing)}; topics: {has}")
    there = {key: name for key, name in names.items() if name is not None}
    read = read_joint_series(reader, {name: wanted[key][1] for key, name in there.items()})
    if "health" in there:
        read[there["health"]] = _as_named(read[there["health"]])
    streams = {key: _passes(read[name]) for key, name in there.items()}
    if empty := [str(name) for key, name in required.items() if not streams[key]]:
        raise BagReadError(f"{bag}: no message about joint '{joint}' on {', '.join(empty)}")
    begin, states = max(streams["states"], key=lambda one: int(np.ptp(one[1].stamps)))
    # Each topic restarts at its own moment, but all of them at about the same.
    chosen = {
        key: min(spans, key=lambda one: abs(one[0] - begin))[1]
        for key, spans in streams.items()
        if spans
    }
    states = states.ordered()
    return RecordedRun(
        name="/".join(Path(bag).absolute().parts[-2:]),
        joint=str(joint),
        measurements=chosen["measurements"],
        stamps=states.stamps,
        states=states.values,
        state_bounds=align(chosen["bounds"], states.stamps),
        disturbance=align(chosen["disturbance"], states.stamps)[:, 0],
        disturbance_bounds=align(chosen["disturbance_bound"], states.stamps)[:, 0],
        topic=str(names["measurements"]),
        joints=joints,
        ran=ran,
        passes=len(streams["states"]),
        **{key: chosen[key].ordered() for key in _OPTIONAL if key in chosen},
    )


def _wanted(joint: str, observer: str) -> dict[str, tuple[str, Wanted]]:
    """Return for each part of a run the end of its topic's name, and what to read of it."""
    motion = Wanted(topics.sides(joint), ("position", "velocity"))
    angle = Wanted((joint,), ("position",))
    health = [*topics.CONDITIONS, *topics.parameter_names(joint, topics.CONDITIONS, alone=False)]
    return {
        "measurements": ("joint_measurements", Wanted((joint,), ("position", "effort"))),
        "states": (f"{observer}/{topics.STATES}", motion),
        "bounds": (f"{observer}/{topics.STATE_BOUNDS}", motion),
        "disturbance": (f"{observer}/{topics.DISTURBANCE}", angle),
        "disturbance_bound": (f"{observer}/{topics.DISTURBANCE_BOUND}", angle),
        "innovations": (f"{observer}/{topics.INNOVATION}", angle),
        "health": (f"{observer}/{topics.HEALTH}", Wanted(health, ("position",))),
        "truth": ("ground_truth/joint_states", motion),
        "true_disturbance": ("ground_truth/disturbance", angle),
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


def _there(reader: BagReader, name: str | None) -> str | None:
    info = reader.topics.get(name or "")
    return None if info is None or info.type != JOINT_STATE else info.name


def _observed_joints(reader: BagReader, topic: str) -> tuple[str, ...]:
    """Return the joints that the first estimates are of."""
    messages = islice(reader.messages([topic]), _FIRST_MESSAGES)
    groups, _ = JointStateDecoder().decode_all([message.data for message in messages])
    sides = dict.fromkeys(name for group in groups for name in group.names)
    return tuple(side.removesuffix("_link") for side in sides if side.endswith("_link"))


def _choose_joint(bag: Path, joints: tuple[str, ...], joint: str | None) -> str:
    if joint in joints or (joint is None and len(joints) == 1):
        return joint or joints[0]
    has = ", ".join(joints) or "none"
    if joint is None and joints:
        raise BagReadError(f"{bag}: estimates of several joints, choose one of: {has}")
    whom = "" if joint is None else f" of joint '{joint}'"
    raise BagReadError(f"{bag}: no estimate{whom}; joints: {has}")


def _as_named(health: JointSeries) -> JointSeries:
    """Return the numbers of a joint that is alone or, if there are such, of one among several."""
    begin = len(topics.CONDITIONS) if health.named[:, len(topics.CONDITIONS) :].any() else 0
    own = slice(begin, begin + len(topics.CONDITIONS))
    given = health.given[:, own]
    return replace(health, values=health.values[:, own], named=health.named[:, own], given=given)


def _passes(series: JointSeries) -> list[tuple[int, Series]]:
    """Return each pass over the stamps in order of recording, with its first log time [ns]."""
    named = series.named.all(axis=1)
    if not named.any():
        return []
    log_times, stamps = series.log_times[named], series.stamps[named]
    values = series.values[named].reshape(len(stamps), -1)
    return [
        (int(log_times[a]), Series(stamps[a:b], values[a:b])) for a, b in passes(stamps.tolist())
    ]


def align(series: Series, stamps: Stamps) -> Array:
    """Return the values that have exactly these stamps, NaN if there is none, (m, k)."""
    source = series.ordered()
    result = np.full((len(stamps), source.values.shape[1]), np.nan)
    if len(source.stamps):
        places = np.searchsorted(source.stamps, stamps).clip(max=len(source.stamps) - 1)
        found = source.stamps[places] == stamps
        result[found] = source.values[places[found]]
    return result


def interpolate_motion(series: Series, stamps: Stamps, max_gap: float = MAX_GAP) -> Array:
    """Return [q₁, q̇₁, q₂, q̇₂] between its samples, NaN outside of them and in gaps.

    Angles follow the cubic that has the angles and velocities of both neighbours, velocities
    its derivative. Of a smooth motion the angle is off by at most h⁴/384 max|q⁗| and the
    velocity by at most √3 h³/216 max|q⁗|: 10⁻⁹ rad and 10⁻⁶ rad/s for the elastic-joint arm at
    h = 5 ms. A white acceleration of density s makes the truth between samples random; the cubic
    is then its conditional mean, with a 1σ of √(s h)/4 in velocity half way: 2·10⁻⁴ rad/s at
    s = 10⁻⁴ rad²/s³, a hundredth of the estimation error.

    Args:
        series: Samples in ascending order, values of shape (n, 4).
        stamps: Where to evaluate [ns], shape (m,).
        max_gap: Distance of neighbouring samples that still counts as sampled [s].

    Returns:
        The motion, shape (m, 4).
    """
    result = np.full((len(stamps), 4), np.nan)
    if len(series.stamps) < 2:
        return result
    inside = _between_close_samples(series.stamps, stamps, max_gap)
    origin = int(series.stamps[0])
    times, wanted = series.seconds(origin), (stamps[inside] - origin) / NANOSECONDS
    spline = CubicHermiteSpline(times, series.values[:, 0::2], series.values[:, 1::2], axis=0)
    result[inside, 0::2] = spline(wanted)
    result[inside, 1::2] = spline(wanted, 1)
    return result


def hold(series: Series, stamps: Stamps, max_gap: float = MAX_GAP) -> Array:
    """Return the newest value at or before each stamp, NaN if it is older than the gap, (m, k).

    A disturbance may jump, so nothing is assumed between its samples; of one that moves at a
    rate r this is late by at most one period h, an error of at most r h.
    """
    result = np.full((len(stamps), series.values.shape[1]), np.nan)
    places = np.searchsorted(series.stamps, stamps, side="right") - 1
    recent = places >= 0
    age = stamps[recent] - series.stamps[places[recent]]
    recent[recent] = age <= max_gap * NANOSECONDS
    result[recent] = series.values[places[recent]]
    return result


def _between_close_samples(known: Stamps, stamps: Stamps, max_gap: float) -> NDArray[np.bool_]:
    inside = (stamps >= known[0]) & (stamps <= known[-1])
    right = np.searchsorted(known, stamps, side="right").clip(1, len(known) - 1)
    close = known[right] - known[right - 1] <= max_gap * NANOSECONDS
    return np.asarray(inside & close)
