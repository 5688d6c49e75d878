# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The runs of a campaign, drawn by their numbers, and the premises of the bound they violate."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.campaign.definition import Campaign, ScenarioEntries
from tsobs_ros.checks import check_names, non_negative
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import SIDES, ElasticJointArm
from tsobs_ros.plants import EFFORT_ERROR, TORQUES, scenario_of
from tsobs_ros.schema import decode, within
from tsobs_ros.simulation.plant import Friction, Mismatch, Scenario
from tsobs_ros.simulation.sensor import sensor_numbers
from tsobs_ros.simulation.signals import (
    EXCITATIONS,
    KINDS,
    BiasStep,
    GaussMarkov,
    Ramp,
    Signal,
    Sinusoid,
    signal_of,
)

Choose = Callable[[float, float], float]
"""Chooses a number from a range."""

WALK = 1e6
"""Time constant of a drift that acts as a random walk over the length of a run [s]."""

_EPSILON = 1e-9

_SENSOR = {
    "outlier_probability": "outliers",
    "noise_time_constant": "coloured noise",
    "noise_degrees": "heavy tails",
    "burst_interval": "bursts",
    "latency": "latency",
    "resolution": "resolution",
}
"""Effects in sensors that no design foresees, by the number that is not 0 if they act."""

_SEEDS = 2**53
"""Seeds of runs are below this limit, so that every program can read them."""

_INERTIAS = {"link_inverse_inertia": "link_inertia", "motor_inverse_inertia": "motor_inertia"}
_NUMBERS = {"gravity": "gravity_torque", **_INERTIAS}
"""Names of an arm's numbers by uncertain parameter, if the two names differ."""


class Drawn(NamedTuple):
    """A run before it is simulated.

    Attributes:
        run: Its number.
        name: Name of its scenario in the campaign.
        seed: Seed of its simulation.
        scenario: Scenario to simulate.
        theta: True changes of the design's uncertain parameters, by name.
        numbers: Numbers drawn from ranges, by the paths of the entries.
    """

    run: int
    name: str
    seed: int
    scenario: Scenario
    theta: dict[str, float]
    numbers: dict[str, float]


def draw_group(campaign: Campaign, begin: int, end: int) -> list[Drawn]:
    """Return the runs from `begin` up to `end`, or fewer, that share all numbers drawn from ranges.

    Raises:
        TsobsError: An entry of their scenario is unknown, out of range or does not fit the design.
    """
    repeats = campaign.entries.repeats
    group = begin // repeats
    end = min(end, (group + 1) * repeats)
    sequence = np.random.SeedSequence(campaign.entries.seed, spawn_key=(group,))
    random = np.random.Generator(np.random.Philox(sequence))
    seeds = random.integers(_SEEDS, size=repeats).tolist()
    name = campaign.turns[group % len(campaign.turns)]
    drawn = _drawn(campaign, name, random, random.uniform)
    return [Drawn(run, name, seeds[run - group * repeats], *drawn) for run in range(begin, end)]


def check(campaign: Campaign) -> None:
    """Refuse a campaign with a scenario that cannot be drawn, at either end of its ranges.

    Raises:
        TsobsError: An entry is unknown, out of range or does not fit the design.
    """
    random = np.random.default_rng(0)
    for name in campaign.entries.scenarios:
        for end in (min, max):
            _drawn(campaign, name, random, end)


def _drawn(
    campaign: Campaign, name: str, random: np.random.Generator, choose: Choose
) -> tuple[Scenario, dict[str, float], dict[str, float]]:
    entries, request = campaign.entries, campaign.design.arm_request
    data = {
        "uncertainty": entries.uncertainty,
        "initial_state": entries.initial_state,
        "excitation": entries.excitation,
        **entries.scenarios[name],
    }
    numbers: dict[str, float] = {}
    with within(f"scenarios.{name}"):
        given = decode(_filled(data, "", choose, numbers), ScenarioEntries)
        share = non_negative("uncertainty", given.uncertainty)
        theta = {}
        for parameter, bound in request.uncertainty.items():
            theta[parameter] = share * bound * choose(-1.0, 1.0)
            if parameter.endswith("damping"):  # a damping is not negative
                theta[parameter] = max(theta[parameter], -getattr(request.arm, parameter))
        scenario = _scenario(request, given, theta, random, entries.duration)
    return scenario, theta, numbers


def _filled(data: Any, path: str, choose: Choose, numbers: dict[str, float]) -> Any:
    """Return plain data with a number drawn in the place of each range."""
    if isinstance(data, dict):
        return {
            name: _filled(value, f"{path}.{name}".removeprefix("."), choose, numbers)
            for name, value in data.items()
        }
    if not isinstance(data, list):
        return data
    if len(data) == 2 and all(isinstance(each, int | float) for each in data):
        least, most = map(float, data)
        if not (math.isfinite(most - least) and least <= most):
            raise ModelError(f"{path}: expected a range [least, most], got {data}")
        numbers[path] = choose(least, most)
        return numbers[path]
    return [_filled(value, f"{path}[{place}]", choose, numbers) for place, value in enumerate(data)]


