# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is inside of messages: CDR bytes checked and decoded without ROS, JointStates above all."""
