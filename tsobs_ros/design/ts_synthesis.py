# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Synthesis of the certified gain for any T–S system."""

from pathlib import Path

from tsobs_ros.design.synthesis import solve_gain
from tsobs_ros.design.ts_design import TSDesign
from tsobs_ros.design.ts_file import load_ts_request, save_ts_design
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


def design_ts_file(request: Path, output: Path) -> TSDesign:
    """Design what a request file asks for, write the design file and return the design.

    Raises:
        DesignFileError: The request cannot be read or the design cannot be written.
        DesignError: As for `synthesise_ts`.
    """
    design = synthesise_ts(load_ts_request(request))
    save_ts_design(design, output)
    return design
