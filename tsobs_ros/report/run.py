# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One recorded run of the observer as stamped series of numbers, read from a bag."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, islice, pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple, TypeAlias
from weakref import finalize

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.diagnostics import DIAGNOSTICS, RecordedStatus, read_statuses
from tsobs_ros.bag.joint_series import JointSeries, Wanted, read_blocks
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder
from tsobs_ros.bag.message_rows import read_rows
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.design.signals import Signals, signals
from tsobs_ros.errors import BagReadError
from tsobs_ros.replay.designs import RecordedObserver, choose_designs, recorded_observer
from tsobs_ros.replay.health import as_of_now
from tsobs_ros.replay.places import places_of
from tsobs_ros.replay.source import MEASUREMENTS, RESTART_MESSAGES, UNNAMED_SYSTEM, restarts
from tsobs_ros.report.quantities import QUANTITIES, Quantity, measured_states, quantities_of
from tsobs_ros.series import NANOSECONDS

Stamps = NDArray[np.int64]
"""Integer nanoseconds, shape (n,)."""

MAX_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""


_FIRST_MESSAGES = 1000
_TRUTH = ("truth", "true_disturbance", "true_torque")
_REQUIRED = ("measurements", "states", "bounds", "disturbance", "disturbance_bound")
_SERIES = (
    "innovations", *_TRUTH, "health", "parameters", "parameter_bounds", "delays", "estimate_delays",
)  # fmt: skip
# Numbers of a joint that is alone, and those of one among several, are in entries of other names.
_TWICE = ("health", "parameters", "parameter_bounds")
# Of which topics the time from the stamp to the recording is of interest.
_DELAYED = {"measurements": "delays", "states": "estimate_delays"}
_ALIGNED = {
    "bounds": "state_bounds",
    "disturbance": "disturbance",
    "disturbance_bound": "disturbance_bounds",
    "torque": "torque",
    "torque_bound": "torque_bounds",
}
BLOCK = 2**17
"""Number of messages that are read at once, of all topics: some 80 s at 200 Hz."""
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

    def column(self, place: int) -> "Series":
        """Return one of the values at each stamp."""
        return Series(self.stamps, self.values[:, place : place + 1])

    def seconds(self, origin: int) -> Array:
        """Return the stamps as seconds since `origin` [ns], shape (n,)."""
        return np.asarray((self.stamps - origin) / NANOSECONDS, dtype=np.float64)


