# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of an observer, below its own name, and of a simulator.

They are JointStates, but for `DESIGN` and `TICKS`.
"""

DESIGN = "design"
"""What it runs, a latched std_msgs/String: see `tsobs_ros.design.file.ObserverRecord`."""

TICKS = "ticks"
"""Which measurements each tick includes: see `tsobs_ros.bag.cdr`."""

STATES, STATE_BOUNDS = "joint_states", "error_bound"
DISTURBANCE, DISTURBANCE_BOUND = "disturbance", "disturbance_bound"
INNOVATION = "innovation"
RESTARTS = "restarts"
HEALTH = "health"
PARAMETERS, PARAMETER_BOUNDS = "parameters_estimate", "parameters_bound"
TORQUE_DISTURBANCE, TORQUE_DISTURBANCE_BOUND = "torque_disturbance", "torque_disturbance_bound"

TRUE_STATES, TRUE_DISTURBANCE = "ground_truth/joint_states", "ground_truth/disturbance"
TRUE_TORQUE = "ground_truth/torque_disturbance"
TRUTH = (TRUE_STATES, TRUE_DISTURBANCE, TRUE_TORQUE)
"""Topics of a simulator, below its namespace."""

TOPICS = (STATES, STATE_BOUNDS, DISTURBANCE, DISTURBANCE_BOUND, INNOVATION, RESTARTS, HEALTH)
"""The JointStates that every observer publishes.

All but the restarts are published for those who listen at the time. A message about a restart, its
positions the number of restarts before it, stays there for those who come later: what follows it is
that of an observer without a past.
"""

PARAMETER_TOPICS = (PARAMETERS, PARAMETER_BOUNDS)
"""Published, too, if it learns parameters."""

TORQUE_TOPICS = (TORQUE_DISTURBANCE, TORQUE_DISTURBANCE_BOUND)
"""Published, too, if a design has a torque disturbance; `effort` of the sides."""

SLOW_PERIOD = 100_000_000
"""Parameters and health change slowly: they are published ten times a second [ns]."""


def sides(joint: str) -> tuple[str, str]:
    """Return the names of a joint's link and motor in estimates."""
    return f"{joint}_link", f"{joint}_motor"
