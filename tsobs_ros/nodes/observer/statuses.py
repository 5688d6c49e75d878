# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the observer node says of itself in diagnostics, as functions of its parts."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tsobs_ros.estimation.health import Level, Phase, Status
from tsobs_ros.estimation.records import Estimate, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.nodes.observer.joints import LoadedDesign, ObservedJoint
from tsobs_ros.nodes.observer.parameters import ObserverParameters

_LEVEL_OF_PHASE = {
    Phase.TRACKING: Level.OK,
    Phase.COASTING: Level.WARN,
    Phase.WAITING: Level.WARN,
    Phase.STALE: Level.ERROR,
}
_FROM_BEST_TO_WORST = list(_LEVEL_OF_PHASE)
_MANY_REJECTED = 0.01


def worst_phase(phases: Iterable[Phase]) -> Phase:
    """Return the worst of some phases."""
    return max(phases, key=_FROM_BEST_TO_WORST.index)


def state_status(phase: Phase, values: dict[str, str], *, enabled: bool, failed: bool) -> Status:
    """Return the state of a joint, or of the node, which is that of its worst joint.

    Args:
        phase: How fresh its measurements are.
        values: What else there is to say.
        enabled: Whether the node works at all.
        failed: Whether there was a numerical failure since the last status.
    """
    if not enabled:
        return Status("state", Level.WARN, "DISABLED", values)
    if failed:
        return Status("state", Level.ERROR, f"{phase.value}, after a numerical failure", values)
    return Status("state", _LEVEL_OF_PHASE[phase], phase.value, values)


def tracking_values(joint: ObservedJoint, now: int) -> dict[str, str]:
    """Return how fresh the measurements of a joint are, and what befell its tracker."""
    values = {
        "restarts": str(joint.tracker.restarts),
        "numerical failures": str(joint.tracker.failures),
        **{name: str(count) for name, count in joint.tracker.events.items()},
    }
    age = joint.age(now)
    if age is not None:
        values["measurement age [s]"] = f"{age:.4f}"
    return values


def measurement_status(trackers: Sequence[Tracker[Any]], received: int) -> Status:
    """Return what became of the samples of joints: received = used + rejected, by reason."""
    rejected: Counter[RejectReason] = sum((each.rejected for each in trackers), Counter())
    total = rejected.total()
    values = {
        "received": str(received),
        "used": str(sum(each.used for each in trackers)),
        "rewinds": str(sum(each.rewinds for each in trackers)),
        **{f"rejected: {reason.value}": str(rejected[reason]) for reason in RejectReason},
    }
    level = Level.WARN if total > _MANY_REJECTED * max(received, 1) else Level.OK
    return Status("measurements", level, f"{total} rejected", values)


def domain_status(estimate: Estimate | None, x_max: float) -> Status:
    """Return whether the estimated link angle lies where the certificate is valid."""
    values = {"x_max [rad]": f"{x_max:.4g}"}
    if estimate is None:
        return Status("premise domain", Level.OK, "no estimate yet", values)
    values["link angle [rad]"] = f"{estimate.state[0]:.4f}"
    if estimate.in_domain:
        return Status("premise domain", Level.OK, "inside the certificate's domain", values)
    return Status("premise domain", Level.WARN, "outside: the bound is not certified", values)


def certificate_status(loaded: LoadedDesign, method: str, estimate: Estimate | None) -> Status:
    """Return which design is in use, and whether its bound is the one that is published."""
    if method != "certified":
        return Status("certificate", Level.WARN, f"method {method}: nothing is certified", {})
    certified = estimate is not None and estimate.certified
    request = loaded.design.request
    values = {
        "design": str(loaded.path),
        "design sha256": loaded.identity,
        "disturbance model": request.disturbance_model.label,
        "design rate [Hz]": f"{request.rate:g}",
        "margin [1/s]": f"{loaded.design.certificate.worst.margin:.3e}",
        "bound": "certified" if certified else "along the estimate",
    }
    message = "certified bound" if certified else "bound along the estimate"
    return Status("certificate", Level.OK, message, values)


def parameter_status(names: Sequence[str], estimate: Estimate) -> Status:
    """Return the parameters that are learnt, and whether they can be believed."""
    learnt = zip(names, estimate.parameters, estimate.parameter_bound, strict=True)
    values = {name: f"{theta:.4f} +- {bound:.4f}" for name, theta, bound in learnt}
    if estimate.parameters_valid:
        return Status("parameters", Level.OK, "learnt", values)
    return Status("parameters", Level.OK, "not yet: the motion is too poor", values)


def estimate_statuses(joint: ObservedJoint, method: str) -> list[Status]:
    """Return what can be said of a joint's estimate."""
    estimate = joint.estimate
    statuses = [
        domain_status(estimate, joint.loaded.design.request.x_max),
        joint.innovations.status(),
        joint.faults.status(),
        certificate_status(joint.loaded, method, estimate),
    ]
    if joint.learnt and estimate is not None:
        statuses.append(parameter_status(joint.learnt, estimate))
    return statuses


def joint_statuses(
    joint: ObservedJoint, now: int, parameters: ObserverParameters, *, enabled: bool
) -> list[Status]:
    """Return all that can be said of one of several joints."""
    phase, values = joint.phase(now, parameters), tracking_values(joint, now)
    return [
        state_status(phase, values, enabled=enabled, failed=False),
        measurement_status([joint.tracker], joint.received),
        *estimate_statuses(joint, parameters.method),
    ]


def summary_status(statuses: Mapping[str, Sequence[Status]]) -> Status:
    """Return the worst of the statuses of several joints, and the worst level of each joint."""
    worst = max(
        ((joint, status) for joint, own in statuses.items() for status in own),
        key=lambda item: item[1].level,
    )
    level = worst[1].level
    message = (
        "all well" if level is Level.OK else f"{worst[0]}: {worst[1].name}: {worst[1].message}"
    )
    values = {joint: max(status.level for status in own).name for joint, own in statuses.items()}
    return Status("joints", level, message, values)
