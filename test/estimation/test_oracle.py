# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The core against textbook recursions in NumPy: one filter, weights of several, their mixture.

The learning of parameters is compared with that of an augmented filter in test_comparison.py.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, DisturbanceTerm, Output, TorqueDisturbance
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.estimation.estimator import Estimator, certified_estimator
from tsobs_ros.estimation.records import Basis, Hypothesis
from tsobs_ros.estimation.state import likeliest
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.prediction import Record
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, arm_with, simulate
from tsobs_ros.simulation.signals import Sinusoid

Array = NDArray[np.float64]
SOON = ObserverSettings(settle_time=0.5)
BANK = {name: value for name, value, _ in native.BANK_CONSTANTS}
FRICTION = TorqueDisturbance(
    motor=(DisturbanceTerm("gauss_markov", {"std": 0.2, "time_constant": 0.5}),)
)
PARTS = (Hypothesis.COLOURED_NOISE, Hypothesis.DRIFT, Hypothesis.TONE)
"""Hypotheses with a part of the output that is a state of their own."""


def derivative(function: Callable[[Array], Array], point: Array) -> Array:
    """Return the matrix of partial derivatives by complex steps, exact to rounding."""
    steps = point + 1e-30j * np.eye(len(point))
    return np.array([np.imag(function(step)) / 1e-30 for step in steps]).T


class Filter:
    """An extended Kalman filter of a design's arm, which hands over to the certified gain and back.

    A step is half a kick by gravity, the linear flow, and half a kick.
    """

    def __init__(self, design: Design, gain_mode: str) -> None:
        request = design.arm_request
        self.flow, self.riccati = request.flow, gain_mode == "riccati"
        self.C, self.T, self.R = (
            self.flow.output_matrix,
            self.flow.period,
            request.measurement_covariance,
        )
        self.X, self.K = design.covariance_bound, design.K
        self.S, self._gravity = self.C @ self.X @ self.C.T + self.R, request.arm.gravity_gain
        self.x, self.P = np.zeros(len(self.X)), 0.9 * self.X
        self.certified, self.corrected, self.settling = False, False, 0.1

    def estimator(self) -> Estimator:
        return certified_estimator(
            self.flow, self.R, 0.9 * self.X, self.K, self.X, settle_time=0.1,
            gain_mode="riccati" if self.riccati else "certified",
        )  # fmt: skip

    def innovation_covariance(self) -> Array:
        return self.S if self.certified else self.C @ self.P @ self.C.T + self.R

    def correct(self, y: Array) -> None:
        there = np.isfinite(y)
        if self.certified and there.all():
            self.x = self.x + self.K @ (y - self.C @ self.x)
        else:
            self._leave()
            for c, variance, value in zip(
                self.C[there], np.diag(self.R)[there], y[there], strict=True
            ):
                gain = self.P @ c / (c @ self.P @ c + variance)
                self.x = self.x + gain * (value - c @ self.x)
                self.P = self.P - np.outer(gain, c @ self.P)
        self.corrected = True

    def _leave(self) -> None:
        """Go on with Riccati gains from the certificate's bound."""
        if self.certified:
            closed = np.eye(len(self.X)) - self.K @ self.C
            after = closed @ self.X @ closed.T + self.K @ self.R @ self.K.T
            self.P, self.certified = after if self.corrected else self.X, False

    def predict(self, u: Array, duration: float) -> None:
        regular = abs(duration / self.T - 1.0) <= 0.1
        serves = self.certified and self.corrected and regular
        if not serves:
            self._leave()
        left = duration
        while left > 1e-9:
            self._step(u, min(self.T, left))
            left -= self.T
        self.corrected, self.settling = False, max(0.0, self.settling - duration)
        if not serves and self.settling <= 0.0 and not self.riccati:
            self.certified = bool(np.linalg.eigvalsh(self.X - self.P)[0] >= 0.0)

    def _step(self, u: Array, T: float) -> None:
        linear = self.flow.transition(T)

        def kick(x: Array) -> Array:
            return np.concatenate([x[:1], x[1:2] - 0.5 * T * self._gravity * np.sin(x[:1]), x[2:]])

        before = self.x
        middle = linear.phi @ kick(before) + linear.gamma @ u
        after = derivative(kick, middle)
        F = after @ linear.phi @ derivative(kick, before)
        self.P = F @ self.P @ F.T + after @ linear.noise @ after.T
        self.x = kick(middle)


