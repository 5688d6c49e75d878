# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The extended Kalman filter that the acceptance benchmark compares with, plain or with a gate.

Its states are [x; w], or [x; w; θ] with θ of stiffness and gravity. Plain, it has the Kalman gain
along its estimate for ever. With a gate, it leaves samples out that are further off than so many
sigmas, and starts its covariance again if it left most of the last half second out: what somebody
writes who knows about outliers.
"""

import math
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled, compiled_nogil
from tsobs_ros.design.record import Design
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.trigonometry import cosine, sine
from tsobs_ros.model.uncertainty import SINE, TORQUE, Uncertainty

THETA_STD = 0.2
"""1σ of each θ before any measurement."""

THETA_WANDER = 1e-6
"""Growth of each θ's variance [1/s]."""

GATE = 5.0
"""Sigmas of the innovation beyond which a filter with a gate leaves a sample out."""

MOST = 0.6
"""Share of the last samples that have to be left out for the covariance to start again."""

_WINDOW = 100


class Filtered(NamedTuple):
    """Estimates after each sample of some runs.

    Attributes:
        x: [x; w; θ], shape (runs, samples, n + k).
        std: 1σ of the arm's four states and of the disturbance, shape (runs, samples, 5).
    """

    x: Array
    std: Array


class KalmanFilter:
    """The filter of one design.

    Args:
        design: Disturbance, noise and start.
        arm: The arm to predict with, if it is not the design's.
        uncertainty: Parameters to have as states; none if None.
        gate: `GATE`, or infinite for the plain filter.

    Attributes:
        flow: Prediction model without the parameters.
        phi, gamma, noise: The linear flow over a nominal step, with the parameters.
        output: States to measured angle, shape (n + k,).
        covariance: Before any measurement.
        effects: Accelerations of link and motor by each θ, from [x, sin x₁, u], shape (k, 2, 6).
    """

    def __init__(
        self,
        design: Design,
        arm: ElasticJointArm | None = None,
        uncertainty: Uncertainty | None = None,
        gate: float = math.inf,
    ) -> None:
        request = design.arm_request
        arm = arm or request.arm
        self.flow = ArmFlow(arm, request.disturbance_model, request.process_noise, request.period)
        self.effects = np.zeros((0, 2, TORQUE + 1))
        if uncertainty is not None:
            self.effects = np.ascontiguousarray(uncertainty.directions[:, 0, [1, 3]])
        step, n, k = self.flow.nominal, self.flow.state_count, len(self.effects)
        std = np.concatenate(
            [
                arm.from_physical(request.initial_std),
                request.disturbance_model.initial_std,
                np.full(k, THETA_STD),
            ]
        )
        self.covariance = np.diag(std**2)
        self.phi, self.noise = np.eye(n + k), THETA_WANDER * step.duration * np.eye(n + k)
        self.phi[:n, :n], self.noise[:n, :n] = step.phi, step.noise
        self.gamma = np.concatenate([step.gamma[:, 0], np.zeros(k)])
        self.output = np.concatenate([self.flow.output_matrix[0], np.zeros(k)])
        self._disturbance = np.zeros(n + k)
        self._disturbance[4:n] = self.flow.disturbance.H[0]
        self._variance = float(request.measurement_covariance[0, 0])
        self._gate = gate

    def observe(self, y: Array, u: Array) -> Filtered:
        """Return the estimates from measurements and torques, shape (runs, samples, 1) each."""
        shape = y.shape[:2]
        found = Filtered(np.empty((*shape, len(self.phi))), np.empty((*shape, 5)))
        step = self.flow.nominal
        numbers = np.array([step.duration, step.half_kick, self._variance, self._gate])
        _observe(
            numbers,
            self.phi,
            self.gamma,
            self.noise,
            self.output,
            self._disturbance,
            self.effects,
            self.covariance,
            np.ascontiguousarray(y[..., 0]),
            np.ascontiguousarray(u[..., 0]),
            *found,
        )
        return found


