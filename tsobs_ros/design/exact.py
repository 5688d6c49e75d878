# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certificate in exact rational arithmetic: no floating point number enters the verdict.

The numbers of the request, P and K are floats, and every float is a fraction, so X = P⁻¹ and the
claim of `certificate` can be written in fractions, up to three things that are not rational:

- the linear flow Φ = e^{AT} and its noise Q. They are enclosed by Taylor polynomials in fractions
  with a bound d on each entry of what the error makes of Φ W Φᵀ + Q; a symmetric error with
  entries up to d is ⪯ n d I (Gershgorin), so n d I is added as if it were process noise;
- cos x_max, replaced by a fraction just below it: a slightly larger domain;
- e^{−2ρT}, replaced by a fraction just below it: a slightly faster decay.

A symmetric matrix of fractions is positive definite if and only if all pivots of its LDLᵀ are
positive, which integers decide. The margins are proved as well: μ is printed only if the inequality
still holds with μ X a second taken away. Candidates for μ come from the check in floating point,
which makes them neither true nor false.

The model is the request's: A and the arm's noise are computed from its parameters without
rounding; the disturbance's S, H and G and the directions of uncertainty are those that are stored.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import matrix_balance

from tsobs_ros.design.rational import (
    Enclosure,
    Rational,
    cosine_below,
    decay_below,
    exponential,
    identity,
    inverse,
    is_positive_definite,
    noise_integral,
    rational,
)
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import DesignRequest
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY, MOTOR_VELOCITY
from tsobs_ros.model.vertices import KickCorner, kick_corners, linear_directions

_NEARLY_ALL = (2.0**-20, 2.0**-10, 2.0**-4, 0.5, 0.9, 1.0 - 1e-3, 1.0 - 1e-6)
"""How much is taken off the margin in floating point, one after the other, until it is proved."""


class ExactInequality(NamedTuple):
    """One strict matrix inequality, proved or not.

    Attributes:
        name: What is claimed.
        where: The vertex, or "" for one that has none.
        holds: Whether it is proved, which for these is whether it is true but for enclosures.
        margin: A proved lower bound on the margin; per second for the decrease.
    """

    name: str
    where: str
    holds: bool
    margin: float

    def __str__(self) -> str:
        place = f" at {self.where}" if self.where else ""
        verdict = f"proved, margin at least {self.margin:.3e}" if self.holds else "NOT PROVED"
        return f"{self.name}{place}: {verdict}"


@dataclass(frozen=True)
class ExactReport:
    """Every inequality of a certificate as exact arithmetic finds it."""

    inequalities: tuple[ExactInequality, ...]

    @property
    def holds(self) -> bool:
        """Whether every inequality is proved."""
        return all(inequality.holds for inequality in self.inequalities)

    def text(self) -> str:
        """Return the report for people to read."""
        verdict = "proved in exact arithmetic" if self.holds else "NOT PROVED IN EXACT ARITHMETIC"
        return "\n".join(
            [*(f"  {each}" for each in self.inequalities), f"the certificate: {verdict}"]
        )

    def as_mapping(self) -> dict[str, Any]:
        """Return the report as plain data."""
        return {
            "holds": self.holds,
            "inequalities": [inequality._asdict() for inequality in self.inequalities],
        }


def verify_exactly(design: Design) -> ExactReport:
    """Check the certificate of a design in exact rational arithmetic.

    Raises:
        ModelError: The arm is so fast for the period that its flow cannot be enclosed.
    """
    return ExactReport(tuple(_inequalities(design)))


def _inequalities(design: Design) -> Iterator[ExactInequality]:
    request = design.request
    if request.disturbance_model.arbitrary:
        yield ExactInequality("disturbance has a model", "", False, 0.0)
        return
    guesses = {(each.name, each.where): each.margin for each in design.certificate.inequalities}

    def judged(name: str, where: str, matrix: Rational, unit: Rational) -> ExactInequality:
        holds = is_positive_definite(matrix)
        guess = guesses.get((name, where), 0.0)
        return ExactInequality(name, where, holds, _margin(matrix, unit, guess) if holds else 0.0)

    P = rational(design.P)
    name = "P symmetric and positive definite"
    if (P != P.T).any():
        yield ExactInequality(name, "", False, 0.0)
        return
    positive = judged(name, "", P, np.diag(np.diag(P)))
    yield positive
    if not positive.holds:
        return
    problem = _Problem(request, P, rational(design.K))
    places = [vertex.where for vertex in request.vertices()]
    pairs = product(problem.corners, repeat=2)
    for where, (first, second) in zip(places, pairs, strict=True):
        decrease = problem.decrease(first, second)
        yield judged("covariance decrease", where, decrease, problem.period * problem.X)


