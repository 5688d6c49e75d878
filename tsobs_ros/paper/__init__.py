# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The published method: its systems, observer, design, examples and claims."""
