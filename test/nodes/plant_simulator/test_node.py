# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulator publishes its core's numbers bit for bit, at exact stamps, by any clock."""

import itertools
import os
from collections.abc import Callable
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from staging import start, to_stamp

from tsobs_ros.errors import ParameterError
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Friction, Payload, SimulatedOutput
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import Constant, Pulses, Ramp

PERIOD = 20_000_000
SECOND = 1_000_000_000


def test_a_command_moves_the_arm_until_its_timeout_and_a_reset_makes_it_as_new(
    ros: Any, listener: Any
) -> None:
    # Time that the node drives itself: the wall clock may stand still for a second on a busy
    # machine, and then the stamps restart.
    listener.start(seed=5, command_timeout=0.1, publish_clock=True)
    received = listener.measurements
    listener.wait_for(received, 20)
    listener.command(2.5)
    efforts = lambda: [item.message.effort[0] for item in received]  # noqa: E731
    ros.spin_until(lambda: 2.5 in efforts() and efforts()[-1] != 2.5, what="the command's timeout")
    first, samples = efforts().index(2.5), listener.core(5000, seed=5)
    assert efforts()[first:] == [2.5] * 5 + efforts()[first + 5 :]
    # The same arm until the sample that applied the command, another one after it.
    assert listener.places(received[: first + 1], samples)[-1] >= 20
    assert received[-1].message.position[0] not in samples

    answer = listener.reset()
    assert (answer.success, answer.message) == (True, "restarted with seed 5")
    early = set(samples[:15])
    restarted = lambda: [  # noqa: E731
        place for place in range(first, len(received))
        if received[place].message.position[0] in early
    ]  # fmt: skip
    ros.spin_until(restarted, what="the restart")
    listener.wait_for(received, 20)
    found = listener.places(received[restarted()[0] :], samples)
    assert found == sorted(set(found))
    assert {(item.stamp - received[0].stamp) % PERIOD for item in received} == {0}


def test_without_subscribers_it_starts_after_the_timeout(ros: Any) -> None:
    node = start(ros, "plant_simulator", wait_for_subscribers=2, wait_timeout=0.3, duration=0.1)
    ros.spin_until(lambda: node.finished, what="a run without subscribers")


def test_a_pace_beyond_the_machine_leaves_services_answered(ros: Any, listener: Any) -> None:
    start(ros, "plant_simulator", rate=5000.0, publish_clock=True, real_time_factor=1000.0)
    assert all(listener.reset().success for _ in range(5))


def test_a_leap_of_the_clock_is_caught_up_with_before_the_next(ros: Any, capfd: Any) -> None:
    clock = ros.node("time").create_publisher(Clock, "/clock", 10)
    node = start(ros, "plant_simulator", use_sim_time=True, rate=5000.0, duration=0.5)
    ros.spin_until(clock.get_subscription_count, what="matching of /clock")
    clock.publish(Clock(clock=to_stamp(50 * SECOND)))
    ros.spin_until(lambda: "started: " in capfd.readouterr().err, what="the start")
    clock.publish(Clock(clock=to_stamp(51 * SECOND)))
    ros.spin_until(lambda: node.finished, what="the end")


def test_driven_clock_starts_at_one_second_leads_the_samples_and_stands_still_with_the_arm(
    ros: Any, listener: Any, manage: Callable[[Any], Any]
) -> None:
    listener.listen_to_clock()
    manager = manage(listener.start(publish_clock=True, duration=1.0))
    listener.wait_for(listener.clock, 10)
    assert manager.change("deactivate")
    paused_at = ros.hear_out(listener.clock)
    ros.spin_for(0.1)
    assert len(listener.clock) == paused_at
    assert manager.change("activate")
    final = SECOND + 50 * PERIOD
    ros.spin_until(lambda: listener.clock[-1] == final, what="the last clock")
    assert all((time - SECOND) % PERIOD == 0 for time in listener.clock)
    assert {b - a for a, b in itertools.pairwise(listener.clock)} == {PERIOD}
    found = listener.places(listener.measurements, listener.core(51))
    assert [item.stamp for item in listener.measurements] == [SECOND + k * PERIOD for k in found]


def test_external_clock_is_followed_and_a_jump_back_restarts(ros: Any, listener: Any) -> None:
    clock = listener.node.create_publisher(Clock, "/clock", 10)
    own = listener.start(use_sim_time=True).get_clock()
    ros.spin_until(clock.get_subscription_count, what="matching of /clock")
    samples = listener.core(1000, of="physical")

    def advance(first: int, count: int) -> list[Any]:
        """Publish the clock in steps of 48 ms, no multiple of the period; return what came."""
        already = len(listener.states)
        for now in range(first, first + count * 48_000_000, 48_000_000):
            clock.publish(Clock(clock=to_stamp(now)))
            ros.spin_until(lambda now=now: own.now().nanoseconds == now, what="the clock")
        ros.spin_until(
            lambda: bool(listener.states) and 0 <= now - listener.states[-1].stamp < PERIOD,
            what="the last one",
        )
        return listener.states[already:]

    assert not listener.states  # before there is a time
    advance(50 * SECOND, 1)
    advance(50 * SECOND, 30)
    came = listener.places(listener.states, samples)
    assert came == list(range(70))
    assert [item.stamp for item in listener.states] == [50 * SECOND + k * PERIOD for k in came]

    again = advance(20 * SECOND, 20)
    assert listener.places(again, samples) == list(range(46))
    assert [item.stamp for item in again] == [20 * SECOND + k * PERIOD for k in range(46)]


