# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The interface that all estimators of one joint share, so that one tracker and node run them."""

from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from tsobs_ros.checks import Array

S = TypeVar("S")


class Correction(NamedTuple):
    """The effect of one measurement.

    Attributes:
        innovation: y − ŷ before the correction, shape (..., p).
        innovation_covariance: Expected covariance of the innovation, shape (..., p, p) or (p, p).
        gain: The gain that was used, shape (..., n, p) or (n, p).
        weight: The share of the correction that was applied; 0 if the measurement was not used.
        regression: Of an adaptive observer, the share of the parameters' uncertainty.
    """

    innovation: Array
    innovation_covariance: Array
    gain: Array
    weight: float = 1.0
    regression: Any = None


class Readout(NamedTuple):
    """An estimator's state in physical units.

    Attributes:
        state: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (..., 4).
        state_bound: 1σ bound of each, shape (..., 4) or (4,).
        disturbance: Output disturbance [rad], shape (..., p).
        disturbance_rate: Its modelled rate [rad/s], shape (..., p).
        disturbance_bound: 1σ bound of the disturbance [rad], shape (..., p) or (p,).
        certified: Whether the bounds are the certificate's.
        parameters: Estimated changes θ of the model's parameters, shape (k,).
        parameter_bound: 1σ of each, shape (k,).
        parameters_valid: Whether the motion was rich enough for them to count.
    """

    state: Array
    state_bound: Array
    disturbance: Array
    disturbance_rate: Array
    disturbance_bound: Array
    certified: bool
    parameters: Array = np.zeros(0)
    parameter_bound: Array = np.zeros(0)
    parameters_valid: bool = False


class Estimator(Protocol[S]):
    """Pure steps of an estimator; the state S is all of its memory and is never changed."""

    @property
    def period(self) -> float:
        """Nominal sampling period [s]."""
        ...

    def initial(self) -> S:
        """Return the state before any measurement."""
        ...

    def correct(self, state: S, y: Array) -> tuple[S, Correction]:
        """Use one measurement y [rad], shape (1,)."""
        ...

    def predict(self, state: S, u: Array, duration: float) -> S:
        """Predict over `duration` [s] with the torque u [N m], shape (1,), held."""
        ...

    def extrapolate(self, state: S, u: Array, duration: float) -> S:
        """Predict to a time between samples; the result is only read."""
        ...

    def readout(self, state: S) -> Readout:
        """Return the estimate in physical units."""
        ...

    def events(self, state: S) -> dict[str, int]:
        """Return counts of outliers, jumps and the like, by name, for diagnostics."""
        ...
