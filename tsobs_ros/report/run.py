# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One recorded run of the observer as stamped series of numbers, read from a bag."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateDecoder, Wanted
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import BagReadError
from tsobs_ros.estimation.records import USED
from tsobs_ros.replay.health import CLAIMED
from tsobs_ros.replay.places import ESTIMATES, places_of
from tsobs_ros.replay.source import BagSource, passes
from tsobs_ros.report.diagnosed import RecordedStatus
from tsobs_ros.report.quantities import Quantity, quantities_of
from tsobs_ros.series import NANOSECONDS, Series, SeriesSpool, Stamps

MAX_GAP = 0.1
"""Series are not interpolated across longer gaps [s]: messages were lost there."""

BLOCK = 2**17
"""Number of messages that are read at once, of all topics: some 80 s at 200 Hz."""

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
"""The simulator's topics by the names of a run's parts."""

_OWN = {fields[0]: topic for topic, fields in ESTIMATES.items() if topic != topics.HEALTH}
_OWN |= {"health": topics.HEALTH, "innovation": topics.INNOVATION}


class Estimated(NamedTuple):
    """A quantity of a run: m estimates, 1σ bounds, the truth, and the truth at the same stamps.

    Unknown values are NaN; a truth that is not recorded is None.
    """

    values: Array
    bounds: Array
    truth: Series | None
    true_values: Array

    @property
    def error(self) -> Array:
        """Estimate − truth, NaN if unknown, shape (m,)."""
        return self.values - self.true_values


NOTHING = Series(np.zeros(0, np.int64), np.zeros((0, 0)))


@dataclass(frozen=True)
class RecordedRun:
    """Measurements, estimates and, from a simulation, the truth.

    Attributes:
        name: Its origin, for titles.
        parts: The following series, if they exist. Stamps ascend except in measurements.

            measurements: Outputs, then inputs, at the sampling stamps in order of arrival.
            state, disturbance, torque_disturbance: Estimates of the state, for an arm [q₁, q̇₁, q₂,
                q̇₂] (rad, rad/s), per output, and per torque [N m]. There is always a state.
            state_bound, disturbance_bound, torque_disturbance_bound: Published 1σ bounds.
            true_state, true_disturbance, true_torque_disturbance: At the sampling stamps.
            innovation: y − ŷ at the sampling stamps, NaN of outputs that were not used.
            health: Fields of `HEALTH` at their stamps.
            parameters, parameter_bound: Learnt changes of the uncertain parameters, and 1σ.
            held_out: Readings of a sensor that was kept from all observers.
        topic: Name of the measurements' topic.
        passes: Number of passes over the recorded time; the run is the longest one.
        request: The design's request, for names, units and places.
    """

    name: str
    joint: str
    parts: Mapping[str, Series]
    topic: str = "joint_measurements"
    passes: int = 1
    request: ArmRequest | TSRequest = field(default_factory=ArmRequest)

    def part(self, name: str) -> Series:
        """Return a part; it has no rows if it does not exist."""
        return self.parts.get(name, NOTHING)

    @property
    def stamps(self) -> Stamps:
        """Stamps of the estimates [ns], ascending, shape (m,)."""
        return self.parts["state"].stamps

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:
        """The estimated quantities."""
        return quantities_of(self.request)

    @cached_property
    def origin(self) -> int:
        """Stamp from which times count [ns]: the first measurement's, or estimate's if earlier."""
        stamped = self.part("measurements").stamps
        return int(np.append(stamped[stamped > 0], self.stamps[0]).min())

    @cached_property
    def times(self) -> Array:
        """Times of the estimates since the origin [s], shape (m,)."""
        return self.parts["state"].seconds(self.origin)

    def of(self, quantity: Quantity) -> Estimated:
        """Return the estimates, bounds and truth of a quantity."""
        return self._estimated[quantity.key]

    @cached_property
    def _estimated(self) -> dict[str, Estimated]:
        nothing, known = np.full(len(self.stamps), np.nan), dict[str, Array]()
        for name in {*ESTIMATED, *TRUE} & self.parts.keys():
            # A disturbance may jump between its samples.
            between = interpolate if name == "true_state" else hold if name in TRUE else align
            known[name] = between(self.parts[name], self.stamps)

        def of(name: str, place: int) -> Array:
            return known[name][:, place] if name in known else nothing

        found = {}
        for kind, place, key in ((one.kind, one.column, one.key) for one in self.quantities):
            truth = self.part(f"true_{kind}")
            own = truth._replace(values=truth.values[:, [place]]) if len(truth.stamps) else None
            at_stamps = of(f"true_{kind}", place)
            found[key] = Estimated(of(kind, place), of(f"{kind}_bound", place), own, at_stamps)
        return found


