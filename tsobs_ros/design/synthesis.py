# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Synthesis of the certified gain by semidefinite programming (cvxpy with Clarabel).

In delta coordinates Ã = (A − I)/T, R_c = R T, and with one matrix P for all slope vertices,

    ⎡ (λ²−1)/T P − PÃ − ÃᵀP + C̄ᵀR_c⁻¹C̄    √T (PÃ − C̄ᵀR_c⁻¹C̄)    P G ⎤
    ⎢               *                       P + T C̄ᵀR_c⁻¹C̄       0  ⎥ ⪰ 0 ,  G Gᵀ = Q/T
    ⎣               *                               *             I  ⎦

is the closed-loop inequality of `certificate` with the optimal gain K = X C̄ᵀ(C̄XC̄ᵀ + R)⁻¹
eliminated by completing the square, and it stays well conditioned as T → 0.

Two choices differ from a plain trace minimisation. First, the volume of the bound, log det X, is
minimised, by minimising trace(Z⁻¹X) around the last solution Z until it settles. The states have
different units, and a plain trace would weigh radians against radians per second. The same Z = T Tᵀ
scales the problem; otherwise interior-point solvers stall. Second, the design assumes a little more
noise than there is, relative to the bound, so that the inequalities hold strictly. The extra noise
is the first of `MARGINS` whose answer passes the re-check. An arm with modes of 1000 rad/s needs
the second or third, because a margin of 1e-4 per second is 1e-7 of the terms whose difference it
is. Neither tighter tolerances nor more equilibration makes the solver that accurate.

For slow systems, T and the extra noise are in a unit of time longer than a second: 20 periods, or
the time of the error's fastest mode if that is longer. Otherwise a change of 1e-4 per second would
count as little for the solver, and as much noise for a system that takes hours.
"""

import math
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import clarabel
import cvxpy as cp
import numpy as np
from scipy.linalg import solve_discrete_are

from tsobs_ros.checks import Array, expect
from tsobs_ros.design.certificate import check_certificate
from tsobs_ros.design.feasibility import find_obstacles, require_detectable
from tsobs_ros.design.record import Design, SolverReport
from tsobs_ros.design.request import AnyRequest, ArmRequest, Output, TSRequest
from tsobs_ros.errors import DesignError, ModelError
from tsobs_ros.model.arm import ANGLES
from tsobs_ros.model.disturbance import CLEAN, DisturbanceTerm
from tsobs_ros.model.prediction import VertexSystem

MARGINS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
"""Extra noise density, as a fraction of the bound per second or longer unit of time of a slow
system, that makes the claim strict."""

_SETTLED = 1e-3
_DECAYING = (DisturbanceTerm("gauss_markov"),)
_SHARES = (0.75, 0.5, 0.25)


class Remedy(NamedTuple):
    """A change of a request in words, and the request after it."""

    text: str
    request: AnyRequest


class _Solution(NamedTuple):
    covariance: Array
    objective: float
    status: str
    iterations: int


def synthesise(request: AnyRequest) -> Design:
    """Design the certified gain for a request.

    Args:
        request: Model, noise, domain and rate.

    Returns:
        The design with the smallest proved bound, its certificate re-checked.

    Raises:
        DetectabilityError: No observer can exist; the message names the hidden mode and the reason.
        DesignError: The solver found no common matrix P, or its answer failed the re-check.
    """
    expect("request", request, ArmRequest | TSRequest, "a request, as of load_request")
    try:
        require_detectable(request)
        return Design(request, *solve_gain(request))
    except DesignError as error:
        firsts = (next(filter(_has_design, family), None) for family in _remedies(request))
        found = [remedy for remedy in firsts if remedy is not None]
        advice = [remedy.text for remedy in found] or ["none of the changes that were tried"]
        text = "\n  - ".join([f"{error}\nwhat would help:", *advice])
        raise type(error)(text, found) from error


def _has_design(remedy: Remedy) -> bool:
    """Return whether a changed request has a design that is found with little effort."""
    try:
        require_detectable(remedy.request)
        solve_gain(remedy.request, passes=1, smallest_step=1.0 / 4.0)
    except DesignError:
        return False
    return True


def solve_gain(
    problem: AnyRequest, passes: int = 12, smallest_step: float = 1.0 / 64.0
) -> tuple[Array, Array, SolverReport]:
    """Return P and K with the smallest proved bound, re-checked, and the solver's report.

    At most `passes` solves shrink the bound's volume. The solved share of the domain grows in steps
    of at least `smallest_step`.

    Raises:
        DesignError: The solver found no common matrix P, or its answer failed the re-check.
    """
    started = time.perf_counter()
    solution = _walk_to_domain(problem, MARGINS[0], smallest_step)
    for margin in MARGINS:
        solution = _settle(problem, solution, margin, passes)
        P = np.linalg.inv(solution.covariance)
        P = (P + P.T) / 2
        C, R, bound = problem.flow.output_matrix, problem.measurement_covariance, np.linalg.inv(P)
        K = bound @ C.T @ np.linalg.inv(C @ bound @ C.T + R)
        report = check_certificate(problem, P, K)
        if report.holds:
            break
    else:
        raise DesignError(
            f"the solver answered {solution.status!r}, but on re-checking: {report.worst}"
        )
    seconds = round(time.perf_counter() - started, 3)
    how = solution.status, solution.iterations, seconds, margin
    version = f"{clarabel.__version__} (cvxpy {cp.__version__})"
    return P, K, SolverReport("Clarabel", version, *how)


def _walk_to_domain(problem: AnyRequest, margin: float, smallest_step: float) -> _Solution:
    """Solve on the whole domain, from its middle in as few steps as the solver manages."""
    starts = [problem.vertices(share)[0] for share in problem.starts]
    found = [_kalman_covariance(problem, start) for start in starts]
    guesses = [guess for guess in found if guess is not None]
    if not guesses:
        where = starts[-1].where
        raise DesignError(
            f"no stationary Kalman filter at {where}; process_noise may be too small: its noise "
            "has to reach every state"
        )
    scaling, share, step = guesses[0], 0.0, 1.0
    solution: _Solution | None = None
    while share < 1.0 or solution is None:
        target = min(1.0, share + step)
        candidate = _solve(problem, problem.vertices(target), scaling, margin)
        if candidate is None:
            step = step / 2
            if step < smallest_step:
                raise DesignError(
                    "no common matrix P exists, or none the solver can find, for "
                    f"{problem.domain} at decay rate {problem.decay_rate:.4g} 1/s and "
                    f"{problem.rate:.4g} Hz; it reached {100.0 * share:.3g} % of that range"
                )
            if solution is None:
                scaling = guesses[-1]
            continue
        solution, share, scaling = candidate, target, candidate.covariance
    return solution


def _settle(problem: AnyRequest, solution: _Solution, margin: float, passes: int) -> _Solution:
    """Repeat the solve around its own answer until the bound's volume stops shrinking."""
    vertices = problem.vertices()
    for _ in range(passes):
        candidate = _solve(problem, vertices, solution.covariance, margin)
        if candidate is None:
            break
        solution = candidate
        if abs(solution.objective - problem.flow.state_count) < _SETTLED:
            break
    return solution


