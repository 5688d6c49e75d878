# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Filter and adaptation against their formulas in NumPy, with derivatives by complex steps."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import Estimator, certified_estimator
from tsobs_ros.estimation.options import (
    AdaptationOptions,
    CertifiedGain,
    GainMode,
    SupervisionOptions,
)
from tsobs_ros.estimation.records import Learning
from tsobs_ros.model.disturbance import DisturbanceModel, bias, clean, gauss_markov, per_channel
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.prediction import Flow
from tsobs_ros.model.ts_flow import TSFlow
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

Array = NDArray[np.float64]
OPTIONS = AdaptationOptions(
    initial_std=0.3, random_walk_density=1e-3, start=0.05, significance=0.01, memory=0.5
)
MOVING, CURVED = 6.0, 0.3
"""Bounds by which a plant at rest may move; share of what was learnt that a bound adds."""


class System(ABC):
    """A system in NumPy, whose step also takes complex numbers."""

    flow: Flow
    uncertainty: Uncertainty

    @abstractmethod
    def step(self, x: Array, theta: Array, u: Array) -> Array:
        """Return the state a period later."""

    @abstractmethod
    def noise(self, x: Array, theta: Array, u: Array) -> Array:
        """Return the covariance that is added in a period."""


def derivative(function: Callable[[Array], Array], point: Array) -> Array:
    """Return the matrix of partial derivatives by complex steps, exact to rounding."""
    steps = point + 1e-30j * np.eye(len(point))
    return np.array([np.imag(function(step)) / 1e-30 for step in steps]).T


def linear_flow(A: Array, W: Array, T: float) -> tuple[Array, Array]:
    """Return the transition and, after Van Loan, the covariance of the noise."""
    n = len(A)
    both = expm(np.block([[-A, W], [np.zeros((n, n)), A.T]]) * T)
    return both[n:, n:].T, both[n:, n:].T @ both[:n, n:]


class Arm(System):
    """The arm of the shipped adaptive design: kick, linear flow, kick."""

    def __init__(self) -> None:
        request = load_design(config_path(SHIPPED_DESIGN)).request
        self.flow, self.uncertainty = request.flow, request.uncertainty_model
        arm, T, n = request.arm, self.flow.period, self.flow.state_count
        self._gravity, self._effects = arm.gravity_gain, self.uncertainty.directions[:, 0]
        A = block_diag(arm.spring_matrix, self.flow.disturbance.S)
        gain = arm.stiffness / arm.link_inertia
        process, G = request.process_noise, self.flow.disturbance.G
        W = block_diag(np.diag([0.0, process.link, 0.0, process.motor * gain**2]), G @ G.T)
        self._phi, self._Q = linear_flow(A, W, T)
        whole = np.zeros((n + 1, n + 1))
        whole[:n, :n], whole[:4, n:] = A, arm.input_matrix
        self._gamma = expm(whole * T)[:n, n]

    def _kick(self, x: Array, theta: Array, u: Array) -> Array:
        signals = np.concatenate([x[:4], [np.sin(x[0])], u, [0.0]])
        rates = np.tensordot(theta, self._effects, 1) @ signals
        rates[1] = rates[1] - self._gravity * np.sin(x[0])
        return np.concatenate([x[:4] + 0.5 * self.flow.period * rates, x[4:]])

    def _drift(self, x: Array, theta: Array, u: Array) -> Array:
        return np.asarray(self._phi @ self._kick(x, theta, u) + self._gamma * u[0])

    def step(self, x: Array, theta: Array, u: Array) -> Array:
        return self._kick(self._drift(x, theta, u), theta, u)

    def noise(self, x: Array, theta: Array, u: Array) -> Array:
        after = derivative(lambda z: self._kick(z, theta, u), self._drift(x, theta, u))
        return after @ self._Q @ after.T


