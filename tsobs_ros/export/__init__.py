# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags as tables for other tools: CSV and Parquet files, one a topic, with units."""
