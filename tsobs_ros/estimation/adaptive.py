# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified observer with adaptation to constant parametric uncertainty.

A filtered-regressor (two-stage) adaptive observer after Q. Zhang (2002): Υ = ∂x̂/∂θ is filtered
through the observer's own error dynamics, so that the innovation is explained as e = Ω θ̃ + noise
with Ω = C̄Υ, whatever the relative degree of the sensor. θ follows by recursive least squares with
a bounded gain, projected on its known bounds. The prediction takes θ in with the gravity kicks.

The regressor is taken at the estimate. While that is far less certain than it will be, innovations
count for less in θ, by as much as the covariance exceeds the certified bound: otherwise errors of
the start-up are learnt as parameters, and with great confidence.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array, non_negative, positive
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.observer import ObserverState, TSObserver
from tsobs_ros.model.flow import UNKNOWN_TORQUE, GapFlow
from tsobs_ros.model.linear_flow import matvec
from tsobs_ros.model.prediction import sensitivity
from tsobs_ros.model.uncertainty import Uncertainty


@dataclass(frozen=True)
class AdaptationOptions:
    """How fast parameters are learnt, and when they count as known.

    Attributes:
        initial_std: 1σ of each θ before any measurement; caps the gain ever after.
        random_walk_density: Growth of each θ's variance, which keeps the gain alive [1/s].
        start: Adaptation begins so long after a (re)start [s], when the innovations are not
            one-sided any more.
        memory: Time constant of the measure of excitation [s].
        excitation: Smallest eigenvalue of the excitation from which θ counts as valid.
    """

    initial_std: float = 0.1
    random_walk_density: float = 1e-6
    start: float = 2.0
    memory: float = 10.0
    excitation: float = 400.0

    def __post_init__(self) -> None:
        positive("adaptation initial_std", self.initial_std)
        non_negative("adaptation random_walk_density", self.random_walk_density)
        non_negative("adaptation start", self.start)
        positive("adaptation memory", self.memory)
        non_negative("adaptation excitation", self.excitation)


class AdaptiveState(NamedTuple):
    """State of the observer and of its adaptation.

    Attributes:
        observer: The observer's own state.
        theta: Estimated parameter changes θ̂, shape (k,).
        gamma: Their covariance, the adaptation gain Γ, shape (k, k).
        upsilon: Filtered regressor Υ = ∂x̂/∂θ, shape (n, k).
        gram: Exponentially forgotten sum of ΩᵀΩ/S, shape (k, k).
        age: Time since the start [s].
    """

    observer: ObserverState
    theta: Array
    gamma: Array
    upsilon: Array
    gram: Array
    age: float


class Regression(NamedTuple):
    """The share of θ's uncertainty in an innovation.

    Attributes:
        omega: Ω = C̄Υ, shape (k,), or (p, k) for several outputs.
        cross: ΓΩᵀ, shape (k,) or (k, p).
        variance: ΩΓΩᵀ, shape (1,) or (p, p).
    """

    omega: Array
    cross: Array
    variance: Array