class Blend(System):
    """A T–S system of any size, blended by Gaussian memberships of a state and a signal."""

    def __init__(self, n: int, disturbance: DisturbanceModel, k: int, rules: int) -> None:
        rng = np.random.default_rng(n)
        p, self._n, T = disturbance.channel_count, n, 0.02
        self._A = 0.5 * rng.standard_normal((rules, n, n)) - np.eye(n)
        self._B = rng.standard_normal((rules, n, 2))
        self._centres = np.linspace(-1.0, 1.0, rules)
        self._premise = rng.standard_normal(n) / n
        memberships = [
            (membership("gaussian", {"centre": float(c), "width": 0.8}),) for c in self._centres
        ]
        model = TSModel(
            self._A, self._B, rng.standard_normal((p, n)), RuleBase(tuple(memberships)),
            self._premise[np.newaxis], np.array([[0.7]]),
        )  # fmt: skip
        density = np.linspace(0.1, 0.2, n)
        self.flow = TSFlow(model, disturbance, density, T)
        self._directions = 0.5 * rng.standard_normal((k, rules, n, n + 2))
        names = tuple(f"parameter {i}" for i in range(k))
        self.uncertainty = Uncertainty(dict.fromkeys(names, 0.05), self._directions)
        self._mean = np.concatenate([self._A.mean(axis=0), self._B.mean(axis=0)], axis=1)
        S, G = disturbance.S, disturbance.G
        A = block_diag(self._mean[:, :n], S)
        self._phi, self._Q = linear_flow(A, block_diag(np.diag(density), G @ G.T), 0.5 * T)
        whole = np.zeros((len(A) + 2, len(A) + 2))
        whole[: len(A), : len(A)], whole[:n, len(A) :] = A, self._mean[:, n:]
        self._gamma = expm(0.5 * T * whole)[: len(A), len(A) :]

    def _entering(self, x: Array, theta: Array, u: Array) -> Array:
        z = self._premise @ x[: self._n] + 0.7 * u[2]
        fired = np.exp(-0.5 * ((z - self._centres) / 0.8) ** 2)
        entries = np.concatenate([self._A, self._B], axis=2) - self._mean
        entries = entries + np.tensordot(theta, self._directions, 1)
        blend = np.tensordot(fired / fired.sum(), entries, 1)
        rates = blend @ np.concatenate([x[: self._n], u[:2]])
        return np.concatenate([rates, np.zeros(len(x) - self._n)])

    def _middle(self, x: Array, theta: Array, u: Array) -> Array:
        return np.asarray(
            self._phi @ (x + 0.5 * self.flow.period * self._entering(x, theta, u))
            + self._gamma @ u[:2]
        )

    def step(self, x: Array, theta: Array, u: Array) -> Array:
        entering = self._entering(self._middle(x, theta, u), theta, u)
        forced = self._gamma @ u[:2]
        return np.asarray(
            self._phi @ (self._phi @ x + forced + self.flow.period * entering) + forced
        )

    def noise(self, x: Array, theta: Array, u: Array) -> Array:
        slope = derivative(lambda z: self._entering(z, theta, u), self._middle(x, theta, u))
        spread = self._phi @ (np.eye(len(x)) + self.flow.period * slope)
        return spread @ self._Q @ spread.T + self._Q


