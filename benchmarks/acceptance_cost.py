# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a step that learns two parameters, next to filterpy's EKF with the same states.

A step is correct + predict. All contenders take the same samples in short turns on one thread, so
that a change of the machine's speed meets all.
"""

import time
from collections.abc import Callable

import numpy as np
from acceptance_ekf import AugmentedFilter
from acceptance_runs import supervised, uncertainty_of
from filterpy.kalman import ExtendedKalmanFilter

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.options import GainMode
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY, MOTOR_VELOCITY
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.uncertainty import SINE, Uncertainty
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_ROWS = [LINK_VELOCITY, MOTOR_VELOCITY]
_TURN = 200


class FilterpyAugmentedFilter(ExtendedKalmanFilter):  # type: ignore[misc]
    """The same model and states in filterpy's filter, one arm, from the parts ours is made of."""

    def __init__(self, design: Design, uncertainty: Uncertainty) -> None:
        twin = AugmentedFilter(design, uncertainty)
        size = len(twin.phi)
        super().__init__(dim_x=size, dim_z=1, dim_u=1)
        self.flow: ArmFlow = twin.flow
        self.effects = uncertainty.directions[:, 0, _ROWS]
        self.phi, self.gamma = twin.phi, twin.gamma
        self.x = np.zeros((size, 1))
        self.P = twin.initial(()).covariance
        self.Q = twin.noise
        self.R = design.request.measurement_covariance
        self.H = np.hstack([twin.flow.output_matrix, np.zeros((1, uncertainty.count))])
        self._identity = np.eye(size)

    def predict_x(self, u: Array) -> None:  # type: ignore[override]
        """Predict as the observer does, and linearise there."""
        torque = float(u[0])
        x, first = self._kick(self.x[:, 0], torque)
        x, second = self._kick(self.phi @ x + self.gamma * torque, torque)
        self.x = x[:, np.newaxis]
        self.F = second @ self.phi @ first

    def step(self, y: Array, u: Array) -> None:
        """Correct by a sample y (1,) and predict with the torque u (1,) held."""
        self.update(y[:, np.newaxis], lambda _: self.H, lambda x: self.H @ x)
        self.predict(u)

    def _kick(self, x: Array, torque: float) -> tuple[Array, Array]:
        step, n = self.flow.nominal, self.flow.state_count
        half, theta = 0.5 * step.duration, x[n:]
        push = (self.effects @ [*x[:4], np.sin(x[LINK_ANGLE]), torque]).T
        change = np.tensordot(theta, self.effects, 1)
        jacobian = self._identity.copy()
        jacobian[_ROWS, :4] += half * change[:, :4]
        jacobian[_ROWS, LINK_ANGLE] += half * change[:, SINE] * np.cos(x[LINK_ANGLE])
        jacobian[_ROWS, n:] = half * push
        jacobian[LINK_VELOCITY, LINK_ANGLE] -= step.half_kick * np.cos(x[LINK_ANGLE])
        kicked = x.copy()
        kicked[_ROWS] += half * (push @ theta)
        kicked[LINK_VELOCITY] -= step.half_kick * np.sin(x[LINK_ANGLE])
        return kicked, jacobian


def step_cost(design: Design, seconds: float = 30.0) -> dict[str, float]:
    """Return the median time of one step of each contender [µs]."""
    runs = simulate(SCENARIOS["stiff"], [1], seconds)
    y, u = runs.measurements[0], runs.torques[0]
    ekf = FilterpyAugmentedFilter(design, uncertainty_of(design))
    contenders: dict[str, Callable[[int], object]] = {
        "adaptive": _stepping(supervised(design, GainMode.CERTIFIED), y, u),
        "adaptive_riccati": _stepping(supervised(design, GainMode.RICCATI), y, u),
        "fixed": _stepping(supervised(design, GainMode.CERTIFIED, adaptive=False), y, u),
        "filterpy": lambda sample: ekf.step(y[sample], u[sample]),
    }
    times: dict[str, list[int]] = {name: [] for name in contenders}
    for begin in range(0, len(y) - _TURN, _TURN):
        for name, step in contenders.items():
            for sample in range(begin, begin + _TURN):
                started = time.perf_counter_ns()
                step(sample)
                times[name].append(time.perf_counter_ns() - started)
    # The first half is for caches and for the certified gain to take over.
    return {name: float(np.median(each[len(each) // 2 :])) / 1e3 for name, each in times.items()}


def _stepping(observer: Estimator, y: Array, u: Array) -> Callable[[int], None]:
    state = observer.initial()
    period = observer.period

    def step(sample: int) -> None:
        nonlocal state
        corrected, _ = observer.correct(state, y[sample])
        state = observer.predict(corrected, u[sample], period)

    return step
