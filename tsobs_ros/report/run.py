# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One recorded run of the observer as stamped series of numbers, read from a bag."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import JointSeries, Wanted, read_blocks
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.checks import Array
from tsobs_ros.errors import BagReadError
from tsobs_ros.estimation.records import NANOSECONDS
from tsobs_ros.replay.designs import RecordedObserver, recorded_observer
from tsobs_ros.replay.source import RESTART_MESSAGES, restarts

Stamps = NDArray[np.int64]
"""Integer nanoseconds, shape (n,)."""

MAX_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""


_FIRST_MESSAGES = 1000
_TRUTH = ("truth", "true_disturbance")
_OPTIONAL = ("innovations", *_TRUTH, "health")
_WIDTHS = {
    **dict.fromkeys(("states", "bounds", "truth"), 4),
    **dict.fromkeys(("disturbance", "disturbance_bound", "innovations", "true_disturbance"), 1),
    "measurements": 2,
    "health": len(topics.CONDITIONS),
}
BLOCK = 2**14
"""Number of messages that are read at once, of all topics: some 10 s at 200 Hz."""
# Messages may be recorded this late [ns], and truth before a part still serves it.
_LATENESS, _BEFORE = 2 * NANOSECONDS, NANOSECONDS


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

    def take(self, chosen: NDArray[np.bool_] | slice) -> "Series":
        """Return some of the values."""
        return Series(self.stamps[chosen], self.values[chosen])

    def followed_by(self, other: "Series") -> "Series":
        """Return these values and others behind them."""
        return Series(*(np.concatenate(both) for both in zip(self, other, strict=True)))

    def seconds(self, origin: int) -> Array:
        """Return the stamps as seconds since `origin` [ns], shape (n,)."""
        return np.asarray((self.stamps - origin) / NANOSECONDS, dtype=np.float64)


def _no_series(width: int) -> Series:
    return Series(np.zeros(0, np.int64), np.zeros((0, width)))


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
        begin: Origin of the times [ns]; None if it is in these data.
        since: Begin of this part of a run [ns], truth may begin earlier; None for the first.
        until: End of this part of a run [ns], truth may go on; None for the last.
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
    begin: int | None = None
    since: int | None = None
    until: int | None = None

    def covers(self, stamps: Stamps) -> NDArray[np.bool_]:
        """Return whether stamps are of this part and of no other, shape (n,)."""
        there = np.ones(len(stamps), np.bool_)
        if self.since is not None:
            there &= stamps >= self.since
        if self.until is not None:
            there &= stamps < self.until
        return there

    @cached_property
    def origin(self) -> int:
        """Stamp that times count from: the first measurement's, or estimate's if earlier [ns]."""
        if self.begin is not None:
            return self.begin
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
    """Read a run from a bag at once; see `find_run`."""
    (run,) = find_run(bag, joint, namespace=namespace, observer=observer, size=None)
    return run


def find_run(
    bag: Path,
    joint: str | None = None,
    *,
    namespace: str | None = None,
    observer: str = "observer",
    size: int | None = BLOCK,
) -> "RunParts":
    """Find a run in a bag.

    The topics are found by how their names end, so that any namespace will do. If the recorded
    time restarts, as in a looped bag, the pass with the longest estimates is read.

    Args:
        bag: Bag folder or MCAP file.
        joint: Name of the joint; None if there are estimates of one only.
        namespace: Namespace of all topics, for a bag with several arms.
        observer: Name of the observer node.
        size: Number of messages in a part, divisible by 4; None for one part.

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
    there = {name: (key, wanted[key][1]) for key, name in names.items() if name is not None}
    streams = _survey(reader, there)
    if empty := [str(name) for key, name in required.items() if not streams[key]]:
        raise BagReadError(f"{bag}: no message about joint '{joint}' on {', '.join(empty)}")
    states = max(streams["states"], key=lambda one: one.last - one.first)
    # Each topic restarts at its own moment, but all of them at about the same.
    chosen = {
        key: min(spans, key=lambda one: abs(one.log_time - states.log_time))
        for key, spans in streams.items()
        if spans
    }
    return RunParts(
        reader,
        {name: one for name, one in there.items() if one[0] in chosen},
        chosen,
        RecordedRun(
            name="/".join(Path(bag).absolute().parts[-2:]),
            joint=str(joint),
            measurements=_no_series(2),
            stamps=_no_series(0).stamps,
            states=_no_series(4).values,
            state_bounds=_no_series(4).values,
            disturbance=np.zeros(0),
            disturbance_bounds=np.zeros(0),
            topic=str(names["measurements"]),
            joints=joints,
            ran=ran,
            passes=len(streams["states"]),
            begin=min([states.first, *chosen["measurements"].first_stamped]),
        ),
        size,
    )


class _Span(NamedTuple):
    """A pass over the stamps of a topic.

    Attributes:
        begin: Place of its first message among those about the joint.
        end: Place after its last message.
        log_time: Of its first message [ns].
        first: Smallest stamp [ns].
        last: Largest stamp [ns].
        first_stamped: Smallest stamp above zero, none or one.
    """

    begin: int
    end: int
    log_time: int
    first: int
    last: int
    first_stamped: tuple[int, ...]


class _PassFinder:
    """Finds the passes over a topic's stamps, block by block."""

    def __init__(self) -> None:
        self.spans: list[_Span] = []
        self._waiting = np.zeros((2, 0), np.int64)
        self._count, self._highest = 0, 0

    def add(self, log_times: Stamps, stamps: Stamps, *, is_last: bool) -> None:
        """Add messages; whether time restarts at one shows in the next ones."""
        log_times, stamps = np.concatenate([self._waiting, [log_times, stamps]], axis=1)
        known = len(stamps) if is_last else max(0, len(stamps) - RESTART_MESSAGES)
        edges = [edge for edge in restarts(stamps, self._highest) if edge < known]
        for number, (begin, end) in enumerate(pairwise([0, *edges, known])):
            if begin == end:
                continue
            own = stamps[begin:end]
            span = _Span(
                self._count + begin,
                self._count + end,
                int(log_times[begin]),
                int(own.min()),
                int(own.max()),
                tuple(own[own > 0][:1].tolist() and [int(own[own > 0].min())]),
            )
            self._highest = max(span.last, 0 if number else self._highest)
            if number or not self.spans:
                self.spans.append(span)
                continue
            last = self.spans[-1]
            self.spans[-1] = last._replace(
                end=span.end,
                first=min(last.first, span.first),
                last=max(last.last, span.last),
                first_stamped=tuple(sorted(last.first_stamped + span.first_stamped)[:1]),
            )
        self._count += known
        self._waiting = np.stack([log_times[known:], stamps[known:]])


