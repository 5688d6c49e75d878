# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The core against textbook recursions in NumPy: a filter and its learning, weights, mixture."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import Estimator, certified_estimator
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.estimation.state import State
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate
from tsobs_ros.simulation.signals import Sinusoid

Array = NDArray[np.float64]
LEARNING = {
    "initial_std": 0.3, "random_walk": 1e-3, "start": 0.05, "significance": 0.01, "memory": 0.5,
    "pass_time": 0.2,
}  # fmt: skip
BANK = {name: value for name, value, _ in native.bank_constants()}
BANK |= {"MOVING": 0.3}
"""Constants, but arms need not move as much."""
PARTS = (Hypothesis.COLOURED_NOISE, Hypothesis.DRIFT, Hypothesis.TONE)
"""Hypotheses with a part of the output that is a state of their own."""


def derivative(function: Callable[[Array], Array], point: Array) -> Array:
    """Return the matrix of partial derivatives by complex steps, exact to rounding."""
    steps = point + 1e-30j * np.eye(len(point))
    return np.array([np.imag(function(step)) / 1e-30 for step in steps]).T


class Arm:
    """An arm with any outputs and unknown torques: half a kick, linear flow, half a kick.

    Its steps take complex numbers and at most a period; `noise` is what they add to the covariance.
    """

    def __init__(self, file: Path) -> None:
        self.design = load_design(file)
        request = self.design.arm_request
        self.flow, self.uncertainty = request.flow, request.uncertainty_model
        self._gravity, self._effects = request.arm.gravity_gain, self.uncertainty.directions[:, 0]
        self._linear = cache(request.flow.transition)
        self._torques = np.array([request.flow.motor_torque, request.flow.link_torque])

    def _kick(self, x: Array, theta: Array, u: Array, T: float) -> Array:
        motor, link = self._torques @ x
        signals = np.concatenate([x[:4], [np.sin(x[0])], [u[0] + motor, link]])
        rates = np.tensordot(theta, self._effects, 1) @ signals
        rates[1] = rates[1] - self._gravity * np.sin(x[0])
        return np.concatenate([x[:4] + 0.5 * T * rates, x[4:]])

    def _drift(self, x: Array, theta: Array, u: Array, T: float) -> Array:
        linear = self._linear(T)
        return np.asarray(linear.phi @ self._kick(x, theta, u, T) + linear.gamma @ u)

    def step(self, x: Array, theta: Array, u: Array, T: float) -> Array:
        return self._kick(self._drift(x, theta, u, T), theta, u, T)

    def noise(self, x: Array, theta: Array, u: Array, T: float) -> Array:
        Q = self._linear(T).noise
        after = derivative(lambda z: self._kick(z, theta, u, T), self._drift(x, theta, u, T))
        return after @ Q @ after.T


class Plan:
    """What all filters of an estimator have in common."""

    def __init__(self, system: Arm) -> None:
        request = system.design.request
        self.system, self.C, self.T = system, system.flow.output_matrix, system.flow.period
        self.R, self.X = request.measurement_covariance, system.design.covariance_bound
        self.S = self.C @ self.X @ self.C.T + self.R
        self.K = self.X @ self.C.T @ np.linalg.inv(self.S)
        self.k = system.uncertainty.count

    def estimator(self, gain_mode: str) -> Estimator:
        made = certified_estimator(
            self.system.flow, self.R, 0.9 * self.X, self.K, self.X, settle_time=0.1,
            uncertainty=self.system.uncertainty, gain_mode=gain_mode,
        )  # fmt: skip
        made.learn(self.system.uncertainty, **LEARNING)
        made.model["constants"] = list(BANK.values())
        return made


