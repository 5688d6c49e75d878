# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Gains and projection of adaptive laws: ‖Ξ‖ ≤ ξ is kept without hurting the Lyapunov argument.

For Ξ' = Γ Y with V = tr(Ξ̃ᵀΓ⁻¹Ξ̃) the projected rate is Γ Y − Γ g ⟨g, ΓY⟩/⟨g, Γg⟩ where Ξ is on the
bound and moving out; g = u₁v₁ᵀ is the subgradient of the spectral norm. Because the ball is convex,
⟨g, Ξ̂ − Ξ⟩ ≥ 0 for every Ξ in it, so the projection adds a term ≤ 0 to V'.
"""

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError

_EDGE = 1e-9
_ASYMMETRY = 1e-12


def projected_rate(value: Array, gradient: Array, Gamma: Array, limit: Array) -> Array:
    """Return Γ Y, without its part that leads out of ‖Ξ‖ ≤ ξ where Ξ is on that bound.

    Args:
        value: Ξ, shape (..., p, q).
        gradient: Y, shape (..., p, q).
        Gamma: Γ ≻ 0, shape (..., p, p).
        limit: ξ ≥ 0, shape (...).
    """
    rate = Gamma @ gradient
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    normal = left[..., :, :1] @ right[..., :1, :]
    outward = np.sum(normal * rate, axis=(-1, -2))
    steep = Gamma @ normal
    blocked = (singular[..., 0] >= limit * (1.0 - _EDGE)) & (outward > 0.0)
    # ⟨g, Γg⟩ is at least the smallest eigenvalue of Γ, since g has unit norm.
    excess = np.where(blocked, outward / np.sum(normal * steep, axis=(-1, -2)), 0.0)
    return np.asarray(rate - excess[..., np.newaxis, np.newaxis] * steep)


def clipped(value: Array, limit: Array) -> Array:
    """Return the nearest matrix with ‖Ξ‖ ≤ ξ: singular values cut at ξ.

    It removes what a step of finite length overshoots by.

    Args:
        value: Ξ, shape (..., p, q).
        limit: ξ ≥ 0, shape (...).
    """
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    cut = np.minimum(singular, np.asarray(limit)[..., np.newaxis])
    return np.asarray((left * cut[..., np.newaxis, :]) @ right)


def checked_gamma(Gamma: ArrayLike, rules: int, outputs: int) -> Array:
    """Return Γᵢ as an array of shape (rules, outputs, outputs).

    Raises:
        ModelError: A shape is wrong, or a Γᵢ is not symmetric or not positive definite; the
            text names the rule.
    """
    given = np.asarray(Gamma, dtype=np.float64)
    if given.ndim == 2:
        given = np.repeat(given[np.newaxis], rules, axis=0)
    checked = as_matrix("Γ", given, (rules, outputs, outputs))
    for rule, matrix in enumerate(checked, 1):
        asymmetry = float(np.abs(matrix - matrix.T).max())
        if asymmetry > _ASYMMETRY * float(np.abs(matrix).max()):
            raise ModelError(
                f"Γ of rule {rule}: expected a symmetric matrix, got {matrix.tolist()}, "
                f"unsymmetric by {asymmetry:.3g}"
            )
        smallest = float(np.linalg.eigvalsh(matrix)[0])
        if smallest <= 0.0:
            raise ModelError(
                f"Γ of rule {rule}: expected a positive definite matrix, got smallest "
                f"eigenvalue {smallest:.6g}"
            )
    return checked
