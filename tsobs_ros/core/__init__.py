# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The compiled core: a C library that knows no ROS, no solver, no clock and no file."""