class Filter:
    """An extended Kalman filter, and the two-stage learning of parameters."""

    def __init__(self, plan: Plan) -> None:
        n, k = len(plan.X), plan.k
        self.plan, self.n = plan, n
        self.x, self.P = np.zeros(n), 0.9 * plan.X
        self.theta, self.gamma = np.zeros(k), LEARNING["initial_std"] ** 2 * np.eye(k)
        self.upsilon, self.gram = np.zeros((n, k)), np.zeros((k, k))
        self.pending, self.anchor = np.zeros(k), np.zeros(k)
        self.significant, self.certified, self.corrected = False, False, False
        self.learning, self.pass_age, self.passes, self.settling = 0.0, 0.0, 0, 0.1

    def expected(self, y: Array) -> tuple[Array, Array, Array]:
        """Return innovations, what is known of their covariance, and of that by the parameters."""
        C = self.plan.C
        known = self.plan.S if self.certified else C @ self.P @ C.T + self.plan.R
        omega = C @ self.upsilon
        return y - C @ self.x, known, omega @ self.gamma @ omega.T

    def correct(self, y: Array, moving: bool) -> None:
        e, known, _ = self.expected(y)
        adapt = moving and self.learning >= LEARNING["start"]
        there = np.isfinite(y)
        if self.certified and there.all():
            omega = self.plan.C @ self.upsilon
            self.x = self.x + self.plan.K @ e
            self.upsilon = self.upsilon - self.plan.K @ omega
            for i in range(len(y)):
                self._learn(omega[i], e[i], known[i, i], adapt)
        else:
            self._leave()
            for i in np.flatnonzero(there):
                self._correct_by(i, y[i], adapt)
        self.corrected = True
        if adapt:
            self._use_pending()
            self._begin_pass()

    def _leave(self) -> None:
        """Go on with Riccati gains from the certificate's bound."""
        if self.certified:
            closed = np.eye(self.n) - self.plan.K @ self.plan.C
            after = closed @ self.plan.X @ closed.T + self.plan.K @ self.plan.R @ self.plan.K.T
            self.P = after if self.corrected else self.plan.X
            self.certified = False

    def _correct_by(self, i: int, y: float, adapt: bool) -> None:
        c, omega = self.plan.C[i], self.plan.C[i] @ self.upsilon
        known = c @ self.P @ c + self.plan.R[i, i]
        e, K = y - c @ self.x, self.P @ c / known
        inflation = self.inflation()
        self.x, self.P = self.x + K * e, self.P - known * np.outer(K, K)
        self.upsilon = self.upsilon - np.outer(K, omega)
        self._learn(omega, e, known, adapt, inflation)

    def inflation(self) -> float:
        """Return how much wider the errors are than with the certified gain."""
        return max(1.0, float(np.trace(np.linalg.solve(self.plan.X, self.P))) / self.n)

    def _learn(
        self, omega: Array, e: float, known: float, adapt: bool, inflation: float = 1.0
    ) -> None:
        """Take a step of recursive least squares, within the limits."""
        self.gram = self.gram + np.outer(omega, omega) / known
        if adapt:
            variance = known * inflation + omega @ self.gamma @ omega
            gain, limits = self.gamma @ omega / variance, self.plan.system.uncertainty.limits
            self.gamma = self.gamma - variance * np.outer(gain, gain)
            moved = self.theta + self.pending + gain * (e - omega @ self.pending)
            self.pending = np.clip(moved, -limits, limits) - self.theta

    def _use_pending(self) -> None:
        evidence = float(self.pending @ np.linalg.solve(self.gamma, self.pending))
        self.significant = self.significant or evidence > LEARNING["significance"]
        if self.significant:
            self.x = self.x + self.upsilon @ self.pending
            self.theta, self.pending = self.theta + self.pending, np.zeros(self.plan.k)

    def _begin_pass(self) -> None:
        """Trust less what the last pass has moved, along wrong regressors."""
        if self.pass_age > LEARNING["pass_time"]:
            self.passes, self.pass_age = self.passes + 1, 0.0
            for a, moved in enumerate(self.theta - self.anchor):
                grown = self.gamma[a, a] + (BANK["CURVED"] * moved) ** 2
                self.gamma[a, a] = min(grown, 0.3**2)
            self.anchor = self.theta.copy()

    def predict(self, u: Array, duration: float) -> None:
        regular = abs(duration / self.plan.T - 1.0) <= 0.1
        serves = self.certified and self.corrected and regular
        if not serves:
            self._leave()
        left = duration
        while left > 1e-9:
            part = min(self.plan.T, left)
            self._step(u, part)
            left -= part
        self.corrected = False
        self.settling = max(0.0, self.settling - duration)
        self.learning += duration
        self.pass_age += duration if self.learning >= LEARNING["start"] else 0.0
        self.gram = (1.0 - duration / LEARNING["memory"]) * self.gram
        for a in range(self.plan.k):
            grown = self.gamma[a, a] + duration * LEARNING["random_walk"]
            self.gamma[a, a] = min(grown, 0.3**2)
        if not serves and self.settling <= 0.0:
            self.certified = bool(np.linalg.eigvalsh(self.plan.X - self.P)[0] >= 0.0)

    def _step(self, u: Array, T: float) -> None:
        system, x, theta = self.plan.system, self.x, self.theta
        F = derivative(lambda z: system.step(z, theta, u, T), x)
        effect = derivative(lambda t: system.step(x, t, u, T), theta)
        self.P = F @ self.P @ F.T + system.noise(x, theta, u, T)
        self.x, self.upsilon = system.step(x, theta, u, T), F @ self.upsilon + effect

    def bound(self, functional: Array) -> float:
        """Return 1σ of a function of the states."""
        P, share = self.plan.X if self.certified else self.P, functional @ self.upsilon
        curved = BANK["CURVED"] * (self.theta + self.pending - self.anchor)
        own = functional @ P @ functional + share @ self.gamma @ share
        return math.sqrt(own + (share @ self.pending) ** 2 + (share @ curved) ** 2)