def read_series(source: BagSource, asked: Mapping[str, tuple[str, Wanted]]) -> dict[str, Series]:
    """Read numbers of topics of JointStates, all in one pass and up to any damage.

    `asked` has full names of topics, each with groups of numbers to read. If a message has entries
    of several groups, the last of these groups is read. Messages without any entry are left out.

    Raises:
        BagReadError: The bag has no such topic, or a topic is of another type.
    """
    names = dict.fromkeys(topic for topic, _ in asked.values())
    source.reader.require(names, JOINT_STATE)
    spools = {key: SeriesSpool(len(groups[0])) for key, (_, groups) in asked.items()}
    decoder = JointStateDecoder()
    for block in source.reader.blocks(names, BLOCK, on_damage=source.damaged):
        for key, (topic, groups) in asked.items():
            logged = block[topic].log_times
            there, stamps, values = decoder.read_places(len(logged), block[topic].groups, groups)
            spools[key].add(stamps[there], logged[there], values[there])
    return {key: spool.read() for key, spool in spools.items()}


def recorded_parts(
    source: BagSource, place: int, observer: str = "", learnt: tuple[str, ...] = ()
) -> dict[str, Series]:
    """Return the parts of a run that a bag, whose designs are known, has for a joint, by name.

    These are the measurements in the order of recording, the truth and, if `observer` is the full
    name of one, its estimates; `learnt` has the names of its learnt parameters.
    """
    joint, own, samples = source.joints[place], source.signals[place], source.samples
    # The entries of health and parameters have other names if the joint is alone.
    each = [
        places_of(joint, own, alone=alone, learnt=learnt, rated=False) for alone in (True, False)
    ]
    parts = {key: (source.truth.get(end, ""), end) for key, end in TRUE.items()}
    if observer:
        parts |= {key: (f"{observer}/{end}", end) for key, end in _OWN.items()}
    asked = {
        key: (topic, [one[end] for one in each])
        for key, (topic, end) in parts.items()
        if topic in source.reader.topics and each[0][end]
    }
    y, u = samples.y[:, place, : len(own.outputs)], samples.u[:, place, : len(own.inputs)]
    there = (samples.codes[:, place] == USED) | np.isfinite(y).any(axis=1)
    measured = Series(samples.stamps, np.hstack([y, u]), samples.log_times).take(there)
    return {**(read_series(source, asked) if asked else {}), "measurements": measured}


def read_run(
    source: BagSource, request: ArmRequest | TSRequest, *, observer: str | None = None
) -> RecordedRun:
    """Return the recorded estimates of the only joint of a source.

    `observer` is the name of their observer beside the measurements; None: the recorded one.

    If the recorded time restarts, as in a looped bag, the pass with the longest estimates is read.

    Raises:
        BagReadError: The bag has no estimate of the joint, or is damaged.
    """
    source.observe([request])
    (joint,), path = source.joints, Path(source.path)
    node = source.observer if observer is None else f"{source.namespace}/{observer}"
    found = recorded_parts(source, 0, node, request.uncertainty_model.names)
    if source.damage is not None:
        raise source.damage
    if "state" not in found or not len(found["state"].stamps):
        raise BagReadError(
            f"{path}: no estimate of {joint} from {source.count} measurements on {source.topic}; "
            f"expected some on {node}/{topics.STATES}. The observer's log "
            "and /diagnostics say why it rejects measurements. Topics: "
            f"{', '.join(source.reader.topics)}"
        )
    folders = [part for part in path.absolute().parts if part != "bag"]
    name = f"{joint}, {folders[-1]}" if len(folders) > 1 else joint
    return run_of(found, name, joint, request, source.topic)


