# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node's diagnostics, as functions of its joints and a meter of its ticks."""

import math
import time
from collections.abc import Sequence

import numpy as np

from tsobs_ros.design.file import identity
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.estimation.events import NOISY, EventKind
from tsobs_ros.estimation.health import LastMinute, Level, Phase, Status, lasting
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.methods import CERTIFIED
from tsobs_ros.nodes.observer.joints import FAILURES, ObservedJoint

_MANY_REJECTED = 0.01
_MANY_MISSED = 0.05
# A jump of the clock: back, or ahead by over this [ns] and over this multiple of steady time.
_JUMP = 1_000_000_000
_FASTEST = 100


def statuses_of(
    joints: Sequence[ObservedJoint], timing: Status, now: int, *, resets: int, enabled: bool
) -> list[Status]:
    """Return the node's and its joints' statuses at a time [ns], with joint names if several."""
    each = [_joint_statuses(joint, now, enabled) for joint in joints]
    state = max((own[0] for own in each), key=lambda status: status.level)
    state = state._replace(values={"resets": str(resets), **state.values})
    if not enabled:
        state = state._replace(level=Level.WARN, message="DISABLED")
    if len(joints) == 1:
        return [state, timing, *each[0][1:]]
    names = [f"{joint.name}: " for joint in joints]
    return [state, timing] + [
        status._replace(name=name + status.name)
        for name, own in zip(names, each, strict=True)
        for status in own
    ]


def _joint_statuses(joint: ObservedJoint, now: int, enabled: bool) -> list[Status]:
    names = joint.request.output_names
    faults = zip(joint.faults.faults, joint.signals.units, names, strict=True)
    first = [_state_status(joint, now), _measurement_status(joint)]
    statuses = [
        _domain_status(joint),
        _innovation_status(joint),
        *(fault.status(now, unit, name * (len(names) > 1)) for fault, unit, name in faults),
        *_torque_statuses(joint),
        _certificate_status(joint, now),
    ]
    estimate = joint.latest
    if estimate is not None and isinstance(joint.request, ArmRequest):
        values = {"hypothesis": estimate.hypothesis.words}
        values |= lasting(joint.events.changes[EventKind.HYPOTHESIS].since, now)
        statuses.append(Status("hypothesis", *estimate.hypothesis.judged, values))
    if estimate is not None and joint.learnt:
        learnt = zip(joint.learnt, estimate.parameters, estimate.parameter_bound, strict=True)
        values = {name: f"{theta:.4f} +- {bound:.4f}" for name, theta, bound in learnt}
        message = "learnt" if estimate.parameters_valid else "not yet: the motion is too poor"
        statuses.append(Status("parameters", Level.OK, message, values))
    if not enabled or joint.phase(now) is Phase.STALE:  # what was, as nothing is estimated
        statuses = [
            one._replace(level=Level.STALE, message=f"at last: {one.message}") for one in statuses
        ]
    return first + statuses


def _state_status(joint: ObservedJoint, now: int) -> Status:
    phase = joint.phase(now)
    level, message = phase.level, phase.name
    values = {
        "restarts": str(joint.tracker.restarts),
        FAILURES: str(joint.tracker.failures),
        **{name: str(count) for name, count in joint.tracker.events.items()},
    }
    if (age := joint.age(now)) is not None:
        values["measurement age [s]"] = f"{age:.4f}"
    if joint.newly[FAILURES]:
        return Status("state", Level.ERROR, f"{message}, after a numerical failure", values)
    if losses := joint.recent.growth["losses of track"]:
        level = max(level, Level.WARN)
        message += f", losses of track in the last minute: {losses}"
    return Status("state", level, message, values)


def _measurement_status(joint: ObservedJoint) -> Status:
    """Return the counts of samples: received = used + rejected, by reason."""
    recent, rejected = joint.recent.growth, joint.tracker.rejected
    values = {
        "received": str(joint.received),
        "used": str(joint.tracker.used),
        "rewinds": str(joint.tracker.rewinds),
        **{f"rejected: {reason.text}": str(rejected[reason]) for reason in RejectReason},
        "last minute: received": str(recent["received"]),
        "last minute: rejected": str(sum(map(recent.__getitem__, RejectReason))),
    }
    outputs = joint.request.output_names
    for output, sensor in zip(outputs, joint.tracker.state["sensors"][0], strict=True):
        if len(outputs) > 1:
            values |= {f"{output}: {what}": str(sensor[what]) for what in ("gated", "missing")}
    most = max(RejectReason, key=recent.__getitem__)
    if not recent[most]:
        return Status("measurements", Level.OK, "none rejected in the last minute", values)
    count = int(values["last minute: rejected"])
    values["remedy"] = most.remedy
    message = f"rejected in the last minute: {count} of {recent['received']}, most: {most.text}"
    level = Level.WARN if count > _MANY_REJECTED * recent["received"] else Level.OK
    return Status("measurements", level, message, values)


def _innovation_status(joint: ObservedJoint) -> Status:
    """Return the scale of the noise, and the events of the last minute."""
    level, message, values = Level.OK, "as large as designed", dict[str, str]()
    if (estimate := joint.latest) is not None:
        values["noise scale"] = f"{estimate.noise_scale:.3f}"
        values["coloured power"] = f"{estimate.coloured_power:.3f}"
        if estimate.noise_scale >= NOISY:
            level = Level.WARN
            message = f"the noise is {estimate.noise_scale:.2g} times the design's"
    for event in ("outliers left out", "sensor jumps", "hits", "wrong torques"):
        values[f"last minute: {event}"] = str(joint.recent.growth[event])
    return Status("innovation", level, message, values)


