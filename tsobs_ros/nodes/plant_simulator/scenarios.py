# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scenarios of a plant simulator's joints, from its parameters and their design files."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, fields, replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from tsobs_ros.checks import finite, shown
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.model.arm import SIDES
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.nodes.plant_simulator.torque_file import PLAYED
from tsobs_ros.plants import scenario_of
from tsobs_ros.simulation.integrator import Payload
from tsobs_ros.simulation.plant import Mismatch, Scenario, TorqueDisturbance
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import KINDS, Signal, signal_of
from tsobs_ros.simulation.systems import SystemScenario
from tsobs_ros.yaml_files import load_yaml

if TYPE_CHECKING:
    from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters

Readers = Mapping[str, Callable[[Any], Any]]
"""What an entry may name of one joint, each with the function that reads the entry's value."""


def scenarios_of(parameters: "PlantSimulatorParameters") -> dict[str, Scenario | SystemScenario]:
    """Return what parameters describe, by joint.

    Raises:
        ModelError: They do not describe a plant.
        ParameterError: An entry of a list names no signal of the joints.
    """
    signals: dict[str, Readers] = {}
    changes: dict[str, Readers] = {}
    outputs: dict[str, Readers] = {}
    for joint, request in parameters.requests.items():
        torques, uncertain = [f"{side}_torque" for side in SIDES], fields(Mismatch)
        is_arm = isinstance(request, ArmRequest)
        disturbed = (*request.output_names, *(torques if is_arm else ()))
        signals[joint] = {
            name: partial(signal_of, KINDS if name in disturbed else PLAYED)
            for name in (*request.output_names, *request.input_names, *disturbed)
        }
        names = [each.name for each in uncertain] if is_arm else request.uncertainty_model.names
        changes[joint] = {name: partial(finite, "value") for name in names}
        outputs[joint] = dict.fromkeys(request.output_names, bool)
    given = _by_joint("signals", parameters.signals, signals)
    changed = _by_joint("joint_mismatch", parameters.joint_mismatch, changes)
    chosen = [f"{name}: true" for name in parameters.affected]
    affected = _by_joint("affected", chosen, outputs)
    starts, spreads = (_states(parameters, name) for name in ("initial_state", "initial_spread"))
    return {
        joint: _scenario(
            parameters,
            joint,
            {name: each[-1] for name, each in changed[joint].items()},
            given[joint],
            affected[joint] if chosen else outputs[joint],
            {"initial_state": starts[joint], "initial_spread": spreads[joint]},
        )
        for joint in parameters.requests
    }


def _scenario(
    parameters: "PlantSimulatorParameters",
    joint: str,
    mismatch: dict[str, float],
    signals: Mapping[str, list[Signal]],
    affected: Iterable[str],
    states: dict[str, Any],
) -> Scenario | SystemScenario:
    """Return the scenario of one joint: that of its request, with what the parameters change."""
    request, factor = parameters.requests[joint], parameters.process_noise.factor
    common = asdict(parameters.mismatch) if isinstance(request, ArmRequest) else {}
    base = scenario_of(request, common | mismatch)
    outputs = []
    for output in base.signals.outputs:
        sensor, disturbance = output.sensor, tuple(signals.get(output.measures, ()))
        if not parameters.design_of[joint]:
            sensor = replace(sensor, noise_std=parameters.noise_std)
        if output.measures in affected:
            sensor = parameters.sensor(sensor.noise_std)
            disturbance = parameters.disturbance.build() + disturbance
        outputs.append(replace(output, sensor=sensor, disturbance=disturbance))
    own: dict[str, Any] = {"rate": parameters.sample_rate, "duration": parameters.duration}
    own["outputs"] = tuple(outputs)
    count = base.signals.input_count
    free = (parameters.excitation.build(),) * count + base.signals.inputs[count:]
    inputs = tuple(
        signals[name][-1] if name in signals and name not in request.output_names else default
        for name, default in zip(request.input_names, free, strict=True)
    )
    if isinstance(base, SystemScenario):
        noise = np.asarray(base.process_noise) * factor
        return replace(base, **own, **states, process_noise=noise, inputs=inputs)
    payload, error, density = parameters.payload, parameters.effort_error, base.process_noise
    torques = {side: tuple(signals.get(f"{side}_torque", ())) for side in SIDES}
    own |= {name: tuple(base.arm.from_physical(each).tolist()) for name, each in states.items()}
    return replace(
        base,
        **own,
        process_noise=ProcessNoise(density.link * factor, density.motor * factor),
        friction=parameters.friction,
        payload=payload.build() if joint in (payload.joints or (joint,)) else Payload(),
        excitation=inputs[0],
        torque_disturbance=TorqueDisturbance(**torques),
        torque_error=(error,) if error.amplitude else (),
        sensor=Sensor(),
    )


def _states(parameters: "PlantSimulatorParameters", name: str) -> dict[str, tuple[float, ...]]:
    """Return the numbers of a parameter that each joint's states get."""
    values: tuple[float, ...] = getattr(parameters, name)
    sizes = {joint: len(each.state_names) for joint, each in parameters.requests.items()}
    if values == getattr(type(parameters), name):
        designed = parameters.design_of
        return {joint: (0.0,) * n if designed[joint] else values for joint, n in sizes.items()}
    if len(values) == sum(sizes.values()):
        numbers = iter(values)
        return {joint: tuple(islice(numbers, n)) for joint, n in sizes.items()}
    if set(sizes.values()) == {len(values)}:
        return dict.fromkeys(sizes, values)
    expected = " + ".join(map(str, sizes.values()))
    raise ModelError(f"{name}: expected {expected} numbers, got {len(values)}")


def _by_joint(
    parameter: str, lines: Iterable[str], readers: Mapping[str, Readers]
) -> dict[str, dict[str, list[Any]]]:
    """Return the values of a list parameter by joint and by what they are about.

    ROS parameters hold lists of texts only, so an entry is a line of YAML:
    "elbow/motor_angle: {kind: ramp}", without "elbow/" if there is one joint.
    """
    found: dict[str, dict[str, list[Any]]] = {joint: {} for joint in readers}
    known = {f"{joint}/{name}": (joint, name) for joint, own in readers.items() for name in own}
    if len(found) == 1:
        known |= {name: (joint, name) for joint, name in known.values()}
    for place, line in enumerate(lines):
        where = f"parameter '{parameter}[{place}]'"
        try:
            data = load_yaml(line)
        except ValueError as error:
            raise ParameterError(f"{where}: not valid YAML: {error}") from error
        if not isinstance(data, dict) or len(data) != 1:
            raise ParameterError(f"{where}: expected one 'name: value', got {shown(line)}")
        ((target, value),) = data.items()
        if target not in known:
            expected = ", ".join(known)
            raise ParameterError(f"{where}: expected one of {expected}, got {str(target)!r}")
        joint, name = known[target]
        try:
            found[joint].setdefault(name, []).append(readers[joint][name](value))
        except (ModelError, ValueError) as error:
            raise ParameterError(f"{where}: {target}: {error}") from error
    return found
