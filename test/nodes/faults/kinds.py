# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The catalogue of bad input, complete."""

from faults import arrivals, shapes, stamps, values
from faults.script import KINDS

__all__ = ["KINDS", "arrivals", "shapes", "stamps", "values"]
