# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Certified gains: what is asked, synthesis (the only user of cvxpy), the proof and its file."""
