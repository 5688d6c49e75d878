# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated plants: their motion, sensor, disturbances, scenarios and Monte Carlo runs."""
