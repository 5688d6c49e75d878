# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A finished design: the request, the matrices that answer it, and who computed them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.design.certificate import CertificateReport, check_certificate
from tsobs_ros.design.request import DesignRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.adaptive import AdaptiveObserver
from tsobs_ros.estimation.observer import TORQUE_RATE, CertifiedGain, GainMode, TSObserver
from tsobs_ros.estimation.supervised import SupervisedObserver


@dataclass(frozen=True)
class SolverReport:
    """Who computed the matrices; for the record only, nothing is trusted because of it.

    Attributes:
        name: Solver.
        version: Its version.
        status: What it said of its answer.
        iterations: Of its last solve.
        seconds: Time of the whole synthesis [s].
        margin: Extra noise it was asked to allow for, as a fraction of the bound per second.
    """

    name: str
    version: str
    status: str
    iterations: int
    seconds: float
    margin: float = 1e-4


@dataclass(frozen=True)
class Design:
    """A gain with its proof.

    Attributes:
        request: What was asked.
        P: Certificate matrix, shape (n, n), design coordinates; X = P⁻¹ bounds the error
            covariance before each sample.
        K: Filter gain, shape (n, 1).
        solver: Who computed P and K.

    Raises:
        ModelError: A matrix is not finite or of the wrong shape.
    """

    request: DesignRequest
    P: Array
    K: Array
    solver: SolverReport

    def __post_init__(self) -> None:
        n = self.request.flow.state_count
        object.__setattr__(self, "P", as_matrix("P", self.P, (n, n)))
        object.__setattr__(self, "K", as_matrix("K", self.K, (n, 1)))

    @cached_property
    def certificate(self) -> CertificateReport:
        """The certificate, re-checked from the stored matrices."""
        return check_certificate(self.request, self.P, self.K)

    @cached_property
    def covariance_bound(self) -> Array:
        """X = P⁻¹, the bound on the error covariance before each sample, shape (n, n).

        Raises:
            ModelError: P is not positive definite, and there is no bound.
        """
        try:
            np.linalg.cholesky(self.P)
            bound = np.linalg.inv(self.P)
        except np.linalg.LinAlgError as error:
            raise ModelError(
                f"P: expected a positive definite matrix, got {self.P.tolist()}"
            ) from error
        return as_matrix("X", (bound + bound.T) / 2, self.P.shape)

    @property
    def bound_std(self) -> Array:
        """Certified 1σ of [q₁, q̇₁, q₂, q̇₂] (rad, rad/s) and the disturbance's states, (n,)."""
        std = np.sqrt(np.diag(self.covariance_bound))
        std[:4] = self.request.arm.to_physical(std[:4])
        return std

    def observer(
        self,
        settle_time: float = 5.0,
        gain_mode: GainMode = GainMode.CERTIFIED,
        torque_rate: float = TORQUE_RATE,
    ) -> TSObserver:
        """Return the observer this design is for.

        Args:
            settle_time: Riccati gains are used for this long after a (re)start [s].
            gain_mode: Whether the certified gain takes over afterwards.
            torque_rate: 1σ of the rate at which the torque may move in a gap [N m/s].
        """
        return TSObserver(
            flow=self.request.flow,
            measurement_covariance=self.request.measurement_covariance,
            initial_covariance=self.request.initial_covariance,
            certified=CertifiedGain(self.K, self.covariance_bound),
            settle_time=settle_time,
            gain_mode=gain_mode,
            torque_rate=torque_rate,
        )

    def supervised(
        self,
        settle_time: float = 5.0,
        gain_mode: GainMode = GainMode.CERTIFIED,
        adapt: bool = True,
        torque_rate: float = TORQUE_RATE,
    ) -> SupervisedObserver:
        """Return the observer for a real arm: supervised, and learning what is uncertain.

        Args:
            settle_time: Riccati gains are used for this long after a (re)start [s].
            gain_mode: Whether the certified gain takes over afterwards.
            adapt: Whether to learn the parameters that the request calls uncertain.
            torque_rate: 1σ of the rate at which the torque may move in a gap [N m/s].
        """
        observer = self.observer(settle_time, gain_mode, torque_rate)
        if not (adapt and self.request.uncertainty):
            return SupervisedObserver(observer)
        covered = self.request.certify_uncertainty
        return SupervisedObserver(
            AdaptiveObserver(observer, self.request.uncertainty_model, covered=covered)
        )