def _scenario(
    request: ArmRequest,
    given: ScenarioEntries,
    theta: Mapping[str, float],
    random: np.random.Generator,
    duration: float,
) -> Scenario:
    mismatch, friction = _true_arm(request.arm, given, theta)
    signals: dict[str, list[Any]] = {EFFORT_ERROR: _signals("torque_error", given.torque_error)}
    for side, torque in zip(SIDES, TORQUES, strict=True):
        signals[torque] = _designed(getattr(request.torque_disturbance, side), given, random)
        signals[torque] += _signals(torque, getattr(given, torque))
    check_names("outputs", given.outputs, request.output_names)
    for place, asked in enumerate(request.sensors):
        own = signals[asked.measures] = _designed(asked.disturbance, given, random)
        for entries in (given if place == 0 else None, given.outputs.get(asked.measures)):
            if entries is not None:
                own += _signals("disturbance", entries.disturbance)
                with within("sensor"):
                    own.append(sensor_numbers(entries.sensor))
    with within("excitation"):
        excitation = signal_of(EXCITATIONS, given.excitation)
    found = scenario_of(
        request,
        mismatch,
        initial_state=given.initial_state,
        excitation=excitation,
        signals=signals,
        noise_factor=given.noise,
        process_noise_factor=given.process_noise * given.process_noise,
        duration=duration,
        friction=friction,
        payload=given.payload,
    )
    assert isinstance(found, Scenario)
    return found


def _signals(name: str, entries: Sequence[dict[str, Any]]) -> list[Any]:
    """Return the signals of entries; `name` is for errors."""
    found = []
    for place, entry in enumerate(entries):
        with within(f"{name}[{place}]"):
            found.append(signal_of(KINDS, entry))
    return found


def _designed(
    terms: Iterable[DisturbanceTerm], given: ScenarioEntries, random: np.random.Generator
) -> list[Any]:
    """Return a disturbance, with its start, as a design's terms describe it, if `as_designed`."""
    found: list[Any] = []
    for term in terms if given.as_designed else ():
        if term.kind in ("bias", "ramp"):
            found.append(BiasStep(term["initial_std"] * random.standard_normal(), 0.0))
            found.append(GaussMarkov(math.sqrt(0.5 * term["density"] * WALK), WALK, 0.0))
        if term.kind == "ramp":
            found.append(Ramp(term["initial_rate_std"] * random.standard_normal(), 0.0))
        if term.kind == "gauss_markov":
            found.append(GaussMarkov(term["std"], term["time_constant"], 0.0))
        if term.kind == "sinusoid":
            sine, cosine = (term["initial_std"] * random.standard_normal(2)).tolist()
            found.append(
                Sinusoid(math.hypot(sine, cosine), term["frequency"], 0.0, math.atan2(sine, cosine))
            )
    return found


def _true_arm(
    arm: ElasticJointArm, given: ScenarioEntries, theta: Mapping[str, float]
) -> tuple[dict[str, float], Friction]:
    """Return mismatch and friction of an arm: the scenario's changes, then those by θ."""
    changes, friction = dict[str, float](), asdict(given.friction)
    for name, value in theta.items():
        if not name.endswith("damping"):
            change = 1.0 / (1.0 + value) - 1.0 if name in _INERTIAS else value
            changes[_NUMBERS.get(name, name)] = change
        elif value >= 0.0:
            friction[f"{name.partition('_')[0]}_viscous"] += value
        else:
            changes[name] = max(value / getattr(arm, name), math.nextafter(-1.0, 0.0))
    mismatch = {
        name: (1.0 + own) * (1.0 + changes.get(name, 0.0)) - 1.0
        for name, own in asdict(given.mismatch).items()
    }
    return mismatch, Friction(**friction)


def violated(scenario: Scenario, request: ArmRequest) -> tuple[str, ...]:
    """Return the properties of a scenario that the bound of a design does not foresee.

    Dropouts are not among them: the claimed bound after a dropout is a covariance, until the
    certificate covers it again. All changes of uncertain parameters within their bounds are
    foreseen; if the design does not certify them, the bound is called "certified but for the learnt
    parameters". Only a simulation shows whether a run stays in the domain.
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
    """Return the changes of uncertain parameters that are equivalent to a mismatch."""
    return {
        "stiffness": mismatch.stiffness,
        "gravity": mismatch.gravity_torque if arm.gravity_torque else 0.0,
        "link_damping": mismatch.link_damping * arm.link_damping,
        "motor_damping": mismatch.motor_damping * arm.motor_damping,
        "link_inverse_inertia": 1.0 / (1.0 + mismatch.link_inertia) - 1.0,
        "motor_inverse_inertia": 1.0 / (1.0 + mismatch.motor_inertia) - 1.0,
        "torque_gain": mismatch.torque_gain,
    }


def _foresees(terms: Sequence[DisturbanceTerm], components: Iterable[Signal]) -> bool:
    """Return whether terms of a design cover each of some components."""
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
