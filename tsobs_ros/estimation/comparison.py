# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observers to compare with, made to run where the certified one runs: tracker and node.

They prove no bound, so their readout has none, and PO and PIO know no disturbance either; what is
missing has length zero. Nothing supervises them.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.estimation.estimator import Correction, Readout
from tsobs_ros.estimation.high_gain import HighGainObserver
from tsobs_ros.estimation.proportional_integral import ProportionalIntegralObserver
from tsobs_ros.model.arm import ElasticJointArm

_NONE = np.zeros(0)


class ComparisonObserver:
    """An observer without bounds as an `Estimator` of one joint.

    Attributes:
        period: Nominal sampling period [s].
    """

    def __init__(
        self,
        observer: Any,
        initial: Any,
        arm: ElasticJointArm,
        period: float,
        measurement_std: float,
        disturbance: Callable[[Any], Array] | None = None,
    ) -> None:
        """Take an observer to run.

        Args:
            observer: Has `correct(state, y) -> (state, innovation)` and `predict`, and states
                whose `x` begins with the four of the arm in design coordinates.
            initial: Its state before any measurement.
            arm: The nominal arm, for physical units.
            period: Nominal sampling period [s].
            measurement_std: 1σ of a sample [rad], all that is expected of an innovation.
            disturbance: Reads the disturbance [rad] off a state, if the observer has one.
        """
        self.period = positive("period", period)
        self._observer = observer
        self._initial = initial
        self._arm = arm
        self._spread = np.array([[positive("measurement_std", measurement_std) ** 2]])
        self._disturbance = disturbance

    def initial(self) -> Any:
        """Return the state before any measurement."""
        return self._initial

    def correct(self, state: Any, y: Array) -> tuple[Any, Correction]:
        """Use one measurement y [rad], shape (1,)."""
        corrected, innovation = self._observer.correct(state, y)
        return corrected, Correction(innovation, self._spread, _NONE)

    def predict(self, state: Any, u: Array, duration: float) -> Any:
        """Predict over `duration` [s] with the torque u [N m], shape (1,), held."""
        return self._observer.predict(state, u, duration)

    def extrapolate(self, state: Any, u: Array, duration: float) -> Any:
        """Predict to a time between samples, for reading only."""
        return self._observer.predict(state, u, duration)

    def readout(self, state: Any) -> Readout:
        """Return the estimate in physical units; bounds are empty."""
        disturbance = _NONE if self._disturbance is None else self._disturbance(state)
        return Readout(
            state=self._arm.to_physical(state.x[..., :4]),
            state_bound=_NONE,
            disturbance=disturbance,
            disturbance_rate=_NONE,
            disturbance_bound=_NONE,
            certified=False,
        )

    def events(self, state: Any) -> dict[str, int]:
        """Return no counts: these observers judge nothing."""
        return {}


def high_gain(
    arm: ElasticJointArm, theta: float, period: float, measurement_std: float
) -> ComparisonObserver:
    """Return the proportional high-gain observer (PO) with poles at −θ·(1, 1.1, 1.2, 1.3)."""
    inner = HighGainObserver(arm, theta)
    return ComparisonObserver(inner, inner.initial(), arm, period, measurement_std)


def proportional_integral(
    arm: ElasticJointArm, theta: float, period: float, measurement_std: float
) -> ComparisonObserver:
    """Return the proportional-integral observer (PIO) with poles at −θ·(1, …, 1.4)."""
    inner = ProportionalIntegralObserver(arm, theta)
    return ComparisonObserver(inner, inner.initial(), arm, period, measurement_std)
