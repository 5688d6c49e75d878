# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One recorded run of the observer as stamped series of numbers, read from a bag."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import Wanted, read_joint_series
from tsobs_ros.bag.joint_states import JOINT_STATE
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.checks import Array
from tsobs_ros.errors import BagReadError
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.source import passes

Stamps = NDArray[np.int64]
"""Integer nanoseconds, shape (n,)."""

LARGEST_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""


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
    """What was measured, estimated and, in a simulation, true.

    Attributes:
        name: Where it comes from, for titles.
        joint: The joint's name.
        measurements: In order of arrival: [y (rad), u (N m)] at the sampling stamps, (n, 2).
        stamps: Of the estimates [ns], ascending, shape (m,).
        states: Estimated [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (m, 4).
        state_bounds: Published 1σ bound of each, NaN where lost, shape (m, 4).
        disturbance: Estimated sensor disturbance [rad], NaN where lost, shape (m,).
        disturbance_bounds: Published 1σ bound of it [rad], NaN where lost, shape (m,).
        innovations: y − ŷ [rad] at the measurements' stamps, values (n', 1); None if not recorded.
        truth: True [q₁, q̇₁, q₂, q̇₂] at the sampling stamps, values (k, 4); None on a robot.
        true_disturbance: [rad] at the sampling stamps, values (k', 1); None on a robot.
        passes: How often the recorded time restarted, plus one; this is the longest pass.
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
        """Truth at the estimates' stamps, NaN where unknown, shape (m, 4); see `series`."""
        return None if self.truth is None else interpolate_motion(self.truth, self.stamps)

    @cached_property
    def true_disturbance_held(self) -> Array | None:
        """True disturbance at the estimates' stamps, NaN where unknown [rad], shape (m,)."""
        if self.true_disturbance is None:
            return None
        return hold(self.true_disturbance, self.stamps)[:, 0]


class _Topic(NamedTuple):
    """A topic to read: for each name in a message, these fields, in this order."""

    suffix: str
    names: tuple[str, ...]
    fields: tuple[str, ...]
    required: bool


class _Stream(NamedTuple):
    """The messages of one topic in order of recording."""

    log_times: Stamps
    series: Series


def read_run(
    bag: Path,
    joint: str = "elastic_joint",
    *,
    namespace: str | None = None,
    observer: str = "observer",
) -> RecordedRun:
    """Read a run from a bag.

    The topics are found by how their names end, so that any namespace will do. Where the recorded
    time restarts, as in a looped bag, the pass with the longest estimates is read.

    Args:
        bag: Bag folder or MCAP file.
        joint: Name of the joint in `joint_measurements`.
        namespace: Namespace of all topics, for a bag with several arms.
        observer: Name of the observer node.

    Raises:
        BagReadError: The bag cannot be read, lacks a topic that is needed or messages of the
            joint on it, or has several topics that could be meant.
    """
    reader = BagReader(bag)
    wanted = _topics(joint, observer)
    names = {key: _find(reader, topic.suffix, namespace) for key, topic in wanted.items()}
    missing = [wanted[key].suffix for key in wanted if wanted[key].required and names[key] is None]
    if missing:
        has = ", ".join(reader.topics) or "none"
        raise BagReadError(f"{bag}: no topic ends in {', '.join(missing)}; topics: {has}")
    streams = _read(reader, {name: wanted[key] for key, name in names.items() if name is not None})
    found = {key: streams[name] for key, name in names.items() if name is not None}
    empty = [names[key] for key in found if wanted[key].required and not len(found[key].log_times)]
    if empty:
        raise BagReadError(
            f"{bag}: no message about joint '{joint}' on {', '.join(map(str, empty))}"
        )
    chosen, passes = _longest_pass(found)
    return _assemble(bag, joint, chosen, passes)