def _solve(
    problem: AnyRequest, vertices: Sequence[VertexSystem], scaling: Array, margin: float
) -> _Solution | None:
    """Minimise trace(Z⁻¹X) over the vertices with Z = `scaling`; None if the solver gives up."""
    n, R = problem.flow.state_count, problem.measurement_covariance
    root = np.linalg.cholesky(scaling)
    inverse = np.linalg.inv(root)
    decay = np.exp(-2.0 * problem.decay_rate * problem.period)
    output = problem.flow.output_matrix @ root
    closed = np.eye(n) - output.T @ np.linalg.inv(output @ output.T + R) @ output
    modes = np.linalg.eigvals(inverse @ vertices[0].transition @ root @ closed)
    unit = max(1.0, problem.period / min(np.abs(modes - 1.0).max(), 1.0 / 20.0))
    period = problem.period / unit
    information = output.T @ np.linalg.inv(period * R) @ output

    P, W = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    constraints = [cp.bmat([[W, np.eye(n)], [np.eye(n), P]]) >> 0]
    for vertex in vertices:
        delta = inverse @ ((vertex.transition - np.eye(n)) / period) @ root
        noise = inverse @ (vertex.noise / period) @ inverse.T + margin * np.eye(n)
        G = np.linalg.cholesky((noise + noise.T) / 2)
        corner = (decay - 1.0) / period * P - P @ delta - delta.T @ P + information
        cross = np.sqrt(period) * (P @ delta - information)
        middle, zero = P + period * information, np.zeros((n, n))
        rows = [corner, cross, P @ G], [cross.T, middle, zero], [(P @ G).T, zero, np.eye(n)]
        block = cp.bmat(list(rows))
        constraints.append((block + block.T) / 2 >> 0)
    program = cp.Problem(cp.Minimize(cp.trace(W)), constraints)
    try:
        with warnings.catch_warnings():
            # "Solution may be inaccurate" is harmless: every answer is re-checked.
            warnings.simplefilter("ignore", UserWarning)
            program.solve(solver=cp.CLARABEL, tol_gap_abs=1e-6, tol_gap_rel=1e-6, tol_feas=1e-7)
    except cp.SolverError:
        return None
    if P.value is None or program.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        return None
    normalised = np.linalg.inv((P.value + P.value.T) / 2)
    if np.linalg.eigvalsh(normalised)[0] <= 0.0:
        return None
    covariance = root @ normalised @ root.T
    iterations = int(program.solver_stats.num_iters or 0)
    how = float(np.trace(normalised)), str(program.status), iterations
    return _Solution((covariance + covariance.T) / 2, *how)


