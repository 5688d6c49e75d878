# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The solutions that the method's paper prints, against the conditions they are printed for."""

from dataclasses import dataclass

import numpy as np

from tsobs_ros.paper import printed
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.conditions import ConditionReport, check_conditions, least_epsilon
from tsobs_ros.paper.examples import PaperExample

ROUNDING = 1e-3
"""‖P M − C̄ᵀ‖ that four printed decimals can leave."""


@dataclass(frozen=True)
class PrintedChecks:
    """The printed solutions against their conditions.

    Attributes:
        example_1: (18) on {C̄x̄ = 0}, (19) and (38) with the printed P and M.
        example_3: (37) with the printed P and H, one report for each reading: every change of
            sign of P's coordinates, every one of H's, and H as Hᵢ or as E_L⁻¹Hᵢ.
        epsilon: ε of Example 1 as recomputed.
    """

    example_1: ConditionReport
    example_3: tuple[ConditionReport, ...]
    epsilon: float


def check_printed(example_1: PaperExample, example_3: PaperExample) -> PrintedChecks:
    """Check every printed solution that is available."""
    first, third = Augmentation(example_1.system), Augmentation(example_3.system)
    epsilon = least_epsilon(first, example_1.alpha, example_1.xi)
    report = check_conditions(
        first,
        printed.EXAMPLE_1_P,
        alpha_1=first.alpha_1(example_1.alpha),
        M=printed.EXAMPLE_1_M,
        epsilon=epsilon,
        rounding=ROUNDING,
    )
    signs = printed.sign_changes(4)
    gains = [change[:, np.newaxis] * printed.EXAMPLE_3_H for change in signs]
    readings = [*gains, *(third.E_L_inverse @ each for each in gains)]
    reports = tuple(
        check_conditions(
            third, change[:, np.newaxis] * printed.EXAMPLE_3_P * change, alpha_1=np.zeros(2), H1=H1
        )
        for change in signs
        for H1 in readings
    )
    return PrintedChecks(report, reports, epsilon)