def _topics(joint: str, observer: str) -> dict[str, _Topic]:
    arm, angle_rate = topics.sides(joint), ("position", "velocity")
    own = (joint,)
    return {
        "measurements": _Topic("joint_measurements", own, ("position", "effort"), True),
        "states": _Topic(f"{observer}/{topics.STATES}", arm, angle_rate, True),
        "bounds": _Topic(f"{observer}/{topics.STATE_BOUNDS}", arm, angle_rate, True),
        "disturbance": _Topic(f"{observer}/{topics.DISTURBANCE}", own, ("position",), True),
        "disturbance_bound": _Topic(
            f"{observer}/{topics.DISTURBANCE_BOUND}", own, ("position",), True
        ),
        "innovations": _Topic(f"{observer}/{topics.INNOVATION}", own, ("position",), False),
        "truth": _Topic("ground_truth/joint_states", arm, angle_rate, False),
        "true_disturbance": _Topic("ground_truth/disturbance", own, ("position",), False),
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


def _read(reader: BagReader, topics: dict[str, _Topic]) -> dict[str, _Stream]:
    wanted = {name: Wanted(topic.names, topic.fields) for name, topic in topics.items()}
    streams = {}
    for name, series in read_joint_series(reader, wanted).items():
        topic = topics[name]
        named = series.named.all(axis=1)
        values = series.values.reshape(series.count, len(topic.names) * len(topic.fields))
        streams[name] = _Stream(
            series.log_times[named], Series(series.stamps[named], values[named])
        )
    return streams


def _longest_pass(streams: dict[str, _Stream]) -> tuple[dict[str, Series], int]:
    """Return of every stream the pass in which the estimates last longest, and their number."""
    estimates = _passes(streams["states"])
    longest = max(estimates, key=lambda one: int(np.ptp(one.series.stamps)))
    begin = longest.log_times[0]

    def matching(stream: _Stream) -> Series:
        # Each topic restarts at its own moment, but all of them at about the same.
        return min(_passes(stream), key=lambda one: abs(int(one.log_times[0] - begin))).series

    chosen = {key: matching(stream) for key, stream in streams.items() if len(stream.log_times)}
    return chosen, len(estimates)


def _passes(stream: _Stream) -> list[_Stream]:
    stamps, values = stream.series
    return [
        _Stream(stream.log_times[a:b], Series(stamps[a:b], values[a:b]))
        for a, b in passes(stamps.tolist())
    ]


def _assemble(bag: Path, joint: str, chosen: dict[str, Series], passes: int) -> RecordedRun:
    states = chosen["states"].ordered()
    truth, fault = chosen.get("truth"), chosen.get("true_disturbance")
    innovations = chosen.get("innovations")
    return RecordedRun(
        name="/".join(Path(bag).absolute().parts[-2:]),
        joint=joint,
        measurements=chosen["measurements"],
        stamps=states.stamps,
        states=states.values,
        state_bounds=align(chosen["bounds"], states.stamps),
        disturbance=align(chosen["disturbance"], states.stamps)[:, 0],
        disturbance_bounds=align(chosen["disturbance_bound"], states.stamps)[:, 0],
        innovations=None if innovations is None else innovations.ordered(),
        truth=None if truth is None else truth.ordered(),
        true_disturbance=None if fault is None else fault.ordered(),
        passes=passes,
    )


def align(series: Series, stamps: Stamps) -> Array:
    """Return the values that have exactly these stamps, NaN where there is none, (m, k)."""
    source = series.ordered()
    result = np.full((len(stamps), source.values.shape[1]), np.nan)
    if len(source.stamps):
        places = np.searchsorted(source.stamps, stamps).clip(max=len(source.stamps) - 1)
        found = source.stamps[places] == stamps
        result[found] = source.values[places[found]]
    return result


def interpolate_motion(series: Series, stamps: Stamps, largest_gap: float = LARGEST_GAP) -> Array:
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
        largest_gap: Distance of neighbouring samples that still counts as sampled [s].

    Returns:
        The motion, shape (m, 4).
    """
    result = np.full((len(stamps), 4), np.nan)
    if len(series.stamps) < 2:
        return result
    inside = _between_close_samples(series.stamps, stamps, largest_gap)
    origin = int(series.stamps[0])
    times, wanted = series.seconds(origin), (stamps[inside] - origin) / NANOSECONDS
    spline = CubicHermiteSpline(times, series.values[:, 0::2], series.values[:, 1::2], axis=0)
    result[inside, 0::2] = spline(wanted)
    result[inside, 1::2] = spline(wanted, 1)
    return result


def hold(series: Series, stamps: Stamps, largest_gap: float = LARGEST_GAP) -> Array:
    """Return the newest value at or before each stamp, NaN if it is older than the gap, (m, k).

    A disturbance may jump, so nothing is assumed between its samples; of one that moves at a
    rate r this is late by at most one period h, an error of at most r h.
    """
    result = np.full((len(stamps), series.values.shape[1]), np.nan)
    places = np.searchsorted(series.stamps, stamps, side="right") - 1
    recent = places >= 0
    age = stamps[recent] - series.stamps[places[recent]]
    recent[recent] = age <= largest_gap * NANOSECONDS
    result[recent] = series.values[places[recent]]
    return result


def _between_close_samples(known: Stamps, stamps: Stamps, largest_gap: float) -> NDArray[np.bool_]:
    inside = (stamps >= known[0]) & (stamps <= known[-1])
    right = np.searchsorted(known, stamps, side="right").clip(1, len(known) - 1)
    close = known[right] - known[right - 1] <= largest_gap * NANOSECONDS
    return np.asarray(inside & close)
