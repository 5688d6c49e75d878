# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `observer` node: measurements in, estimates with bounds out at a fixed rate.

It estimates angles and velocities of link and motor of each joint, the sensors' disturbances and
the torque of a contact, as its design says; or the states of a T-S system.

topics, sensor_msgs/msg/JointState without another type:
  joint_measurements (in)      position: measured angle of the link [rad], 0 hanging down, or
                               velocity [rad/s]; of <joint>_motor too, if both sides are measured;
                               effort: torque of the motor from the stamp on [N m];
                               of a T-S system: position of each output and input, by its name
  ~/joint_states (out)         <joint>_link and <joint>_motor [rad, rad/s]
  ~/error_bound (out)          1 sigma bound of each
  ~/disturbance (out)          disturbance of the sensor [rad] and its rate [rad/s]
  ~/disturbance_bound (out)    1 sigma bound of the disturbance
  ~/torque_disturbance (out)   effort: torque at <joint>_motor and <joint>_link that the design has
                               a model of, besides the motor's known one [N m]
  ~/torque_disturbance_bound (out)
                               1 sigma bound of each
  ~/parameters_estimate (out)  learnt changes of the parameters that the design calls uncertain
  ~/parameters_bound (out)     1 sigma bound of each
  ~/innovation (out)           measured minus expected value of each output in use
  ~/restarts (out)             number of restarts; latched
  ~/design (out)               std_msgs/msg/String: design and parameters, as JSON; latched
  ~/health (out)               what the estimates are worth, ten times a second
  ~/ticks (out)                std_msgs/msg/Int64MultiArray: which measurements each estimate has
  /diagnostics (out)           diagnostic_msgs/msg/DiagnosticArray, once a second

services:
  ~/reset                      std_srvs/srv/Trigger: start as a new observer
  ~/enable                     std_srvs/srv/SetBool: whether anything is published
"""

from tsobs_ros.nodes.observer.node import Observer
from tsobs_ros.nodes.observer.parameters import ObserverParameters as Parameters

create = Observer

__all__ = ["Observer", "Parameters", "create"]
