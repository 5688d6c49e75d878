# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Premises of a certified bound: which of them a simulated run does not keep."""

from collections.abc import Iterable, Sequence

from tsobs_ros.campaign.drawing import WALK
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.model.arm import SIDES, ElasticJointArm
from tsobs_ros.simulation.plant import Mismatch, Scenario
from tsobs_ros.simulation.signals import BiasStep, GaussMarkov, Ramp, Signal, Sinusoid

_EPSILON = 1e-9

_SENSOR = {
    "outlier_probability": "outliers",
    "noise_time_constant": "coloured noise",
    "noise_degrees": "heavy tails",
    "burst_interval": "bursts",
    "latency": "latency",
    "resolution": "resolution",
}
"""What sensors have that no design foresees, by the number that is not 0 then."""


def violated(scenario: Scenario, request: ArmRequest) -> tuple[str, ...]:
    """Return what a scenario has that the bound of a design does not foresee.

    Dropouts are not among it: what is claimed after them is a covariance, until the certificate
    covers it. Of uncertain parameters all changes within the bounds are foreseen; if the design
    does not certify these, the bound is called "certified but for the learnt parameters". Whether
    a run stays in the domain is seen only when it has been simulated.
    """
    friction, payload, torques = scenario.friction, scenario.payload, scenario.torque_disturbance
    noise, designed = scenario.process_noise, request.process_noise
    uncertain = request.uncertainty
    found = {
        "payload": any(payload.total),
        "backlash": scenario.backlash,
        "torque error": scenario.torque_error,
        "process noise": _is_more(noise.link, designed.link)
        or _is_more(noise.motor, designed.motor),
        "torque disturbance": not all(
            _foresees(getattr(request.torque_disturbance, side), getattr(torques, side))
            for side in SIDES
        ),
        "friction": friction.link_coulomb
        or friction.motor_coulomb
        or _is_more(friction.link_viscous, uncertain.get("link_damping", 0.0))
        or _is_more(friction.motor_viscous, uncertain.get("motor_damping", 0.0)),
        "parameters": any(
            _is_more(abs(theta), uncertain.get(name, 0.0))
            for name, theta in _thetas(scenario.mismatch, request.arm).items()
        ),
    }
    for asked, output in zip(request.sensors, scenario.outputs, strict=True):
        sensor = output.sensor
        for name, holds in (
            ("disturbance", not _foresees(asked.disturbance, output.disturbance)),
            ("noise", _is_more(sensor.noise_std, asked.measurement_std)),
            *((name, getattr(sensor, number)) for number, name in _SENSOR.items()),
        ):
            found[name] = found.get(name) or holds
    return tuple(sorted(name for name, holds in found.items() if holds))


def _thetas(mismatch: Mismatch, arm: ElasticJointArm) -> dict[str, float]:
    """Return the changes of uncertain parameters that a mismatch is."""
    return {
        "stiffness": mismatch.stiffness,
        "gravity": mismatch.gravity_torque if arm.gravity_torque else 0.0,
        "link_damping": mismatch.link_damping * arm.link_damping,
        "motor_damping": mismatch.motor_damping * arm.motor_damping,
        "link_inverse_inertia": 1.0 / (1.0 + mismatch.link_inertia) - 1.0,
        "motor_inverse_inertia": 1.0 / (1.0 + mismatch.motor_inertia) - 1.0,
    }


def _foresees(terms: Sequence[DisturbanceTerm], components: Iterable[Signal]) -> bool:
    """Return whether terms of a design have a place for each of some components."""
    drifts = list(terms)
    for component in components:
        drifting = isinstance(component, GaussMarkov)
        fitting = [term for term in (drifts if drifting else terms) if _fits(component, term)]
        if not fitting:
            return False
        if drifting:
            drifts.remove(fitting[0])  # one drift per term
    return True


def _fits(component: Signal, term: DisturbanceTerm) -> bool:
    match component:
        case BiasStep(start=start):
            return start <= 0.0 and term.kind in ("bias", "ramp")
        case Ramp(start=start):
            return start <= 0.0 and term.kind == "ramp"
        case Sinusoid(frequency=frequency, start=start):
            return start <= 0.0 and term.get("frequency") == frequency
        case GaussMarkov(std=std, time_constant=time) if term.kind == "gauss_markov":
            return term["time_constant"] == time and not _is_more(std, term["std"])
        case GaussMarkov(std=std, time_constant=time) if term.kind in ("bias", "ramp"):
            return time == WALK and not _is_more(2.0 * std * std / time, term["density"])
    return False


def _is_more(value: float, limit: float) -> bool:
    return value > limit * (1.0 + _EPSILON)