class Rest:
    """Tells whether the arm moves."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.mean, self.spread = plan, np.zeros(4), np.zeros(4)

    def moves(self, of: Filter) -> bool:
        share = min(self.plan.T / 2.0, 1.0) if of.learning >= LEARNING["start"] else 1.0
        off = of.x[:4] - self.mean
        self.mean = self.mean + share * off
        self.spread = (1.0 - share) * (self.spread + share * off**2)
        least = BANK["MOVING"] ** 2 * self.plan.X.diagonal()[:4]
        return bool((self.spread > least).any())


FILES = {
    "one encoder": config_path(SHIPPED_DESIGN),
    "both encoders": Path(__file__).parent / "data" / "both_encoders.design.yaml",
}


def check(ours: Any, exact: Any, what: str) -> None:
    exact = np.asarray(exact)
    scale = 1e-10 * (1e-4 + np.nanmax(np.abs(exact), initial=0.0))
    np.testing.assert_allclose(ours, exact, rtol=1e-8, atol=scale, err_msg=what)


def compare(core: Any, oracle: Filter, what: str) -> None:
    """Compare a hypothesis' record with its filter, where the core has room for more states."""
    n = oracle.n
    for name in ("theta", "gamma", "gram", "pending", "settling", "learning"):
        check(core[name], getattr(oracle, name), f"{name} {what}")
    check(core["x"][:n], oracle.x, f"x {what}")
    check(core["upsilon"][:, :n].T, oracle.upsilon, f"upsilon {what}")
    assert bool(core["certified"]) == oracle.certified, what
    if not oracle.certified:
        check(core["covariance"][:n, :n], oracle.P, f"covariance {what}")
    assert not core["covariance"][n:].any()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("gain_mode", ["certified", "riccati"])
