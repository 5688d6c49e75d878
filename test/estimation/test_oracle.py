# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The core against textbook recursions in NumPy: filters, learning, weights, mixture."""

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import Estimator, SupervisionOptions, certified_estimator
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.estimation.state import State
from tsobs_ros.model.disturbance import DisturbanceModel, bias, clean, gauss_markov, per_channel
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_flow import TSFlow
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

Array = NDArray[np.float64]
LEARNING = {
    "initial_std": 0.3, "random_walk": 1e-3, "start": 0.05, "significance": 0.01, "memory": 0.5,
    "pass_time": 0.2,
}  # fmt: skip
BANK = {name: value for name, value, _ in native.bank_constants()}
BANK |= {"MOVING": 0.3}
"""Constants, but arms need not move as much."""
GATE = 5.0
SENSOR = (Hypothesis.COLOURED_NOISE, Hypothesis.DRIFT)


def derivative(function: Callable[[Array], Array], point: Array) -> Array:
    """Return the matrix of partial derivatives by complex steps, exact to rounding."""
    steps = point + 1e-30j * np.eye(len(point))
    return np.array([np.imag(function(step)) / 1e-30 for step in steps]).T


class Arm:
    """An arm with any outputs and unknown torques: half a kick, linear flow, half a kick.

    Its steps, as those of the other system, take complex numbers and at most a period; `noise` is
    what they add to the covariance, and `process` that in a period if nothing bends it.
    """

    def __init__(self, file: Path) -> None:
        self.design = load_design(file)
        request = self.design.arm_request
        self.flow, self.uncertainty = request.flow, request.uncertainty_model
        self._gravity, self._effects = request.arm.gravity_gain, self.uncertainty.directions[:, 0]
        self.process = request.flow.nominal.noise
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


class Blend:
    """A T–S system of any size, blended by Gaussian memberships of a state and a signal."""

    def __init__(self, n: int, disturbance: DisturbanceModel, k: int, rules: int) -> None:
        rng = np.random.default_rng(n)
        p, self._n, period = disturbance.channel_count, n, 0.02
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
        self.flow = TSFlow(model, disturbance, density, period)
        self._directions = 0.5 * rng.standard_normal((k, rules, n, n + 2))
        self.uncertainty = Uncertainty({f"parameter {i}": 0.05 for i in range(k)}, self._directions)
        self._mean = np.concatenate([self._A.mean(axis=0), self._B.mean(axis=0)], axis=1)
        self._S, G = disturbance.S, disturbance.G
        self._W = block_diag(np.diag(density), G @ G.T)
        self._linear = cache(self._halves)
        self.process = 2.0 * self._linear(period)[2]

    def _halves(self, T: float) -> tuple[Array, Array, Array]:
        """Return transition, effect of the inputs and, after Van Loan, noise over half a time."""
        A = block_diag(self._mean[:, : self._n], self._S)
        n = len(A)
        whole = np.zeros((n + 2, n + 2))
        whole[:n, :n], whole[: self._n, n:] = A, self._mean[:, self._n :]
        phi = expm(0.5 * T * whole)
        both = expm(np.block([[-A, self._W], [np.zeros((n, n)), A.T]]) * 0.5 * T)
        return phi[:n, :n], phi[:n, n:], both[n:, n:].T @ both[:n, n:]

    def _entering(self, x: Array, theta: Array, u: Array) -> Array:
        z = self._premise @ x[: self._n] + 0.7 * u[2]
        fired = np.exp(-0.5 * ((z - self._centres) / 0.8) ** 2)
        entries = np.concatenate([self._A, self._B], axis=2) - self._mean
        entries = entries + np.tensordot(theta, self._directions, 1)
        blend = np.tensordot(fired / fired.sum(), entries, 1)
        rates = blend @ np.concatenate([x[: self._n], u[:2]])
        return np.concatenate([rates, np.zeros(len(x) - self._n)])

    def _middle(self, x: Array, theta: Array, u: Array, T: float) -> Array:
        phi, gamma, _ = self._linear(T)
        return np.asarray(phi @ (x + 0.5 * T * self._entering(x, theta, u)) + gamma @ u[:2])

    def step(self, x: Array, theta: Array, u: Array, T: float) -> Array:
        phi, gamma, _ = self._linear(T)
        entering = self._entering(self._middle(x, theta, u, T), theta, u)
        forced = gamma @ u[:2]
        return np.asarray(phi @ (phi @ x + forced + T * entering) + forced)

    def noise(self, x: Array, theta: Array, u: Array, T: float) -> Array:
        phi, _, Q = self._linear(T)
        slope = derivative(lambda z: self._entering(z, theta, u), self._middle(x, theta, u, T))
        spread = phi @ (np.eye(len(x)) + T * slope)
        return spread @ Q @ spread.T + Q


