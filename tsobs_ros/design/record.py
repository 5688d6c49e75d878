# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A finished design: the request, the matrices that answer it, and who computed them."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.design.certificate import CertificateReport, check_certificate
from tsobs_ros.design.request import AnyRequest, ArmRequest
from tsobs_ros.design.signals import labelled
from tsobs_ros.errors import ModelError, printable
from tsobs_ros.estimation.estimator import (
    Estimator,
    SupervisionOptions,
    certified_estimator,
)
from tsobs_ros.model.matrices import inverse

MAX_RATE = 1e6
"""Largest rate of an estimator's samples [Hz]."""


@dataclass(frozen=True)
class SolverReport:
    """The solver that computed the matrices, for information only; no check relies on it.

    `iterations` are those of the last solve, `seconds` is the duration of the synthesis, and
    `margin` is the extra noise that was assumed, as a fraction of the bound; see `synthesis`.
    """

    name: str = ""
    version: str = ""
    status: str = ""
    iterations: int = 0
    seconds: float = 0.0
    margin: float = 1e-4


@dataclass(frozen=True, eq=False)
class Design:
    """A gain with its proof, for an arm or for a T–S system.

    Attributes:
        request: The request that the design answers.
        P: Certificate matrix, shape (n, n), in design coordinates; X = P⁻¹ bounds the error
            covariance before each sample.
        K: Filter gain, shape (n, p).
        solver: The solver that computed P and K.
        file: The file that the design was loaded from; a changed copy has none.
        source: The text of that file; empty if there is none.

    Raises:
        ModelError: A matrix is not finite or has the wrong shape, a disturbance is arbitrary, or
            the rate above 1 MHz.

    >>> from tsobs_ros.design.file import load_design
    >>> from tsobs_ros.resources import config_path
    >>> design = load_design(config_path("elastic_joint.design.yaml"))
    >>> design.certificate.holds
    True
    >>> state, _ = (observer := design.observer()).correct(observer.initial(), np.array([0.3]))
    """

    request: AnyRequest
    P: Array
    K: Array
    solver: SolverReport
    file: str = field(default="a design without a file", init=False)
    source: str = field(default="", init=False)

    def __post_init__(self) -> None:
        if self.request.disturbance_model.arbitrary:
            raise ModelError(
                "disturbance: expected one with a model, as arbitrary ones explain every output "
                "and nothing is proved for them"
            )
        if self.request.rate > MAX_RATE:
            raise ModelError(f"rate: expected at most {MAX_RATE:g} Hz, got {self.request.rate:g}")
        p, n = self.request.flow.output_matrix.shape
        object.__setattr__(self, "P", as_matrix("P", self.P, (n, n)))
        object.__setattr__(self, "K", as_matrix("K", self.K, (n, p)))

    @property
    def arm_request(self) -> ArmRequest:
        """The request of a design for an arm.

        Raises:
            ModelError: The design is for a T–S system.
        """
        if not isinstance(self.request, ArmRequest):
            raise ModelError("design: expected one for an arm, got one for a T-S system")
        return self.request

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
        except np.linalg.LinAlgError:
            got = self.P.tolist()
            raise ModelError(f"P: expected a positive definite matrix, got {got}") from None
        return as_matrix("X", inverse(self.P), self.P.shape)

    @cached_property
    def late_factor(self) -> float:
        """ν with A X Aᵀ + Q ⪯ ν² X at all vertices of steps up to a period, rounded up to 10⁻⁴.

        If a sample does not come, an error covariance that is below X at its due time stays below
        ν² X for one more period, since the left side is matrix-convex in the slopes, like the
        certificate's. Rounding makes ν the same on every CPU.
        """
        root, worst = np.linalg.cholesky(self.covariance_bound), 1.0
        for share in (0.25, 0.5, 0.75, 1.0):  # lateness of the sample in periods
            for vertex in self.request.at_rate(self.request.rate / share).vertices():
                moved = np.linalg.solve(root, vertex.transition @ root)
                noise = np.linalg.solve(root, np.linalg.solve(root, vertex.noise).T)
                growth = np.linalg.eigvalsh(moved @ moved.T + (noise + noise.T) / 2)[-1]
                worst = max(worst, float(growth))
        return math.ceil(1e4 * math.sqrt(worst) * (1.0 + 1e-9)) / 1e4

    @property
    def bound_std(self) -> Array:
        """Certified 1σ of the plant's (in physical units) and the disturbance's states, (n,)."""
        std = np.sqrt(np.diag(self.covariance_bound))
        plant = self.request.flow.to_physical(std)
        return np.concatenate([plant, std[plant.size :]])

    def observer(
        self,
        settle_time: float = 5.0,
        gain_mode: str = "certified",
        torque_rate: float = 0.0,
        *,
        adapt: bool = False,
        supervision: SupervisionOptions | None = None,
    ) -> Estimator:
        """Return the observer of this design.

        Args:
            settle_time: Riccati gains are used for this long after a (re)start [s].
            gain_mode: "certified" if the certified gain takes over afterwards, else "riccati".
            torque_rate: 1σ of the rate at which an arm's torque, or a system's first input, may
                move in a gap [N m/s]; 0: that of `certified_estimator`.
            adapt: Whether to learn the parameters that the request calls uncertain, if any.
            supervision: Rules for leaving out samples, output by output; None: all are used.
        """
        request = self.request
        learnt = request.uncertainty_model if adapt and request.uncertainty_model.count else None
        estimator = certified_estimator(
            request.flow,
            request.measurement_covariance,
            request.initial_covariance,
            self.K,
            self.covariance_bound,
            late_factor=self.late_factor,
            settle_time=settle_time,
            gain_mode=gain_mode,
            torque_rate=torque_rate or None,
            uncertainty=learnt,
            domain=request.reach,
        )
        if learnt is not None:
            estimator.learn(learnt, covered=request.certify_uncertainty)
        estimator.limit_torque(request.torque_limits())
        if supervision is not None:
            estimator.supervise(supervision)
        return estimator

    def summary(self) -> dict[str, Any]:
        """Return certificate, gain and bounds as plain data."""
        report, request = self.certificate, self.request
        return {
            "holds": report.holds,
            "inequalities": report.as_mappings,
            "contraction_rate": report.contraction_rate,
            "gain": self.plain_gain,
            "bound_std": self.bound_std.tolist() if report.holds else None,
            "disturbance": request.disturbance_model.label,
            "claim": request.claim,
            "rate": request.rate,
            "solver": f"{self.solver.name} {self.solver.version}",
            "solver_status": self.solver.status,
        }

    @property
    def plain_gain(self) -> list[Any]:
        """K as plain data: a list of numbers for an arm with one output, else a list of rows."""
        is_list = isinstance(self.request, ArmRequest) and self.K.shape[1] == 1
        plain: list[Any] = (self.K[:, 0] if is_list else self.K).tolist()
        return plain

    def text(self) -> str:
        """Return the summary for people to read."""
        report, request = self.certificate, self.request
        lines = [
            f"{request.headline}, {request.rate:g} Hz; {self.solver.name} {self.solver.version}: "
            f"{self.solver.status}",
            *(f"  {inequality}" for inequality in report.inequalities),
            f"certified decay without noise: {report.contraction_rate:.4g} 1/s",
        ]
        if report.holds:
            states = labelled(request.state_names, request.state_units)
            names = [*states, *request.disturbance_labels]
            width = max(24, *(len(name) + 1 for name in names))
            lines.append("certified 1-sigma bounds before a sample:")
            lines += [
                f"  {name:<{width}}{bound:#.4g}"
                for name, bound in zip(names, self.bound_std, strict=True)
            ]
        verdict = "the certificate holds" if report.holds else "THE CERTIFICATE DOES NOT HOLD"
        return "\n".join(map(printable, [*lines, verdict]))
