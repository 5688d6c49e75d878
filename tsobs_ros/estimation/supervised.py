# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An observer under supervision: what the node runs, one joint at a time."""

from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.adaptive import AdaptiveObserver
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.observer import TSObserver
from tsobs_ros.estimation.supervision import SupervisionOptions, Verdict, Watch, elapse, judge


class SupervisedState(NamedTuple):
    """State of the observer and of its supervision.

    Attributes:
        inner: State of the observer underneath.
        watch: What the supervision remembers.
        pause: Learning rests for so much longer [s].
        pinned: How long a parameter has been at its limit [s].
        y: The last sample [rad], None before the first.
        repeats: How often it has come again without a change.
        outliers: Number of measurements that were downweighted.
        jumps: Number of sensor jumps found.
        losses: Number of times the estimate was given up and restarted.
        adaptation_resets: Number of times learning was begun again.
    """

    inner: Any
    watch: Watch
    pause: float = 0.0
    pinned: float = 0.0
    y: float | None = None
    repeats: int = 0
    outliers: int = 0
    jumps: int = 0
    losses: int = 0
    adaptation_resets: int = 0


class SupervisedObserver:
    """Weighs outliers down, re-opens after a jump, restarts when lost, guards the learning.

    It has no batch axis: arms in a batch would react at different times.

    Attributes:
        observer: The observer underneath.
    """

    def __init__(
        self,
        observer: TSObserver | AdaptiveObserver,
        options: SupervisionOptions | None = None,
    ) -> None:
        # Any: the two kinds of state never mix, which the type system cannot see from here.
        self.observer: Any = observer
        self._learner = observer if isinstance(observer, AdaptiveObserver) else None
        self._certified = observer.observer if isinstance(observer, AdaptiveObserver) else observer
        self._period = float(observer.period)
        self.options = options or SupervisionOptions()

    @property
    def options(self) -> SupervisionOptions:
        """When to react; may be exchanged between two steps."""
        return self._options

    @options.setter
    def options(self, options: SupervisionOptions) -> None:
        self._options = options
        # What a jump of the sensor re-opens: the states that the disturbance is read from.
        flow = self._certified.flow
        read = np.zeros(flow.state_count)
        read[flow.state_count - flow.disturbance.state_count :] = flow.disturbance.H[0] != 0.0
        self._opened = np.diag(read * options.jump_std**2)
        self._doubted = np.diag(read * options.disturbance_limit**2)

    @property
    def period(self) -> float:
        """Nominal sampling period [s]."""
        return self._period

    def initial(self) -> SupervisedState:
        """Return the state before any measurement."""
        return SupervisedState(self.observer.initial(), Watch())

    def correct(self, state: SupervisedState, y: Array) -> tuple[SupervisedState, Correction]:
        """Use one measurement y [rad], shape (1,), as far as it can be believed."""
        expected: Correction = self.observer.expect(state.inner, y)
        state, correction, verdict = self.judged(state, expected, y)
        if verdict is not None:
            inner = self.observer.apply(
                state.inner, correction, correction.weight, self.learns(state)
            )
            state = self.concluded(state, inner, verdict)
        return state, correction

    def judged(
        self, state: SupervisedState, correction: Correction, y: Array
    ) -> tuple[SupervisedState, Correction, Verdict | None]:
        """Judge an innovation.

        Args:
            state: Before the correction.
            correction: What the observer expects of it.
            y: The measurement [rad], shape (1,).

        Returns:
            The state to correct, the correction with its weight, and the verdict; None in its
            place if the measurement is not to be used and the state is already final.
        """
        sample = float(y[0])
        repeats = state.repeats + 1 if sample == state.y else 0
        if 0 < self._options.stuck_samples <= repeats:
            inner = self.observer.end_gap(state.inner)
            state = state._replace(inner=inner, y=sample, repeats=repeats)
            return state, correction._replace(weight=0.0), None
        normalised = (
            float(correction.innovation[0]) / float(correction.innovation_covariance[0, 0]) ** 0.5
        )
        watch, verdict = judge(state.watch, normalised, self._period, self._options)
        # Made whole: replacing single fields of so many takes several times as long.
        state = SupervisedState(
            state.inner, watch, state.pause, state.pinned, sample, repeats, *state[6:]
        )
        if verdict.lost:
            # Not from this sample: it may be the worst of those that gave the estimate up. And
            # with the sensor in doubt: what was lost is more often the sensor than the arm.
            initial = self.observer.initial()
            inner = self.observer.inflate_covariance(initial, self._doubted, 0.0)
            state = state._replace(inner=inner, losses=state.losses + 1)
            return state, correction._replace(weight=0.0), None
        if verdict.weight < 1.0:
            state = state._replace(outliers=state.outliers + 1)
            correction = correction._replace(weight=verdict.weight)
        if verdict.weight > 0.0:
            return state, correction, verdict
        return state._replace(inner=self.observer.end_gap(state.inner)), correction, None

    def learns(self, state: SupervisedState) -> bool:
        """Return whether parameters may be learnt from the next correction."""
        return state.pause <= 0.0 and not self.frozen(state)

    def concluded(self, state: SupervisedState, inner: Any, verdict: Verdict) -> SupervisedState:
        """Return the state after a correction, with what the verdict says besides.

        Args:
            state: From `judged`.
            inner: State of the observer underneath after the correction.
            verdict: From `judged`.
        """
        if verdict.jumped and self._opened.any():
            duration = self._options.jump_duration
            inner = self.observer.inflate_covariance(inner, self._opened, duration)
            state = state._replace(jumps=state.jumps + 1, pause=duration)
        inner = self.observer.limit_disturbance(inner, self._options.disturbance_limit)
        return self._guarded(state, inner, verdict)

    def predict(self, state: SupervisedState, u: Array, duration: float) -> SupervisedState:
        """Predict over `duration` [s] with the torque u [N m], shape (1,), held."""
        return self.moved(state, self.observer.predict(state.inner, u, duration), duration)

    def moved(self, state: SupervisedState, inner: Any, duration: float) -> SupervisedState:
        """Return the state after a prediction of the observer underneath."""
        pause = max(0.0, state.pause - duration)
        return SupervisedState(inner, elapse(state.watch, duration), pause, *state[3:])

    def extrapolate(self, state: SupervisedState, u: Array, duration: float) -> SupervisedState:
        """Predict to a time between samples, for reading only."""
        return SupervisedState(self.observer.extrapolate(state.inner, u, duration), *state[1:])

    def readout(self, state: SupervisedState) -> Readout:
        """Return the estimate and its bounds in physical units."""
        return self.reported(state, self.observer.readout(state.inner))

    def reported(self, state: SupervisedState, readout: Readout) -> Readout:
        """Return a readout of the observer underneath, as far as it can be believed."""
        return readout._replace(parameters_valid=False) if self.frozen(state) else readout

    def events(self, state: SupervisedState) -> dict[str, int]:
        """Return how many outliers, jumps, losses and new beginnings were found so far."""
        return {
            "outliers downweighted": state.outliers,
            "sensor jumps": state.jumps,
            "losses of track": state.losses,
            "learning restarts": state.adaptation_resets,
        }

    def frozen(self, state: SupervisedState) -> bool:
        """Return whether learning was given up: the model differs in other ways than θ."""
        return self._learner is not None and state.adaptation_resets > self.options.relearn_budget

    def _guarded(self, state: SupervisedState, inner: Any, verdict: Verdict) -> SupervisedState:
        """Take the corrected inner state, or begin learning again where it went wrong."""
        learner = self._learner
        if learner is None or self.frozen(state):
            return SupervisedState(inner, *state[1:])
        pinned = state.pinned + self._period if learner.at_limit(inner) else 0.0
        if not verdict.strained and pinned < self._options.strain:
            return SupervisedState(inner, state.watch, state.pause, pinned, *state[4:])
        again = state._replace(pinned=0.0, adaptation_resets=state.adaptation_resets + 1)
        forget = learner.nominal if self.frozen(again) else learner.reset_adaptation
        return again._replace(inner=forget(inner))
