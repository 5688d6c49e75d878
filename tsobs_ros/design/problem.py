# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the synthesis and the certificate need to know of a request, whatever its model."""

from collections.abc import Sequence
from typing import Protocol

from tsobs_ros.checks import Array
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.prediction import PredictionModel


class ErrorVertex(Protocol):
    """The error system e⁺ = transition·e + noise at one vertex."""

    @property
    def transition(self) -> Array:
        """Shape (n, n)."""
        ...

    @property
    def noise(self) -> Array:
        """Covariance of the noise, shape (n, n)."""
        ...

    @property
    def where(self) -> str:
        """The vertex in words, for reports."""
        ...


class DesignProblem(Protocol):
    """The error systems that one matrix P and one gain K are wanted for, and their noise."""

    @property
    def flow(self) -> PredictionModel:
        """The prediction model."""
        ...

    @property
    def disturbance_model(self) -> DisturbanceModel:
        """What disturbs the measurements besides white noise."""
        ...

    @property
    def measurement_covariance(self) -> Array:
        """R of one sample, shape (p, p)."""
        ...

    @property
    def period(self) -> float:
        """Sampling period T [s]."""
        ...

    @property
    def decay_rate(self) -> float:
        """Rate ρ at which eᵀPe has to shrink without noise, as e^{−2ρt} [1/s]."""
        ...

    @property
    def domain(self) -> str:
        """The domain in words, after "for", e.g. "gravity slopes [0.7317, 1]"."""
        ...

    @property
    def remedies(self) -> Sequence[str]:
        """What would help where no common matrix is found, the best first."""
        ...

    def vertices(self, share: float = 1.0) -> Sequence[ErrorVertex]:
        """Return the error systems of a share of the domain, 0 for its middle, 1 for all of it."""
        ...

    def starts(self) -> Sequence[ErrorVertex]:
        """Return systems whose Kalman filters are first guesses, the best first."""
        ...
