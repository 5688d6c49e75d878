# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate of a gain, checked on the stored matrices alone; no solver is involved.

With X = P⁻¹, the gain K and every slope vertex j of the error system (A_j, Q_j), the claim is

    A_j [(I − K C̄) X (I − K C̄)ᵀ + K R Kᵀ] A_jᵀ + Q_j ≺ λ² X ,   λ = e^{−ρT} ≤ 1 .

The left side is matrix-convex in each slope and each uncertain parameter of the prediction's two
kicks. So the vertices cover every slope of the domain and, if the request asks for it, every
parameter within its bounds. An error covariance that is below X before a sample is then below X
before the next one, along every premise trajectory that is independent of the noise.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.request import AnyRequest
from tsobs_ros.errors import CertificateError
from tsobs_ros.model.prediction import VertexSystem

_ROUNDING = 100.0 * float(np.finfo(np.float64).eps)
"""Relative rounding error of the matrix products, per row, with a safety factor of about 30."""


class Inequality(NamedTuple):
    """One strict matrix inequality and its margin.

    Attributes:
        name: The claim.
        where: The vertex, e.g. "slopes (0.732, 1)"; "" for a claim without one.
        margin: Smallest eigenvalue, of P with unit diagonal or of the decrease [1/s] with X = I.
        required: Bound on the rounding error of the margin; the margin must exceed it.
    """

    name: str
    where: str
    margin: float
    required: float

    @property
    def holds(self) -> bool:
        """Whether the inequality holds with its required margin; false for NaN."""
        return self.margin > self.required

    def __str__(self) -> str:
        place = f" at {self.where}" if self.where else ""
        verdict = "holds" if self.holds else "DOES NOT HOLD"
        return f"{self.name}{place}: {verdict}, margin {self.margin:.3e} (> {self.required:.0e})"


@dataclass(frozen=True)
class CertificateReport:
    """All inequalities of a certificate, and the decay rate that follows if they hold.

    Attributes:
        inequalities: The claims in the order they were checked.
        contraction_rate: Certified decay rate [1/s] of the noise-free error in the norm eᵀPe, at
            the slowest vertex; NaN if P is not positive definite.
    """

    inequalities: tuple[Inequality, ...]
    contraction_rate: float

    @property
    def failing(self) -> list[Inequality]:
        """The inequalities that do not hold."""
        return [inequality for inequality in self.inequalities if not inequality.holds]

    @property
    def holds(self) -> bool:
        """Whether every inequality holds."""
        return not self.failing

    @property
    def as_mappings(self) -> list[dict[str, Any]]:
        """The inequalities as plain data."""
        return [{**each._asdict(), "holds": each.holds} for each in self.inequalities]

    @property
    def worst(self) -> Inequality:
        """The first inequality that fails, else the one with the smallest relative margin.

        Margins of different kinds have different units, so each is divided by its requirement.
        """
        if self.failing:
            return self.failing[0]
        return min(self.inequalities, key=lambda each: each.margin / (each.required or 1.0))

    def require(self, source: str) -> None:
        """Raise `CertificateError` if an inequality fails; it names `source` and all that fail."""
        if not self.holds:
            failing = "; ".join(map(str, self.failing))
            raise CertificateError(f"{source}: the certificate does not hold: {failing}")


def check_certificate(problem: AnyRequest, P: Array, K: Array) -> CertificateReport:
    """Check the certificate of gain K (n, p) and matrix P (n, n) from the problem's model alone.

    P is scaled to unit diagonal, so that units do not matter. Its Cholesky factor is then exact to
    n ε κ, with κ the condition number of the scaled matrix, and so is the decrease over a step. Its
    margin must exceed that error divided by the period. `exact.verify_exactly` needs no such
    allowance. A margin is NaN if the matrices overflow. An inequality that fails raises no error.

    Raises:
        ModelError: The request describes no model.
    """
    rounding = problem.flow.state_count * _ROUNDING
    with np.errstate(all="ignore"):
        scale = np.sqrt(np.diag(P))
        correlation = P / scale / scale[:, np.newaxis]
        smallest = _smallest_eigenvalue(correlation) if (P == P.T).all() else math.nan
        definite = Inequality("P symmetric and positive definite", "", smallest, rounding)
        if not definite.holds:
            return CertificateReport((definite,), math.nan)
        root = scale[:, np.newaxis] * np.linalg.cholesky(correlation)
        # The trace of the correlation is n, which bounds its largest eigenvalue.
        required = rounding * P.shape[0] / smallest / problem.period
        steps = [_check_vertex(problem, root, K, vertex) for vertex in problem.vertices()]
        decreases = [
            Inequality("covariance decrease", where, margin / problem.period, required)
            for where, margin, _ in steps
        ]
        rate = -np.log(np.max([growth for _, _, growth in steps])) / problem.period
        return CertificateReport((definite, *decreases), float(rate))


def _check_vertex(
    problem: AnyRequest, root: Array, K: Array, vertex: VertexSystem
) -> tuple[str, float, float]:
    """Return a vertex's name, the decrease over a step with X = I, and the growth of the error."""
    closed = vertex.transition @ (np.eye(K.shape[0]) - K @ problem.flow.output_matrix)
    # With P = L Lᵀ the error map is Lᵀ A (I − K C̄) L⁻ᵀ, and M L⁻ᵀ is the transpose of the
    # solution Z of L Z = Mᵀ.
    error_map = np.linalg.solve(root, closed.T @ root).T
    noise_map = root.T @ vertex.transition @ K
    noise = noise_map @ problem.measurement_covariance @ noise_map.T
    noise += root.T @ vertex.noise @ root
    kept = math.exp(-2.0 * problem.decay_rate * problem.period) * np.eye(K.shape[0])
    margin = _smallest_eigenvalue(kept - error_map @ error_map.T - (noise + noise.T) / 2)
    finite = bool(np.isfinite(error_map).all())
    return vertex.where, margin, float(np.linalg.norm(error_map, 2)) if finite else math.nan


def _smallest_eigenvalue(matrix: Array) -> float:
    """Return the smallest eigenvalue of a symmetric matrix, NaN if an entry is not finite."""
    return float(np.linalg.eigvalsh(matrix)[0]) if np.isfinite(matrix).all() else math.nan
