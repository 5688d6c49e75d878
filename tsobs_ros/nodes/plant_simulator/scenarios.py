# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios of a plant simulator's joints, from its parameters and their design files."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.nodes.plant_simulator.entries import (
    Entry,
    component,
    entries_of,
    excitation,
    number,
)
from tsobs_ros.plants import scenario_of
from tsobs_ros.simulation.integrator import Payload
from tsobs_ros.simulation.plant import (
    Mismatch,
    Scenario,
    SimulatedOutput,
    TorqueDisturbance,
)
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.systems import SystemScenario

if TYPE_CHECKING:
    from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters

Named = Mapping[str, list[Entry]]
"""Entries of one joint by what they name."""

_TORQUES = {"motor_torque": "motor", "link_torque": "link"}
"""Names of an arm's torques in `signals`, and their sides."""


def scenarios_of(parameters: "PlantSimulatorParameters") -> dict[str, Scenario | SystemScenario]:
    """Return what parameters describe, by joint.

    Raises:
        ModelError: They do not describe a plant.
        ParameterError: An entry of a list names no signal of the joints.
    """
    requests = parameters.requests

    def outputs(joint: str) -> tuple[str, ...]:
        return tuple(requests[joint].output_names)

    def signals(joint: str) -> tuple[str, ...]:
        torques = tuple(_TORQUES) if isinstance(requests[joint], ArmRequest) else ()
        return (*outputs(joint), *requests[joint].input_names, *torques)

    def changes(joint: str) -> tuple[str, ...]:
        request = requests[joint]
        if isinstance(request, ArmRequest):
            return tuple(item.name for item in fields(Mismatch))
        return request.uncertainty_model.names

    given = _by_joint("signals", parameters.signals, requests, signals)
    changed = _by_joint("joint_mismatch", parameters.joint_mismatch, requests, changes)
    chosen = [f"{name}: true" for name in parameters.affected]
    affected = _by_joint("affected", chosen, requests, outputs)
    starts = _states("initial_state", parameters)
    spreads = _states("initial_spread", parameters)
    found = {}
    for joint, path in parameters.design_of.items():
        mismatch = {name: number(each[-1]) for name, each in changed[joint].items()}
        base: Scenario | SystemScenario
        if path:
            request = requests[joint]
            if isinstance(request, ArmRequest):
                mismatch = {
                    name: getattr(parameters.mismatch, name) for name in changes(joint)
                } | mismatch
            base = scenario_of(request, mismatch)
        else:
            base = _own_arm(parameters, mismatch)
        own: dict[str, Any] = {
            "rate": parameters.sample_rate,
            "duration": parameters.duration,
            "outputs": tuple(
                _output(
                    parameters, each, given[joint], not chosen or each.measures in affected[joint]
                )
                for each in base.signals.outputs
            ),
            "initial_state": starts[joint],
            "initial_spread": spreads[joint],
        }
        if isinstance(base, SystemScenario):
            own |= _of_system(parameters, joint, base, given[joint])
        else:
            own |= _of_arm(parameters, joint, base, given[joint])
            for name in ("initial_state", "initial_spread"):
                own[name] = tuple(base.arm.from_physical(own[name]).tolist())
        found[joint] = replace(base, **own)
    return found


def _own_arm(parameters: "PlantSimulatorParameters", mismatch: Mapping[str, float]) -> Scenario:
    densities = parameters.process_noise
    return Scenario(
        arm=parameters.arm,
        mismatch=replace(parameters.mismatch, **mismatch),
        process_noise=ProcessNoise(
            link=densities.link_acceleration_density,
            motor=densities.motor_acceleration_density,
        ),
        sensor=Sensor(parameters.noise_std),
    )