def _torque_statuses(joint: ObservedJoint) -> list[Status]:
    """Return the torques, with a warning if there was a contact since the last call."""
    sides, estimate, values = joint.torque_sides, joint.latest, dict[str, str]()
    if not sides:
        return []
    touched, joint.touched, text = joint.touched, False, "no estimate yet"
    if joint.torque_warn:
        values["warn level [N m]"] = f"{joint.torque_warn:g}"
    if estimate is not None:
        numbers = estimate.torque_disturbance, estimate.torque_disturbance_bound
        for side, torque, bound in zip(sides, *numbers, strict=True):
            values[f"{side} [N m]"], values[f"{side} bound [N m]"] = f"{torque:.4g}", f"{bound:.4g}"
        text = joint.torque_text(estimate, touched)
    return [Status("torque disturbance", Level.WARN if touched else Level.OK, text, values)]


def _domain_status(joint: ObservedJoint) -> Status:
    """Return whether the certificate covers the premise, which is an angle only for an arm."""
    request, estimate = joint.request, joint.latest
    level, values = Level.OK, dict[str, str]()
    if not isinstance(request, ArmRequest):
        level = Level.OK if request.covers_estimated_premise else Level.WARN
        message = request.claim
    elif not request.arm.gravity_torque:
        message = "all angles: there is no gravity"
    else:
        values["x_max [rad]"] = f"{request.x_max:.4g}"
        message = "no estimate yet"
        if estimate is not None:
            values["link angle [rad]"] = f"{estimate.state[0]:.4f}"
            message = "inside the certificate's domain"
            if not estimate.in_domain:
                fate = "not certified" if estimate.claimed else "void"
                level, message = Level.WARN, f"outside: the bound is {fate}"
    return Status("premise domain", level, message, values)


def _certificate_status(joint: ObservedJoint, now: int) -> Status:
    if joint.method not in CERTIFIED:
        return Status("certificate", Level.WARN, f"method {joint.method}: nothing is certified", {})
    design, estimate, request = joint.design, joint.latest, joint.request
    values = {
        "design": design.file,
        "design sha256": identity(design),
        "disturbance model": request.disturbance_model.label,
        "design rate [Hz]": f"{request.rate:g}",
        "margin [1/s]": f"{design.certificate.worst.margin:.3e}",
    }
    if not math.isnan(joint.measured_rate):
        values["measured rate [Hz]"] = f"{joint.measured_rate:.4g}"
    if estimate is None:
        return Status("certificate", Level.OK, "no estimate yet", values)
    values["claimed"] = "yes" if estimate.claimed else "no"
    values["basis"] = estimate.basis.words
    values |= lasting(joint.events.changes[EventKind.BOUND].since, now)
    return Status("certificate", *estimate.basis.judged, values)


class TickMeter:
    """Measures the regularity and the duration of ticks; each `status` starts a new interval."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._missed = self._ticks = 0
        # Start of the latest work: the time, the steady time, and whether a tick started it.
        self._latest: tuple[int, int, bool] | None = None
        self._periods: list[int] = []
        self._between_ticks: list[int] = []
        self._times: dict[str, list[int]] = {"tick time": [], "latency": []}
        self._recent = LastMinute()

    def begin(self, now: int, *, tick: bool = True) -> None:
        """Note the start of work at a time [ns]; missed ticks count only between two ticks."""
        steady = time.monotonic_ns()
        if self._latest is not None:
            before, began, was_tick = self._latest
            period = now - before
            if 0 <= period <= max(_JUMP, _FASTEST * (steady - began)):
                self._periods.append(period)
                if tick and was_tick:
                    self._between_ticks.append(period)
        self._latest = now, steady, tick

    def end(self) -> None:
        """Note the end of work."""
        if self._latest is not None:
            self._times["tick time"].append(time.monotonic_ns() - self._latest[1])

    def answered(self, latency: int) -> None:
        """Note the time from an input's arrival to the first output that uses it [ns]."""
        self._times["latency"].append(latency)

    def restart(self) -> None:
        """Forget the last tick: there was a pause."""
        self._latest = None

    def status(self) -> Status:
        """Return rate, tick time and latency since the last call, about a second ago."""
        periods, self._periods = self._periods, []
        apart, self._between_ticks = self._between_ticks, []
        times, self._times = self._times, {name: [] for name in self._times}
        self._ticks += len(times["tick time"])
        self._missed += max(0, round(sum(apart) * 1e-9 * self._rate) - len(apart))
        self._recent.update({"missed": self._missed, "ticks": self._ticks})
        missed, made = self._recent.growth["missed"], self._recent.growth["ticks"]
        values = {"wanted rate [Hz]": f"{self._rate:g}", "missed ticks": str(self._missed)}
        if not times["tick time"]:
            return Status("timing", Level.STALE, "no ticks", values)
        if sum(periods) > 0:
            values["achieved rate [Hz]"] = f"{len(periods) * 1e9 / sum(periods):.1f}"
        for name, each in times.items():
            for percent in (50, 99) if each else ():
                time_ns = np.percentile(each, percent, method="inverted_cdf")
                values[f"{name} p{percent} [ms]"] = f"{time_ns * 1e-6:.3f}"
        level = Level.WARN if missed > _MANY_MISSED * (made + missed) else Level.OK
        return Status("timing", level, f"ticks missed in the last minute: {missed}", values)
