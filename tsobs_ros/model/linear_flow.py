# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The exact flow of a linear system with a held input and white noise, over a step of any length.

Φ' = AΦ, Γ' = AΓ + B, Q' = AQ + QAᵀ + W, by their Taylor series with precomputed coefficients: a
step then costs one product, which matters because real stamps jitter. Where a step is long for
the fastest mode, the series serves a fraction 2⁻ˢ of it and is doubled s times; a sum of positive
semidefinite terms, so the noise stays a covariance.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError

Step = TypeVar("Step")

_ROUNDING = float(np.finfo(np.float64).eps)
_MOST_TERMS = 60
_TERMS_STEP = 8
_LARGEST_TURN = 2.0**16
"""Most a mode may turn or decay in one step [rad]; doubling loses a digit for every factor 10."""

_STRETCH = 1.25
"""A step may be longer than nominal by so much: real stamps jitter about the period."""


class LinearFlow:
    """Φ, Γ and Q of ẋ = A x + B u + noise of density W.

    Args:
        A: State matrix, shape (n, n) [1/s].
        B: Input matrix, shape (n, m).
        W: Density of the white noise, shape (n, n).
        period: The step that is taken most [s].

    Raises:
        ModelError: An entry or the flow over the period is not finite, or a step is too long
            for the fastest mode.
    """

    def __init__(self, A: Array, B: Array, W: Array, period: float) -> None:
        turn = _norm(A) * period
        if not turn <= _LARGEST_TURN:
            raise ModelError(
                f"period: expected the fastest mode to turn or decay by at most "
                f"{_LARGEST_TURN:.0f} rad in a step of {period:.4g} s, got {turn:.4g} rad; a "
                f"higher rate or a softer, heavier or less damped arm is needed"
            )
        # The series converges fast for |A|t up to 1; the common step needs no doubling.
        self._reach = _STRETCH * period / max(1.0, _STRETCH * turn)
        self._n, self._m = B.shape
        rows, columns = np.indices((self._n, self._n))
        # Where Q is in a row of the series: its upper triangle twice, so that it is symmetric.
        entries = np.minimum(rows, columns) * self._n + np.maximum(rows, columns)
        self._noise_entries = self._n * (self._n + self._m) + entries
        with np.errstate(over="ignore", invalid="ignore"):
            self._series = self._coefficients(A, B, W)
            self._orders = np.arange(len(self._series), dtype=np.float64)
            over_period = self.over(period)
        if not all(np.isfinite(part).all() for part in over_period):
            raise ModelError(
                f"flow: every entry over a step of {period:.4g} s must be finite; "
                f"the model's numbers are too large"
            )

    def over(self, duration: float) -> tuple[Array, Array, Array]:
        """Return Φ, Γ and Q over `duration` [s] ≥ 0, shapes (n, n), (n, m) and (n, n)."""
        if duration <= self._reach:
            return self._evaluate(duration)
        doublings = math.ceil(math.log2(duration / self._reach))
        phi, gamma, noise = self._evaluate(math.ldexp(duration, -doublings))
        for _ in range(doublings):
            gamma = phi @ gamma + gamma
            noise = phi @ noise @ phi.T + noise
            noise = 0.5 * (noise + noise.T)
            phi = phi @ phi
        return phi, gamma, noise

    def _evaluate(self, duration: float) -> tuple[Array, Array, Array]:
        n, m, square = self._n, self._m, self._n * self._n
        flat = (duration**self._orders).dot(self._series)
        return (
            flat[:square].reshape(n, n),
            flat[square : square + n * m].reshape(n, m),
            flat.take(self._noise_entries),
        )

    def _coefficients(self, A: Array, B: Array, W: Array) -> Array:
        """Return Taylor coefficients of Φ, Γ and Q side by side, (order + 1, n (2n + m))."""
        n = self._n
        phi, gamma, noise = np.eye(n), np.zeros((n, self._m)), np.zeros((n, n))
        rows: list[Array] = []
        largest = np.zeros(n * (2 * n + self._m))
        for order in range(1, _MOST_TERMS):
            row = np.hstack([phi.ravel(), gamma.ravel(), noise.ravel()])
            rows.append(row)
            size = np.abs(row) * self._reach ** (order - 1)
            largest = np.maximum(largest, size)
            # Judged entry by entry: entries differ by ten orders of magnitude.
            if order > 2 * n and (size <= 1e-3 * _ROUNDING * largest).all():
                break
            phi, gamma, noise = (
                A @ phi / order,
                (A @ gamma + (B if order == 1 else 0.0)) / order,
                (A @ noise + noise @ A.T + (W if order == 1 else 0.0)) / order,
            )
        # Alike arms are to have equally many terms, so that they can be stacked.
        rows += [np.zeros_like(row)] * (-len(rows) % _TERMS_STEP)
        return np.array(rows)


def _norm(A: Array) -> float:
    """Return a norm of A [1/s] in coordinates where it is close to its fastest eigenvalue."""
    if not np.isfinite(A).all():
        raise ModelError(f"state matrix: every entry must be finite, got {A.tolist()}")
    # The states' units differ; scaling them changes no flow, and the series is none the wiser.
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(matrix_balance(A, permute=False)[0], 1))


def cut_into_steps(
    duration: float, period: float, nominal: Step, last: Callable[[float], Step]
) -> list[Step]:
    """Cut a time into nominal steps and a last one, up to 1.25 periods long, in their order.

    Args:
        duration: The time [s].
        period: Length of a nominal step [s].
        nominal: The step of that length.
        last: Makes a step from its length [s].

    Raises:
        ModelError: The duration is negative or not finite.
    """
    if duration == period:
        return [nominal]
    if not 0.0 <= duration < math.inf:
        raise ModelError(f"duration: expected a finite number of at least 0, got {duration!r} s")
    whole = int(duration // period)
    rest = duration - whole * period
    if whole and 0.0 < rest <= (_STRETCH - 1.0) * period:
        whole, rest = whole - 1, rest + period
    return [nominal] * whole + ([last(rest)] if rest > 0.0 else [])


def matvec(matrix: Array, x: Array) -> Array:
    """Return M x, shape (..., m), for x of shape (..., n) and M of shape (m, n) or (..., m, n)."""
    if matrix.shape[-1] == 1:
        # Exact, also in the sign of a zero, which a library is free to choose.
        return matrix[..., 0] * x
    if x.ndim == 1:
        # The method takes a third of the operator's time.
        return np.asarray(matrix.dot(x))
    if matrix.ndim == 2:
        return np.asarray(x @ matrix.T)
    return np.asarray((matrix @ x[..., np.newaxis])[..., 0])


def transposed(matrix: NDArray[np.floating[Any]]) -> Array:
    """Return Mᵀ of each matrix, shape (..., n, m)."""
    return np.asarray(matrix.T if matrix.ndim == 2 else matrix.swapaxes(-1, -2))