class AdaptiveObserver:
    """A `TSObserver` that learns the model's parameters; one system, no batch axis.

    Attributes:
        observer: The certified observer underneath.
        uncertainty: Directions and bounds of θ.
        options: How fast.
        covered: Whether the certificate holds for every θ within the bounds; if not, no bound
            that depends on θ is called certified.
    """

    def __init__(
        self,
        observer: TSObserver,
        uncertainty: Uncertainty,
        options: AdaptationOptions | None = None,
        covered: bool = False,
    ) -> None:
        self.observer = observer
        self.covered = covered
        self.uncertainty = uncertainty
        self.options = options or AdaptationOptions()
        k = uncertainty.count
        self._C = observer.flow.output_matrix
        self._single_output = len(self._C) == 1
        self._initial_gamma = np.eye(k) * self.options.initial_std**2
        self._limits: list[float] = uncertainty.limits.tolist()
        self._random_walk = np.eye(k) * self.options.random_walk_density
        self._sensitivity = sensitivity(observer.flow, uncertainty)
        gap_flow = observer.gap_flow
        self._gap_sensitivity = None if gap_flow is None else sensitivity(gap_flow, uncertainty)

    @property
    def period(self) -> float:
        """Nominal sampling period [s]."""
        return self.observer.period

    def initial(self) -> AdaptiveState:
        """Return the state before any measurement: nominal parameters."""
        k, n = self.uncertainty.count, self.observer.flow.state_count
        return AdaptiveState(
            self.observer.initial(),
            np.zeros(k),
            self._initial_gamma,
            np.zeros((k, n)).T,
            np.zeros((k, k)),
            0.0,
        )

    def inflate_covariance(
        self, state: AdaptiveState, variance: Array, duration: float
    ) -> AdaptiveState:
        """Return the state with more uncertainty of the estimate; see `TSObserver`."""
        return state._replace(
            observer=self.observer.inflate_covariance(state.observer, variance, duration)
        )

    def limit_disturbance(self, state: AdaptiveState, limit: float) -> AdaptiveState:
        """Return the state with the disturbance kept within ±limit; see `TSObserver`."""
        observer = self.observer.limit_disturbance(state.observer, limit)
        return state if observer is state.observer else state._replace(observer=observer)

    def end_gap(self, state: AdaptiveState) -> AdaptiveState:
        """Return the state after a sample without its angle; see `TSObserver.end_gap`."""
        observer = self.observer.end_gap(state.observer)
        return state if observer is state.observer else state._replace(observer=observer)

    def reset_adaptation(self, state: AdaptiveState, *, nominal: bool = False) -> AdaptiveState:
        """Return the state with the adaptation restarted.

        Args:
            state: Before.
            nominal: Whether θ̂ and its excitation are reset as well, not only gain and regressor.
        """
        reset = state._replace(gamma=self._initial_gamma, upsilon=np.zeros_like(state.upsilon))
        if not nominal:
            return reset
        return reset._replace(theta=np.zeros_like(state.theta), gram=np.zeros_like(state.gram))

    def at_limit(self, state: AdaptiveState) -> bool:
        """Return whether a parameter sits at the end of its known range."""
        return any(
            abs(one) >= limit for one, limit in zip(state.theta.tolist(), self._limits, strict=True)
        )

    def correct(self, state: AdaptiveState, y: Array) -> tuple[AdaptiveState, Correction]:
        """Use one measurement y, shape (p,)."""
        correction = self.expect(state, y)
        return self.apply(state, correction), correction

    def expect(self, state: AdaptiveState, y: Array) -> Correction:
        """Return the innovation of a measurement, its covariance and the gain for it."""
        known = self.observer.expect(state.observer, y)
        if self._single_output:
            omega = matvec(state.upsilon.T, self._C[0])
            cross = matvec(state.gamma, omega)
            regression = Regression(omega, cross, matvec(omega[np.newaxis], cross))
        else:
            omega = self._C @ state.upsilon
            cross = state.gamma @ omega.T
            regression = Regression(omega, cross, omega @ cross)
        innovation_covariance = known.innovation_covariance + regression.variance
        return Correction(known.innovation, innovation_covariance, known.gain, 1.0, regression)

    def apply(
        self, state: AdaptiveState, correction: Correction, weight: float = 1.0, adapt: bool = True
    ) -> AdaptiveState:
        """Correct estimate and parameters by an innovation.

        Args:
            state: The state the correction was computed from.
            correction: From `expect`.
            weight: Share of the correction to apply, in (0, 1].
            adapt: Whether θ may learn from it.
        """
        observer = self.observer.apply(state.observer, correction, weight)
        adapt = adapt and weight >= 1.0 and state.age >= self.options.start
        learn = self._learn_from_one if self._single_output else self._learn_from_many
        return learn(state, observer, correction, adapt)

    def covariance_inflation(self, state: AdaptiveState) -> float:
        """Return κ ≥ 1, the present error covariance relative to the certified bound."""
        return max(1.0, self.observer.covariance_ratio(state.observer))

    def _learn_from_many(
        self, state: AdaptiveState, observer: ObserverState, correction: Correction, adapt: bool
    ) -> AdaptiveState:
        """Return the state after a sample of any number of outputs."""
        omega, cross, explained = correction.regression
        known = correction.innovation_covariance - explained
        upsilon = state.upsilon - correction.gain @ omega
        gram = state.gram + omega.T @ np.linalg.solve(known, omega)
        if not adapt:
            return AdaptiveState(observer, state.theta, state.gamma, upsilon, gram, state.age)
        innovation_covariance = known * self.covariance_inflation(state) + explained
        gain = np.linalg.solve(innovation_covariance, cross.T).T
        limits = self.uncertainty.limits
        theta = np.clip(state.theta + gain @ correction.innovation, -limits, limits)
        x = observer.x + upsilon @ (theta - state.theta)
        gamma = state.gamma - gain @ cross.T
        return AdaptiveState(
            observer._replace(x=x), theta, 0.5 * (gamma + gamma.T), upsilon, gram, state.age
        )

    def _learn_from_one(
        self, state: AdaptiveState, observer: ObserverState, correction: Correction, adapt: bool
    ) -> AdaptiveState:
        """Return the same for one output, quicker: quotients stand for inverses."""
        omega, cross, explained = correction.regression
        known = correction.innovation_covariance[0] - explained
        rows = state.upsilon.T - omega[:, np.newaxis] * correction.gain[np.newaxis, :, 0]
        gram = state.gram + _square(omega / np.sqrt(known))
        if not adapt:
            return AdaptiveState(observer, state.theta, state.gamma, rows.T, gram, state.age)
        variance = known * self.covariance_inflation(state) + explained
        moved = state.theta + cross * (correction.innovation / variance)
        limits = self.uncertainty.limits
        theta = np.minimum(np.maximum(moved, -limits), limits)
        gamma = state.gamma - _square(cross / np.sqrt(variance))
        x = observer.x + matvec(rows.T, theta - state.theta)
        observer = ObserverState(x, *observer[1:])
        return AdaptiveState(observer, theta, gamma, rows.T, gram, state.age)

    def predict(self, state: AdaptiveState, u: Array, duration: float) -> AdaptiveState:
        """Predict over `duration` [s] with the inputs u, shape (m,), held."""
        observer, upsilon = self._flow(state, u, duration, between_samples=False)
        return AdaptiveState(
            observer,
            state.theta,
            self._capped(state.gamma + self._random_walk * duration),
            upsilon,
            state.gram * math.exp(-duration / self.options.memory),
            state.age + duration,
        )

    def extrapolate(self, state: AdaptiveState, u: Array, duration: float) -> AdaptiveState:
        """Predict to a time between samples; the result is read and not stepped on."""
        observer, upsilon = self._flow(state, u, duration, between_samples=True)
        return state._replace(observer=observer, upsilon=upsilon)

    def valid(self, state: AdaptiveState) -> bool:
        """Return whether the motion has been rich enough for θ̂ to count."""
        return self.uncertainty.count > 0 and exceeds(state.gram.tolist(), self.options.excitation)

    def readout(self, state: AdaptiveState) -> Readout:
        """Return the estimate; its bounds include the uncertainty of the parameters.

        For x − x̂ is the observer's own error plus Υ(θ − θ̂), of covariance ΥΓΥᵀ.
        """
        inner, output = self.observer.readout(state.observer), self.observer.output
        rows, gamma = state.upsilon.T, state.gamma
        disturbance_rows = output.exosystem(rows).dot(output.H.T)
        added = self.observer.flow.to_physical(np.sqrt(_variances(rows, gamma)))
        return Readout(
            inner.state,
            np.hypot(inner.state_bound, added),
            inner.disturbance,
            inner.disturbance_rate,
            np.sqrt(inner.disturbance_bound**2 + _variances(disturbance_rows, gamma)),
            certified=inner.certified and self.covered,
            parameters=state.theta,
            parameter_bound=np.sqrt(gamma.diagonal()),
            parameters_valid=self.valid(state),
        )

    def events(self, state: AdaptiveState) -> dict[str, int]:
        """Return no counts: this observer is not supervised."""
        return {}

    def _capped(self, gamma: Array) -> Array:
        """Return Γ shrunk so that no variance exceeds the initial one."""
        variance = gamma.diagonal()
        largest = self.options.initial_std**2
        if max(variance.tolist(), default=0.0) <= largest:
            return gamma
        shrink = np.sqrt(np.minimum(1.0, largest / variance))
        return np.asarray(gamma * np.outer(shrink, shrink))

    def _flow(
        self, state: AdaptiveState, u: Array, duration: float, *, between_samples: bool
    ) -> tuple[ObserverState, Array]:
        """Return observer state and Υ after the flow with θ̂ in its kicks."""
        before, inner, hand_over = state.observer, self.observer, not between_samples
        if inner.stays_certified(before, duration, between_samples=between_samples):
            x, upsilon, _ = self._sensitivity.carry(
                before.x, state.upsilon, None, state.theta, u, duration
            )
            return inner.certified_state(x), upsilon
        gap = inner.gap_before(before, duration)
        if gap is None or self._gap_sensitivity is None:
            x, upsilon, covariance = self._sensitivity.carry(
                before.x, state.upsilon, before.covariance, state.theta, u, duration
            )
            assert covariance is not None
            after = inner.uncertified_state(before, x, covariance, duration, hand_over=hand_over)
            return after, upsilon
        x, upsilon, gap = self._gap_sensitivity.carry(
            GapFlow.widen(before.x),
            GapFlow.widen(state.upsilon.T).T,
            gap,
            state.theta,
            u,
            duration,
        )
        assert gap is not None
        after = inner.uncertified_state(
            before, x[:-UNKNOWN_TORQUE], GapFlow.narrow(gap), duration, gap, hand_over=hand_over
        )
        return after, upsilon[:-UNKNOWN_TORQUE]


def _square(vector: Array) -> Array:
    """Return v vᵀ, shape (k, k)."""
    return vector[:, np.newaxis] * vector


def _variances(rows: Array, gamma: Array) -> Array:
    """Return diag(Υ Γ Υᵀ) for the rows Υᵀ, without rounding errors below zero."""
    return np.asarray(np.maximum(np.add.reduce(gamma.dot(rows) * rows, axis=-2), 0.0))


def exceeds(matrix: list[list[float]], level: float) -> bool:
    """Return whether every eigenvalue of a symmetric matrix is at least `level`, by its pivots."""
    rows = [
        [number - level if i == j else number for j, number in enumerate(row)]
        for i, row in enumerate(matrix)
    ]
    for first, pivot_row in enumerate(rows):
        pivot = pivot_row[first]
        if not pivot > 0.0:  # which NaN is not either
            return pivot == 0.0 and not any(any(row[first:]) for row in rows[first:])
        for row in rows[first + 1 :]:
            share = row[first] / pivot
            for column in range(first, len(row)):
                row[column] -= share * pivot_row[column]
    return True
