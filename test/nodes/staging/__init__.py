# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An arm, bad input for its observer, and a stage for observers under a test's own time."""