System = Arm | Blend


class Plan:
    """What all filters of an estimator have in common."""

    def __init__(self, system: System, seed: int, forks: bool = False) -> None:
        self.system, rng = system, np.random.default_rng(seed)
        n, p = system.flow.state_count, len(system.flow.output_matrix)
        root = 0.05 * rng.standard_normal((n, n)) + 0.3 * np.eye(n)
        self.C, self.T, self.k = system.flow.output_matrix, system.flow.period, 0
        self.R, self.start = np.diag(np.linspace(0.01, 0.02, p)), root @ root.T
        self.X = 1.5 * self.start + 0.05 * np.eye(n)
        if isinstance(system, Arm):
            self.R, self.X = (
                system.design.request.measurement_covariance,
                system.design.covariance_bound,
            )
            self.start = 0.9 * self.X
        self.S = self.C @ self.X @ self.C.T + self.R
        self.K = self.X @ self.C.T @ np.linalg.inv(self.S)
        self.plant = len(system.flow.to_physical(np.ones(n)))
        self.supervised, self.force = forks, 0.0

    def estimator(self, **options: Any) -> Estimator:
        made = certified_estimator(
            self.system.flow, self.R, self.start, self.K, self.X, settle_time=0.1,
            uncertainty=self.system.uncertainty, **options,
        )  # fmt: skip
        made.learn(self.system.uncertainty, **LEARNING)
        made.model["constants"] = list(BANK.values())
        if self.supervised:
            made.supervise(SupervisionOptions(disturbance_limit=1e9))
        self.k, self.force = self.system.uncertainty.count, float(made.model["force"][0])
        return made


