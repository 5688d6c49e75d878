# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Offline estimation: the observer's core run over recorded measurements at full speed."""