def test_one_filter_is_that_of_the_formulas(name: str, gain_mode: str) -> None:
    """With Riccati gains; and with the hand-over to the certified gain and back."""
    system = Arm(FILES[name])
    plan = Plan(system)
    observer = plan.estimator(gain_mode)
    p, rng = len(plan.C), np.random.default_rng(5)
    oracle, rest, state = Filter(plan), Rest(plan), observer.initial()
    gains = []
    for step in range(75):
        # Three times as far as it expects, so that it moves enough to be learnt from.
        e, known, learnt = oracle.expected(np.zeros(p))
        y = 3.0 * np.linalg.cholesky(known + learnt) @ rng.standard_normal(p) - e
        if step % 30 == 25 and p > 1:
            y[step // 30 % p] = np.nan
        u, T = 5.0 * rng.standard_normal(1), plan.T * (2.3 if step % 50 == 45 else 1.0)
        oracle.correct(y, rest.moves(oracle))
        state, correction = observer.correct(state, y)
        check(correction.innovation, y + e, "innovation")
        check(correction.innovation_covariance.diagonal(), (known + learnt).diagonal(), "S")
        compare(state.records["hypotheses"][0, 0], oracle, f"after {step}")
        oracle.predict(u, T)
        oracle.certified = oracle.certified and gain_mode == "certified"
        state = observer.predict(state, u, T)
        compare(state.records["hypotheses"][0, 0], oracle, f"before {step + 1}")
        gains.append(oracle.certified)
    assert len({*gains}) == (2 if gain_mode == "certified" else 1)
    assert oracle.passes > 0
    assert oracle.theta.any()
    readout, units = observer.readout(state), system.flow.to_physical(np.ones(4))
    unit, disturbances = np.eye(oracle.n)[:4], system.flow.disturbance_map
    check(readout.state, units * oracle.x[:4], "state")
    check(readout.state_bound, units * list(map(oracle.bound, unit)), "bound")
    check(readout.disturbance, disturbances @ oracle.x, "disturbance")
    check(readout.disturbance_bound, list(map(oracle.bound, disturbances)), "its bound")
    known = oracle.gamma.diagonal() + oracle.pending**2
    known += (BANK["CURVED"] * (oracle.theta + oracle.pending - oracle.anchor)) ** 2
    check(readout.parameter_bound**2, known, "bound of the parameters")


def alone(state: State, place: int) -> State:
    """Return the state with one hypothesis only."""
    other = state.copy()
    others = other.records["hypotheses"][0]
    others["live"] = np.arange(len(others)) == place
    others["score"], other.records["best"] = 0.0, place
    return other


def test_weights_follow_bayes_rule_and_the_mixture_has_their_moments() -> None:
    """Of the hypotheses that compete for friction and a tone, each as it stands alone."""
    design = load_design(config_path(SHIPPED_DESIGN))
    observer, request = design.supervised(0.5), design.request
    scenario = replace(SCENARIOS["friction"], disturbance=(Sinusoid(0.1, 3.0, 1.0),))
    run = simulate(scenario, [1], 6.0)
    (c,), ((variance,),) = request.flow.output_matrix, request.measurement_covariance
    designed = float(c @ design.covariance_bound @ c + variance)

    def likelihood(one: Any, y: float, noise_scale: float) -> float:
        """Return the logarithm of that of a sample by a hypothesis, or of an outlier's."""
        seen = np.append(c, [0.0, one["kind"] in PARTS, 0.0])
        omega, level = one["upsilon"] @ seen, designed * noise_scale**2
        loud = BANK["NOISE_FACTOR"] if one["kind"] == Hypothesis.LOUD else 1.0
        S = seen @ one["covariance"] @ seen + loud * variance * noise_scale**2
        S = (level if one["certified"] else S) + omega @ one["gamma"] @ omega
        least = -BANK["OUTLIER_PRICE"] - 0.5 * math.log(level)
        return max(-0.5 * (y - seen @ one["x"]) ** 2 / S - 0.5 * math.log(S), least)

    state, compared = observer.initial(), set()
    for (y,), u in zip(run.measurements[0], run.torques[0], strict=True):
        before = state.records["hypotheses"][0]
        state, _ = observer.correct(state, [y])
        after = state.records["hypotheses"][0]
        live, scale = np.flatnonzero(before["live"]), max(1.0, float(state.noise_scale.item()))
        if len(live) > 1 and all((before[name] == after[name]).all() for name in ("live", "kind")):
            scores = [one["score"] + likelihood(one, y, scale) for one in before[live]]
            check(after["score"][live], np.maximum(scores - max(scores), -BANK["FLOOR"]), "scores")
            compared |= {*before["kind"][live].tolist()}
        live = np.flatnonzero(after["live"] & (after["score"] >= -0.8 * BANK["FLOOR"]))
        weights = np.exp(after["score"][live])
        weights /= weights.sum()
        whole, parts = observer.readout(state), [observer.readout(alone(state, i)) for i in live]
        for name in ("state", "disturbance"):
            values = np.array([getattr(part, name) for part in parts])
            bounds = np.array([getattr(part, f"{name}_bound") for part in parts])
            mean = weights @ values
            check(getattr(whole, name), mean, name)
            spread = weights @ (bounds**2 + (values - mean) ** 2)
            check(getattr(whole, f"{name}_bound") ** 2, spread, f"bound of {name}")
        state = observer.predict(state, u, request.period)
    assert compared == {*Hypothesis}


@pytest.mark.parametrize(
    ("kind", "power"), [(Hypothesis.IMPERFECT, 1.0), (Hypothesis.TONE, 0.5), (Hypothesis.LOUD, 0.0)]
)
def test_some_hypotheses_trust_the_model_less(kind: Hypothesis, power: float) -> None:
    request = load_design(config_path(SHIPPED_DESIGN)).request
    observer = load_design(config_path(SHIPPED_DESIGN)).supervised(0.5)
    states = [observer.initial(), observer.initial()]
    states[1].records["hypotheses"]["kind"][0, 0] = kind
    spreads = [observer.predict(one, [0.0], request.period).covariance for one in states]
    more = (BANK["IMPERFECTION"] ** power - 1.0) * request.flow.nominal.noise[:4, :4]
    check((spreads[1] - spreads[0])[:4, :4], more, "process noise")
