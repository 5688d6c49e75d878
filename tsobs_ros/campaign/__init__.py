# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo campaigns: many runs drawn, simulated, observed and scored."""