def _output(
    parameters: "PlantSimulatorParameters",
    output: SimulatedOutput,
    signals: Named,
    is_affected: bool,
) -> SimulatedOutput:
    """Return an output with the sensor and the disturbance that the parameters give it."""
    own = tuple(map(component, signals.get(output.measures, ())))
    if not is_affected:
        return replace(output, disturbance=own)
    return SimulatedOutput(
        output.measures,
        parameters.sensor(output.sensor.noise_std),
        parameters.disturbance.build() + own,
    )


def _of_arm(
    parameters: "PlantSimulatorParameters", joint: str, base: Scenario, signals: Named
) -> dict[str, Any]:
    """Return what only the scenario of an arm has."""
    excited = parameters.excitation.build()
    for name in parameters.requests[joint].input_names:
        if name in signals:
            excited = excitation(signals[name][-1])
    torques = {
        side: tuple(map(component, signals.get(name, ()))) for name, side in _TORQUES.items()
    }
    payload = parameters.payload
    noise, factor = base.process_noise, parameters.process_noise.factor
    return {
        "process_noise": ProcessNoise(noise.link * factor, noise.motor * factor),
        "friction": parameters.friction,
        "payload": payload.build() if joint in (payload.joints or (joint,)) else Payload(),
        "excitation": excited,
        "torque_disturbance": TorqueDisturbance(**torques),
        "torque_error": (parameters.effort_error,) if parameters.effort_error.amplitude else (),
        "sensor": Sensor(),
    }


def _of_system(
    parameters: "PlantSimulatorParameters", joint: str, base: SystemScenario, signals: Named
) -> dict[str, Any]:
    """Return what only the scenario of a T–S system has."""
    names, measured = (
        parameters.requests[joint].input_names,
        [each.measures for each in base.outputs],
    )
    m = base.model.input_count
    free = (parameters.excitation.build(),) * m + base.inputs[m:]
    return {
        "process_noise": np.asarray(base.process_noise) * parameters.process_noise.factor,
        "inputs": tuple(
            excitation(signals[name][-1]) if name in signals and name not in measured else own
            for name, own in zip(names, free, strict=True)
        ),
    }


def _states(name: str, parameters: "PlantSimulatorParameters") -> dict[str, tuple[float, ...]]:
    """Return the numbers of a parameter that each joint's states get."""
    values: tuple[float, ...] = getattr(parameters, name)
    designed = {joint: bool(path) for joint, path in parameters.design_of.items()}
    sizes = [len(request.state_names) for request in parameters.requests.values()]
    if values == getattr(type(parameters), name) and any(designed.values()):
        own = [
            (0.0,) * n if is_designed else values
            for n, is_designed in zip(sizes, designed.values(), strict=True)
        ]
    elif len(values) == sum(sizes):
        ends = np.cumsum(sizes).tolist()
        own = [values[end - n : end] for end, n in zip(ends, sizes, strict=True)]
    elif set(sizes) == {len(values)}:
        own = [values] * len(sizes)
    elif set(sizes) == {4}:
        raise ModelError(f"{name}: expected four numbers, or four a joint, got {values}")
    else:
        expected = " + ".join(map(str, sizes))
        raise ModelError(f"{name}: expected {expected} numbers, got {len(values)}")
    return dict(zip(designed, own, strict=True))


def _by_joint(
    parameter: str,
    lines: Iterable[str],
    joints: Iterable[str],
    names: Callable[[str], Iterable[str]],
) -> dict[str, dict[str, list[Entry]]]:
    """Return the entries of a list by joint and by what they name."""
    found: dict[str, dict[str, list[Entry]]] = {joint: {} for joint in joints}
    known = {f"{joint}/{name}": (joint, name) for joint in found for name in names(joint)}
    if len(found) == 1:
        known |= {name: (joint, name) for joint, name in known.values()}
    for entry in entries_of(parameter, lines):
        if entry.target not in known:
            raise ParameterError(
                f"{entry.where}: expected one of {', '.join(known)}, got {entry.target!r}"
            )
        joint, name = known[entry.target]
        found[joint].setdefault(name, []).append(entry)
    return found
