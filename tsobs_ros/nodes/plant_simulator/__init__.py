# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `plant_simulator` node: arms or T-S systems to try an observer on, and the truth about them.

topics, sensor_msgs/msg/JointState without another type:
  joint_measurements (out)         position: measured angle of the link [rad], 0 hanging down, or
                                   what else the joint's design file has as outputs;
                                   effort: torque of the motor from the stamp on [N m]
  ground_truth/joint_states (out)  true <joint>_link and <joint>_motor [rad, rad/s]
  ground_truth/disturbance (out)   what the sensor adds to the angle besides white noise [rad]
  ground_truth/torque_disturbance (out)
                                   effort: what <joint>_motor and <joint>_link get besides the
                                   known torque: contact, friction, payload [N m]
  joint_torque_command (in)        std_msgs/msg/Float64MultiArray: torque in place of `excitation`
                                   [N m], one number a joint
  /clock (out)                     rosgraph_msgs/msg/Clock, with `publish_clock`

services:
  ~/reset                          std_srvs/srv/Trigger: start again at t = 0
"""

from tsobs_ros.nodes.plant_simulator.node import PlantSimulatorNode
from tsobs_ros.nodes.plant_simulator.parameters import PlantSimulatorParameters as Parameters

create = PlantSimulatorNode

__all__ = ["Parameters", "PlantSimulatorNode", "create"]
