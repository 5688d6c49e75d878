# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `plant_simulator` node: an arm to try an observer on, and the truth about it."""

from tsobs_ros.nodes.plant_simulator.node import PlantSimulatorNode, create

__all__ = ["PlantSimulatorNode", "create"]