def _survey(reader: BagReader, there: Mapping[str, tuple[str, Wanted]]) -> dict[str, list[_Span]]:
    finders = {key: _PassFinder() for key, _ in there.values()}
    for block, is_last in _blocks(reader, there, BLOCK):
        for key, series in block.items():
            named = series.named.all(axis=1)
            stamps, log_times = series.stamps[named], series.log_times[named]
            finders[key].add(log_times, stamps, is_last=is_last)
    return {key: finder.spans for key, finder in finders.items()}


def _blocks(
    reader: BagReader, there: Mapping[str, tuple[str, Wanted]], size: int | None
) -> Iterator[tuple[dict[str, JointSeries], bool]]:
    """Yield the topics of a run block by block, and whether it is the last one."""
    wanted = {name: own for name, (_, own) in there.items()}
    for block in read_blocks(reader, wanted, size):
        found = {there[name][0]: series for name, series in block.series.items()}
        if "health" in found:
            found["health"] = _as_named(found["health"])
        yield found, block.horizon == math.inf


class RunParts:
    """A recorded run in parts of bounded size, read from the bag each time that they are needed.

    Args:
        reader: The bag.
        there: What to read of which topic, and the name of a run's part that it is.
        spans: The pass to read of each.
        run: What all parts have in common.
        size: Number of messages in a part; None for one part.

    Attributes:
        run: The same.
        has_truth: Whether there is any.
    """

    def __init__(
        self,
        reader: BagReader,
        there: Mapping[str, tuple[str, Wanted]],
        spans: Mapping[str, _Span],
        run: RecordedRun,
        size: int | None,
    ) -> None:
        self.run, self._size = run, size
        self._reader, self._there, self._spans = reader, there, spans
        self.has_truth = "truth" in spans

    def __iter__(self) -> Iterator[RecordedRun]:
        count = dict.fromkeys(self._spans, 0)
        waiting = {key: _no_series(_WIDTHS[key]) for key in self._spans}
        since: int | None = None
        for block, is_last in _blocks(self._reader, self._there, self._size):
            for key, series in block.items():
                span, named = self._spans[key], series.named.all(axis=1)
                places = count[key] + np.arange(int(named.sum()))
                count[key] += len(places)
                own = (span.begin <= places) & (places < span.end)
                stamps = series.stamps[named][own]
                values = series.values[named][own].reshape(len(stamps), _WIDTHS[key])
                waiting[key] = waiting[key].followed_by(Series(stamps, values))
            latest = waiting["states"].stamps.max(initial=0)
            until = None if is_last else int(latest) - _LATENESS
            part = self._part(waiting, since, until)
            if len(part.stamps) or is_last:
                yield part
                since = until
                waiting = {
                    key: one.take(one.stamps >= (until or 0) - (_BEFORE if key in _TRUTH else 0))
                    if key != "measurements"
                    else one.take(slice(0))
                    for key, one in waiting.items()
                }

    def _part(
        self, waiting: Mapping[str, Series], since: int | None, until: int | None
    ) -> RecordedRun:
        run = replace(self.run, since=since, until=until)
        known = {
            key: one if key in (*_TRUTH, "measurements") else one.take(run.covers(one.stamps))
            for key, one in waiting.items()
        }
        states = known["states"].ordered()
        optional: dict[str, Any] = {key: known[key].ordered() for key in _OPTIONAL if key in known}
        return replace(
            run,
            measurements=known["measurements"],
            stamps=states.stamps,
            states=states.values,
            state_bounds=align(known["bounds"], states.stamps),
            disturbance=align(known["disturbance"], states.stamps)[:, 0],
            disturbance_bounds=align(known["disturbance_bound"], states.stamps)[:, 0],
            **optional,
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