def test_after_a_pause_the_arm_goes_on_from_there_with_present_stamps(
    ros: Any, listener: Any, manage: Callable[[Any], Any]
) -> None:
    manager = manage(listener.start())
    listener.wait_for(listener.states, 20)
    assert manager.change("deactivate")
    listener.command(5.0)  # not for an arm that stands still
    arrived = ros.hear_out(listener.states)
    paused_at = listener.states[-1].stamp
    ros.spin_for(0.2)
    assert len(listener.states) == arrived
    assert manager.change("activate")
    listener.wait_for(listener.states, 20)

    found = listener.places(listener.states, listener.core(5000, of="physical"))
    assert found == list(range(found[0], found[0] + len(found)))
    stamps = [item.stamp for item in listener.states]
    assert max(b - a for a, b in itertools.pairwise(stamps)) > SECOND // 5
    assert stamps[-1] > paused_at + SECOND // 5


GIVEN = """
noise_factor: 2.0
friction: {link_viscous: 0.1, link_coulomb: 0.05, motor_viscous: 0.3, motor_coulomb: 0.15}
payload: {mass: 2.0, distance: 0.5, start: 1.0}
excitation: {kind: constant, constant: {amplitude: 4.5}}
disturbance:
  kind: pulses
  pulses: {amplitude: 0.4, start: 3.0, duration: 0.7, interval: 6.0}
sensor: {latency: 0.015, noise_degrees: 3, outlier_probability: 0.02, outlier_is_uniform: true}
signals:
  - "link_angle: {kind: ramp, rate: 0.1}"
  - "link_angle: {dropout_interval: 9.0}"
  - "effort_error: {kind: pulses, amplitude: 50.0, start: 2.0, duration: 0.01, interval: 4.0}"
"""


def test_parameters_describe_arms_sensors_and_torques_that_no_design_foresees(
    ros: Any, tmp_path: Path
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(f"/**:\n  ros__parameters:\n{indent(GIVEN, '    ')}")
    arguments = ["--ros-args", "--params-file", str(file)]
    node = start(ros, "plant_simulator", options={"cli_args": arguments})
    (scenario,) = node.parameters.scenarios.values()
    sensor = Sensor(
        0.056, 0.02, dropout_interval=9.0, outlier_is_uniform=True, noise_degrees=3, latency=0.015
    )
    disturbance = (Pulses(0.4, 3.0, 0.7, 6.0), Ramp(0.1))
    assert scenario.outputs == (SimulatedOutput("link_angle", sensor, disturbance),)
    assert scenario.friction == Friction(0.1, 0.05, 0.3, 0.15)
    assert scenario.payload == Payload(mass=2.0, distance=0.5, start=1.0)
    assert scenario.inputs == (Constant(4.5),)
    assert scenario.torque_error == (Pulses(50.0, 2.0, 0.01, 4.0),)


def test_a_file_s_torques_are_played_and_end_in_none_or_are_refused(
    listener: Any, tmp_path: Path
) -> None:
    file = tmp_path / "motion.csv"
    file.write_text(
        "# 50 Hz\ntime [s],torque [N m],angle [rad]\n0,1.5,0\n0.08,-2.0,0\n0.16,0.5,0\n"
    )
    listener.start(excitation__kind="file", excitation__file=str(file))
    listener.wait_for(listener.measurements, 20)
    efforts = [item.message.effort[0] for item in listener.measurements[:20]]
    assert efforts == [1.5] * 4 + [-2.0] * 4 + [0.5] + [0.0] * 11

    file.write_text("time,torque\n0,1\n0.01,nan\n")
    with pytest.raises(ParameterError, match="line 3: expected a time and a finite torque"):
        start(listener.ros, "plant_simulator", signals=[f"torque: {{kind: file, file: {file}}}"])
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(ParameterError, match=r"torque: \S*motion.csv: cannot read it: not a reg"):
        start(listener.ros, "plant_simulator", signals=[f"torque: {{kind: file, file: {file}}}"])


def test_files_are_read_again_only_by_another_configuration(
    ros: Any, manage: Callable[[Any], Any], tmp_path: Path
) -> None:
    design, file = tmp_path / "arm.design.yaml", tmp_path / "motion.csv"
    design.write_bytes(config_path(SHIPPED_DESIGN).read_bytes())
    file.write_text("time,torque\n0,1\n")
    signals = [f"torque: {{kind: file, file: {file}}}"]
    node = start(ros, "plant_simulator", design=str(design), signals=signals)
    for each in (design, file):
        each.write_text("half of it")
    (found,) = node.set_parameters([Parameter("noise_factor", value=2.0)])
    assert found.successful
    (found,) = node.set_parameters([Parameter("signals", value=[f"{signals[0]} "])])
    assert "motion.csv" in found.reason
    manager = manage(node)
    assert manager.change("deactivate", "cleanup")
    assert not manager.change("configure")
    design.write_bytes(config_path(SHIPPED_DESIGN).read_bytes())
    file.write_text("time,torque\n0,2\n")
    assert manager.change("configure")
    assert node.parameters.noise_factor == 2.0
    (scenario,) = node.parameters.scenarios.values()
    assert scenario.inputs[0].values(np.zeros(1)) == 2.0


def test_a_change_that_cannot_be_applied_leaves_the_parameters(ros: Any, monkeypatch: Any) -> None:
    node = start(ros, "plant_simulator")
    monkeypatch.setattr(node, "retune", None)
    with pytest.raises(TypeError):
        node.set_parameters([Parameter("noise_factor", value=2.0)])
    assert node.parameters.noise_factor == 1.0
