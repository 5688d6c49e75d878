# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node's diagnostics, as functions of its joints and a meter of its ticks."""

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence

from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.estimation import health
from tsobs_ros.estimation.events import NOISY, EventKind
from tsobs_ros.estimation.health import Level, Phase, Status
from tsobs_ros.estimation.records import IMPLAUSIBLE_TORQUE, Estimate, Learning, RejectReason
from tsobs_ros.nodes.managed import Statuses
from tsobs_ros.nodes.observer.joints import NAMES, ObservedJoint, main_of

_MANY_REJECTED = 0.01
_MANY_MISSED = 0.05
_MANY_TORQUES, _ENOUGH = 0.2, 100
_BEYOND_LIMIT = (
    "the drive is beyond the torque limit for a fifth of the time: the design's torque_limit is "
    "wrong"
)
# The clock has jumped if it went on by more than this [ns], so much faster than time passes.
_JUMP = 1_000_000_000
_FASTEST = 100
_ROUNDING = 1e-3


def statuses_of(
    joints: Sequence[ObservedJoint],
    timing: Status,
    now: int,
    *,
    steady: int,
    resets: int,
    enabled: bool,
    failed: bool,
) -> Statuses:
    """Return the statuses of the node and, if it has several joints, of each joint.

    Args:
        joints: The joints.
        timing: That of the node's ticks.
        now: Time on the node's clock [ns].
        steady: Time that neither stands still nor goes back [ns], for the last minute.
        resets: Number of restarts of the whole node.
        enabled: Whether the node works.
        failed: Whether there was a numerical failure since the last statuses.
    """
    for joint in joints:
        joint.count(steady)
    parts = {
        joint.name: [
            _state_status([joint], now, _tracking_values(joint, now), enabled=enabled),
            _measurement_status([joint]),
            *_estimate_statuses(joint, now),
        ]
        for joint in joints
    }
    values = {"resets": str(resets)}
    further = [_summary_status(parts)]
    if len(joints) == 1:
        (state, _, *further), parts = parts[joints[0].name], {}
        values |= state.values
    state = _state_status(joints, now, values, enabled=enabled, failed=failed)
    return [state, _measurement_status(joints), timing, *further], parts


def _state_status(
    joints: Sequence[ObservedJoint],
    now: int,
    values: dict[str, str],
    *,
    enabled: bool,
    failed: bool = False,
) -> Status:
    """Return the worst state of joints, and why their samples are all refused if they are."""
    phases = [joint.phase(now) for joint in joints]
    phase = max(phases)
    if not enabled:
        return Status("state", Level.WARN, "DISABLED", values)
    if failed:
        return Status("state", Level.ERROR, f"{phase.name}, after a numerical failure", values)
    level, message = phase.level, phase.name
    in_it = [joint for joint, each in zip(joints, phases, strict=True) if each is phase]
    refused = main_of(sum((joint.newly for joint in in_it if joint.in_vain), Counter()))
    if refused and phase is not Phase.TRACKING:
        message += f": all that comes is rejected, most: {refused}"
    if losses := sum(joint.recent.growth["losses of track"] for joint in joints):
        level = max(level, Level.WARN)
        message += f", after {losses} loss{'es' * (losses != 1)} of track in the last minute"
    return Status("state", level, message, values)


def _tracking_values(joint: ObservedJoint, now: int) -> dict[str, str]:
    values = {
        "restarts": str(joint.tracker.restarts),
        "numerical failures": str(joint.tracker.failures),
        **{name: str(count) for name, count in joint.tracker.events.items()},
    }
    if (age := joint.age(now)) is not None:
        values["measurement age [s]"] = f"{age:.4f}"
    return values


def _measurement_status(joints: Sequence[ObservedJoint]) -> Status:
    """Return the counts of samples: received = used + rejected, by reason."""
    trackers, received = [joint.tracker for joint in joints], sum(j.received for j in joints)
    rejected: Counter[str] = sum((joint.rejected for joint in joints), Counter())
    recent: Counter[str] = sum((joint.recent.growth for joint in joints), Counter())
    causes = Counter({name: recent[name] for name in NAMES[1:]})
    values = {
        "received": str(received),
        "used": str(sum(each.used for each in trackers)),
        "rewinds": str(sum(each.rewinds for each in trackers)),
        **{f"rejected: {name}": str(rejected[name]) for name in NAMES[1:]},
        "last minute: received": str(recent["received"]),
        "last minute: rejected": str(causes.total()),
    }
    if len(joints) == 1 and len(joints[0].faults.sensors) > 1:
        names = joints[0].loaded.design.request.output_names
        for output, counts in zip(names, trackers[0].output_counts, strict=True):
            values |= {f"{output}: {what}": str(count) for what, count in counts.items()}
    if not causes.total():
        return Status("measurements", Level.OK, "none rejected in the last minute", values)
    share = causes.total() / max(recent["received"], causes.total())
    many = share > _MANY_REJECTED
    amount = f"{100.0 * share:.0f} % of" if many else f"{causes.total()} in"
    now = main_of(sum((joint.newly for joint in joints), Counter()))
    most = now or main_of(causes)
    values["remedy"] = RejectReason(most).remedy
    message = f"{amount} the last minute rejected, most: {most}{'' if now else ', none now'}"
    if recent[NAMES[IMPLAUSIBLE_TORQUE]] > _MANY_TORQUES * max(recent["received"], _ENOUGH):
        message += f"; {_BEYOND_LIMIT}"
    return Status("measurements", Level.WARN if many else Level.OK, message, values)


