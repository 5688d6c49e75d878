# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's observer of its Example 3, made to run where the certified one runs."""

import numpy as np

from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.comparison import ComparisonObserver
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper import printed
from tsobs_ros.paper.augmentation import Augmentation
from tsobs_ros.paper.examples import example_3
from tsobs_ros.paper.observer import AugmentedObserver

PAPER_WARNING = (
    "method paper: on this undamped arm the method's conditions are infeasible (modes ±4.776j and "
    "±1.481j are hidden by an arbitrary disturbance). Running the printed gains of its Example 3: "
    "the estimate is an open-loop simulation whose error does not decay; no bound is published"
)
"""What a user of the paper's observer is told, once."""


def printed_paper_observer() -> AugmentedObserver:
    """Return the method's observer with the gains that it prints for Example 3."""
    augmentation = Augmentation(example_3().system)
    M = np.linalg.solve(printed.EXAMPLE_3_P, augmentation.C_bar.T)
    return AugmentedObserver(augmentation, augmentation.E_L_inverse @ printed.EXAMPLE_3_H, M)


def paper(arm: ElasticJointArm, period: float, measurement_std: float) -> ComparisonObserver:
    """Return the method's observer for the arm of its Example 3.

    Raises:
        ModelError: The arm is another one; the method prints gains for this one only.
    """
    if arm != ElasticJointArm():
        raise ModelError(
            "method paper: expected the arm of the method's Example 3, for which it prints gains, "
            f"got {arm}"
        )
    inner = printed_paper_observer()
    start = inner.initial(np.zeros(1))
    return ComparisonObserver(
        inner, start, arm, period, measurement_std, lambda state: inner.estimate(state).omega
    )
