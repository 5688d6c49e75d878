# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What an observer and a design need of a prediction model, whatever the system it predicts."""

from typing import Protocol

from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.model.disturbance import DisturbanceModel


class PredictionModel(Protocol):
    """One step of the augmented state x̄ = [x; w] and of its error covariance.

    Attributes:
        disturbance: The exosystem, whose states w are the last ones of x̄.
        period: Nominal step [s].
    """

    disturbance: DisturbanceModel
    period: float

    @property
    def state_count(self) -> int:
        """Length n of the augmented state."""
        ...

    @property
    def output_matrix(self) -> Array:
        """Augmented state to measurement C̄ = [C H], shape (p, n)."""
        ...

    def predict(self, x: Array, u: Array, duration: float) -> Array:
        """Return x̄, shape (..., n), a time `duration` [s] later, u of shape (..., m) held."""
        ...

    def predict_with_covariance(
        self, x: Array, covariance: Array, u: Array, duration: float
    ) -> tuple[Array, Array]:
        """Return x̄ and its error covariance, shape (..., n, n), a time `duration` [s] later."""
        ...

    def to_physical(self, x: ArrayLike) -> Array:
        """Return the plant's states in physical units for augmented states, shape (..., n)."""
        ...
