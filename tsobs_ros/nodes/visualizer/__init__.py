# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `visualizer` node: arms as markers for RViz and Foxglove; needs no tf.

Each arm swings in its own vertical plane: what a sensor measures, what the observer estimates, as a
translucent ghost with its bound, and the truth of a simulator as a solid arm. The ghost has the
colour of the sensor's fault. Without an observer only the truth is drawn.

topics, sensor_msgs/msg/JointState without another type:
  ~/markers (out)                    visualization_msgs/msg/MarkerArray
  observer/joint_states (in)         estimates
  observer/error_bound (in)          their bounds
  observer/design (in)               std_msgs/msg/String: which sides have which encoders
  joint_measurements (in)            measured angles; the topic that the observer names
  ground_truth/joint_states (in)     the truth
  /diagnostics (in)                  diagnostic_msgs/msg/DiagnosticArray: the sensors' faults
"""

from tsobs_ros.nodes.visualizer.node import Visualizer
from tsobs_ros.nodes.visualizer.scene import VisualizerParameters as Parameters

create = Visualizer

__all__ = ["Parameters", "Visualizer", "create"]
