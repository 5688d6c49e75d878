# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate of a gain, checked on the stored matrices alone; no solver is involved.

With X = P⁻¹, the gain K and every slope vertex j of the error system (A_j, Q_j), the claim is

    A_j [(I − K C̄) X (I − K C̄)ᵀ + K R Kᵀ] A_jᵀ + Q_j ≺ λ² X ,   λ = e^{−ρT} ≤ 1 .

Its left side is matrix-convex in each kick of the prediction, so the four vertices cover every
slope pair of the domain. Then an error covariance below X before a sample is below X before
the next one, along every premise trajectory that is independent of the noise.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from tsobs_ros.checks import Array
from tsobs_ros.design.request import DesignRequest
from tsobs_ros.errors import CertificateError
from tsobs_ros.model.flow import VertexSystem

_ROUNDING = 1e-9
"""Margins below this [1/s, relative] are not told from rounding and count as not holding."""


class Inequality(NamedTuple):
    """One strict matrix inequality and its margin.

    Attributes:
        name: What is claimed.
        where: The vertex, e.g. "slopes (0.732, 1)", or "" for one that has none.
        margin: Smallest eigenvalue in coordinates where X = I; per second for the decrease.
        required: The margin must exceed this.
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
    """Every inequality of a certificate, and what follows when all of them hold.

    Attributes:
        inequalities: The claims in the order they were checked.
        contraction_rate: Certified decay [1/s] of the noise-free error in the norm eᵀPe, the
            slowest vertex; NaN where P is not positive definite.
    """

    inequalities: tuple[Inequality, ...]
    contraction_rate: float

    @property
    def holds(self) -> bool:
        """Whether every inequality holds."""
        return all(inequality.holds for inequality in self.inequalities)

    @property
    def worst(self) -> Inequality:
        """The first inequality that fails, else the one with the smallest margin."""
        failing = [inequality for inequality in self.inequalities if not inequality.holds]
        return failing[0] if failing else min(self.inequalities, key=lambda each: each.margin)

    def require(self, source: str) -> None:
        """Raise `CertificateError` naming `source` and each failing inequality, if one fails."""
        failing = [str(inequality) for inequality in self.inequalities if not inequality.holds]
        if failing:
            raise CertificateError(f"{source}: the certificate does not hold: {'; '.join(failing)}")


def check_certificate(request: DesignRequest, P: Array, K: Array) -> CertificateReport:
    """Check the certificate of gain K and matrix P from the request's model alone.

    Args:
        request: The model, noise and domain the certificate is for.
        P: Symmetric matrix, shape (n, n), in design coordinates.
        K: Filter gain, shape (n, 1).

    Returns:
        Every inequality with its margin; nothing is raised for one that fails.
    """
    n = request.flow.state_count
    asymmetry = float(np.abs(P - P.T).max())
    scale = np.sqrt(np.abs(np.diag(P)))
    correlation = P / np.where(scale > 0.0, np.outer(scale, scale), 1.0)
    smallest = float(np.linalg.eigvalsh(correlation)[0]) if asymmetry == 0.0 else math.nan
    inequalities = [Inequality("P symmetric and positive definite", "", smallest, _ROUNDING)]
    if not inequalities[0].holds:
        return CertificateReport(tuple(inequalities), math.nan)

    root = np.asarray(np.linalg.cholesky(P), dtype=np.float64)
    decay = math.exp(-request.decay_rate * request.period)
    growths = []
    for vertex in request.flow.vertices(*request.slope_range):
        error_map = _normalised_error_map(root, vertex, K, request.flow.output_matrix)
        noise_map = root.T @ vertex.transition @ K
        spread = noise_map @ request.measurement_covariance @ noise_map.T
        spread += root.T @ vertex.noise @ root
        decrease = decay**2 * np.eye(n) - error_map @ error_map.T - (spread + spread.T) / 2
        margin = float(np.linalg.eigvalsh(decrease)[0]) / request.period
        where = f"slopes ({vertex.slopes[0]:.4g}, {vertex.slopes[1]:.4g})"
        inequalities.append(Inequality("covariance decrease", where, margin, _ROUNDING))
        growths.append(float(np.linalg.norm(error_map, 2)))
    return CertificateReport(tuple(inequalities), -math.log(max(growths)) / request.period)


def _normalised_error_map(root: Array, vertex: VertexSystem, K: Array, C: Array) -> Array:
    """Return Lᵀ A (I − K C̄) L⁻ᵀ with P = L Lᵀ, shape (n, n)."""
    closed = vertex.transition @ (np.eye(K.shape[0]) - K @ C)
    # M L⁻ᵀ is the transpose of the solution Z of L Z = Mᵀ.
    return np.asarray(solve_triangular(root, (root.T @ closed).T, lower=True).T)