class Filter:
    """One hypothesis: an extended Kalman filter with states of its own behind the design's, and
    the two-stage learning of parameters.
    """

    def __init__(self, plan: Plan, kind: Hypothesis = Hypothesis.AS_DESIGNED) -> None:
        n, k, p = len(plan.C.T), plan.k, len(plan.C)
        self.plan, self.kind, self.n, self.score = plan, kind, n, 0.0
        self.frequency, self.size, self.output = 7.0, 0.1, p - 1
        self.own = {Hypothesis.FORCE: 1, Hypothesis.TONE: 2}.get(kind, p if kind in SENSOR else 0)
        std, _ = self._stationary()
        self.x = np.zeros(n + self.own)
        self.P = block_diag(plan.start, np.diag(std**2 * np.ones(self.own)))
        self.theta, self.gamma = np.zeros(k), LEARNING["initial_std"] ** 2 * np.eye(k)
        self.upsilon, self.gram = np.zeros((n + self.own, k)), np.zeros((k, k))
        self.pending, self.anchor = np.zeros(k), np.zeros(k)
        self.significant, self.certified, self.corrected = False, False, False
        self.learning, self.pass_age, self.passes = 0.0, 0.0, 0
        self.settling, self.loudness = 0.1, 1.0
        self.nis, self.colour, self.slow_power = 1.0, 0.0, 0.0
        self.previous, self.slow = np.zeros(p), np.zeros(p)

    def _stationary(self) -> tuple[Any, float]:
        """Return 1σ, a number or one an output, and correlation time of the states of its own."""
        std = np.sqrt(np.diag(self.plan.R))
        return {
            Hypothesis.FORCE: (self.plan.force, BANK["FORCE_TIME"]),
            Hypothesis.COLOURED_NOISE: (BANK["COLOUR_SIZE"] * std, BANK["COLOUR_TIME"]),
            Hypothesis.DRIFT: (BANK["DRIFT_SIZE"] * std, BANK["DRIFT_TIME"]),
            Hypothesis.TONE: (self.size, BANK["TONE_TIME"]),
        }.get(self.kind, (0.0, 1.0))

    @property
    def C(self) -> Array:
        """The states to the outputs."""
        own = np.zeros((len(self.plan.C), self.own))
        if self.kind in SENSOR:
            own = np.eye(self.own)
        elif self.kind is Hypothesis.TONE:
            own[self.output, 0] = 1.0
        return np.hstack([self.plan.C, own])

    def expected(self, y: Array, scale: Array) -> tuple[Array, Array, Array]:
        """Return innovations, what is known of their covariance, and of that by the parameters."""
        C, loud = self.C, BANK["NOISE_FACTOR"] if self.kind is Hypothesis.LOUD else 1.0
        known = C @ self.P @ C.T + loud * self.plan.R * scale**2
        if self.certified:
            known = self.plan.S * np.outer(scale, scale)
        omega = C @ self.upsilon
        return y - C @ self.x, known, omega @ self.gamma @ omega.T

    def correct(self, y: Array, moving: bool, now: "Sensors", price: float = math.inf) -> float:
        """Use a sample; return the logarithm of its likelihood."""
        scale = now.sizes
        e, known, learnt = self.expected(y, scale)
        variances, level = (known + learnt).diagonal(), scale**2 * self.plan.S.diagonal()
        said = -0.5 * e**2 / variances - 0.5 * np.log(variances)
        there = np.isfinite(y)
        self.loudness = float(scale[there].max()) if self.plan.supervised else 1.0
        used = there & (~np.isfinite(price) | (said >= -0.5 * GATE**2 - 0.5 * np.log(level)))
        least = -price - 0.5 * np.log(level)
        said = np.where(there, np.maximum(said, least), 0.0)
        adapt = moving and self.learning >= LEARNING["start"]
        if not used.any():
            return float(said.sum())
        if self.certified and used.all():
            omega = self.C @ self.upsilon
            self.x = self.x + self.plan.K @ e
            self.upsilon = self.upsilon - self.plan.K @ omega
            for i in range(len(y)):
                inflation = self.inflation()
                self._follow(i, e[i], variances[i], now.elapsed[i])
                self._learn(omega[i], e[i], known[i, i], inflation, adapt)
        else:
            self._leave()
            for i in np.flatnonzero(used):
                said[i] = max(self._correct_by(i, y[i], now, adapt), least[i])
        self.corrected = True
        if adapt:
            self._use_pending()
            self._begin_pass()
        return float(said.sum())

    def _leave(self) -> None:
        """Go on with Riccati gains from the certificate's bound."""
        if self.certified:
            closed = np.eye(self.n) - self.plan.K @ self.plan.C
            after = closed @ self.plan.X @ closed.T + self.plan.K @ self.plan.R @ self.plan.K.T
            self.P = self.loudness**2 * (after if self.corrected else self.plan.X)
            self.certified = False

    def _correct_by(self, i: int, y: float, now: "Sensors", adapt: bool) -> float:
        loud = BANK["NOISE_FACTOR"] if self.kind is Hypothesis.LOUD else 1.0
        c, omega = self.C[i], self.C[i] @ self.upsilon
        known = c @ self.P @ c + loud * self.plan.R[i, i] * now.sizes[i] ** 2
        e, K = y - c @ self.x, self.P @ c / known
        variance = known + omega @ self.gamma @ omega
        inflation, before = self.inflation(), self.x[self.n :].copy()
        self.x, self.P = self.x + K * e, self.P - known * np.outer(K, K)
        self.upsilon = self.upsilon - np.outer(K, omega)
        self._follow(i, e, variance, now.elapsed[i])
        self._learn(omega, e, known, inflation, adapt)
        if self.kind is Hypothesis.TONE:
            spread = self.P[self.n, self.n] + self.P[self.n + 1, self.n + 1]
            if before @ before > 9.0 * spread:
                now = self.x[self.n :]
                turn = (before[1] * now[0] - before[0] * now[1]) / (before @ before)
                share = turn / (0.1 * BANK["TONE_TIME"] * self.frequency)
                self.frequency *= 1.0 + float(np.clip(share, -0.01, 0.01))
        return float(-0.5 * e**2 / variance - 0.5 * np.log(variance))

    def _follow(self, i: int, e: float, variance: float, T: float) -> None:
        """Average squares, products of neighbours and slow parts of an innovation in sigmas."""
        if not self.plan.supervised:
            return
        p, r = len(self.plan.C), float(np.clip(e / math.sqrt(variance), -GATE, GATE))
        share = min(T / BANK["SLOW_TIME"], 1.0)
        self.nis += T / p * (r * r - self.nis)
        self.colour += T / p * (r * self.previous[i] - self.colour)
        self.previous[i] = r
        self.slow[i] += share * (r - self.slow[i])
        power = self.slow[i] ** 2 * (2.0 - share) / share
        self.slow_power += T / BANK["POWER_TIME"] / p * (power - self.slow_power)

    def inflation(self) -> float:
        wide = 1.0
        if not self.certified:
            P = self.P[: self.n, : self.n]
            wide = max(1.0, float(np.trace(np.linalg.solve(self.plan.X, P))) / self.n)
        alike = max(self.colour / max(self.nis, 1.0) - 3.0 * math.sqrt(0.5 * self.plan.T), 0.0)
        noisy = max(self.nis, 1.0) * (1.0 + alike) / (1.0 - alike)
        return wide * (noisy if self.plan.supervised else 1.0)

    def _learn(self, omega: Array, e: float, known: float, inflation: float, adapt: bool) -> None:
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
        if self.kind in (Hypothesis.IMPERFECT, Hypothesis.TONE):
            power = 1.0 if self.kind is Hypothesis.IMPERFECT else 0.5
            more = (BANK["IMPERFECTION"] ** power - 1.0) * duration / self.plan.T
            q = self.plan.plant
            self.P[:q, :q] += more * self.plan.system.process[:q, :q]
        self.corrected = False
        self.settling = max(0.0, self.settling - duration)
        self.learning += duration
        self.pass_age += duration if self.learning >= LEARNING["start"] else 0.0
        self.gram = (1.0 - duration / LEARNING["memory"]) * self.gram
        for a in range(self.plan.k):
            grown = self.gamma[a, a] + duration * LEARNING["random_walk"]
            self.gamma[a, a] = min(grown, 0.3**2)
        if not serves and self.kind is Hypothesis.AS_DESIGNED and self.settling <= 0.0:
            self.certified = bool(np.linalg.eigvalsh(self.plan.X - self.P)[0] >= 0.0)

    def _step(self, u: Array, T: float) -> None:
        system, n = self.plan.system, self.n
        std, time = self._stationary()
        turn, fade = self.frequency * T, math.exp(-T / time)
        own = fade * np.eye(self.own)
        if self.kind is Hypothesis.TONE:
            cos, sin = math.cos(turn), math.sin(turn)
            own = fade * np.array([[cos, sin], [-sin, cos]])

        def driven(z: Array) -> Array:
            return u + z[n] * np.eye(len(u))[0] if self.kind is Hypothesis.FORCE else u

        def step(z: Array, theta: Array) -> Array:
            return np.concatenate([system.step(z[:n], theta, driven(z), T), own @ z[n:]])

        x, theta = self.x, self.theta
        F = derivative(lambda z: step(z, theta), x)
        effect = derivative(lambda t: step(x, t), theta)
        noise = system.noise(x[:n], theta, driven(x), T)
        self.P = F @ self.P @ F.T + block_diag(
            noise, np.diag(std**2 * (1 - fade**2) * np.ones(self.own))
        )
        self.x, self.upsilon = step(x, theta), F @ self.upsilon + effect

    def bound(self, functional: Array, scale: float) -> float:
        """Return 1σ of a function of the design's states and those of its own."""
        spread, share = 1.0, functional @ self.upsilon
        P = block_diag(self.plan.X, np.zeros((self.own, self.own))) if self.certified else self.P
        if self.plan.supervised:
            slow = self.slow_power / (BANK["QUIET"] * self.nis)
            spread = math.sqrt(max(self.nis, 1.0)) * max(slow, 1.0)
            spread *= max(scale, 1.0) if self.certified else 1.0
        curved = BANK["CURVED"] * (self.theta + self.pending - self.anchor)
        own = spread**2 * (functional @ P @ functional) + share @ self.gamma @ share
        return math.sqrt(own + (share @ self.pending) ** 2 + (share @ curved) ** 2)


