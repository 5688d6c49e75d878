# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Synthesis of the certified gain for any T–S system."""

from tsobs_ros.design.synthesis import solve_gain
from tsobs_ros.design.ts_design import TSDesign
from tsobs_ros.design.ts_request import TSRequest


def synthesise_ts(request: TSRequest) -> TSDesign:
    """Design the certified gain for a request.

    Returns:
        A design whose certificate was re-checked on the returned matrices.

    Raises:
        DetectabilityError: No observer can exist; the text says which mode is hidden and where.
        DesignError: The solver found no common matrix P, or its answer failed the re-check.
    """
    request.require_detectable()
    return TSDesign(request, *solve_gain(request))
