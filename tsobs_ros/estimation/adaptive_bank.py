# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning observers of several joints, each with its own design, as one set of operations."""

from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.adaptive import AdaptiveObserver, AdaptiveState, added_variances
from tsobs_ros.estimation.bank import Bank, Members, in_groups, of
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.observer_bank import ObserverBank
from tsobs_ros.estimation.regression import Explained, Memory, Regression


class AdaptiveBank(Bank[AdaptiveObserver]):
    """Steps k observers of one output as `AdaptiveObserver` steps each; see there."""

    def __init__(self, observers: Sequence[AdaptiveObserver]) -> None:
        super().__init__(observers)
        self._inner = ObserverBank([observer.observer for observer in observers])
        self._regression = Regression.stack(
            [one.regression for one in observers if one.regression is not None]
        )

    def predict(
        self, states: Sequence[AdaptiveState], u: Sequence[Array], duration: float
    ) -> list[AdaptiveState]:
        """Predict over `duration` [s], one by one: the kicks with θ are in Python's numbers."""
        members = zip(self.observers, states, u, strict=True)
        return [observer.predict(state, torque, duration) for observer, state, torque in members]

    def extrapolate(
        self, states: Sequence[AdaptiveState], u: Sequence[Array], duration: float
    ) -> list[AdaptiveState]:
        """Predict to a time between samples, for reading only."""
        members = zip(self.observers, states, u, strict=True)
        return [
            observer.extrapolate(state, torque, duration) for observer, state, torque in members
        ]

    def expect(self, states: Sequence[AdaptiveState], y: Sequence[Array]) -> list[Correction]:
        """Return what is expected of measurements y."""
        known = self._inner.expect([state.observer for state in states], y)
        rows, gamma = _regressors(states)
        explained = self._regression.explained(rows, gamma)
        return [
            observer.expected(correction, Explained(*each))
            for observer, correction, *each in zip(self.observers, known, *explained, strict=True)
        ]

    def apply(
        self,
        states: Sequence[AdaptiveState],
        corrections: Sequence[Correction],
        adapt: Sequence[bool],
    ) -> list[AdaptiveState]:
        """Correct estimates and parameters by as much of each innovation as its weight says."""
        corrected = self._inner.apply([state.observer for state in states], corrections)

        def learn(members: Members) -> list[AdaptiveState]:
            part, before = self.only(members), of(members, states)
            chosen, inner = of(members, corrections), of(members, corrected)
            doubts = None
            if learning[members[0]]:
                both = zip(part.observers, before, strict=True)
                doubts = np.array(
                    [[observer.covariance_inflation(state)] for observer, state in both]
                )
            memory, x = part._regression.applied(
                Memory.stack([state.memory for state in before]),
                np.array([state.x for state in inner]),
                Correction(
                    np.array([one.innovation for one in chosen]),
                    np.array([one.innovation_covariance for one in chosen]),
                    np.array([one.gain for one in chosen]),
                ),
                Explained.stack([one.learning for one in chosen]),
                doubts,
            )
            return [
                state.corrected(observer, Memory(*each), moved)
                for state, observer, moved, *each in zip(before, inner, x, *memory, strict=True)
            ]

        learning = [
            allowed and observer.learns(state, correction.weight)
            for observer, state, correction, allowed in zip(
                self.observers, states, corrections, adapt, strict=True
            )
        ]
        return in_groups(learning, learn)

    def readout(self, states: Sequence[AdaptiveState]) -> list[Readout]:
        """Return the estimates; their bounds have what the uncertain parameters add."""
        readouts = self._inner.readout([state.observer for state in states])
        added = added_variances(*_regressors(states), self._inner.output)
        return [
            observer.reported(*each)
            for observer, *each in zip(self.observers, states, readouts, *added, strict=True)
        ]


def _regressors(states: Sequence[AdaptiveState]) -> tuple[Array, Array]:
    """Return Υᵀ and Γ of all members, shapes (k, θ, n) and (k, θ, θ)."""
    return np.array([state.upsilon.T for state in states]), np.array([s.gamma for s in states])
