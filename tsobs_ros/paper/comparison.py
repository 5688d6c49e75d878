# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's Example 3 on the same noisy runs of the arm for every observer: whose x₃ is best?

The truth is the nonlinear arm with a little process noise, u = sin t, and white measurement noise
of 5 % of the largest angle, in as many runs as there are seeds. PO and PIO get the best θ of a grid
for each; the paper's observer gets the printed gains.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import DisturbanceTerm
from tsobs_ros.estimation.high_gain import HighGainObserver
from tsobs_ros.estimation.kalman import ExtendedKalmanFilter
from tsobs_ros.estimation.proportional_integral import ProportionalIntegralObserver
from tsobs_ros.model.arm import MOTOR_ANGLE, ElasticJointArm
from tsobs_ros.paper.arm_observer import printed_paper_observer
from tsobs_ros.simulation.scenarios import SCENARIOS, Trajectories, simulate

THETAS = tuple(round(float(theta), 3) for theta in np.geomspace(0.5, 8.0, 13))
"""The grid of θ [1/s] of PO and PIO."""

WINDOW_START = 20.0
"""Errors count from here on [s]."""

SCALE = (0.226, 0.60, 3.55, 4.64)
"""RMS of the states themselves in this scenario, in design coordinates."""

WORK = 7
"""Pieces of work of `compare_on_arm`: the runs, then six observers."""

_FIRST_SEED = 9000

State = TypeVar("State")


class StateWithEstimate(Protocol):
    """What every observer carries has an estimate, in design coordinates first."""

    @property
    def x(self) -> Array: ...


class SampledObserver(Protocol[State]):
    """An observer that is run sample by sample."""

    def correct(self, state: State, y: Array) -> tuple[State, object]: ...

    def predict(self, state: State, u: Array, duration: float) -> State: ...


class ObserverErrors(NamedTuple):
    """Errors of one observer, one row a run.

    Attributes:
        name: For tables and legends.
        rmse: Of the four states in design coordinates, shape (runs, 4).
        theta: The θ it used [1/s]; NaN where there is none.
        example: x̂ of the first run, shape (samples, 4).
    """

    name: str
    rmse: Array
    theta: float
    example: Array

    @property
    def motor_angle(self) -> Array:
        """RMSE of x₃ by run, shape (runs,)."""
        return np.asarray(self.rmse[:, MOTOR_ANGLE])

    @property
    def normalised(self) -> Array:
        """RMS over the states of RMSE over the states' own RMS, by run, shape (runs,)."""
        return np.asarray(np.sqrt(np.mean((self.rmse / np.array(SCALE)) ** 2, axis=1)))


@dataclass(frozen=True)
class Comparison:
    """All observers on the same runs.

    Attributes:
        trajectories: The runs.
        observers: PO, PIO, paper (the paper's), ours, EKF (with our disturbance states) and
            EKF clean (with none), in this order.
    """

    trajectories: Trajectories
    observers: tuple[ObserverErrors, ...]

    def __getitem__(self, name: str) -> ObserverErrors:
        """Return an observer by its name."""
        return next(each for each in self.observers if each.name == name)


def compare_on_arm(
    design: Design,
    seeds: int = 20,
    *,
    duration: float = 60.0,
    thetas: Sequence[float] = THETAS,
    advance: Callable[[], None] = lambda: None,
) -> Comparison:
    """Run every observer on the same noisy arm.

    Args:
        design: The certified design; its model and noise densities are the EKF's too.
        seeds: Number of runs.
        duration: Of a run [s], above `WINDOW_START`.
        thetas: Grid for PO and PIO [1/s].
        advance: Called after each of the `WORK` pieces of work.
    """
    runs = simulate(SCENARIOS["noise"], range(_FIRST_SEED, _FIRST_SEED + seeds), duration)
    advance()
    arm = ElasticJointArm()
    grid = np.array(thetas, dtype=np.float64)[:, np.newaxis]
    batch = (len(thetas), seeds)
    observers = []
    high_gain = HighGainObserver(arm, grid)
    observers.append(_best("PO", thetas, runs, run(high_gain, high_gain.initial(batch), runs)))
    advance()
    integral = ProportionalIntegralObserver(arm, grid)
    observers.append(_best("PIO", thetas, runs, run(integral, integral.initial(batch), runs)))
    advance()
    paper = printed_paper_observer()
    start = paper.initial(runs.measurements[:, 0])
    observers.append(_errors("paper", runs, run(paper, start, runs)))
    advance()
    ours = design.observer()
    observers.append(_errors("ours", runs, run(ours, ours.initial((seeds,)), runs)))
    advance()
    without = replace(design.request, disturbance=(DisturbanceTerm("clean"),))
    for name, request in (("EKF", design.request), ("EKF clean", without)):
        ekf = ExtendedKalmanFilter(
            request.flow, request.measurement_covariance, request.initial_covariance
        )
        observers.append(_errors(name, runs, run(ekf, ekf.initial((seeds,)), runs)))
        advance()
    return Comparison(runs, tuple(observers))


def run(observer: SampledObserver[State], state: State, runs: Trajectories) -> Array:
    """Return x̂ after each sample, shape (..., runs, samples, 4), from a start state."""
    period = float(runs.times[1] - runs.times[0])
    estimates = []
    for index in range(len(runs.times)):
        state, _ = observer.correct(state, runs.measurements[:, index])
        estimates.append(_estimate(state))
        state = observer.predict(state, runs.torques[:, index], period)
    return np.stack(estimates, axis=-2)


def _estimate(state: object) -> Array:
    x: Array = state.x  # type: ignore[attr-defined]
    return x[..., :4]


def _errors(
    name: str, runs: Trajectories, estimates: Array, theta: float = float("nan")
) -> ObserverErrors:
    return ObserverErrors(name, _rmse(runs, estimates), theta, estimates[0])


def _best(
    name: str, thetas: Sequence[float], runs: Trajectories, estimates: Array
) -> ObserverErrors:
    """Return the errors at the θ with the smallest mean RMSE of x₃."""
    errors = _rmse(runs, estimates)
    best = int(np.argmin(errors[..., MOTOR_ANGLE].mean(axis=-1)))
    return _errors(name, runs, estimates[best], thetas[best])


def _rmse(runs: Trajectories, estimates: Array) -> Array:
    settled = runs.times >= WINDOW_START
    error = estimates[..., settled, :] - runs.states[:, settled]
    return np.asarray(np.sqrt(np.mean(error**2, axis=-2)))
