# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimators as pure step functions on stamps and arrays: no ROS, no solver, no clock, no file."""
