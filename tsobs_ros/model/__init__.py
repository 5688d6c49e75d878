# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Models: the arm, its T–S form, disturbances and one exact prediction step; NumPy only."""
