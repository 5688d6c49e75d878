# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a measurement says of the augmented state: of one system, a batch, or a stack of any."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.prediction import PredictionModel
from tsobs_ros.model.products import mapped, transposed


class OutputModel(NamedTuple):
    """y = C̄ x̄ + v, cov(v) = R, and the disturbance ω = H w in it; a stack has a leading axis.

    Attributes:
        C: Augmented state to measurement C̄, shape (p, n).
        R: Covariance of the measurement noise, shape (p, p).
        H: States of the disturbance, the last ones of x̄, to ω, shape (p, q).
        rate_map: The same to dω/dt, shape (p, q).
        identity: Shape (n, n).
    """

    C: Array
    R: Array
    H: Array
    rate_map: Array
    identity: Array

    @classmethod
    def of(cls, flow: PredictionModel, R: Array) -> "OutputModel":
        """Return the model of a flow's outputs with noise of covariance R."""
        disturbance, identity = flow.disturbance, np.eye(flow.state_count)
        return cls(flow.output_matrix, R, disturbance.H, disturbance.rate_map, identity)

    @classmethod
    def stack(cls, models: Sequence["OutputModel"]) -> "OutputModel":
        """Return models of equal shapes as a stack."""
        return cls(*map(np.stack, zip(*models, strict=True)))

    def innovation(self, x: Array, y: Array) -> Array:
        """Return y − C̄ x̂, shape (..., p)."""
        return y - mapped(self.C, x)

    def gain(self, covariance: Array) -> tuple[Array, Array]:
        """Return the covariance S expected of the innovation, and the Kalman gain Σ C̄ᵀ S⁻¹."""
        cross = covariance @ transposed(self.C)
        spread = self.C @ cross + self.R
        if spread.shape[-1] == 1:
            return spread, cross / spread
        return spread, transposed(np.linalg.solve(spread, transposed(cross)))

    def joseph(self, covariance: Array, gain: Array) -> Array:
        """Return (I − KC̄) Σ (I − KC̄)ᵀ + K R Kᵀ, symmetric and positive for any gain."""
        closed = self.identity - gain @ self.C
        result = closed @ covariance @ transposed(closed) + gain @ self.R @ transposed(gain)
        return np.asarray(0.5 * (result + transposed(result)))

    def disturbance(self, x: Array) -> Array:
        """Return ω = H w, shape (..., p)."""
        return mapped(self.H, self._exosystem(x))

    def disturbance_rate(self, x: Array) -> Array:
        """Return dω/dt as modelled, shape (..., p)."""
        return mapped(self.rate_map, self._exosystem(x))

    def _exosystem(self, x: Array) -> Array:
        return x[..., x.shape[-1] - self.H.shape[-1] :]