class Rest:
    """Tells whether the plant moves."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.mean, self.spread = plan, np.zeros(plan.plant), np.zeros(plan.plant)

    def moves(self, of: Filter, scale: float) -> bool:
        share = min(self.plan.T / 2.0, 1.0) if of.learning >= LEARNING["start"] else 1.0
        off = of.x[: self.plan.plant] - self.mean
        self.mean = self.mean + share * off
        self.spread = (1.0 - share) * (self.spread + share * off**2)
        least = BANK["MOVING"] ** 2 * scale**2 * self.plan.X.diagonal()[: self.plan.plant]
        return bool((self.spread > least).any())


class Sensors:
    """Time since their samples, and the size of their noise, by the running median of neighbouring
    differences.
    """

    def __init__(self, plan: Plan) -> None:
        p = len(plan.C)
        self.plan, self.since, self.scale, self.age = plan, np.zeros(p), np.ones(p), np.zeros(p)
        self.previous, self.paired = np.zeros(p), np.zeros(p, int)

    @property
    def sizes(self) -> Array:
        """The noise's, by the design's."""
        return np.maximum(self.scale, 1.0)

    @property
    def elapsed(self) -> Array:
        """The time that a sample counts for."""
        return np.clip(self.since, self.plan.T, 1.1 * self.plan.T)

    def listen(self, e: Array) -> None:
        for i in np.flatnonzero(np.isfinite(e)):
            std, T = math.sqrt(self.plan.S[i, i]), min(self.since[i], 1.1 * self.plan.T)
            kind = 2 if abs(e[i]) > self.sizes[i] * GATE * std else 1
            if self.paired[i] == kind:
                rate = max(20.0 / (1.0 + 20.0 * self.age[i]), 1.0)
                step = 1.0 + 0.5 * rate * T
                larger = abs(e[i] - self.previous[i]) > self.scale[i] * math.sqrt(2) * std * 0.6745
                self.scale[i] = self.scale[i] * step if larger else max(self.scale[i] / step, 0.5)
                self.age[i] += T
            self.previous[i], self.paired[i] = e[i], kind

    def waited(self, y: Array, duration: float) -> None:
        self.since = np.where(np.isfinite(y), 0.0, self.since) + duration


SYSTEMS: dict[str, Callable[[], System]] = {
    "arm": lambda: Arm(config_path(SHIPPED_DESIGN)),
    "both encoders": lambda: Arm(Path(__file__).parent / "data" / "both_encoders.design.yaml"),
    "two outputs of one state": lambda: Blend(1, per_channel([clean(), bias(1e-3)]), 2, 2),
    "many": lambda: Blend(6, per_channel([bias(1e-3), clean(), gauss_markov(), bias(1e-2)]), 3, 4),
}
SLOW = pytest.mark.slow
PARTS = ("x", "theta", "gamma", "gram", "pending")


def check(ours: Any, exact: Any, what: str) -> None:
    exact = np.asarray(exact)
    scale = 1e-10 * (1e-4 + np.nanmax(np.abs(exact), initial=0.0))
    np.testing.assert_allclose(ours, exact, rtol=1e-8, atol=scale, err_msg=what)


def compare(core: Any, oracle: Filter, what: str) -> None:
    """Compare a hypothesis' record with its filter, where the core has room for both."""
    n, wide = oracle.n, core["x"].shape[0]
    torque = oracle.kind is Hypothesis.FORCE
    places = np.r_[:n, n + (not torque) : n + (not torque) + oracle.own]
    for name in PARTS[1:]:
        check(core[name], getattr(oracle, name), f"{name} {what}")
    check(core["x"][places], oracle.x, f"x {what}")
    check(core["upsilon"][:, places].T, oracle.upsilon, f"upsilon {what}")
    assert bool(core["certified"]) == oracle.certified, what
    if not oracle.certified:
        check(core["covariance"][np.ix_(places, places)], oracle.P, f"covariance {what}")
    rest = np.setdiff1d(np.arange(wide), places)
    assert not core["covariance"][rest].any()
    for name in ("nis", "colour", "slow_power", "previous", "slow", "settling", "learning"):
        check(core[name], getattr(oracle, name), f"{name} {what}")