def _no_series(width: int) -> Series:
    return Series(np.zeros(0, np.int64), np.zeros((0, width)))


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
        delays: Time from the stamps of measurements to their recording [s], values (n, 1); None if
            not recorded.
        estimate_delays: The same of the estimates, values (m, 1).
        topic: Name of the measurements' topic.
        joints: All that there are estimates of.
        ran: What the observer ran, as far as the bag has it.
        passes: Number of passes over the recorded time; this is the longest one.
        quantities: What the estimates are of.
        measured: The place of the output that measures a state, by the state's key.
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
    torque: Array = field(default_factory=lambda: np.zeros((0, 0)))
    torque_bounds: Array = field(default_factory=lambda: np.zeros((0, 0)))
    innovations: Series | None = None
    truth: Series | None = None
    true_disturbance: Series | None = None
    true_torque: Series | None = None
    health: Series | None = None
    parameters: Series | None = None
    parameter_bounds: Series | None = None
    delays: Series | None = None
    estimate_delays: Series | None = None
    topic: str = "joint_measurements"
    joints: tuple[str, ...] = ()
    ran: RecordedObserver = field(default_factory=RecordedObserver)
    passes: int = 1
    quantities: tuple[Quantity, ...] = QUANTITIES
    measured: Mapping[str, int] = field(default_factory=lambda: {"link_angle": 0})
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

    @property
    def output_count(self) -> int:
        """Number of outputs p."""
        return int(self.disturbance.shape[1])

    @cached_property
    def true_states(self) -> Array | None:
        """Truth at the estimates' stamps, NaN if unknown, shape (m, plant)."""
        if self.truth is None:
            return None
        rated = self.quantities[1].key == "link_velocity"
        return (interpolate_motion if rated else interpolate)(self.truth, self.stamps)

    @cached_property
    def true_disturbance_held(self) -> Array | None:
        """True disturbances at the estimates' stamps, NaN if unknown, shape (m, p)."""
        truth = self.true_disturbance
        return None if truth is None else hold(truth, self.stamps)

    @cached_property
    def true_torque_held(self) -> Array | None:
        """True torque disturbances at the estimates' stamps, NaN if unknown [N m], shape (m, t)."""
        return None if self.true_torque is None else hold(self.true_torque, self.stamps)

    def of(self, quantity: Quantity) -> Estimated:
        """Return what is known of a quantity."""
        own = {
            "state": (self.states, self.state_bounds, self.truth, self.true_states),
            "disturbance": (
                self.disturbance,
                self.disturbance_bounds,
                self.true_disturbance,
                self.true_disturbance_held,
            ),
            "torque": (self.torque, self.torque_bounds, self.true_torque, self.true_torque_held),
        }
        values, bounds, series, truth = own[quantity.kind]
        column = quantity.column
        return Estimated(
            values[:, column],
            bounds[:, column],
            None if series is None else series.column(column),
            None if truth is None else truth[:, column],
        )


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
    """Find a run in a bag, of the design that its observer ran, else of the shipped one.

    Args:
        bag: Bag folder or MCAP file.
        joint: Name of the joint; None if there are estimates of one only.
        namespace: Namespace of all topics, for a bag with several arms.
        observer: Name of the observer node.
        size: Number of messages in a part, divisible by 4; None for one part.

    Raises:
        BagReadError: As for `find_observer` and its `run`.
        DesignFileError: The design that the observer ran is not known here.
    """
    found = find_observer(bag, namespace=namespace, observer=observer)
    joint = found.choose(joint)
    (files,) = choose_designs(bag, found.ran, [joint]).values()
    return found.run(joint, files[0].design.request, size)


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
    names = {key: _find(reader, end, namespace) for key, end in _topics(observer).items()}
    ran, entries = RecordedObserver(), tuple[str, ...]()
    if names["states"] is not None:
        ran = recorded_observer(reader, names["states"].removesuffix(f"/{topics.STATES}"))
        names["measurements"] = names["measurements"] or _there(reader, ran.measurements)
        entries = _first_entries(reader, names["states"])
    return FoundObserver(reader, observer, names, ran, entries)


