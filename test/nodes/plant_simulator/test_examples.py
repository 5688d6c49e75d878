# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Examples 1 and 2 of the published method live: the published observer follows their plant."""

from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from tsobs_ros.nodes import observer, plant_simulator
from tsobs_ros.paper.examples import example_1, example_2
from tsobs_ros.resources import config_path

RATE, SECONDS, SETTLED = 250.0, 11.0, 9.0
# Driven time starts at 1 s.
BEGIN, END = 1_000_000_000, 12_000_000_000


@pytest.mark.slow
@pytest.mark.parametrize(("number", "example"), [(1, example_1()), (2, example_2())])
def test_the_published_observer_follows_the_published_plant(
    listener: Any, number: int, example: Any
) -> None:
    ros, estimates = listener.ros, []
    listener.node.create_subscription(JointState, "observer/joint_states", estimates.append, 5000)
    files = [
        *("--params-file", str(config_path(f"paper_example_{number}.nodes.yaml"))),
        *("-p", f"design:={config_path(f'paper_example_{number}.design.yaml')}"),
    ]
    clock = ["-p", "publish_clock:=true", "-p", "real_time_factor:=2.0"]
    wait = ["-p", "wait_for_subscribers:=2", "-p", f"duration:={SECONDS}"]
    simulated = ["-p", "use_sim_time:=true", "-p", "publish_on:=measurement"]
    for module, extra in ((observer, simulated), (plant_simulator, [*clock, *wait])):
        arguments = ["--ros-args", *files, *extra]
        ros.add(module.create(context=ros.context, cli_args=arguments))
    truth = (listener.states, listener.disturbances)
    ros.spin_until(
        lambda: all(each and each[-1].stamp == END for each in truth), 60.0, "the end of the run"
    )
    times = np.arange(round(SECONDS * RATE) + 1) / RATE
    # The first samples may have come before all subscriptions were matched.
    for each in listener.disturbances:
        row = example.disturbance(times)[round((each.stamp - BEGIN) * RATE / 1e9)]
        np.testing.assert_allclose(each.message.position, row, atol=1e-10)
    true_times = [(each.stamp - BEGIN) / 1e9 for each in listener.states]
    states = np.array([each.message.position for each in listener.states])
    for each in listener.measurements[::50]:
        assert list(each.message.name) == ["u", "y1", "y2", "y3"]
    errors = []
    for message in estimates:
        stamp = message.header.stamp
        time = (stamp.sec * 1_000_000_000 + stamp.nanosec - BEGIN) / 1e9
        if SETTLED < time < SECONDS:
            assert list(message.name) == ["x1", "x2", "x3"]
            true = [np.interp(time, true_times, column) for column in states.T]
            errors.append(np.array(message.position) - true)
    assert errors
    # What the printed uncertainty leaves of the error, about twice the RMS of docs/method.md.
    assert np.abs(errors).max() < 0.05