def _kalman_covariance(problem: AnyRequest, vertex: VertexSystem) -> Array | None:
    """Return the stationary prior covariance of the Kalman filter of one system, or None."""
    C, R = problem.flow.output_matrix, problem.measurement_covariance
    try:
        covariance = solve_discrete_are(vertex.transition.T, C.T, vertex.noise, R)
        covariance = np.asarray((covariance + covariance.T) / 2)
        np.linalg.cholesky(covariance)
    except (np.linalg.LinAlgError, ValueError):
        # SciPy raises either error, depending on where its ordering of eigenvalues fails.
        return None
    return covariance


def _remedies(request: AnyRequest) -> Iterator[Iterable[Remedy]]:
    """Yield changes of a request that has no design, grouped by kind, the smallest first.

    The first change of each kind that leads to a design is suggested.
    """
    if request.disturbance_model.arbitrary:
        yield [_modelled(request, kind) for kind in ("bias", "gauss_markov")]
        return
    if obstacles := find_obstacles(request):
        slopes = [each.slope for each in obstacles if each.slope is not None]
        if isinstance(request, ArmRequest) and len(slopes) == len(obstacles):
            yield _domain_above(request, max(slopes))
    else:
        yield _faster(request)
        smaller = [request.on_share(share) for share in _SHARES]
        yield [Remedy(*each) for each in smaller if each is not None]
        slower = [share * request.decay_rate for share in (0.25, 0.0) if request.decay_rate]
        yield [
            Remedy(f"a smaller decay_rate: {rate:.3g} 1/s", replace(request, decay_rate=rate))
            for rate in slower
        ]
    for terms, kept, text in (
        (_DECAYING, ("clean", "gauss_markov"), "whose decaying state need not be seen"),
        (CLEAN, ("clean",), "if it is not disturbed"),
    ):
        for place, channel in enumerate(request.channels):
            if any(term.kind not in kept for term in channel.terms):
                words = f"kind {terms[0].kind} for {channel.name}, {text}"
                yield [Remedy(words, request.with_terms(place, terms))]
    if isinstance(request, ArmRequest):
        std = float(request.output_std[0])
        for name in (name for name in ANGLES if name not in request.output_names):
            text = f"a further output without disturbance: {name} with 1σ of {std:.3g} rad"
            outputs = [*request.sensors, Output(name, std)]
            both = replace(request, outputs=outputs, disturbance=None, measurement_std=None)
            yield [Remedy(text, both)]


def _modelled(request: AnyRequest, kind: str) -> Remedy:
    """Return the request with each arbitrary term replaced by a term of a given kind."""
    for place, channel in enumerate(request.channels):
        model = DisturbanceTerm(kind)
        terms = tuple(model if each.kind == "arbitrary" else each for each in channel.terms)
        request = request.with_terms(place, terms)
    return Remedy(f"a model of the disturbance in place of arbitrary: kind {kind}", request)


def _domain_above(request: ArmRequest, slope: float) -> Iterator[Remedy]:
    tidy = 0.0 if abs(slope) < 1e-12 else slope
    widest = math.acos(min(tidy, 1.0))
    for share in (0.95, *_SHARES) if slope < 1.0 - 1e-9 else ():
        x_max = float(f"{share * widest:.3g}")
        text = (
            f"a smaller domain: x_max below {widest:.4g} rad keeps the slope above {tidy:.4g}; "
            f"{x_max:g} rad has a design"
        )
        yield Remedy(text, replace(request, x_max=x_max))


def _faster(request: AnyRequest) -> Iterator[Remedy]:
    slower = ""
    for factor in (1.5, 2.0, 3.0, 5.0, 10.0, 20.0):
        rate = factor * request.rate
        try:
            faster = replace(request, rate=rate)
        except ModelError:  # a delay of too many periods
            return
        yield Remedy(f"a faster rate: {rate:g} Hz{slower}", faster)
        slower = f" ({rate:g} Hz is not enough)"
