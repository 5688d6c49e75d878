# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""State and sensor-disturbance estimation for a robot arm with an elastic joint."""

__version__ = "0.1.0"
