# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Certified observers of several joints, each with its own design, as one set of operations."""

from collections.abc import Iterable, Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.bank import Bank, Members, in_groups, of
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.observer import ObserverState, TSObserver
from tsobs_ros.estimation.output_model import OutputModel
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.flow_bank import FlowBank
from tsobs_ros.model.gap_flow import UNHEARD, narrowed, widened
from tsobs_ros.model.products import mapped


class ObserverBank(Bank[TSObserver]):
    """Steps k observers of arms as `TSObserver` steps each; see there for the arguments.

    Attributes:
        flow: Prediction models, stacked.
        gap_flow: Those of gaps, stacked, if every member has one.
        output: Output models, stacked.
    """

    def __init__(self, observers: Sequence[TSObserver]) -> None:
        super().__init__(observers)
        self.flow = FlowBank(
            [observer.flow for observer in observers if isinstance(observer.flow, ArmFlow)]
        )
        gap_flows = [observer.gap_flow for observer in observers if observer.gap_flow is not None]
        self.gap_flow = FlowBank(gap_flows) if len(gap_flows) == len(observers) else None
        self.output = OutputModel.stack([observer.output for observer in observers])
        self._K = np.array([observer.certified.K for observer in observers])

    def predict(
        self, states: Sequence[ObserverState], u: Sequence[Array], duration: float
    ) -> list[ObserverState]:
        """Predict over `duration` [s]."""
        return self._moved(states, u, duration, between_samples=False)

    def extrapolate(
        self, states: Sequence[ObserverState], u: Sequence[Array], duration: float
    ) -> list[ObserverState]:
        """Predict to a time between samples, for reading only."""
        return self._moved(states, u, duration, between_samples=True)

    def expect(self, states: Sequence[ObserverState], y: Sequence[Array]) -> list[Correction]:
        """Return what is expected of measurements y."""
        innovations = self.output.innovation(_estimates(states), np.array(y))
        return [
            observer.expected(state, innovation)
            for observer, state, innovation in zip(self.observers, states, innovations, strict=True)
        ]

    def apply(
        self,
        states: Sequence[ObserverState],
        corrections: Sequence[Correction],
        adapt: Sequence[bool] = (),
    ) -> list[ObserverState]:
        """Return the states corrected by as much of each innovation as its weight says."""
        innovations = np.array(
            [c.innovation if c.weight == 1.0 else c.weight * c.innovation for c in corrections]
        )
        settled = all(state.certified for state in states)
        gains = self._K if settled else np.array([correction.gain for correction in corrections])
        x = _estimates(states) + mapped(gains, innovations)
        return [
            observer.applied(state, correction, each)
            for observer, state, correction, each in zip(
                self.observers, states, corrections, x, strict=True
            )
        ]

    def readout(self, states: Sequence[ObserverState]) -> list[Readout]:
        """Return the estimates and their bounds in physical units."""
        x = _estimates(states)
        physical = self.flow.to_physical(x)
        disturbance, rate = self.output.disturbance(x), self.output.disturbance_rate(x)
        return [
            observer.reported(*each)
            for observer, *each in zip(
                self.observers, states, physical, disturbance, rate, strict=True
            )
        ]

    def _moved(
        self,
        states: Sequence[ObserverState],
        u: Sequence[Array],
        duration: float,
        *,
        between_samples: bool,
    ) -> list[ObserverState]:
        hand_over = not between_samples

        def move(members: Members) -> list[ObserverState]:
            part, before, certified = self.only(members), of(members, states), covered[members[0]]
            x, torque = _estimates(before), np.array(of(members, u))
            covariances: Iterable[Array] = [state.covariance for state in before]
            after: Iterable[Array | None] = [None] * len(before)
            if certified:
                x = part.flow.predict(x, torque, duration)
            elif gaps[members[0]] is None or part.gap_flow is None:
                spreads = np.array(covariances)
                x, covariances = part.flow.predict_with_covariance(x, spreads, torque, duration)
            else:
                spreads = np.array(of(members, gaps))
                x, after = part.gap_flow.predict_with_covariance(
                    widened(x), spreads, torque, duration
                )
                x, covariances = x[..., :-UNHEARD], narrowed(after)
            return [
                observer.moved(state, own, covariance, duration, certified, hand_over, gap)
                for observer, state, own, covariance, gap in zip(
                    part.observers, before, x, covariances, after, strict=True
                )
            ]

        covered = [
            observer.stays_certified(state, duration, between_samples=between_samples)
            for observer, state in zip(self.observers, states, strict=True)
        ]
        if all(covered):
            return move(tuple(range(len(covered))))
        gaps = [
            None if settled else observer.gap(state, duration)
            for observer, state, settled in zip(self.observers, states, covered, strict=True)
        ]
        keys = [(settled, gap is None) for settled, gap in zip(covered, gaps, strict=True)]
        return in_groups(keys, move)


def _estimates(states: Sequence[ObserverState]) -> Array:
    return np.array([state.x for state in states])
