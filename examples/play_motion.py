# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A motion of `tsobs excite` on a robot: its torque as commands of an effort controller.

The controller is a ros2_control controller for this joint alone, e.g. JointGroupEffortController.
Each line is published at its time. The last command is 0, also after Ctrl-C. If this process is
killed, the controller keeps the last torque: keep a hand on the emergency stop.

Nothing is recorded here: run `ros2 bag record` or the node `recorder` at the same time.

Usage: python play_motion.py motion.csv --max-torque 0.24 [--scale 0.1] [--topic /…/commands]
"""

import argparse
import signal
import sys
import time

import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64MultiArray

from tsobs_ros.errors import TsobsError
from tsobs_ros.replay.csv_file import read_torques

parser = argparse.ArgumentParser(description="Play a motion on a robot.")
parser.add_argument("motion", help="CSV file with the columns time and torque")
parser.add_argument("--max-torque", type=float, required=True, help="largest command [N m]")
parser.add_argument("--scale", type=float, default=1.0, help="factor of the torque; 1/gear ratio")
parser.add_argument("--topic", default="/effort_controller/commands", help="of the controller")
options = parser.parse_args()

try:
    due, torque = read_torques(options.motion)
except TsobsError as error:
    sys.exit(f"error: {error}")
if len(due) < 2:
    sys.exit(f"error: {options.motion} has one line only")
torque = torque * options.scale
if not np.abs(torque).max() <= options.max_torque:
    sys.exit(f"error: {np.abs(torque).max():.4g} N m is above --max-torque {options.max_torque:g}")
end = 2.0 * due[-1] - due[-2]  # the last torque is held as long as the one before

# ROS's own handlers would end the publisher before the last command.
for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.default_int_handler)
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = rclpy.create_node("play_motion")
publisher = node.create_publisher(Float64MultiArray, options.topic, 10)
executor = SingleThreadedExecutor()
executor.add_node(node)


def command(value: float) -> None:
    """Publish a torque [N m]."""
    publisher.publish(Float64MultiArray(data=[float(value)]))


def publish_due_line() -> None:
    """Publish the newest line that is due; lines that a busy computer missed are left out."""
    command(torque[np.searchsorted(due, time.monotonic() - start, side="right") - 1])


try:
    patience = time.monotonic() + 10.0
    while publisher.get_subscription_count() == 0:
        if time.monotonic() > patience:
            sys.exit(f"error: no controller takes {options.topic}")
        executor.spin_once(timeout_sec=0.1)
    time.sleep(0.5)  # another publisher may be discovered later
    if node.count_publishers(options.topic) > 1:
        sys.exit(f"error: {options.topic} has another publisher")
    start = time.monotonic()
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(np.diff(due).min(), publish_due_line, clock=steady)
    try:
        while time.monotonic() - start < end:
            executor.spin_once(timeout_sec=0.1)
    finally:
        command(0.0)
        publisher.wait_for_all_acked(Duration(seconds=1.0))
    print(f"played {end:g} s, up to {np.abs(torque).max():.4g} N m")
except KeyboardInterrupt:
    sys.exit("stopped: the torque is 0")
finally:
    node.destroy_node()
    rclpy.shutdown()
