# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node and a simulated plant in your own rclpy executor, next to your own node.

Needs a sourced ROS 2 Jazzy, or the wheels: pip install 'tsobs_ros[ros]'.
"""

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from tsobs_ros.nodes import observer, plant_simulator


class Listener(Node):
    """Your own node: receives the estimates."""

    def __init__(self) -> None:
        super().__init__("listener")
        self.count = 0
        self.create_subscription(JointState, "observer/joint_states", self._take, 10)

    def _take(self, message: JointState) -> None:
        self.count += 1
        if self.count % 100 == 0:
            pairs = zip(message.name, message.position, strict=True)
            text = ", ".join(f"{name} {angle:+.3f} rad" for name, angle in pairs)
            self.get_logger().info(f"estimate {self.count}: {text}")


rclpy.init()
plant = plant_simulator.create(
    parameter_overrides=[
        Parameter("duration", value=3.0),
        Parameter("wait_for_subscribers", value=1),
        Parameter("disturbance.kind", value="bias_step"),
        Parameter("disturbance.bias_step.start", value=1.0),
    ]
)
nodes = [Listener(), observer.create(parameter_overrides=[Parameter("rate", value=200.0)]), plant]
executor = SingleThreadedExecutor()
for node in nodes:
    executor.add_node(node)
while not plant.finished:  # or executor.spin()
    executor.spin_once()
print(f"{nodes[0].count} estimates received")
for node in nodes:
    executor.remove_node(node)
    node.destroy_node()
rclpy.shutdown()
