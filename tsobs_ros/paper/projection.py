# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The projection of uncertainty estimates on balls of the spectral norm.

For Ξ' = Γ Y with V = tr(Ξ̃ᵀΓ⁻¹Ξ̃) the projected rate is Γ Y − Γ g ⟨g, ΓY⟩/⟨g, Γg⟩ if Ξ is on the
bound ‖Ξ‖ = ξ and moves out; g = u₁v₁ᵀ is the subgradient of the spectral norm. Because the ball is
convex, ⟨g, Ξ̂ − Ξ⟩ ≥ 0 for every Ξ in it, so the projection adds a term ≤ 0 to V'.

Few matrices are near their bound at a time; singular values are sought of these only. Matrices with
numbers that are none stay as they are.
"""

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array

_EDGE = 1e-9


def project(value: Array, rate: Array, Gamma: Array, limit: Array) -> Array:
    """Return rates Γ Y without what leads out of ‖Ξ‖ ≤ ξ where Ξ is on that bound.

    Args:
        value: Ξ, shape (..., p, q).
        rate: Γ Y, of the same shape.
        Gamma: Γ ≻ 0, shape (p, p), or with axes before that fit those of Ξ.
        limit: ξ ≥ 0, one a matrix; infinite for no bound. Its shape fits the axes before p and q.
    """
    edge = limit * (1.0 - _EDGE)
    near = _where(value, edge, np.greater_equal)
    if not near.any():
        return rate
    left, singular, right = np.linalg.svd(value[near], full_matrices=False)
    u, v, rates = left[..., :1], right[..., :1, :], rate[near]
    turned = np.broadcast_to(Gamma, (*near.shape, *Gamma.shape[-2:]))[near] @ u
    u_row = u.swapaxes(-2, -1)
    outward, steepness = u_row @ rates @ v.swapaxes(-2, -1), u_row @ turned
    leaving = singular[:, :1] >= np.broadcast_to(edge, near.shape)[near][:, np.newaxis]
    share = np.where(leaving[..., np.newaxis] & (outward > 0.0), outward / steepness, 0.0)
    rates -= share * turned * v
    rates[np.broadcast_to(limit, near.shape)[near] == 0.0] = 0.0
    projected = rate.copy()
    projected[near] = rates
    return projected


def clip(value: Array, limit: Array) -> Array:
    """Return matrices with their singular values cut at ξ: the nearest ones with ‖Ξ‖ ≤ ξ.

    It removes what a step of finite length overshoots by.

    Args:
        value: Ξ, shape (..., p, q).
        limit: ξ ≥ 0, one a matrix; infinite for no bound. Its shape fits the axes before p and q.
    """
    over = _where(value, limit, np.greater)
    if not over.any():
        return value
    left, singular, right = np.linalg.svd(value[over], full_matrices=False)
    excess = np.maximum(singular - np.broadcast_to(limit, over.shape)[over][:, np.newaxis], 0.0)
    clipped = value.copy()
    clipped[over] -= left * excess[:, np.newaxis] @ right
    return clipped


def _where(value: Array, limit: Array, comparison: np.ufunc) -> NDArray[np.bool_]:
    """Compare Σ Ξᵢⱼ², which is at least ‖Ξ‖², with ξ²; false where a number is not finite."""
    squares = np.einsum("...ab,...ab->...", value, value)
    found: NDArray[np.bool_] = np.asarray(comparison(squares, limit * limit))
    if found.any():
        found &= np.isfinite(value).all(axis=(-2, -1))
    return found
