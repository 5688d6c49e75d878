# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The topics of an observer, below its own name, and of a simulator.

All are JointStates except `DESIGN` and `TICKS`.
"""

DESIGN = "design"
"""Designs and parameters, a latched std_msgs/String: see `tsobs_ros.design.file.ObserverRecord`."""

TICKS = "ticks"
"""The tick log, which lists the measurements of each tick: see `tsobs_ros.bag.cdr`."""

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

Of these, only the restarts are latched, for late subscribers. The positions of a message about a
restart are the number of restarts before it. The estimates that follow such a message are those of
an observer that has just started.
"""

PARAMETER_TOPICS = (PARAMETERS, PARAMETER_BOUNDS)
"""Also published if the observer learns parameters."""

TORQUE_TOPICS = (TORQUE_DISTURBANCE, TORQUE_DISTURBANCE_BOUND)
"""Also published if a design has a torque disturbance, as `effort` of the sides."""

SLOW_PERIOD = 100_000_000
"""Period of parameters and health [ns]: they change slowly, ten messages per second suffice."""


def sides(joint: str) -> tuple[str, str]:
    """Return the names of a joint's link and motor in estimates."""
    return f"{joint}_link", f"{joint}_motor"
