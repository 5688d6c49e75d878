# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A finished design for a T–S system: the request, the matrices that answer it, the observer."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.design.certificate import CertificateReport, check_certificate
from tsobs_ros.design.record import SolverReport
from tsobs_ros.design.ts_request import TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.adaptive import AdaptationOptions, AdaptiveObserver
from tsobs_ros.estimation.observer import CertifiedGain, GainMode, TSObserver


@dataclass(frozen=True, eq=False)
class TSDesign:
    """A gain with its proof.

    Attributes:
        request: What was asked.
        P: Certificate matrix, shape (n, n); X = P⁻¹ bounds the error covariance before a sample.
        K: Filter gain, shape (n, p).
        solver: Who computed P and K.

    Raises:
        ModelError: A matrix is not finite or of the wrong shape.
    """

    request: TSRequest
    P: Array
    K: Array
    solver: SolverReport

    def __post_init__(self) -> None:
        n, p = self.request.flow.state_count, self.request.flow.output_matrix.shape[0]
        object.__setattr__(self, "P", as_matrix("P", self.P, (n, n)))
        object.__setattr__(self, "K", as_matrix("K", self.K, (n, p)))

    @cached_property
    def certificate(self) -> CertificateReport:
        """The certificate, re-checked from the stored matrices."""
        return check_certificate(self.request, self.P, self.K)

    @cached_property
    def covariance_bound(self) -> Array:
        """X = P⁻¹, shape (n, n).

        Raises:
            ModelError: P is not positive definite, and there is no bound.
        """
        if not np.linalg.eigvalsh(self.P)[0] > 0.0:
            raise ModelError(f"P: expected a positive definite matrix, got {self.P.tolist()}")
        bound = np.linalg.inv(self.P)
        return as_matrix("X", (bound + bound.T) / 2, self.P.shape)

    @property
    def bound_std(self) -> Array:
        """Certified 1σ of the states and of the disturbance's states, shape (n,)."""
        return np.sqrt(np.diag(self.covariance_bound))

    def observer(
        self, settle_time: float = 5.0, gain_mode: GainMode = GainMode.CERTIFIED
    ) -> TSObserver:
        """Return the observer this design is for; see `TSObserver` for the arguments."""
        return TSObserver(
            flow=self.request.flow,
            measurement_covariance=self.request.measurement_covariance,
            initial_covariance=self.request.initial_covariance,
            certified=CertifiedGain(self.K, self.covariance_bound),
            settle_time=settle_time,
            gain_mode=gain_mode,
        )

    def adaptive_observer(
        self, settle_time: float = 5.0, options: AdaptationOptions | None = None
    ) -> AdaptiveObserver:
        """Return the observer that learns the request's uncertain directions.

        Raises:
            ModelError: The request names none.
        """
        uncertainty = self.request.uncertainty
        if uncertainty is None:
            raise ModelError("uncertainty: expected at least one direction to learn, got none")
        covered = self.request.certify_uncertainty
        return AdaptiveObserver(self.observer(settle_time), uncertainty, options, covered)

    def summary(self) -> dict[str, Any]:
        """Return what `tsobs design` and `tsobs verify` report, as plain data."""
        report, request = self.certificate, self.request
        return {
            "holds": report.holds,
            "claim": request.claim,
            "covers_estimated_premise": request.covers_estimated_premise,
            "inequalities": [
                {
                    "name": each.name,
                    "where": each.where,
                    "margin": each.margin,
                    "required": each.required,
                    "holds": each.holds,
                }
                for each in report.inequalities
            ],
            "contraction_rate": report.contraction_rate,
            "gain": self.K.tolist(),
            "bound_std": self.bound_std.tolist() if report.holds else None,
            "disturbance": request.disturbance_model.label,
            "rate": request.rate,
            "solver": f"{self.solver.name} {self.solver.version}",
            "solver_status": self.solver.status,
        }

    def text(self) -> str:
        """Return the summary for people."""
        report, request = self.certificate, self.request
        model, w = request.model, request.disturbance_model
        lines = [
            f"T-S system: {model.rule_count} rules, {model.state_count} states, "
            f"{model.C.shape[0]} outputs, disturbance {w.label}, {request.rate:g} Hz",
            f"claim: {request.claim}",
            *(str(each) for each in report.inequalities),
            f"certified decay without noise: {report.contraction_rate:.4g} 1/s",
        ]
        if report.holds:
            lines.append(f"certified 1σ: {', '.join(f'{std:.4g}' for std in self.bound_std)}")
        verdict = "the certificate holds" if report.holds else "THE CERTIFICATE DOES NOT HOLD"
        return "\n".join([*lines, verdict])
