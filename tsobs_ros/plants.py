# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenarios made from requests, so that nobody has to type an arm or a system twice."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import as_matrix, check_names, finite
from tsobs_ros.design.file import FilePath, load_request, parse_design
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.simulation.plant import Mismatch, Scenario, SystemScenario, TorqueDisturbance
from tsobs_ros.simulation.sensor import Sensor, SimulatedOutput
from tsobs_ros.simulation.signals import Signal, Sine
from tsobs_ros.yaml_files import read_yaml

TORQUES = tuple(f"{side}_torque" for side in TorqueDisturbance._fields)
"""Names of the torques that disturb an arm."""

EFFORT_ERROR = "effort_error"
"""Name of the difference between the reported and the applied torque of an arm."""


def request_in(path: FilePath) -> ArmRequest | TSRequest:
    """Return the request in a request or design file; a design's certificate is not judged.

    Raises:
        DesignFileError: The file is missing, not YAML, or neither of these.

    >>> from tsobs_ros.resources import config_path
    >>> request_in(config_path("elastic_joint.design.yaml")).rate
    200.0
    """
    return parse_design(path).request if "format" in read_yaml(path) else load_request(path)


def scenario_of(
    request: ArmRequest | TSRequest,
    mismatch: Mapping[str, float] | None = None,
    *,
    initial_state: ArrayLike | None = None,
    excitation: Signal | None = None,
    signals: Mapping[str, Sequence[Any]] | None = None,
    noise_factor: float = 1.0,
    process_noise_factor: float = 1.0,
    **others: Any,
) -> Scenario | SystemScenario:
    """Return a scenario with a request's plant, outputs, noise and rate, and with given changes.

    Args:
        request: The plant, its outputs, noise and rate.
        mismatch: Relative changes of the true arm, by the names of `Mismatch`, or θ of the true T–S
            system.
        initial_state: Physical state at the start.
        excitation: Signal of every input, sin t if None; scheduled signals are 0.
        signals: Signals by name: for an output, the components of its disturbance and mappings
            with numbers of its sensor; for an input or scheduled signal, its signals, of which the
            last counts; for an arm, the components of `TORQUES` and of `EFFORT_ERROR`.
        noise_factor: Factor on the sensors' designed noise.
        process_noise_factor: Factor on the densities of the process noise.
        **others: Other fields of the scenario.

    Raises:
        ModelError: A name is unknown, or a number out of range.

    >>> scenario_of(ArmRequest(), {"stiffness": 0.2}).true_arm.stiffness
    12.0
    """
    changes, given = mismatch or {}, signals or {}
    names, own = request.output_names, dict[str, Any]()
    make: type[Scenario | SystemScenario]
    if isinstance(request, ArmRequest):
        check_names("mismatch", changes, [item.name for item in fields(Mismatch)])
        make, density = Scenario, request.process_noise
        own["arm"], own["mismatch"] = request.arm, Mismatch(**changes)
        own["process_noise"] = replace(
            density,
            link=density.link * process_noise_factor,
            motor=density.motor * process_noise_factor,
        )
        own["torque"] = request.torque
        torques = (tuple(given.get(name, ())) for name in TORQUES)
        own["torque_disturbance"] = TorqueDisturbance(*torques)
        own["torque_error"] = tuple(given.get(EFFORT_ERROR, ()))
        if initial_state is not None:
            start = request.arm.from_physical(as_matrix("initial_state", initial_state, (4,)))
            own["initial_state"], own["initial_spread"] = tuple(start.tolist()), (0.0,) * 4
        delays = [each.delay for each in request.sensors]
    else:
        make, model, uncertain = SystemScenario, request.model, request.uncertainty_model
        check_names("mismatch", changes, uncertain.names)
        change = np.zeros(model.rates.shape)
        for name, theta in changes.items():
            direction = uncertain.directions[uncertain.names.index(name)]
            change += finite(f"mismatch {name}", theta) * direction
        own["model"], own["true_rates"] = model, model.rates + change
        own["process_noise"] = np.asarray(request.process_noise) * process_noise_factor
        own["initial_state"] = initial_state
        # A scheduled signal with the name of an output is the measured value of that output.
        own["fed_back"] = tuple(
            names.index(name) if name in names else None
            for name in request.input_names[model.input_count :]
        )
        delays = [0.0] * len(names)
    scheduled = len(own.get("fed_back", ()))
    free = [excitation or Sine()] * (len(request.input_names) - scheduled)
    # If an output is an input too, its signals disturb its measured value.
    chosen = {name: each[-1] for name, each in given.items() if each and name not in names}
    own["inputs"] = tuple(map(chosen.get, request.input_names, [*free, *[Signal()] * scheduled]))
    own["outputs"] = ()
    for name, std, delay in zip(names, request.output_std.tolist(), delays, strict=True):
        numbers: dict[str, Any] = {"noise_std": std * noise_factor}
        for each in given.get(name, ()):
            numbers |= {} if isinstance(each, Signal) else each
        faults = tuple(each for each in given.get(name, ()) if isinstance(each, Signal))
        own["outputs"] += (SimulatedOutput(name, Sensor(**numbers), faults, delay),)
    return make(**{"rate": request.rate, **own, **others})
