# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 nodes around the pure core, and the runtime they share; nothing else imports rclpy."""