def diagnostics(source: BagSource) -> Iterator[RecordedStatus]:
    """Yield the observer's recorded statuses for a source's only joint."""
    topic = source.reader.topics.get("/diagnostics")
    node = source.observer.strip("/")
    if topic is None or topic.type != "diagnostic_msgs/msg/DiagnosticArray":
        return
    mark, decode = f"{node}: ".encode(), source.reader.decoder(topic.name)
    is_alone = len(source.ran.designs) <= 1
    for message in source.reader.messages([topic.name]):
        if mark not in message.data:
            continue
        with suppress(Exception):  # any node may publish anything there
            array = decode(message.data)
            stamp = array.header.stamp.sec * NANOSECONDS + array.header.stamp.nanosec
            for each in array.status:
                name = tuple(each.name.split(": "))
                if name[0] == node and (is_alone or {*name[1:2]} & {*source.joints}):
                    values = {pair.key: pair.value for pair in each.values}
                    yield RecordedStatus(stamp, int(each.level), name, values)


def run_of(
    found: Mapping[str, Series],
    name: str,
    joint: str,
    request: ArmRequest | TSRequest,
    topic: str = "",
) -> RecordedRun:
    """Return the run of the longest pass of estimates, with the nearest pass of each other part.

    A looped bag has several passes over the recorded time. The part `state` must have rows.
    """
    each = {
        key: [part.take(slice(*ends)) for ends in passes(part.stamps) if ends[0] < ends[1]]
        for key, part in found.items()
    }
    longest = max(each["state"], key=lambda one: float(np.ptp(one.stamps)))
    # Each topic restarts at its own moment, but these moments are close together.
    near = {
        key: min(own, key=lambda one: abs(one.log_times[0] - longest.log_times[0]))
        for key, own in each.items()
        if own
    }
    if "health" in near and np.isnan(near["health"].values[:, CLAIMED]).any():
        del near["health"]  # from version 0.7, which had other codes
    parts = {key: one if key == "measurements" else one.ordered() for key, one in near.items()}
    return RecordedRun(name, joint, parts, topic, len(each["state"]), request)


def align(series: Series, stamps: Stamps) -> Array:
    """Return the values at exactly these stamps, NaN if there is none, shape (m, k)."""
    source = series.ordered()
    if np.array_equal(source.stamps, stamps):
        return source.values
    result = np.full((len(stamps), source.values.shape[1]), np.nan)
    _, here, there = np.intersect1d(stamps, source.stamps, return_indices=True)
    result[here] = source.values[there]
    return result


def interpolate(series: Series, stamps: Stamps) -> Array:
    """Return values interpolated between samples, NaN outside of them and in gaps, shape (m, k).

    The interpolant is the cubic with the values and slopes of both neighbouring samples; the slope
    at a sample is taken from its own neighbours. For a smooth motion, the error is at most
    h³/24 max|q⃛|: 10⁻⁶ rad for the elastic-joint arm at h = 5 ms.
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
        right = np.searchsorted(known.stamps, own, side="right").clip(1, len(known.stamps) - 1)
        inside = (own >= known.stamps[0]) & (own <= known.stamps[-1])
        inside &= np.diff(known.stamps)[right - 1] <= MAX_GAP * NANOSECONDS
        k, times = right[inside] - 1, known.seconds(int(known.stamps[0]))
        values, slopes = known.values, np.gradient(known.values, times, axis=0)
        step = (times[k + 1] - times[k])[:, np.newaxis]
        part = ((own[inside] - known.stamps[k]) / NANOSECONDS)[:, np.newaxis] / step
        mean = (values[k + 1] - values[k]) / step
        square = 3.0 * mean - 2.0 * slopes[k] - slopes[k + 1]
        cube = slopes[k] + slopes[k + 1] - 2.0 * mean
        result[begin : begin + BLOCK][inside] = values[k] + step * part * (
            slopes[k] + part * (square + part * cube)
        )
    return result


def hold(series: Series, stamps: Stamps) -> Array:
    """Return the newest value at or before each stamp, NaN if it is older than `MAX_GAP`, (m, k).

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
