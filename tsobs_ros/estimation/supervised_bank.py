# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Supervised observers of several joints: stepped at once, and each judged on its own."""

from collections.abc import Hashable, Sequence
from typing import Any

from tsobs_ros.checks import Array
from tsobs_ros.estimation.adaptive import AdaptiveObserver
from tsobs_ros.estimation.adaptive_bank import AdaptiveBank
from tsobs_ros.estimation.bank import Bank
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.observer import TSObserver
from tsobs_ros.estimation.observer_bank import ObserverBank
from tsobs_ros.estimation.supervised import SupervisedObserver, SupervisedState
from tsobs_ros.model.flow import ArmFlow


def structure(estimator: Any) -> Hashable | None:
    """Return what estimators must have in common to form a bank, None if this one cannot."""
    if type(estimator) is not SupervisedObserver:
        return None
    learner, observer, parameters = estimator.observer, estimator.observer, 0
    if type(learner) is AdaptiveObserver:
        observer, parameters = learner.observer, learner.uncertainty.count
    if type(observer) is not TSObserver or type(observer.flow) is not ArmFlow:
        return None
    flow = observer.flow
    holds_torque = observer.gap_flow is None
    return flow.period, flow.state_count, type(learner), parameters, holds_torque


class SupervisedBank(Bank[SupervisedObserver]):
    """Steps k observers as `SupervisedObserver` steps each; see there for the arguments.

    Args:
        observers: Of equal `structure`.
    """

    def __init__(self, observers: Sequence[SupervisedObserver]) -> None:
        super().__init__(observers)
        inner = [observer.observer for observer in observers]
        adaptive = isinstance(inner[0], AdaptiveObserver)
        # Any: the two kinds of state never mix, as in the observer.
        self._inner: Any = AdaptiveBank(inner) if adaptive else ObserverBank(inner)

    def predict(
        self, states: Sequence[SupervisedState], u: Sequence[Array], duration: float
    ) -> list[SupervisedState]:
        """Predict over `duration` [s]."""
        inner = self._inner.predict([state.inner for state in states], u, duration)
        members = zip(self.observers, states, inner, strict=True)
        return [observer.moved(state, moved, duration) for observer, state, moved in members]

    def correct(
        self, states: Sequence[SupervisedState], y: Sequence[Array]
    ) -> list[tuple[SupervisedState, Correction]]:
        """Use one measurement each, as far as it can be believed."""
        expected = self._inner.expect([state.inner for state in states], y)
        judged = [
            observer.judged(*each)
            for observer, *each in zip(self.observers, states, expected, y, strict=True)
        ]
        results = [(state, correction) for state, correction, _ in judged]
        used = tuple(place for place, (*_, verdict) in enumerate(judged) if verdict is not None)
        if not used:
            return results
        inner = self._inner.only(used).apply(
            [judged[place][0].inner for place in used],
            [judged[place][1] for place in used],
            [self.observers[place].learns(judged[place][0]) for place in used],
        )
        for place, corrected in zip(used, inner, strict=True):
            state, correction, verdict = judged[place]
            assert verdict is not None
            concluded = self.observers[place].concluded(state, corrected, verdict)
            results[place] = (concluded, correction)
        return results

    def extrapolate(
        self, states: Sequence[SupervisedState], u: Sequence[Array], duration: float
    ) -> list[SupervisedState]:
        """Predict to a time between samples, for reading only."""
        inner = self._inner.extrapolate([state.inner for state in states], u, duration)
        return [
            SupervisedState(moved, *state[1:]) for state, moved in zip(states, inner, strict=True)
        ]

    def readout(self, states: Sequence[SupervisedState]) -> list[Readout]:
        """Return the estimates and their bounds in physical units."""
        readouts = self._inner.readout([state.inner for state in states])
        return [
            observer.reported(state, readout)
            for observer, state, readout in zip(self.observers, states, readouts, strict=True)
        ]