class Reference:
    """The estimator in matrices, with Riccati gains."""

    def __init__(self, system: System, R: Array, start: Array, bound: Array) -> None:
        n, k = system.flow.state_count, system.uncertainty.count
        self.system, self.C, self.R, self.X = system, system.flow.output_matrix, R, bound
        self.x, self.covariance, self.theta = np.zeros(n), start, np.zeros(k)
        self.gamma, self.upsilon = OPTIONS.initial_std**2 * np.eye(k), np.zeros((n, k))
        self.gram, self.age = np.zeros((k, k)), 0.0
        self.pending, self.significant = np.zeros(k), False
        self.mean, self.spread = np.zeros(n), np.zeros(n)

    def moves(self) -> bool:
        """Follow mean and variance of the plant's states; return whether they are far from rest."""
        share = 1.0
        if self.age >= OPTIONS.start:
            share = 1.0 - math.exp(-0.5 * self.system.flow.period)
        off = self.x - self.mean
        self.mean = self.mean + share * off
        self.spread = (1.0 - share) * (self.spread + share * off**2)
        far = self.spread > MOVING**2 * self.X.diagonal()
        return bool(far[: len(self.system.flow.to_physical(self.x))].any())

    def correct(self, y: Array) -> Array:
        """Use a sample; return the covariance that was expected of its innovation."""
        C, n = self.C, len(self.x)
        S = C @ self.covariance @ C.T + self.R
        K = self.covariance @ C.T @ np.linalg.inv(S)
        innovation, omega = y - C @ self.x, C @ self.upsilon
        explained = omega @ self.gamma @ omega.T
        inflation = max(1.0, float(np.trace(np.linalg.solve(self.X, self.covariance))) / n)
        closed = np.eye(n) - K @ C
        self.x = self.x + K @ innovation
        self.covariance = closed @ self.covariance @ closed.T + K @ self.R @ K.T
        self.upsilon = self.upsilon - K @ omega
        self.gram = self.gram + omega.T @ np.linalg.inv(S) @ omega
        if self.moves() and self.age >= OPTIONS.start:
            gain = self.gamma @ omega.T @ np.linalg.inv(S * inflation + explained)
            limits = self.system.uncertainty.limits
            self.gamma = self.gamma - gain @ omega @ self.gamma
            shift = self.pending + gain @ (innovation - omega @ self.pending)
            self.pending = np.clip(self.theta + shift, -limits, limits) - self.theta
            evidence = float(self.pending @ np.linalg.solve(self.gamma, self.pending))
            if self.significant or evidence > OPTIONS.significance:
                self.significant = True
                self.x = self.x + self.upsilon @ self.pending
                self.theta, self.pending = self.theta + self.pending, np.zeros(len(shift))
        return np.asarray(S + explained)

    def predict(self, u: Array) -> None:
        """Predict over a period."""
        step, x, theta, T = self.system.step, self.x, self.theta, self.system.flow.period
        F = derivative(lambda z: step(z, theta, u), x)
        effect = derivative(lambda t: step(x, t, u), theta)
        noise = self.system.noise(x, theta, u)
        self.x, self.covariance = step(x, theta, u), F @ self.covariance @ F.T + noise
        self.upsilon = F @ self.upsilon + effect
        gamma = self.gamma + T * OPTIONS.random_walk_density * np.eye(len(theta))
        shrink = np.minimum(1.0, OPTIONS.initial_std / np.sqrt(gamma.diagonal()))
        self.gamma = gamma * np.outer(shrink, shrink)
        self.gram = self.gram * math.exp(-T / OPTIONS.memory)
        self.age += T


def estimator_of(system: System, R: Array, start: Array, bound: Array) -> Estimator:
    n, p = system.flow.state_count, len(R)
    return certified_estimator(
        system.flow,
        R,
        start,
        CertifiedGain(np.zeros((n, p)), bound),
        gain_mode=GainMode.RICCATI,
        uncertainty=system.uncertainty,
        adaptation=OPTIONS,
    )


