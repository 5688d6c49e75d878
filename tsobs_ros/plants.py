# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenarios of what a request describes, so that nobody types an arm or a system twice."""

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from tsobs_ros.checks import check_names, finite
from tsobs_ros.design.file import FilePath, load_request, parse_design
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.simulation.plant import Mismatch, Scenario
from tsobs_ros.simulation.sensor import Sensor, SimulatedOutput
from tsobs_ros.simulation.signals import NoTorque, Sine
from tsobs_ros.simulation.systems import SystemScenario
from tsobs_ros.yaml_files import read_yaml


def request_in(path: FilePath) -> ArmRequest | TSRequest:
    """Return the request in a file, which is one or a design; its certificate is not needed.

    Raises:
        DesignFileError: The file is missing, not YAML, or neither.

    >>> from tsobs_ros.resources import config_path
    >>> request_in(config_path("elastic_joint.design.yaml")).rate
    200.0
    """
    return parse_design(path).request if "format" in read_yaml(path) else load_request(path)


def scenario_of(
    request: ArmRequest | TSRequest, mismatch: Mapping[str, float] | None = None
) -> Scenario | SystemScenario:
    """Return a scenario with a request's plant, outputs, noise and rate.

    An arm's torque and the inputs of a T–S system are sin t, scheduled signals 0. `mismatch` has
    relative changes of the true arm, by the names of `Mismatch`, or θ of the true T–S system.

    Raises:
        ModelError: A name is unknown, or a number out of range.

    >>> scenario_of(ArmRequest(), {"stiffness": 0.2}).true_arm.stiffness
    12.0
    """
    if isinstance(request, ArmRequest):
        return _of_arm(request, mismatch or {})
    return _of_system(request, mismatch or {})


def _of_arm(request: ArmRequest, mismatch: Mapping[str, float]) -> Scenario:
    check_names("mismatch", mismatch, [item.name for item in fields(Mismatch)])
    return Scenario(
        arm=request.arm,
        mismatch=Mismatch(**mismatch),
        rate=request.rate,
        process_noise=request.process_noise,
        outputs=tuple(
            SimulatedOutput(
                output.measures, Sensor(noise_std=output.measurement_std), delay=output.delay
            )
            for output in request.sensors
        ),
        torque=request.torque,
    )


def _of_system(request: TSRequest, mismatch: Mapping[str, float]) -> SystemScenario:
    model, uncertain = request.model, request.uncertainty_model
    check_names("mismatch", mismatch, uncertain.names)
    change, names = np.zeros(model.rates.shape), request.output_names
    for name, theta in mismatch.items():
        direction = uncertain.directions[uncertain.names.index(name)]
        change += finite(f"mismatch {name}", theta) * direction
    stds = np.asarray(request.measurement_std).tolist()
    return SystemScenario(
        model,
        model.rates + change,
        tuple(
            SimulatedOutput(name, Sensor(noise_std=std))
            for name, std in zip(names, stds, strict=True)
        ),
        (Sine(),) * model.input_count + (NoTorque(),) * model.schedule.shape[1],
        # A scheduled signal that has the name of an output is that output as it is measured.
        tuple(
            names.index(name) if name in names else None
            for name in request.input_names[model.input_count :]
        ),
        np.asarray(request.process_noise),
        request.rate,
    )