RIVALS = [Hypothesis.FORCE, Hypothesis.IMPERFECT, Hypothesis.DRIFT]

FILES = {
    "one encoder": config_path(SHIPPED_DESIGN),
    "both encoders": Path(__file__).parent / "data" / "both_encoders.design.yaml",
}


def check(ours: Any, exact: Any, what: str) -> None:
    exact = np.asarray(exact)
    scale = 1e-10 * (1e-4 + np.nanmax(np.abs(exact), initial=0.0))
    np.testing.assert_allclose(ours, exact, rtol=1e-8, atol=scale, err_msg=what)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("gain_mode", ["certified", "riccati"])
def test_one_filter_is_that_of_the_formulas(name: str, gain_mode: str) -> None:
    """With missing outputs and irregular steps."""
    oracle, rng = Filter(load_design(FILES[name]), gain_mode), np.random.default_rng(5)
    observer, p, gains = oracle.estimator(), len(oracle.C), []
    state, maps = observer.initial(), (np.eye(len(oracle.x))[:4], oracle.flow.disturbance_map)
    for step in range(75):
        S = oracle.innovation_covariance()
        e = np.linalg.cholesky(S) @ rng.standard_normal(p)
        y = oracle.C @ oracle.x + e
        if step % 30 == 25 and p > 1:
            y[step // 30 % p] = np.nan
        state, correction = observer.correct(state, y)
        check(correction.innovation[np.isfinite(y)], e[np.isfinite(y)], "innovation")
        check(correction.innovation_variance, S.diagonal(), "S")
        oracle.correct(y)
        u, T = 5.0 * rng.standard_normal(1), oracle.T * (2.3 if step % 50 == 45 else 1.0)
        oracle.predict(u, T)
        state = observer.predict(state, u, T)
        best, n = likeliest(state), len(oracle.x)
        check(best["x"][:n], oracle.x, f"x after {step}")
        assert bool(best["certified"]) == oracle.certified
        P = oracle.X if oracle.certified else oracle.P
        if not oracle.certified:
            check(best["covariance"][:n, :n], P, f"covariance after {step}")
        gains.append(oracle.certified)
        readout, units = observer.readout(state), oracle.flow.to_physical(np.ones(4))
        stds = [np.sqrt(np.einsum("ij,jk,ik->i", rows, P, rows)) for rows in maps]
        check(readout.state, units * oracle.x[:4], "state")
        check(readout.state_bound, units * stds[0], "bound")
        check(readout.disturbance, maps[1] @ oracle.x, "disturbance")
        check(readout.disturbance_bound, stds[1], "its bound")
    assert len({*gains}) == (2 if gain_mode == "certified" else 1)


def alone(state: Record, place: int) -> Record:
    """Return the state with one hypothesis only."""
    other = state.copy()
    others = other["hypotheses"][0]
    others["live"] = np.arange(len(others)) == place
    others["score"], other["best"] = 0.0, place
    return other


@pytest.mark.parametrize("is_clean", [False, True])
def test_weights_follow_bayes_rule_and_the_mixture_has_their_moments(is_clean: bool) -> None:
    """Of the hypotheses that compete for friction and a tone, each as it stands alone."""
    design = load_design(config_path(SHIPPED_DESIGN))
    if is_clean:
        design = synthesise(replace(design.arm_request, disturbance=()))
    observer, request = make_estimator(design, SOON), design.request
    scenario = arm_with(SCENARIOS["friction"].friction, Sinusoid(0.1, 3.0, 1.0))
    run = simulate(scenario, [1], 6.0)
    (c,), ((variance,),) = request.flow.output_matrix, request.measurement_covariance
    designed = float(c @ design.covariance_bound @ c + variance)

    def likelihood(one: Any, y: float, noise_scale: float) -> float:
        """Return the logarithm of that of a sample by a hypothesis, or of an outlier's."""
        second = one["kind"] == Hypothesis.TONE and one["x"][-1] > 0.0
        seen = np.append(c, [0.0, one["kind"] in PARTS, 0.0, 0.0, second, 0.0, 0.0])
        omega, level = one["sensitivity"] @ seen, designed * noise_scale**2
        loud = BANK["NOISE_FACTOR"] if one["kind"] == Hypothesis.LOUD else 1.0
        S = seen @ one["covariance"] @ seen + loud * variance * noise_scale**2
        S = (level if one["certified"] else S) + omega @ one["gamma"] @ omega
        least = -BANK["OUTLIER_PRICE"] - 0.5 * math.log(level)
        price = max(1.0, one["slow_power"] / (BANK["SIGN_SLOW"] * max(one["nis"], 1.0)))
        if one["kind"] == Hypothesis.TONE:
            price += 0.5 * (1.0 + max(1.0, one["slow_power"] / (BANK["QUIET"] * one["nis"])))
        if is_clean:
            price += (0.0, 1.0, 1.0, 1.0, 1.0, 1.5, 2.0)[one["kind"]]
        found = -0.5 * (y - seen @ one["x"]) ** 2 / S - 0.5 * math.log(S)
        return max(found - BANK["SLOW_PRICE"] * price, least)

    state, compared = observer.initial(), set()
    for (y,), u in zip(run.measurements[0], run.torques[0], strict=True):
        before = state["hypotheses"][0]
        state, _ = observer.correct(state, [y])
        after = state["hypotheses"][0]
        live = np.flatnonzero(before["live"])
        scale = max(1.0, state["sensors"]["noise_scale"].item())
        names = ("live", "kind", "age")  # an age that falls is that of one that begins again
        if len(live) > 1 and all((before[name] == after[name]).all() for name in names):
            scores = [one["score"] + likelihood(one, y, scale) for one in before[live]]
            check(after["score"][live], np.maximum(scores - max(scores), -BANK["FLOOR"]), "scores")
            compared |= {*before["kind"][live].tolist()}
        counting = after["live"] & (after["score"] >= -0.8 * BANK["FLOOR"])
        if np.isin(after["fork"][np.flatnonzero(counting)], [3, 4, 5]).any():
            continue  # undecided ones widen the bound only
        best = after[state["best"][0]]
        pushed = best["kind"] != Hypothesis.AS_DESIGNED or best["slow_power"] > BANK["SIGN_SLOW"]
        rivals = np.isin(np.arange(len(after)), RIVALS) & pushed
        if best["kind"] == Hypothesis.TONE:  # they follow it until that contradicts them
            power = BANK["QUIET"] * np.maximum(after["nis"], BANK["LEAST_SCALE"] ** 2)
            rivals &= after["nis"] <= BANK["VOID"]
            rivals &= after["slow_power"] <= 7.0 * BANK["VOID"] * power
        least = np.where(rivals, 1.0 / 6.0, 0.0)
        live = np.flatnonzero(after["live"] & (counting | (least > 0.0)))
        weights = np.exp(after["score"][live])
        decided, weights = weights * counting[live], np.maximum(weights, least[live])
        decided, weights = decided / decided.sum(), weights / weights.sum()
        whole, parts = observer.readout(state), [observer.readout(alone(state, i)) for i in live]
        for name in ("state", "disturbance"):
            values = np.array([getattr(part, name) for part in parts])
            bounds = np.array([getattr(part, f"{name}_bound") for part in parts])
            mean = decided @ values
            check(getattr(whole, name), mean, name)
            spread = weights @ (bounds**2 + (values - mean) ** 2)
            check(getattr(whole, f"{name}_bound") ** 2, spread, f"bound of {name}")
        state = observer.predict(state, u, request.period)
    assert compared == {*Hypothesis}


@pytest.mark.parametrize("larger", [0.5, 2.0, 100.0])
def test_a_large_covariance_slows_learning_down_to_a_quarter(larger: float) -> None:
    design = load_design(config_path(SHIPPED_DESIGN))
    observer, (c,) = make_estimator(design, SOON), design.request.flow.output_matrix
    state, n = observer.initial(), len(c)
    one = state["hypotheses"][0, 0]
    one["covariance"][:n, :n] = larger * design.covariance_bound
    one["sensitivity"][:, :n] = np.random.default_rng(0).standard_normal((2, n))
    before, omega = one["gamma"].copy(), one["sensitivity"][:, :n] @ c
    learnt = before @ omega
    S = larger * c @ design.covariance_bound @ c + design.request.measurement_covariance[0, 0]
    shrunk = np.outer(learnt, learnt) / (S * min(max(larger, 1.0), 4.0) + omega @ learnt)
    after = observer.correct(state, [0.0])[0]["hypotheses"][0, 0]["gamma"]
    check(after, before - shrunk, "covariance of the parameters")


@pytest.mark.parametrize(
    ("kind", "power"),
    [(Hypothesis.IMPERFECT, 1.0), (Hypothesis.TONE, 0.25), (Hypothesis.LOUD, 0.0)],
)
def test_some_hypotheses_trust_the_model_less(kind: Hypothesis, power: float) -> None:
    request = load_design(config_path(SHIPPED_DESIGN)).request
    observer = make_estimator(load_design(config_path(SHIPPED_DESIGN)), SOON)
    states = [observer.initial(), observer.initial()]
    states[1]["hypotheses"]["kind"][0, 0] = kind
    moved = [observer.predict(one, [0.0], request.period) for one in states]
    spreads = [likeliest(one)["covariance"] for one in moved]
    more = (BANK["IMPERFECTION"] ** power - 1.0) * request.flow.nominal.noise[:4, :4]
    check((spreads[1] - spreads[0])[:4, :4], more, "process noise")


def test_what_a_design_with_a_motor_torque_lacks_is_at_the_link() -> None:
    request = ArmRequest(
        ElasticJointArm(link_inertia=0.8),
        torque_disturbance=FRICTION,
        disturbance=(),
        uncertainty={},
    )
    observer, T = make_estimator(synthesise(request), SOON), request.period
    check(observer.model["force"], [[0.0, 2.0 * 0.2 / 0.8]], "size of FORCE")

    n, push, more = observer.shape.n, 3.0, BANK["IMPERFECTION"] - 1.0

    def moved(
        kind: int,
        at_link: float = 0.0,
        at_motor: float = 0.0,
        kick: float = 0.0,
        torque: float = 0.0,
    ) -> Any:
        """Predict x with auxiliary states, whose variances are 1, and a change of the velocity."""
        state = observer.initial()
        one = state["hypotheses"][0]
        one["kind"], state["in_gap"] = kind, int(at_motor != 0.0)
        one["x"][0, :n] = [0.3, 0.1 + kick, 2.0, -0.4, 0.05]
        one["x"][0, n : n + 2] = at_motor, at_link
        one["covariance"][0, n, n] = at_motor != 0.0
        one["covariance"][0, n + 1, n + 1] = kind == Hypothesis.FORCE
        return likeliest(observer.predict(state, [torque], T))

    plain, still = moved(Hypothesis.AS_DESIGNED), moved(Hypothesis.FORCE)
    wrong = moved(Hypothesis.IMPERFECT)["covariance"] - plain["covariance"]
    check(wrong[:2, :2], more * request.flow.nominal.noise[:2, :2], "noise of the link")
    assert (wrong[2:] == 0.0).all()
    assert (wrong[:, 2:] == 0.0).all()
    # An acceleration that is held is half a kick before the step and half a kick after it.
    pushed = moved(Hypothesis.FORCE, push)
    kicked = moved(Hypothesis.AS_DESIGNED, kick=0.5 * T * push)["x"][:n]
    check(pushed["x"][:n], kicked + 0.5 * T * push * np.eye(n)[1], "link that is pushed")
    decay = math.exp(-T / BANK["FORCE_TIME"])
    slope = (moved(Hypothesis.FORCE, 1e-4)["x"] - still["x"])[:n] / 1e-4
    found = still["covariance"][n + 1, :n]
    np.testing.assert_allclose(found, decay * slope, rtol=1e-6, atol=1e-10)
    # In a gap the motor's torque is unknown as well.
    for kind in (Hypothesis.AS_DESIGNED, Hypothesis.FORCE):
        at_link = push * (kind == Hypothesis.FORCE)
        both = moved(kind, at_link, at_motor=push)["x"][:n]
        check(both, moved(kind, at_link, torque=push)["x"][:n], "gap")


@pytest.mark.parametrize(
    ("outputs", "uncertain", "hidden"),
    [
        (("link_angle",), (), [2, 3]),
        (("motor_velocity", "motor_angle"), (), [0, 1]),
        (("link_angle", "motor_angle"), (), []),
        (("link_angle",), ("stiffness",), []),
    ],
)
def test_a_stiffness_that_a_motor_torque_hides_is_in_the_bounds(
    outputs: tuple[str, ...], uncertain: tuple[str, ...], hidden: list[int]
) -> None:
    request = ArmRequest(
        outputs=tuple(Output(name, 0.001) for name in outputs),
        torque_disturbance=FRICTION,
        uncertainty=dict.fromkeys(uncertain, 0.4),
    )
    observer = make_estimator(synthesise(request), SOON)
    still, twisted = observer.initial(), observer.initial()
    for state, motion in ((still, [0.0] * 4), (twisted, [0.5, -1.0, 0.2, 2.0])):
        state["hypotheses"]["x"][0, 0, :4] = request.arm.from_physical(motion)
    bounds = [observer.readout(each).state_bound for each in (still, twisted)]
    more = np.zeros(4)
    more[hidden] = (BANK["SPRING"] * np.array([0.3, 3.0, 0.3, 3.0])[hidden]) ** 2
    check(bounds[1] ** 2 - bounds[0] ** 2, more, "what the twist and its rate add")


@pytest.mark.parametrize(
    ("slowness", "lasting", "growth"),
    [(0.9, 1.0, 1.0), (2.0, 1.0, 2.0), (2.0, 2.0, 2.4), (2.0, 3.0, 5.4), (9.0, 2.0, 6.0)],
)
def test_slow_innovations_widen_bounds(slowness: float, lasting: float, growth: float) -> None:
    observer = make_estimator(load_design(config_path(SHIPPED_DESIGN)), SOON)
    calm, slow = observer.initial(), observer.initial()
    for state in (calm, slow):
        state["hypotheses"]["gamma"] *= 1e-4  # so far below the prior that this is no limit
    quiet = BANK["QUIET"] * slow["hypotheses"]["nis"]
    slow["hypotheses"]["slow_power"] = slowness * quiet
    slow["hypotheses"]["lasting"] = lasting * quiet
    for name in ("state_bound", "disturbance_bound", "parameter_bound"):
        bounds = [np.asarray(getattr(observer.readout(one), name)) for one in (calm, slow)]
        check(bounds[1], growth * bounds[0], name)


def beside(kind: int, fork: int, design_behind: float) -> tuple[Estimator, Record]:
    """Return a state whose best hypothesis is a kind, or a fork, that is 10 rad from the design."""
    observer = make_estimator(load_design(config_path(SHIPPED_DESIGN)), SOON)
    state = observer.initial()
    place, all_ = len(Hypothesis) + 1 if fork else kind, state["hypotheses"][0]
    all_["age"][0], all_["settling"][0] = 9.0, 0.0
    all_[place] = all_[0]
    all_["kind"][place], all_["fork"][place], state["best"] = kind, fork, place
    all_["x"][place, 0] += 10.0
    all_["score"][0] = -design_behind
    return observer, state


@pytest.mark.parametrize(("fork", "shift"), [(2, 5.0), (3, 0.0), (5, 0.0), (6, 5.0)])
def test_a_hit_that_is_undecided_widens_the_bound_only(fork: int, shift: float) -> None:
    observer, state = beside(Hypothesis.AS_DESIGNED, fork, 0.0)
    row, variance = observer.readout(state), likeliest(state)["covariance"][0, 0]
    check(row.state[0], shift, "estimate")
    mean_square = 0.5 * (shift**2 + (10.0 - shift) ** 2)  # of the distances from it
    check(row.state_bound[0], math.sqrt(variance + mean_square), "bound")


@pytest.mark.parametrize(("behind", "named"), [(5.9, False), (6.1, True)])
def test_another_hypothesis_is_named_once_the_design_is_unlikely(
    behind: float, named: bool
) -> None:
    observer, state = beside(Hypothesis.IMPERFECT, 0, behind)
    row = observer.readout(state)
    assert row.hypothesis == (Hypothesis.IMPERFECT if named else Hypothesis.AS_DESIGNED)
    assert row.basis == (Basis.HYPOTHESIS if named else Basis.COVARIANCE)