def drawn(filter: Filter, sizes: Array, rng: np.random.Generator, by: float = 1.0) -> Array:
    """Return a sample as a filter expects it, or so many times as far."""
    e, known, learnt = filter.expected(np.zeros(len(sizes)), sizes)
    return np.asarray(by * np.linalg.cholesky(known + learnt) @ rng.standard_normal(len(e)) - e)


@pytest.mark.parametrize(
    ("name", "gain_mode"),
    [
        *((name, "certified") for name in SYSTEMS),
        ("arm", "riccati"),
        *(pytest.param(name, "riccati", marks=SLOW) for name in [*SYSTEMS][1:]),
    ],
)
def test_one_filter_is_that_of_the_formulas(name: str, gain_mode: str) -> None:
    """Alone: with Riccati gains; and with the hand-over to the certified gain and back."""
    system = SYSTEMS[name]()
    plan = Plan(system, 3)
    observer = plan.estimator(gain_mode=gain_mode)
    p, m, rng = len(plan.C), system.flow.input_count, np.random.default_rng(5)
    oracle, rest, sensors, state = Filter(plan), Rest(plan), Sensors(plan), observer.initial()
    gains = []
    for step in range(75):
        y = drawn(oracle, np.ones(p), rng, 3.0)  # of what moves enough to be learnt from
        if step % 30 == 25 and p > 1:
            y[step // 30 % p] = np.nan
        u, T = 5.0 * rng.standard_normal(m), plan.T * (2.3 if step % 50 == 45 else 1.0)
        e, known, learnt = oracle.expected(y, np.ones(p))
        moving = rest.moves(oracle, 1.0)
        oracle.correct(y, moving, sensors)
        state, correction = observer.correct(state, y)
        check(correction.innovation, e, "innovation")
        check(correction.innovation_covariance.diagonal(), (known + learnt).diagonal(), "S")
        compare(state.records["hypotheses"][0, 0], oracle, f"after {step}")
        oracle.predict(u, T)
        oracle.certified = oracle.certified and gain_mode == "certified"
        state = observer.predict(state, u, T)
        compare(state.records["hypotheses"][0, 0], oracle, f"before {step + 1}")
        sensors.waited(y, T)
        gains.append(oracle.certified)
    assert len({*gains}) == (2 if gain_mode == "certified" else 1)
    assert oracle.passes > 0
    assert oracle.theta.any()
    readout, units = observer.readout(state), system.flow.to_physical(np.ones(plan.plant))
    unit = np.eye(len(oracle.x))
    check(readout.state, units * oracle.x[: plan.plant], "state")
    own = [oracle.bound(unit[i], 1.0) for i in range(plan.plant)]
    check(readout.state_bound, units * own, "bound")
    check(readout.disturbance, system.flow.disturbance_map @ oracle.x, "disturbance")
    own = [oracle.bound(row, 1.0) for row in system.flow.disturbance_map]
    check(readout.disturbance_bound, own, "bound of the disturbance")
    known = oracle.gamma.diagonal() + oracle.pending**2
    known += (BANK["CURVED"] * (oracle.theta + oracle.pending - oracle.anchor)) ** 2
    check(readout.parameter_bound**2, known, "bound of the parameters")


def begin(observer: Estimator, filters: list[Filter]) -> State:
    """Return the initial state with all hypotheses awake, as the filters are."""
    state, n = observer.initial(), filters[0].n
    for oracle in filters:
        state.records["hypotheses"][0, oracle.kind] = state.records["hypotheses"][0, 0]
        one = state.records["hypotheses"][0, oracle.kind]
        one["kind"], one["score"], one["output"] = oracle.kind, oracle.score, oracle.output
        one["frequency"], one["size"] = oracle.frequency, oracle.size
        first = n + (oracle.kind is not Hypothesis.FORCE)
        for i in range(oracle.own):
            one["covariance"][first + i, first + i] = oracle.P[n + i, n + i]
    state.records["awake"] = 100.0
    return state


def mixed(
    filters: list[Filter], value: Callable[[Filter], float], bound: Callable[[Filter], float]
) -> tuple[float, float]:
    """Return mean and 1σ of what the filters say, by their weights."""
    scores = np.array([each.score for each in filters])
    weights = np.where(scores < -0.8 * BANK["FLOOR"], 0.0, np.exp(scores))
    weights /= weights.sum()
    values, bounds = (np.array([say(each) for each in filters]) for say in (value, bound))
    mean = float(weights @ values)
    return mean, math.sqrt(weights @ (bounds**2 + (values - mean) ** 2))


@pytest.mark.parametrize(
    "name",
    ["arm", "both encoders", "many", pytest.param("two outputs of one state", marks=SLOW)],
)
def test_the_bank_is_bayes_rule_over_filters(name: str) -> None:
    """All standing hypotheses awake; no sample is an outlier to the best, so that nothing forks."""
    system = SYSTEMS[name]()
    plan = Plan(system, 4, forks=True)
    observer = plan.estimator()
    p, m, rng = len(plan.C), system.flow.input_count, np.random.default_rng(6)
    filters = [Filter(plan, kind) for kind in Hypothesis if plan.force or kind != Hypothesis.FORCE]
    for each in filters:
        each.score = -2.0 * (each.kind % 3)
    state, rest, sensors = begin(observer, filters), Rest(plan), Sensors(plan)
    led = set()
    for step in range(55):
        best = max(filters, key=lambda each: each.score)
        led.add(best.kind)
        # As it expects, and then louder.
        y = np.clip(0.9 * rng.standard_normal(p), -2.0, 2.0)
        e, known, learnt = best.expected(np.zeros(p), sensors.sizes)
        y = y * np.sqrt((known + learnt).diagonal()) * (1.0 if step < 25 else 1.7) - e
        if step % 20 == 15 and p > 1:
            y[step // 20 % p] = np.nan
        u, T = 3.0 * rng.standard_normal(m), plan.T * (2.3 if step == 40 else 1.0)
        sensors.listen(best.expected(y, sensors.sizes)[0])
        there = np.isfinite(y)
        moving = rest.moves(best, float(sensors.scale[there].max(initial=1.0)))
        for each in filters:
            each.score += each.correct(y, moving, sensors, BANK["OUTLIER_PRICE"])
        most = max(each.score for each in filters)
        for each in filters:
            each.score = max(each.score - most, -BANK["FLOOR"])
        state, _ = observer.correct(state, y)
        for each in filters:
            core = state.records["hypotheses"][0, each.kind]
            compare(core, each, f"{each.kind.name} after {step}")
            check(core["score"], each.score, f"score of {each.kind.name} after {step}")
            check(core["frequency"], each.frequency, "frequency")
        readout = observer.readout(state)
        units = system.flow.to_physical(np.ones(plan.plant))
        for i in range(plan.plant):
            said = mixed(
                filters,
                lambda of, i=i: of.x[i],
                lambda of, i=i: of.bound(np.eye(len(of.x))[i], sensors.sizes.max()),
            )
            check(readout.state[i], units[i] * said[0], f"mean {step}")
            check(readout.state_bound[i], units[i] * said[1], f"second moment {step}")
        for each in filters:
            each.predict(u, T)
        state = observer.predict(state, u, T)
        sensors.waited(y, T)
    check(state.noise_scale, sensors.scale.max(), "scale")
    assert not state.records["hypotheses"]["live"][0, native.HYPOTHESES - 6 :].any()
    assert len(led) > 1 or name not in ("arm", "many")
    assert min(each.score for each in filters) < -8.0
