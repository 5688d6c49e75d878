# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Your own T-S model as a node: its design, the observer node and a simulated plant.

Needs cvxpy and clarabel and a sourced ROS 2 Jazzy, or pip install 'tsobs_ros[design,ros]'.

Usage: python ts_node.py [REQUEST.yaml]
"""

import sys
from tempfile import TemporaryDirectory

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

import tsobs_ros as ts
from tsobs_ros.nodes import observer, plant_simulator
from tsobs_ros.resources import config_path

path = sys.argv[1] if len(sys.argv) > 1 else config_path("ts_example.request.yaml")
design = ts.synthesise(ts.load_request(path))


class Listener(Node):
    """Your own node: keeps the newest message of a few topics."""

    def __init__(self) -> None:
        super().__init__("listener")
        self.newest: dict[str, JointState] = {}
        for topic in ("observer/joint_states", "ground_truth/joint_states", "observer/disturbance"):
            take = lambda message, topic=topic: self.newest.update({topic: message})  # noqa: E731
            self.create_subscription(JointState, topic, take, 10)


with TemporaryDirectory() as folder:
    ts.save_design(design, f"{folder}/system.design.yaml")
    file = Parameter("design", value=f"{folder}/system.design.yaml")
    shared = [Parameter("joints", value=["system"]), file]
    rclpy.init()
    plant = plant_simulator.create(
        parameter_overrides=[
            *shared,
            Parameter("rate", value=design.request.rate),
            Parameter("duration", value=6.0),
            Parameter("wait_for_subscribers", value=1),
            Parameter("signals", value=["gyroscope: {kind: bias_step, amplitude: 0.15}"]),
        ]
    )
    listener, executor = Listener(), SingleThreadedExecutor()
    for node in (listener, observer.create(parameter_overrides=shared), plant):
        executor.add_node(node)
    while not plant.finished:
        executor.spin_once()
for topic, message in listener.newest.items():
    pairs = zip(message.name, message.position, strict=True)
    print(f"{topic}: " + ", ".join(f"{name} {value:+.3f}" for name, value in pairs))
rclpy.shutdown()