SYSTEMS: dict[str, Callable[[], System]] = {
    "arm": Arm,
    "two outputs of one state": lambda: Blend(1, per_channel([clean(), bias(1e-3)]), 2, 2),
    "many": lambda: Blend(9, per_channel([bias(1e-3), clean(), gauss_markov(), bias(1e-2)]), 6, 5),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_each_step_is_that_of_the_formulas(name: str) -> None:
    system = SYSTEMS[name]()
    n, p, m = system.flow.state_count, len(system.flow.output_matrix), system.flow.input_count
    rng = np.random.default_rng(3)
    root = 0.05 * rng.standard_normal((n, n)) + 0.3 * np.eye(n)
    R, start, bound = np.diag(np.linspace(0.01, 0.02, p)), root @ root.T, 0.01 * np.eye(n)
    reference, observer = Reference(system, R, start, bound), estimator_of(system, R, start, bound)
    state, limited, waited = observer.initial(), False, 0.0
    size = 0.5 if name == "arm" else 3.0  # far from rest
    for step in range(120):
        y, u = size * rng.standard_normal(p), rng.standard_normal(m)
        expected = reference.correct(y)
        state, correction = observer.correct(state, y)
        np.testing.assert_allclose(
            correction.innovation_covariance, expected, rtol=1e-8, atol=1e-12
        )
        limited = limited or bool((np.abs(reference.theta) == system.uncertainty.limits).any())
        waited = max(waited, float(np.abs(reference.pending).max()))
        reference.predict(u)
        state = observer.predict(state, u, system.flow.period)
        for field in ("x", "covariance", "theta", "pending", "gamma", "gram", "age"):
            ours, exact = getattr(state, field), np.asarray(getattr(reference, field))
            scale = 1e-9 * (1e-6 + np.abs(exact).max())
            np.testing.assert_allclose(
                ours, exact, rtol=1e-7, atol=scale, err_msg=f"{field} {step}"
            )
        scale = 1e-9 * (1e-6 + np.abs(reference.upsilon).max())
        np.testing.assert_allclose(state.upsilon.T, reference.upsilon, rtol=1e-7, atol=scale)
    assert waited > 0.001 or name != "arm"  # where it is significant at once
    assert np.abs(reference.theta).max() > 0.01
    assert limited == (name != "arm")

    readout = observer.readout(state)
    spread = reference.upsilon @ reference.gamma @ reference.upsilon.T
    whole = np.maximum(state.covariance.diagonal(), bound.diagonal()) + spread.diagonal()
    units = system.flow.to_physical(np.ones(n))
    np.testing.assert_allclose(readout.state, system.flow.to_physical(reference.x), rtol=1e-6)
    np.testing.assert_allclose(readout.state_bound, units * np.sqrt(whole[: len(units)]), rtol=1e-6)
    q = system.flow.disturbance.state_count
    H, own = system.flow.disturbance.H, state.covariance[n - q :, n - q :]
    np.testing.assert_allclose(readout.disturbance, H @ reference.x[n - q :], atol=1e-7)
    wide = np.diag(H @ spread[n - q :, n - q :] @ H.T)
    least = np.diag(H @ bound[n - q :, n - q :] @ H.T)
    expected = np.sqrt(np.maximum(np.diag(H @ own @ H.T), least) + wide)
    np.testing.assert_allclose(readout.disturbance_bound, expected, rtol=1e-6)
    known = reference.gamma.diagonal() + (CURVED * reference.theta) ** 2
    np.testing.assert_allclose(readout.parameter_bound**2, known, rtol=1e-6)


def test_learning_starts_over_under_strain_rests_after_a_few_times_and_comes_back() -> None:
    """Gain and regressor are reset; the parameters only if learning rests from then on."""
    design = load_design(config_path(SHIPPED_DESIGN))
    observer = design.supervised(
        options=SupervisionOptions(relearn_budget=1, relearn_time=0.1, strain=0.5)
    )
    fresh = observer.initial()
    limits, eye, u = design.request.uncertainty_model.limits, np.eye(2), np.zeros(1)
    state = fresh.changed(
        theta=limits, anchor=limits, gamma=1e-3 * eye, gram=500.0 * eye, upsilon=0.1,
        age=9.0, pass_age=5.0, pinned=0.499,
    )  # fmt: skip
    assert observer.readout(state).parameters_valid
    reset, _ = observer.correct(state, [0.01])
    assert (int(reset.adaptation_resets), reset.pinned) == (1, 0.0)
    assert (reset.gamma == fresh.gamma).all()
    assert not reset.upsilon.any()
    assert (reset.theta == limits).all()
    assert (reset.gram >= 0.9 * state.gram).all()
    assert observer.readout(reset).learning == Learning.ACTIVE

    resting, _ = observer.correct(reset.changed(pass_age=5.0, pinned=0.499), [0.02])
    assert int(resting.adaptation_resets) == 1
    assert not resting.theta.any()
    assert not resting.gram.any()
    came = observer.readout(resting.changed(gram=500.0 * eye))
    assert came.learning == Learning.STRAINED
    assert not came.parameters_valid

    steps, state = 0, resting
    while observer.readout(state).learning == Learning.STRAINED:
        state, steps = observer.predict(state, u, 0.005), steps + 1
        state, _ = observer.correct(state, [0.01 + 0.001 * (steps % 2)])
    assert steps == 20  # a budget of one comes back in relearn_time
    assert not state.theta.any()