def _estimate_statuses(joint: ObservedJoint, now: int) -> list[Status]:
    estimate, request = joint.latest, joint.loaded.design.request
    names = request.output_names
    pairs = zip(joint.faults.sensors, joint.signals.units, strict=True)
    faults = [sensor.status(now, unit) for sensor, unit in pairs]
    if len(names) > 1:
        faults = [
            status._replace(name=f"{status.name} of {output}")
            for output, status in zip(names, faults, strict=True)
        ]
    statuses = [
        _domain_status(request, estimate),
        _innovation_status(joint),
        *faults,
        *joint.torques.statuses(),
        _certificate_status(joint, now),
    ]
    if estimate is None:
        return statuses
    if isinstance(request, ArmRequest):
        values = {"hypothesis": estimate.hypothesis.words}
        values |= _since(joint, EventKind.HYPOTHESIS, now)
        statuses.append(Status("hypothesis", *estimate.hypothesis.judged, values))
    if joint.learnt:
        learnt = zip(joint.learnt, estimate.parameters, estimate.parameter_bound, strict=True)
        values = {name: f"{theta:.4f} +- {bound:.4f}" for name, theta, bound in learnt}
        values["learning"] = estimate.learning.words
        values |= _since(joint, EventKind.LEARNING, now)
        level, message = estimate.learning.judged
        if estimate.learning is Learning.ACTIVE:
            valid = estimate.parameters_valid
            message = "learnt" if valid else "not yet: the motion is too poor"
        statuses.append(Status("parameters", level, message, values))
    return statuses


def _since(joint: ObservedJoint, kind: EventKind, now: int) -> dict[str, str]:
    """Return for how long something has been as it is, if it has changed."""
    since = joint.events.since(kind)
    return {} if since is None else {"since": health.duration_text(now - since)}


def _innovation_status(joint: ObservedJoint) -> Status:
    """Return whether the innovations are as the design expects, and how large the noise is."""
    names = joint.loaded.design.request.output_names
    each = {
        name: sensor.innovation_status()
        for name, sensor in zip(names, joint.faults.sensors, strict=True)
    }
    output, (name, level, message, values) = max(each.items(), key=lambda item: item[1].level)
    if len(each) > 1:
        message = f"{output}: {message}" if level else message
        values = {
            f"{one}: {key}": value
            for one, status in each.items()
            for key, value in status.values.items()
        }
    if joint.latest is not None:
        scale = joint.latest.noise_scale
        values["noise scale"] = f"{scale:.3f}"
        values["coloured power"] = f"{joint.latest.coloured_power:.3f}"
        if scale >= NOISY:
            level, message = Level.WARN, f"the noise is {scale:.2g} times the design's"
    recent = joint.recent.growth
    for event in ("outliers left out", "sensor jumps", "hits"):
        values[f"last minute: {event}"] = str(recent[event])
    return Status(name, level, message, values)


def _domain_status(request: ArmRequest | TSRequest, estimate: Estimate | None) -> Status:
    """Return whether the certificate covers the premise; that of a T–S system is no angle."""
    if isinstance(request, TSRequest):
        level = Level.OK if request.covers_estimated_premise else Level.WARN
        return Status("premise domain", level, request.claim, {})
    if not request.arm.gravity_torque:
        return Status("premise domain", Level.OK, "all angles: there is no gravity", {})
    values = {"x_max [rad]": f"{request.x_max:.4g}"}
    if estimate is None:
        return Status("premise domain", Level.OK, "no estimate yet", values)
    values["link angle [rad]"] = f"{estimate.state[0]:.4f}"
    if estimate.in_domain:
        return Status("premise domain", Level.OK, "inside the certificate's domain", values)
    return Status("premise domain", Level.WARN, "outside: the bound is void", values)