def _margin(matrix: Rational, unit: Rational, guess: float) -> float:
    """Return a number μ ≥ 0, printed with four digits and no more, with matrix − μ unit ≻ 0."""
    for taken in _NEARLY_ALL:
        candidate = f"{guess * (1.0 - taken):.3e}"
        if guess > 0.0 and is_positive_definite(matrix - Fraction(candidate) * unit):
            return float(candidate)
    return 0.0


class _Problem:
    """A request and its answer in fractions, in coordinates scaled by powers of two.

    Attributes:
        period: T [s].
        X: P⁻¹.
        corners: Those of half a kick, in the order of the vertices.
    """

    def __init__(self, request: DesignRequest, P: Rational, K: Rational) -> None:
        # Any scale is as good for the claim; this one keeps the flow's norm small.
        _, (scale, _) = matrix_balance(request.flow.drift, permute=False, separate=True)
        self._D = np.diag(rational(scale))
        self._D_inverse = np.diag(1 / rational(scale))
        self._request = request
        self.period = 1 / Fraction(request.rate)
        drift: Rational = self._D_inverse @ (self.period * _drift(request)) @ self._D
        density = self._D_inverse @ (self.period * _noise_density(request)) @ self._D_inverse
        self._phi = exponential(drift)
        self._noise = noise_integral(drift, density)
        self._kept = decay_below(2 * Fraction(request.decay_rate) * self.period)

        C: Rational = rational(request.flow.output_matrix) @ self._D
        gain: Rational = self._D_inverse @ K
        self.X = inverse(self._D @ P @ self._D)
        closed = identity(len(gain)) - gain @ C
        variance = Fraction(request.measurement_std) ** 2
        self._posterior = closed @ self.X @ closed.T + (variance * gain) @ gain.T

        self._uncertainty = request.uncertainty_model if request.certify_uncertainty else None
        bounds = [Fraction(bound) for bound in request.uncertainty.values()]
        slopes = (cosine_below(Fraction(request.x_max)), Fraction(1))
        self.corners = list(kick_corners(slopes, self._uncertainty, bounds))

    def decrease(self, first: KickCorner[Fraction], second: KickCorner[Fraction]) -> Rational:
        """Return λ²X less an upper bound on the covariance after a step from X, at a vertex."""
        before, after = self._kick(first), self._kick(second)
        covariance = _bounded(self._phi, self._noise, before @ self._posterior @ before.T)
        return np.asarray(self._kept * self.X - after @ covariance @ after.T)

    def _kick(self, corner: KickCorner[Fraction]) -> Rational:
        arm, half = self._request.arm, self.period / 2
        kick = identity(len(self.X))
        if self._uncertainty is not None:
            changes = self._uncertainty.linear[linear_directions(self._uncertainty), 0]
            for theta, change in zip(corner.theta, changes, strict=True):
                kick[:4, :4] += half * theta * rational(change)
        gravity = Fraction(arm.gravity_torque) / Fraction(arm.link_inertia)
        kick[LINK_VELOCITY, LINK_ANGLE] -= half * gravity * corner.slope
        return np.asarray(self._D_inverse @ kick @ self._D)


def _bounded(phi: Enclosure, noise: Enclosure, W: Rational) -> Rational:
    """Return an upper bound, in the order of matrices, on Φ W Φᵀ + Q for all enclosed Φ and Q."""
    n = len(W)
    largest = np.abs(phi.centre).max() + phi.radius
    # Each entry of ΔΦ W Φᵀ + Φ̃ W ΔΦᵀ is at most twice this sum of n² products.
    error = 2 * n * n * phi.radius * np.abs(W).max() * largest + noise.radius
    centre = phi.centre @ W @ phi.centre.T + noise.centre
    return np.asarray(centre + n * error * identity(n))


def _drift(request: DesignRequest) -> Rational:
    """Return the matrix of the linear flow [1/s], from the parameters without rounding."""
    arm = request.arm
    j1, j2, k = (Fraction(v) for v in (arm.link_inertia, arm.motor_inertia, arm.stiffness))
    drift = rational(np.zeros_like(request.flow.drift))
    drift[:4, :4] = [
        [0, 1, 0, 0],
        [-k / j1, -Fraction(arm.link_damping) / j1, 1, 0],
        [0, 0, 0, 1],
        [k * k / (j1 * j2), 0, -k / j2, -Fraction(arm.motor_damping) / j2],
    ]
    drift[4:, 4:] = rational(request.disturbance_model.S)
    return drift


def _noise_density(request: DesignRequest) -> Rational:
    """Return the white noise density of the augmented state, from the parameters."""
    arm, G = request.arm, rational(request.disturbance_model.G)
    density = rational(np.zeros_like(request.flow.drift))
    gain = Fraction(arm.stiffness) / Fraction(arm.link_inertia)
    density[LINK_VELOCITY, LINK_VELOCITY] = Fraction(request.process_noise.link)
    density[MOTOR_VELOCITY, MOTOR_VELOCITY] = Fraction(request.process_noise.motor) * gain**2
    density[4:, 4:] = G @ G.T
    return density
