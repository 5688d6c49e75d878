# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Metrics, tables and figures of recorded runs; the only user of matplotlib and plotly."""