def _certificate_status(joint: ObservedJoint, now: int) -> Status:
    if joint.method != "certified":
        return Status("certificate", Level.WARN, f"method {joint.method}: nothing is certified", {})
    loaded, estimate = joint.loaded, joint.latest
    request = loaded.design.request
    values = {
        "design": loaded.name,
        "design sha256": loaded.identity,
        "disturbance model": request.disturbance_model.label,
        "design rate [Hz]": f"{request.rate:g}",
        "margin [1/s]": f"{loaded.design.certificate.worst.margin:.3e}",
    }
    if not math.isnan(joint.measured_rate):
        values["measured rate [Hz]"] = f"{joint.measured_rate:.4g}"
    if estimate is None:
        return Status("certificate", Level.OK, "no estimate yet", values)
    values["claimed"] = "yes" if estimate.claimed else "no"
    values["basis"] = estimate.basis.words
    values |= _since(joint, EventKind.BOUND, now)
    return Status("certificate", *estimate.basis.judged, values)


def _summary_status(statuses: Mapping[str, Sequence[Status]]) -> Status:
    """Return the worst of the statuses of several joints, and the worst level of each joint."""
    joint, worst = max(
        ((joint, status) for joint, own in statuses.items() for status in own),
        key=lambda item: item[1].level,
    )
    message = f"{joint}: {worst.name}: {worst.message}" if worst.level else "all well"
    values = {joint: max(status.level for status in own).name for joint, own in statuses.items()}
    return Status("joints", worst.level, message, values)


class TickMeter:
    """Measures how regular ticks are and how long they take; `status` starts a new interval.

    Args:
        rate: The wanted rate [Hz].
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        # How many ticks fell out, and how often the clock jumped ahead, which makes none fall out.
        self._missed = self._jumps = self._ticks = 0
        # Of the latest work: the time, the steady time, and whether a tick started it.
        self._latest: tuple[int, int, bool] | None = None
        self._late = 0.0
        self._periods: list[int] = []
        self._times: dict[str, list[int]] = {"tick time": [], "latency": []}
        self._recent = health.LastMinute()

    def begin(self, now: int, *, tick: bool = True) -> None:
        """Note the start of work.

        Args:
            now: Time on the node's clock [ns].
            tick: Whether a tick starts it; ticks are missed only between two of them.
        """
        steady = time.monotonic_ns()
        if self._latest is not None:
            before, began, was_tick = self._latest
            period = now - before
            if period > _JUMP and period > _FASTEST * (steady - began):
                self._jumps += 1
            else:
                self._periods.append(period)
                if tick and was_tick:
                    # What a late tick lacks, the next one may make good.
                    self._late = max(0.0, self._late + period * 1e-9 * self._rate - 1.0)
                    missed = int(self._late + _ROUNDING)
                    self._missed += missed
                    self._late -= missed
        self._latest = now, steady, tick

    def end(self) -> None:
        """Note the end of work."""
        if self._latest is not None:
            self._times["tick time"].append(time.monotonic_ns() - self._latest[1])

    def answered(self, latency: int) -> None:
        """Note the time from an input's arrival to the first output that uses it [ns]."""
        self._times["latency"].append(latency)

    def restart(self) -> None:
        """Forget the last tick: the clock jumped, or there was a pause."""
        self._latest = None
        self._late = 0.0

    def status(self, steady: int) -> Status:
        """Return achieved rate, tick time and latency since the last call, and missed ticks.

        Args:
            steady: Time that neither stands still nor goes back [ns].
        """
        periods, self._periods = self._periods, []
        times, self._times = self._times, {name: [] for name in self._times}
        self._ticks += len(times["tick time"])
        self._recent.update(steady, {"missed": self._missed, "ticks": self._ticks})
        missed, made = self._recent.growth["missed"], self._recent.growth["ticks"]
        values = {"wanted rate [Hz]": f"{self._rate:g}", "missed ticks": str(self._missed)}
        if self._jumps:
            values["clock jumps ahead"] = str(self._jumps)
        if not times["tick time"]:
            return Status("timing", Level.STALE, "no ticks", values)
        if sum(periods) > 0:
            values["achieved rate [Hz]"] = f"{len(periods) * 1e9 / sum(periods):.1f}"
        for name, ordered in times.items():
            ordered.sort()
            for percent in (50, 99) if ordered else ():
                place = math.ceil(percent / 100.0 * len(ordered)) - 1
                values[f"{name} p{percent} [ms]"] = f"{ordered[place] * 1e-6:.3f}"
        level = Level.WARN if missed > _MANY_MISSED * (made + missed) else Level.OK
        message = f"missed {missed} tick{'s' * (missed != 1)} in the last minute"
        return Status("timing", level, message if missed else "on time", values)