class FoundObserver:
    """A recorded observer.

    Args:
        reader: The bag.
        observer: Name of the node.
        names: Its topics by what they are of; None for one that the bag does not have.
        ran: What it ran, as far as the bag has it.
        entries: Names in its first estimates.

    Attributes:
        ran: The same.
        joints: All that there are estimates of.
    """

    def __init__(
        self,
        reader: BagReader,
        observer: str,
        names: Mapping[str, str | None],
        ran: RecordedObserver,
        entries: tuple[str, ...],
    ) -> None:
        self._reader, self._observer, self._names, self.ran = reader, observer, names, ran
        self._entries = entries
        links = [one.removesuffix("_link") for one in entries if one.endswith("_link")]
        arms = [joint for joint in links if topics.sides(joint)[1] in entries]
        self._has_names = {one.partition("/")[0] for one in entries if "/" in one}
        alone = len(ran.designs) == 1 and bool(entries)
        systems = [one for one in ran.designs if one in self._has_names or alone]
        self.joints = tuple(dict.fromkeys([*arms, *systems]))
        if entries and not self.joints:
            self.joints = (UNNAMED_SYSTEM,)

    def choose(self, joint: str | None) -> str:
        """Return the joint of a name, the only one if it is None.

        Raises:
            BagReadError: There are no estimates of such a joint, or of several.
        """
        self._require({key: self._names[key] for key in ("states",)})
        if not self._entries:
            made = self._reader.topics.get(self._names["measurements"] or "")
            of = "" if made is None else f" of {made.count} measurements on {made.name}"
            raise BagReadError(
                f"{self._reader.path}: the observer made no estimate{of}; its design may be of "
                "another arm or system, and its log and /diagnostics say why measurements were "
                "rejected"
            )
        return _choose_joint(self._reader.path, self.joints, joint)

    def run(
        self, joint: str, request: ArmRequest | TSRequest, size: int | None = BLOCK
    ) -> "RunParts":
        """Return the estimates of a joint.

        If the recorded time restarts, as in a looped bag, the pass with the longest estimates is
        read.

        Args:
            joint: The joint.
            request: Of its design.
            size: Number of messages in a part, divisible by 4; None for one part.

        Raises:
            BagReadError: The bag lacks a topic that is needed, or messages of the joint on it.
        """
        reader, names = self._reader, self._names
        own = signals(request, joint, joint not in self._has_names)
        quantities = quantities_of(request)
        wanted = _wanted(joint, own, request.uncertainty_model.names)
        required = {key: names[key] for key in _REQUIRED}
        self._require(required)
        there = {name: (key, wanted[key]) for key, name in names.items()
                 if name is not None and any(wanted[key])}  # fmt: skip
        kept = _KeptBlocks(_blocks(reader, there, BLOCK if size is None else size))
        streams = _survey(kept.write())
        if empty := [str(name) for key, name in required.items() if not streams[key]]:
            raise BagReadError(
                f"{reader.path}: no message about joint '{joint}' on {', '.join(empty)}"
            )
        states = max(streams["states"], key=lambda one: one.last - one.first)
        # Each topic restarts at its own moment, but all of them at about the same.
        chosen = {
            key: min(spans, key=lambda one: abs(one.log_time - states.log_time))
            for key, spans in streams.items()
            if spans
        }
        none = {key: np.zeros((0, sum(map(len, one)))) for key, one in wanted.items()}
        run = RecordedRun(
            name="/".join(Path(reader.path).absolute().parts[-2:]),
            joint=joint,
            measurements=_no_series(len(own.outputs) + len(own.inputs)),
            stamps=_no_series(0).stamps,
            states=none["states"],
            state_bounds=none["bounds"],
            disturbance=none["disturbance"],
            disturbance_bounds=none["disturbance_bound"],
            torque=none["torque"],
            torque_bounds=none["torque_bound"],
            topic=str(names["measurements"]),
            joints=self.joints,
            ran=self.ran,
            passes=len(streams["states"]),
            quantities=quantities,
            measured=measured_states(request),
            begin=min([states.first, *chosen["measurements"].first_stamped]),
        )
        shown = {name: one for name, one in there.items() if one[0] in chosen}
        return RunParts(_blocks(reader, shown, None) if size is None else kept, shown, chosen, run)

    def statuses(self, joint: str) -> Iterator[RecordedStatus]:
        """Yield the recorded statuses of the observer that are of a joint, or of all joints."""
        topic = self._reader.topics.get("/diagnostics")
        node = str(self._names["states"]).removesuffix(f"/{topics.STATES}").strip("/")
        if topic is None or topic.type != DIAGNOSTICS:
            return
        mark = f"{node}: ".encode()
        for rows, records in read_rows(self._reader, [topic.name]):
            places = zip(
                rows.chunks.tolist(), rows.begins.tolist(), rows.sizes.tolist(), strict=True
            )
            for chunk, begin, size in places:
                data = records[chunk][begin : begin + size].tobytes()
                for status in read_statuses(data) if mark in data else ():
                    of_all = status.name[-1] == "timing" or len(self.joints) == 1
                    if status.name[0] == node and (of_all or status.hardware == joint):
                        yield status

    def _require(self, names: Mapping[str, str | None]) -> None:
        ends = _topics(self._observer)
        if missing := [ends[key] for key, name in names.items() if name is None]:
            has = ", ".join(self._reader.topics) or "none"
            raise BagReadError(
                f"{self._reader.path}: no topic ends in {', '.join(missing)}; topics: {has}"
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


class _Read(NamedTuple):
    """Messages about a joint.

    Attributes:
        stamps: [ns], shape (n,).
        log_times: [ns], shape (n,).
        values: Of all groups that are read, shape (n, k).
    """

    stamps: Stamps
    log_times: Stamps
    values: Array


_Blocks: TypeAlias = Iterable[tuple[dict[str, _Read], bool]]
"""The topics of a run block by block, and whether it is the last one."""


class _KeptBlocks:
    """Blocks in a temporary file, some 0.3 kB for each estimate, as they are needed thrice."""

    def __init__(self, blocks: _Blocks) -> None:
        self._file = TemporaryFile()  # noqa: SIM115 (closed when this object goes)
        finalize(self, self._file.close)
        self._keys: list[tuple[str, ...]] = []
        self._blocks = blocks

    def write(self) -> Iterator[tuple[dict[str, _Read], bool]]:
        """Yield the blocks, and keep them."""
        for block, is_last in self._blocks:
            self._keys.append(tuple(block))
            for array in chain.from_iterable(block.values()):
                np.save(self._file, array)
            yield block, is_last

    def __iter__(self) -> Iterator[tuple[dict[str, _Read], bool]]:
        self._file.seek(0)
        for number, keys in enumerate(self._keys, 1):
            block = {key: _Read(*(np.load(self._file) for _ in _Read._fields)) for key in keys}
            yield block, number == len(self._keys)


def _survey(blocks: _Blocks) -> dict[str, list[_Span]]:
    finders: dict[str, _PassFinder] = {}
    for block, is_last in blocks:
        for key, (stamps, log_times, _) in block.items():
            finder = finders.setdefault(key, _PassFinder())
            finder.add(log_times, stamps, is_last=is_last)
    return {key: finder.spans for key, finder in finders.items()}


def _blocks(
    reader: BagReader, there: Mapping[str, tuple[str, Wanted]], size: int | None
) -> Iterator[tuple[dict[str, _Read], bool]]:
    wanted = {name: own for name, (_, own) in there.items()}
    for block in read_blocks(reader, wanted, size):
        found = {}
        for name, (key, groups) in there.items():
            series, shown = block.series[name], groups
            if key in _TWICE:
                series, shown = _as_named(series), groups[:1]
            named = series.named[:, 0]
            parts = [series.values[named, group, : len(one)] for group, one in enumerate(shown)]
            values = as_of_now(parts[0]) if key == "health" else np.hstack(parts)
            found[key] = _Read(series.stamps[named], series.log_times[named], values)
        yield found, block.horizon == math.inf


class RunParts:
    """A recorded run in parts of bounded size, read from the bag each time that they are needed.

    Args:
        blocks: The messages.
        there: What is read of which topic, and the name of a run's part that it is.
        spans: The pass to read of each.
        run: What all parts have in common.

    Attributes:
        run: The same.
        has_truth: Whether there is any.
    """

    def __init__(
        self,
        blocks: _Blocks,
        there: Mapping[str, tuple[str, Wanted]],
        spans: Mapping[str, _Span],
        run: RecordedRun,
    ) -> None:
        self.run, self._blocks, self._spans = run, blocks, spans
        self._widths = {key: sum(map(len, wanted[: 1 if key in _TWICE else None]))
                        for key, wanted in there.values()}  # fmt: skip
        self.has_truth = "truth" in spans

    def __iter__(self) -> Iterator[RecordedRun]:
        count = dict.fromkeys(self._spans, 0)
        waiting = {key: _no_series(self._widths[key]) for key in self._spans}
        waiting |= {_DELAYED[key]: _no_series(1) for key in self._spans.keys() & _DELAYED.keys()}
        since: int | None = None
        for block, is_last in self._blocks:
            for key, span in self._spans.items():
                stamps, log_times, values = block[key]
                # The messages of the block that are of the pass.
                first = min(max(span.begin - count[key], 0), len(stamps))
                own = slice(first, max(span.end - count[key], first))
                count[key] += len(stamps)
                waiting[key] = waiting[key].followed_by(Series(stamps[own], values[own]))
                if key in _DELAYED:
                    late = (log_times[own] - stamps[own]) / NANOSECONDS
                    delays = Series(stamps[own], late[:, np.newaxis])
                    waiting[_DELAYED[key]] = waiting[_DELAYED[key]].followed_by(delays)
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
        optional: dict[str, Any] = {key: known[key].ordered() for key in _SERIES if key in known}
        aligned: dict[str, Any] = {
            name: align(known[key], states.stamps) for key, name in _ALIGNED.items() if key in known
        }
        nothing = np.full((len(states.stamps), run.torque.shape[1]), np.nan)
        return replace(
            run,
            measurements=known["measurements"],
            stamps=states.stamps,
            states=states.values,
            **{"torque": nothing, "torque_bounds": nothing, **aligned},
            **optional,
        )


def _topics(observer: str) -> dict[str, str]:
    """Return for each part of a run the end of its topic's name."""
    return {
        "measurements": MEASUREMENTS,
        "states": f"{observer}/{topics.STATES}",
        "bounds": f"{observer}/{topics.STATE_BOUNDS}",
        "disturbance": f"{observer}/{topics.DISTURBANCE}",
        "disturbance_bound": f"{observer}/{topics.DISTURBANCE_BOUND}",
        "torque": f"{observer}/{topics.TORQUE_DISTURBANCE}",
        "torque_bound": f"{observer}/{topics.TORQUE_DISTURBANCE_BOUND}",
        "innovations": f"{observer}/{topics.INNOVATION}",
        "health": f"{observer}/{topics.HEALTH}",
        "parameters": f"{observer}/{topics.PARAMETERS}",
        "parameter_bounds": f"{observer}/{topics.PARAMETER_BOUNDS}",
        "truth": topics.TRUE_STATES,
        "true_disturbance": topics.TRUE_DISTURBANCE,
        "true_torque": topics.TRUE_TORQUE,
    }


def _wanted(joint: str, own: Signals, learnt: tuple[str, ...]) -> dict[str, Wanted]:
    """Return for each part of a run what to read of its topic."""
    alone, named = (
        places_of(joint, own, alone=alone, learnt=learnt, rated=False) for alone in (True, False)
    )
    return {
        "measurements": [own.outputs, own.inputs],
        "states": [own.states],
        "bounds": [own.states],
        "disturbance": [alone[topics.DISTURBANCE]],
        "disturbance_bound": [alone[topics.DISTURBANCE]],
        "torque": [own.torques],
        "torque_bound": [own.torques],
        "innovations": [alone[topics.INNOVATION]],
        **{
            key: [alone[topic], named[topic]]
            for key, topic in zip(_TWICE, (topics.HEALTH, *topics.PARAMETER_TOPICS), strict=True)
        },
        "truth": [own.states],
        "true_disturbance": [alone[topics.TRUE_DISTURBANCE]],
        "true_torque": [own.torques],
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


def _first_entries(reader: BagReader, topic: str) -> tuple[str, ...]:
    """Return the names in the first estimates."""
    messages = islice(reader.messages([topic]), _FIRST_MESSAGES)
    groups, _ = JointStateDecoder().decode_all([message.data for message in messages])
    return tuple(dict.fromkeys(name for group in groups for name in group.names))


def _choose_joint(bag: Path, joints: tuple[str, ...], joint: str | None) -> str:
    if joint in joints or (joint is None and len(joints) == 1):
        return joint or joints[0]
    has = ", ".join(joints) or "none"
    if joint is None and joints:
        raise BagReadError(f"{bag}: estimates of several joints, choose one of: {has}")
    whom = "" if joint is None else f" of joint '{joint}'"
    raise BagReadError(f"{bag}: no estimate{whom}; joints: {has}")


def _as_named(series: JointSeries) -> JointSeries:
    """Return the numbers of a joint that is alone or, if there are such, of one among several."""
    return series.of_joint(int(series.named[:, 1].any()))


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
    series = _known(series)
    if len(series.stamps) < 2:
        return result
    inside = _between_close_samples(series.stamps, stamps, max_gap)
    origin = int(series.stamps[0])
    times, wanted = series.seconds(origin), (stamps[inside] - origin) / NANOSECONDS
    spline = CubicHermiteSpline(times, series.values[:, 0::2], series.values[:, 1::2], axis=0)
    result[inside, 0::2] = spline(wanted)
    result[inside, 1::2] = spline(wanted, 1)
    return result


def _known(series: Series) -> Series:
    """Return the samples without those that have a number that is none."""
    known = np.isfinite(series.values).all(axis=1)
    return Series(series.stamps[known], series.values[known])


def interpolate(series: Series, stamps: Stamps, max_gap: float = MAX_GAP) -> Array:
    """Return values between their samples, NaN outside of them and in gaps, shape (m, k).

    They follow the cubic that has the values of both neighbours and their slopes to the next ones.

    Args:
        series: Samples in ascending order, values of shape (n, k).
        stamps: Where to evaluate [ns], shape (m,).
        max_gap: Distance of neighbouring samples that still counts as sampled [s].
    """
    result = np.full((len(stamps), series.values.shape[1]), np.nan)
    series = _known(series)
    if len(series.stamps) < 2:
        return result
    inside = _between_close_samples(series.stamps, stamps, max_gap)
    origin = int(series.stamps[0])
    times, wanted = series.seconds(origin), (stamps[inside] - origin) / NANOSECONDS
    slopes = np.gradient(series.values, times, axis=0)
    result[inside] = CubicHermiteSpline(times, series.values, slopes, axis=0)(wanted)
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
