# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction of an arm through a gap, in which nothing is heard of its torque.

The torque is then u + δ, u being the last that was heard: δ begins at zero and moves at a rate that
is Gauss–Markov, N(0, r²) at any time and correlated over `MEMORY`. Both are states here, behind
those of the arm and its disturbance, so that what they do to the arm is correlated with all else
as it is along the flow, not white.
"""

from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from tsobs_ros.checks import Array
from tsobs_ros.model.flow import ArmFlow

MEMORY = 1.0
"""Correlation time of the torque's rate [s]: that of motions that take some seconds."""

UNHEARD = 2
"""Number of states behind the others: δ [N m] and its rate [N m/s]."""


class GapFlow(ArmFlow):
    """Predicts x̄ = [x; w; δ; δ'] of an arm whose torque was heard of for the last time before.

    Args:
        flow: Of the arm.
        torque_rate: r, 1σ of the torque's rate [N m/s].
    """

    def __init__(self, flow: ArmFlow, torque_rate: float) -> None:
        self.torque_rate = torque_rate
        super().__init__(flow.arm, flow.disturbance, flow.process_noise, flow.period)

    @property
    def state_count(self) -> int:
        """Length of the augmented state with the unheard torque and its rate."""
        return super().state_count + UNHEARD

    @cached_property
    def output_matrix(self) -> Array:
        """Augmented state to measured angle, shape (1, n)."""
        own = np.hstack([self.arm.output_matrix, self.disturbance.H])
        return np.pad(own, ((0, 0), (0, UNHEARD)))

    @cached_property
    def drift(self) -> Array:
        """Continuous augmented matrix without gravity, shape (n, n)."""
        drift = block_diag(super().drift, np.array([[0.0, 1.0], [0.0, -1.0 / MEMORY]]))
        drift[:4, -UNHEARD] = self.arm.input_matrix[:, 0]
        return np.asarray(drift)

    def _noise_density(self) -> Array:
        own = np.diag([0.0, 2.0 * self.torque_rate**2 / MEMORY])
        return np.asarray(block_diag(super()._noise_density(), own))

    def begun(self, covariance: Array) -> Array:
        """Return the covariance at a sample, shape (..., n, n), given that of x and w alone."""
        n = self.state_count
        wide = np.zeros((*covariance.shape[:-2], n, n))
        wide[..., :-UNHEARD, :-UNHEARD] = covariance
        wide[..., -1, -1] = self.torque_rate**2
        return wide


def widened(x: Array) -> Array:
    """Return x̄ with the expected torque behind it, the one last heard of, shape (..., n)."""
    return np.concatenate([x, np.zeros((*x.shape[:-1], UNHEARD))], axis=-1)


def narrowed(covariance: Array) -> Array:
    """Return the covariance of the arm and its disturbance, shape (..., n − 2, n − 2)."""
    return covariance[..., :-UNHEARD, :-UNHEARD]
