# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The certified observer under supervision: what the node runs, one joint at a time."""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.observer import ObserverState, TSObserver
from tsobs_ros.estimation.supervision import SupervisionOptions, Watch, elapse, judge


class SupervisedState(NamedTuple):
    """State of the observer and of its supervision.

    Attributes:
        observer: The observer's own state.
        watch: What the supervision remembers.
        outliers: Number of measurements that were weighed down.
        jumps: Number of sensor jumps found.
        losses: Number of times the estimate was given up and started afresh.
    """

    observer: ObserverState
    watch: Watch
    outliers: int = 0
    jumps: int = 0
    losses: int = 0


class SupervisedObserver:
    """A `TSObserver` that weighs outliers down, re-opens after a jump and restarts when lost.

    It has no batch axis: arms in a batch would react at different times.

    Attributes:
        observer: The certified observer underneath.
        options: When to react.
    """

    def __init__(self, observer: TSObserver, options: SupervisionOptions | None = None) -> None:
        self.observer = observer
        self.options = options or SupervisionOptions()
        # What a jump of the sensor re-opens: the states that the disturbance is read from.
        opened = np.zeros(observer.flow.state_count)
        opened[4:] = (observer.flow.disturbance.H[0] != 0.0) * self.options.jump_std**2
        self._opened = np.diag(opened)
        self._can_jump = bool(opened.any())

    @property
    def period(self) -> float:
        """Nominal sampling period [s]."""
        return self.observer.period

    def initial(self) -> SupervisedState:
        """Return the state before any measurement."""
        return SupervisedState(self.observer.initial(), Watch())

    def correct(self, state: SupervisedState, y: Array) -> tuple[SupervisedState, Correction]:
        """Use one measurement y [rad], shape (1,), as far as it can be believed."""
        corrected, correction = self.observer.correct(state.observer, y)
        normalised = float(correction.innovation[0]) / float(correction.spread[0, 0]) ** 0.5
        watch, verdict = judge(state.watch, normalised, self.period, self.options)
        state = state._replace(watch=watch)
        if verdict.lost:
            again, correction = self.observer.correct(self.observer.initial(), y)
            return state._replace(observer=again, losses=state.losses + 1), correction
        if verdict.weight < 1.0:
            prior = state.observer.x
            corrected = corrected._replace(x=prior + verdict.weight * (corrected.x - prior))
            state = state._replace(outliers=state.outliers + 1)
        if verdict.jumped and self._can_jump:
            duration = self.options.jump_duration
            corrected = self.observer.reopened(corrected, self._opened, duration)
            state = state._replace(jumps=state.jumps + 1)
        return state._replace(observer=corrected), correction

    def predict(self, state: SupervisedState, u: Array, duration: float) -> SupervisedState:
        """Predict over `duration` [s] with the torque u [N m], shape (1,), held."""
        return state._replace(
            observer=self.observer.predict(state.observer, u, duration),
            watch=elapse(state.watch, duration),
        )

    def extrapolate(self, state: SupervisedState, u: Array, duration: float) -> SupervisedState:
        """Predict to a time between samples, for reading only."""
        return state._replace(observer=self.observer.extrapolate(state.observer, u, duration))

    def readout(self, state: SupervisedState) -> Readout:
        """Return the estimate and its bounds in physical units."""
        return self.observer.readout(state.observer)

    def events(self, state: SupervisedState) -> dict[str, int]:
        """Return how many outliers, jumps and losses were found since the start."""
        return {
            "outliers weighed down": state.outliers,
            "sensor jumps": state.jumps,
            "losses of track": state.losses,
        }
