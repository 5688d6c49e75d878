# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the observer node says of itself in diagnostics, as functions of its parts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tsobs_ros.design.record import Design
from tsobs_ros.estimation.health import Level, Phase, Status
from tsobs_ros.estimation.records import Estimate, RejectReason
from tsobs_ros.estimation.tracker import Tracker

_LEVEL_OF_PHASE = {
    Phase.WAITING: Level.WARN,
    Phase.TRACKING: Level.OK,
    Phase.COASTING: Level.WARN,
    Phase.STALE: Level.ERROR,
}
_MANY_REJECTED = 0.01


def state_status(
    tracker: Tracker[Any], phase: Phase, age: float | None, resets: int, enabled: bool
) -> Status:
    """Return how fresh the measurements are, and how often it began afresh."""
    values = {
        "resets": str(resets),
        "restarts": str(tracker.restarts),
        "numerical failures": str(tracker.failures),
        **{name: str(count) for name, count in tracker.events.items()},
    }
    if age is not None:
        values["measurement age [s]"] = f"{age:.4f}"
    if not enabled:
        return Status("state", Level.WARN, "DISABLED", values)
    return Status("state", _LEVEL_OF_PHASE[phase], phase.value, values)


def measurement_status(tracker: Tracker[Any], received: int) -> Status:
    """Return what became of the measurements: received = used + rejected, by reason."""
    rejected = tracker.rejected
    total = sum(rejected.values())
    values = {
        "received": str(received),
        "used": str(tracker.used),
        "rewinds": str(tracker.rewinds),
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


def certificate_status(
    design: Design, path: Path, method: str, estimate: Estimate | None
) -> Status:
    """Return which design is in use, and whether its bound is the one that is published."""
    if method != "certified":
        return Status("certificate", Level.WARN, f"method {method}: nothing is certified", {})
    certified = estimate is not None and estimate.certified
    request = design.request
    values = {
        "design": str(path),
        "disturbance model": request.disturbance_model.label,
        "design rate [Hz]": f"{request.rate:g}",
        "margin [1/s]": f"{design.certificate.worst.margin:.3e}",
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
