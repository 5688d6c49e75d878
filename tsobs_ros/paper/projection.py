# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The projection of uncertainty estimates on balls of the spectral norm, in compiled loops.

For Ξ' = Γ Y with V = tr(Ξ̃ᵀΓ⁻¹Ξ̃) the projected rate is Γ Y − Γ g ⟨g, ΓY⟩/⟨g, Γg⟩ if Ξ is on the
bound ‖Ξ‖ = ξ and moves out; g = u₁v₁ᵀ is the subgradient of the spectral norm. Because the ball is
convex, ⟨g, Ξ̂ − Ξ⟩ ≥ 0 for every Ξ in it, so the projection adds a term ≤ 0 to V'.

Left singular vectors and values are those of ΞΞᵀ, which is small. Only values at the bound and
above are used, and these lose no digits by being squared.
"""

import math

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled

_EDGE = 1e-9
_MAX_SWEEPS = 60


@compiled
def project(
    value: Array, rate: Array, Gamma: Array, limit: float, gram: Array, vectors: Array
) -> None:
    """Take from a rate Γ Y its part that leads out of ‖Ξ‖ ≤ ξ, if Ξ is on that bound.

    Args:
        value: Ξ, shape (p, q).
        rate: Γ Y, shape (p, q), changed in place.
        Gamma: Γ ≻ 0, shape (p, p).
        limit: ξ ≥ 0; infinite for no bound.
        gram: Scratch, shape (p, p).
        vectors: Scratch, shape (p, p).
    """
    p, q = value.shape
    edge = limit * (1.0 - _EDGE)
    if _square_of(value) < edge * edge:
        return
    if limit == 0.0:
        for a in range(p):
            for b in range(q):
                rate[a, b] = 0.0
        return
    _singular(value, gram, vectors)
    largest = 0
    for k in range(1, p):
        if gram[k, k] > gram[largest, largest]:
            largest = k
    singular = math.sqrt(gram[largest, largest])
    if not singular >= edge:
        return
    outward = steepness = 0.0
    for b in range(q):
        right = moved = 0.0
        for a in range(p):
            right += vectors[a, largest] * value[a, b]
            moved += vectors[a, largest] * rate[a, b]
        outward += right / singular * moved
    if not outward > 0.0:
        return
    # Γ u₁, in what is scratch by now. ⟨g, Γg⟩ is at least the smallest eigenvalue of Γ.
    for a in range(p):
        gram[0, a] = 0.0
        for b in range(p):
            gram[0, a] += Gamma[a, b] * vectors[b, largest]
        steepness += vectors[a, largest] * gram[0, a]
    for b in range(q):
        right = 0.0
        for a in range(p):
            right += vectors[a, largest] * value[a, b]
        for a in range(p):
            rate[a, b] -= outward / steepness * (right / singular) * gram[0, a]


@compiled
def clip(value: Array, limit: float, gram: Array, vectors: Array) -> None:
    """Cut the singular values of Ξ at ξ: the nearest matrix with ‖Ξ‖ ≤ ξ.

    It removes what a step of finite length overshoots by.

    Args:
        value: Ξ, shape (p, q), changed in place.
        limit: ξ ≥ 0; infinite for no bound.
        gram: Scratch, shape (p, p).
        vectors: Scratch, shape (p, p).
    """
    p, q = value.shape
    if _square_of(value) <= limit * limit:
        return
    _singular(value, gram, vectors)
    for k in range(p):
        if gram[k, k] > limit * limit:
            excess = 1.0 - limit / math.sqrt(gram[k, k])
            for b in range(q):
                along = 0.0
                for a in range(p):
                    along += vectors[a, k] * value[a, b]
                for a in range(p):
                    value[a, b] -= excess * along * vectors[a, k]


@compiled
def _square_of(value: Array) -> float:
    """Return Σ Ξᵢⱼ², at least ‖Ξ‖²."""
    total = 0.0
    for a in range(value.shape[0]):
        for b in range(value.shape[1]):
            total += value[a, b] * value[a, b]
    return total


@compiled
def _singular(value: Array, gram: Array, vectors: Array) -> None:
    """Write Ξ's squared singular values on gram's diagonal, left singular vectors as columns."""
    p, q = value.shape
    for i in range(p):
        for j in range(p):
            gram[i, j] = 0.0
            for b in range(q):
                gram[i, j] += value[i, b] * value[j, b]
    diagonalise(gram, vectors)


@compiled
def diagonalise(matrix: Array, vectors: Array) -> None:
    """Turn a symmetric matrix into the diagonal one of its eigenvalues, by Jacobi's rotations.

    Args:
        matrix: Shape (p, p), changed in place.
        vectors: Written: the eigenvectors as columns, shape (p, p).
    """
    p = matrix.shape[0]
    for i in range(p):
        for j in range(p):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(_MAX_SWEEPS):
        beside = 0.0
        for i in range(p):
            for j in range(i):
                beside += matrix[i, j] * matrix[i, j]
        if not beside > 1e-36 * _square_of(matrix):
            return
        for i in range(p):
            for j in range(i + 1, p):
                _rotate(matrix, vectors, i, j)


@compiled
def _rotate(matrix: Array, vectors: Array, i: int, j: int) -> None:
    """Turn rows and columns i and j so that the entry (i, j) vanishes."""
    off = matrix[i, j]
    if off == 0.0:
        return
    slope = 0.5 * (matrix[j, j] - matrix[i, i]) / off
    tangent = 1.0 / (abs(slope) + math.sqrt(slope * slope + 1.0))
    if slope < 0.0:
        tangent = -tangent
    cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(matrix.shape[0]):
        one, other = matrix[k, i], matrix[k, j]
        matrix[k, i] = cosine * one - sine * other
        matrix[k, j] = sine * one + cosine * other
        one, other = vectors[k, i], vectors[k, j]
        vectors[k, i] = cosine * one - sine * other
        vectors[k, j] = sine * one + cosine * other
    for k in range(matrix.shape[0]):
        one, other = matrix[i, k], matrix[j, k]
        matrix[i, k] = cosine * one - sine * other
        matrix[j, k] = sine * one + cosine * other