@compiled_nogil
def _observe(
    numbers: Array,
    phi: Array,
    gamma: Array,
    noise: Array,
    output: Array,
    disturbance: Array,
    effects: Array,
    initial: Array,
    y: Array,
    u: Array,
    estimates: Array,
    std: Array,
) -> None:
    """Filter every run; `numbers` are the step [s], half a kick [1/s], R and the gate."""
    duration, half_kick, variance, gate = numbers
    size, half = phi.shape[0], 0.5 * duration
    x, P = np.empty(size), np.empty((size, size))
    cross, jacobian, scratch = np.empty(size), np.empty((size, size)), np.empty((size, size))
    left_out = np.empty(_WINDOW)
    for run in range(y.shape[0]):
        x[:], P[:], left_out[:] = 0.0, initial, 0.0
        seen = 0
        for sample in range(y.shape[1]):
            if math.isfinite(y[run, sample]):
                spread, innovation = variance, y[run, sample]
                for i in range(size):
                    cross[i] = 0.0
                    for j in range(size):
                        cross[i] += P[i, j] * output[j]
                    spread += output[i] * cross[i]
                    innovation -= output[i] * x[i]
                is_out = abs(innovation) > gate * math.sqrt(spread)
                left_out[seen % _WINDOW] = 1.0 if is_out else 0.0
                seen += 1
                if seen >= _WINDOW and left_out.sum() > MOST * _WINDOW:
                    P[:], left_out[:] = initial, 0.0
                    seen = 0
                elif not is_out:
                    for i in range(size):
                        x[i] += cross[i] / spread * innovation
                        for j in range(size):
                            P[i, j] -= cross[i] * cross[j] / spread
            total = 0.0
            for i in range(size):
                estimates[run, sample, i] = x[i]
                for j in range(size):
                    total += disturbance[i] * P[i, j] * disturbance[j]
            for i in range(5):
                power = P[i, i] if i < 4 else total
                std[run, sample, i] = math.sqrt(power) if power >= 0.0 else math.nan
            _kick(effects, half, half_kick, u[run, sample], x, jacobian)
            _spread(jacobian, P, scratch)
            for i in range(size):
                cross[i] = gamma[i] * u[run, sample]
                for j in range(size):
                    cross[i] += phi[i, j] * x[j]
            x[:] = cross
            _spread(phi, P, scratch)
            for i in range(size):
                for j in range(size):
                    P[i, j] += noise[i, j]
            _kick(effects, half, half_kick, u[run, sample], x, jacobian)
            _spread(jacobian, P, scratch)


@compiled
def _kick(
    effects: Array, half: float, half_kick: float, u: float, x: Array, jacobian: Array
) -> None:
    """Give half a kick by gravity and by the parameters; write its Jacobian."""
    size, k = x.shape[0], effects.shape[0]
    angle, slope = sine(x[0]), cosine(x[0])
    for i in range(size):
        for j in range(size):
            jacobian[i, j] = 1.0 if i == j else 0.0
    jacobian[1, 0] -= half_kick * slope
    link, motor = -half_kick * angle, 0.0
    for row in range(2):
        place = 1 + 2 * row
        for i in range(k):
            theta, effect = x[size - k + i], effects[i, row]
            push = effect[SINE] * angle + effect[TORQUE] * u
            for j in range(4):
                push += effect[j] * x[j]
                jacobian[place, j] += half * theta * effect[j]
            jacobian[place, 0] += half * theta * effect[SINE] * slope
            jacobian[place, size - k + i] = half * push
            if row == 0:
                link += half * theta * push
            else:
                motor += half * theta * push
    x[1] += link
    x[3] += motor


@compiled
def _spread(matrix: Array, P: Array, scratch: Array) -> None:
    """Move a covariance: P becomes M P Mᵀ."""
    size = P.shape[0]
    for i in range(size):
        for j in range(size):
            scratch[i, j] = 0.0
        for m in range(size):
            factor = matrix[i, m]
            if factor != 0.0:
                for j in range(size):
                    scratch[i, j] += factor * P[m, j]
    for i in range(size):
        for j in range(size):
            P[i, j] = 0.0
    for m in range(size):
        for j in range(size):
            factor = matrix[j, m]
            if factor != 0.0:
                for i in range(size):
                    P[i, j] += scratch[i, m] * factor
