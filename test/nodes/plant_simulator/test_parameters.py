# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters describe a plant or are refused, and inject faults while it runs."""

from typing import Any

import pytest
from rclpy.parameter import Parameter

from tsobs_ros.errors import ParameterError
from tsobs_ros.nodes.parameters import ParameterBinding
from tsobs_ros.nodes.plant_simulator import create
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters
from tsobs_ros.simulation.integrator import Friction
from tsobs_ros.simulation.plant import SimulatedOutput
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import Constant, Pulses


def test_faults_are_injected_by_parameters_while_running(listener: Any) -> None:
    node = listener.start()
    listener.wait_for(listener.disturbances, 20)
    (result,) = node.set_parameters([Parameter("disturbance.kind", value="bias_step")])
    assert result.successful
    listener.wait_until(lambda: listener.disturbances[-1].message.position[0] == 0.1, "the bias")
    node.set_parameters([Parameter("disturbance.bias_step.amplitude", value=-0.3)])
    listener.wait_until(
        lambda: listener.disturbances[-1].message.position[0] == -0.3, "the other bias"
    )
    (refused,) = node.set_parameters([Parameter("disturbance.kind", value="offset")])
    assert "got 'offset'" in refused.reason
    node.set_parameters([Parameter("disturbance.kind", value="none")])
    listener.wait_until(lambda: listener.disturbances[-1].message.position[0] == 0.0, "the end")
    values = [item.message.position[0] for item in listener.disturbances]
    assert set(values) == {0.0, 0.1, -0.3}
    # Neither the motion nor the white noise knows of the fault.
    index = {s.physical[0].item(): s for s in listener.core(5000)}
    assert all(item.message.position[0] in index for item in listener.states)


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        ({"rate": -1.0}, "rate"),
        ({"initial_state": [0.1, 0.2]}, "initial_state: expected 4"),
        ({"mismatch__stiffness": -1.0}, "mismatch stiffness"),
        ({"arm__link_inertia": 0.0}, "link_inertia"),
        ({"excitation__kind": "triangle"}, "excitation.kind"),
        ({"joint": ""}, "joint"),
        ({"disturbance__gauss_markov__time_constant": -1.0}, "gauss_markov time_constant"),
        ({"excitation__frequency": 0.0}, "sine frequency"),
    ],
)
def test_senseless_overrides_are_refused(ros: Any, overrides: dict[str, Any], reason: str) -> None:
    parameters = [Parameter(name.replace("__", "."), value=v) for name, v in overrides.items()]
    with pytest.raises(ParameterError, match=reason):
        create(context=ros.context, parameter_overrides=parameters)


def test_parameters_describe_arms_sensors_and_torques_that_no_design_foresees(ros: Any) -> None:
    given: dict[str, Any] = {
        "noise_std": 0.05,
        "latency": 0.015,
        "resolution": 0.006,
        "friction.link_viscous": 0.1,
        "friction.link_coulomb": 0.05,
        "friction.motor_viscous": 0.3,
        "friction.motor_coulomb": 0.15,
        "excitation.kind": "constant",
        "excitation.amplitude": 4.5,
        "disturbance.kind": "pulses",
        "disturbance.pulses.amplitude": 0.4,
        "disturbance.pulses.start": 3.0,
        "disturbance.pulses.duration": 0.7,
        "disturbance.pulses.interval": 6.0,
        "noise.time_constant": 0.04,
        "noise.degrees_of_freedom": 3,
        "noise.burst_interval": 7.0,
        "noise.burst_duration": 1.2,
        "noise.burst_factor": 5.0,
        "outliers.probability": 0.02,
        "outliers.size": 3.0,
        "outliers.uniform": True,
        "dropouts.interval": 9.0,
        "dropouts.duration": 0.3,
        "effort_error.amplitude": 50.0,
        "effort_error.start": 2.0,
        "effort_error.duration": 0.01,
        "effort_error.interval": 4.0,
    }
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = ros.node(
        "described",
        parameter_overrides=overrides,
        automatically_declare_parameters_from_overrides=True,
    )
    (scenario,) = ParameterBinding(node, PlantSimulatorParameters).value.scenarios().values()
    sensor = Sensor(
        noise_std=0.05,
        outlier_probability=0.02,
        outlier_size=3.0,
        dropout_interval=9.0,
        dropout_duration=0.3,
        outlier_is_uniform=True,
        noise_time_constant=0.04,
        noise_degrees=3,
        burst_interval=7.0,
        burst_duration=1.2,
        burst_factor=5.0,
        latency=0.015,
        resolution=0.006,
    )
    assert scenario.signals.outputs == (
        SimulatedOutput("link_angle", sensor, (Pulses(0.4, 3.0, 0.7, 6.0),)),
    )
    assert scenario.friction == Friction(0.1, 0.05, 0.3, 0.15)
    assert scenario.excitation == Constant(4.5)
    assert scenario.torque_error == (Pulses(50.0, 2.0, 0.01, 4.0),)
    (default,) = PlantSimulatorParameters().scenarios().values()
    assert default.torque_error == ()
