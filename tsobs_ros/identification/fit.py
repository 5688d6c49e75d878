# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood: the numbers of a joint that explain its recordings best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from tsobs_ros.checks import Array
from tsobs_ros.identification.joint import Joint, Unknowns
from tsobs_ros.identification.likelihood import Evaluation, Likelihood, Recording

GATE = 6.0
"""Sigmas of an innovation from which on it is an outlier, once the numbers are about right."""

_START_SAMPLES = 4000
"""Samples with which starts are compared."""

_STARTS = 3
_MAX_STEPS = 60
_TOLERANCE = 1e-3
"""Gain of a step that is expected and no longer taken [nat]: a twentieth of a σ of a number."""


@dataclass(frozen=True)
class Optimum:
    """The most likely numbers.

    Attributes:
        unknowns: What was estimated.
        coordinates: Where, in units of the priors, shape (k,).
        covariance: Of the coordinates, shape (k, k).
        evaluation: The likelihood there.
        before: The cost at the start.
        steps: Number of steps that were taken.
    """

    unknowns: Unknowns
    coordinates: Array
    covariance: Array
    evaluation: Evaluation
    before: float
    steps: int

    @property
    def joint(self) -> Joint:
        """The joint with these numbers."""
        return self.unknowns.at(self.coordinates)

    @property
    def std(self) -> Array:
        """1σ of the coordinates, shape (k,)."""
        return np.sqrt(np.diag(self.covariance))


def maximise(
    unknowns: Unknowns,
    recordings: Sequence[Recording],
    *,
    seed: int = 0,
    advance: Callable[[int], None] = lambda _: None,
) -> Optimum:
    """Return the most likely numbers.

    First on a short part from several points, without a gate; then on everything from the best of
    them. The Hessian is Fisher's information with the prior's, in a trust region.

    Args:
        unknowns: The numbers.
        recordings: The samples.
        seed: Of the further points that the search starts from.
        advance: Called with the number of filtered samples.
    """
    k, rng = unknowns.count, np.random.default_rng(seed)
    origin = np.zeros(k)
    longest = max(recordings, key=lambda recording: recording.count)
    middle = max(0, (longest.count - _START_SAMPLES) // 2)
    short = Likelihood(
        unknowns, [longest.part(middle, middle + _START_SAMPLES)], advance=advance
    )
    starts = [origin, *(0.5 * rng.standard_normal((_STARTS - 1, k)))]
    found = [_search(short, start, 15) for start in starts]
    best = min(found, key=lambda one: short.cost(one[0]))[0]
    whole = Likelihood(unknowns, recordings, advance=advance)
    best, steps = _search(whole, best, _MAX_STEPS)
    gated = Likelihood(unknowns, recordings, GATE, advance)
    best, more = _search(gated, best, _MAX_STEPS)
    made = gated.evaluate(best)
    hessian = made.information + np.eye(k)
    inverse = np.linalg.inv(hessian)
    # White innovations make both alike; coloured ones do not, and then their spread counts.
    robust = inverse @ (made.spread + np.eye(k)) @ inverse
    ratio = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse), 1.0))
    covariance = inverse * np.outer(ratio, ratio)
    return Optimum(unknowns, best, covariance, made, gated.cost(origin), steps + more)


def _search(likelihood: Likelihood, start: Array, steps: int) -> tuple[Array, int]:
    """Return the point of least cost, and the number of steps to it."""
    unit = np.eye(len(start))

    def settle(intermediate_result: OptimizeResult) -> None:
        made = likelihood.evaluate(intermediate_result.x)
        step = np.linalg.solve(made.information + unit, made.gradient)
        if 0.5 * made.gradient @ step < _TOLERANCE:
            raise StopIteration

    found = minimize(
        likelihood.cost,
        start,
        method="trust-exact",
        jac=lambda at: likelihood.evaluate(at).gradient,
        hess=lambda at: likelihood.evaluate(at).information + unit,
        callback=settle,
        options={
            "initial_trust_radius": 0.5,
            "max_trust_radius": 2.0,
            "gtol": 0.0,
            "maxiter": steps,
        },
    )
    return np.asarray(found.x), int(found.nit)
