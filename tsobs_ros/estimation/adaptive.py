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
from tsobs_ros.estimation.output_model import OutputModel
from tsobs_ros.estimation.regression import Explained, Memory, Regression, exceeds, spread_of
from tsobs_ros.model.gap_flow import UNHEARD, narrowed, widened
from tsobs_ros.model.products import product, transposed
from tsobs_ros.model.sensitivity import sensitivity
from tsobs_ros.model.uncertainty import Uncertainty


@dataclass(frozen=True)
class AdaptationOptions:
    """How fast parameters are learnt, and when they count as known.

    Attributes:
        initial_std: 1σ of each θ before any measurement; caps the gain ever after.
        random_walk_density: Growth of each θ's variance, which keeps the gain alive [1/s].
        start: Adaptation begins so long after a (re)start [s]; the start itself leans.
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

    @property
    def memory(self) -> Memory:
        """What is learnt, as arrays."""
        return Memory(self.theta, self.gamma, self.upsilon.T, self.gram)

    def corrected(self, observer: ObserverState, memory: Memory, x: Array) -> "AdaptiveState":
        """Return the state after a sample: the observer's own with x̂ in it, and what is learnt."""
        theta, gamma, rows, gram = memory
        inner = ObserverState(x, *observer[1:])
        return AdaptiveState(inner, theta, gamma, rows.T, gram, self.age)


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
        self._initial_gamma = np.eye(k) * self.options.initial_std**2
        # None for several outputs, which take a general and slower way.
        self.regression = (
            Regression(self._C[0], -uncertainty.limits, uncertainty.limits)
            if len(self._C) == 1
            else None
        )
        self._limits: list[float] = uncertainty.limits.tolist()
        self._wander = np.eye(k) * self.options.random_walk_density
        self._sensitivity = sensitivity(observer.flow, uncertainty)
        gap_flow = observer.gap_flow
        self._in_gap = None if gap_flow is None else sensitivity(gap_flow, uncertainty)

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

    def reset_adaptation(self, state: AdaptiveState) -> AdaptiveState:
        """Return the state with the adaptation begun again from the present θ."""
        upsilon = np.zeros_like(state.upsilon)
        return state._replace(gamma=self._initial_gamma, upsilon=upsilon)

    def nominal(self, state: AdaptiveState) -> AdaptiveState:
        """Return the state with nominal parameters and nothing learnt."""
        return self.reset_adaptation(state)._replace(
            theta=np.zeros_like(state.theta), gram=np.zeros_like(state.gram)
        )

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
        """Return the innovation, what is expected of it, and the gain; nothing is changed."""
        known = self.observer.expect(state.observer, y)
        if self.regression is not None:
            explained = self.regression.explained(state.upsilon.T, state.gamma)
            return self.expected(known, explained)
        omega = self._C @ state.upsilon
        cross = state.gamma @ omega.T
        learning = (omega, cross, omega @ cross)
        return Correction(
            known.innovation, known.innovation_covariance + learning[2], known.gain, 1.0, learning
        )

    @staticmethod
    def expected(known: Correction, explained: Explained) -> Correction:
        """Return what is expected of one output, from that for known parameters."""
        spread = known.innovation_covariance + explained.variance
        return Correction(known.innovation, spread, known.gain, 1.0, explained)

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
        adapt = adapt and self.learns(state, weight)
        take = self._apply_many if self.regression is None else self._apply_one
        return take(state, observer, correction, adapt)

    def learns(self, state: AdaptiveState, weight: float) -> bool:
        """Return whether θ learns from a correction of which a share is applied."""
        return weight >= 1.0 and state.age >= self.options.start

    def covariance_inflation(self, state: AdaptiveState) -> float:
        """Return κ ≥ 1, by how much the estimate is less certain than it will be."""
        return max(1.0, self.observer.covariance_ratio(state.observer))

    def _apply_many(
        self, state: AdaptiveState, observer: ObserverState, correction: Correction, adapt: bool
    ) -> AdaptiveState:
        """Do the rest of `apply` for any number of outputs."""
        omega, cross, explained = correction.learning
        own_spread = correction.innovation_covariance - explained
        upsilon = state.upsilon - correction.gain @ omega
        gram = state.gram + omega.T @ _solved(own_spread, omega)
        if not adapt:
            return AdaptiveState(observer, state.theta, state.gamma, upsilon, gram, state.age)
        spread = own_spread * self.covariance_inflation(state) + explained
        gain = _solved(spread, cross.T).T
        limits = self.uncertainty.limits
        theta = np.clip(state.theta + gain @ correction.innovation, -limits, limits)
        x = observer.x + upsilon @ (theta - state.theta)
        gamma = state.gamma - gain @ cross.T
        return AdaptiveState(
            observer._replace(x=x), theta, 0.5 * (gamma + gamma.T), upsilon, gram, state.age
        )

    def _apply_one(
        self, state: AdaptiveState, observer: ObserverState, correction: Correction, adapt: bool
    ) -> AdaptiveState:
        """Do the same for one output, quicker: quotients stand for inverses."""
        assert self.regression is not None
        doubt = self.covariance_inflation(state) if adapt else None
        memory, x = self.regression.applied(
            state.memory, observer.x, correction, correction.learning, doubt
        )
        return state.corrected(observer, memory, x)

    def predict(self, state: AdaptiveState, u: Array, duration: float) -> AdaptiveState:
        """Predict over `duration` [s] with the inputs u, shape (m,), held."""
        observer, upsilon = self._flow(state, u, duration, stay_certified=True)
        forgotten = math.exp(-duration / self.options.memory)
        return AdaptiveState(
            observer,
            state.theta,
            self._capped(state.gamma + self._wander * duration),
            upsilon,
            state.gram * forgotten,
            state.age + duration,
        )

    def extrapolate(self, state: AdaptiveState, u: Array, duration: float) -> AdaptiveState:
        """Predict to a time between samples, for reading only."""
        observer, upsilon = self._flow(state, u, duration, stay_certified=False)
        return state._replace(observer=observer, upsilon=upsilon)

    def valid(self, state: AdaptiveState) -> bool:
        """Return whether the motion has been rich enough for θ to be believed."""
        return self.uncertainty.count > 0 and exceeds(state.gram.tolist(), self.options.excitation)

    def readout(self, state: AdaptiveState) -> Readout:
        """Return the estimate; its bound has what the uncertain parameters add to it."""
        return self.reported(
            state,
            self.observer.readout(state.observer),
            *added_variances(state.upsilon.T, state.gamma, self.observer.output),
        )

    def reported(
        self, state: AdaptiveState, readout: Readout, added: Array, added_disturbance: Array
    ) -> Readout:
        """Return the readout of the observer with what is learnt.

        Args:
            state: What is read.
            readout: Of the observer underneath.
            added: Variance of x̂ from the uncertain parameters, shape (n,).
            added_disturbance: That of the disturbance, shape (p,).
        """
        added_std = self.observer.flow.to_physical(np.sqrt(added))
        return Readout(
            readout.state,
            np.hypot(readout.state_bound, added_std),
            readout.disturbance,
            readout.disturbance_rate,
            np.sqrt(readout.disturbance_bound**2 + added_disturbance),
            certified=readout.certified and self.covered,
            parameters=state.theta,
            parameter_bound=np.sqrt(state.gamma.diagonal()),
            parameters_valid=self.valid(state),
        )

    def events(self, state: AdaptiveState) -> dict[str, int]:
        """Return no counts: this observer judges nothing."""
        return {}

    def _capped(self, gamma: Array) -> Array:
        """Return Γ shrunk so that no variance exceeds the initial one."""
        variance = gamma.diagonal()
        most = self.options.initial_std**2
        if max(variance.tolist(), default=0.0) <= most:
            return gamma
        shrink = np.sqrt(np.minimum(1.0, most / variance))
        return np.asarray(gamma * np.outer(shrink, shrink))

    def _flow(
        self, state: AdaptiveState, u: Array, duration: float, *, stay_certified: bool
    ) -> tuple[ObserverState, Array]:
        """Return observer state and Υ after the flow with θ̂ in its kicks."""
        observer, inner = state.observer, self.observer
        certified = inner.stays_certified(observer, duration, between_samples=not stay_certified)
        gap = None if certified else inner.gap(observer, duration)
        covariance: Array | None
        if gap is not None and self._in_gap is not None:
            upsilon = widened(state.upsilon.T).T
            x, upsilon, gap = self._in_gap.carry(
                widened(observer.x), upsilon, gap, state.theta, u, duration
            )
            assert gap is not None
            covariance, x, upsilon = narrowed(gap), x[:-UNHEARD], upsilon[:-UNHEARD]
            moved = inner.moved(observer, x, covariance, duration, False, stay_certified, gap)
            return moved, upsilon
        covariance = None if certified else observer.covariance
        x, upsilon, covariance = self._sensitivity.carry(
            observer.x, state.upsilon, covariance, state.theta, u, duration
        )
        if covariance is None:
            covariance = observer.covariance
        return inner.moved(observer, x, covariance, duration, certified, stay_certified), upsilon


def _solved(spread: Array, right: Array) -> Array:
    """Return spread⁻¹ right; for one output a division, which takes a tenth of the time."""
    if spread.shape == (1, 1):
        return np.asarray(right / spread[0, 0])
    return np.asarray(np.linalg.solve(spread, right), dtype=np.float64)


def added_variances(rows: Array, gamma: Array, output: OutputModel) -> tuple[Array, Array]:
    """Return what θ's uncertainty adds to the variances of x̂ and of the disturbance.

    For x − x̂ is the observer's own error plus Υ(θ − θ̂). A stack has a leading axis.

    Args:
        rows: Υᵀ, shape (k, n).
        gamma: Γ, shape (k, k).
        output: Of the observer.
    """
    exosystem = rows[..., rows.shape[-1] - output.H.shape[-1] :]
    # No variance of a rounding error below zero.
    added = np.maximum(spread_of(rows, gamma), 0.0)
    return added, np.maximum(spread_of(product(exosystem, transposed(output.H)), gamma), 0.0)
