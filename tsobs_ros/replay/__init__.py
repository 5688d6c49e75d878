# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimation after the fact: the observer's core over recorded measurements, at full speed."""
