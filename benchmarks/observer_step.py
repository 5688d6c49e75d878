# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of one observer step, alone and in batches, next to filterpy's extended Kalman filter.

A step is correct + predict on data of a simulated arm with a bias step. All contenders take the
same samples one after another in short turns, so that a change of the machine's speed meets all.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from common import design_of, parser, show, use_one_thread
from filterpy.kalman import ExtendedKalmanFilter

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.observer import GainMode
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.estimation.supervised import SupervisedObserver
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_TURN = 200
_NANO = 1_000_000_000

Step = Callable[[int], object]


class _FilterpyEkf(ExtendedKalmanFilter):  # type: ignore[misc]
    """The same model and states: exact prediction, its Jacobian at the estimate."""

    def __init__(self, design: Design) -> None:
        flow = design.request.flow
        super().__init__(dim_x=flow.state_count, dim_z=1, dim_u=1)
        self.flow: ArmFlow = flow
        self.x = np.zeros((flow.state_count, 1))
        self.P = design.request.initial_covariance.copy()
        self.Q = flow.nominal.noise
        self.R = design.request.measurement_covariance

    def predict_x(self, u: Any = 0) -> None:
        """Predict as the observer does, and linearise there."""
        step = self.flow.nominal
        before = self._kick(step.half_kick * np.cos(self.x[0, 0]))
        self.x = self.flow.predict(self.x[:, 0], u, self.flow.period)[:, np.newaxis]
        self.F = self._kick(step.half_kick * np.cos(self.x[0, 0])) @ step.phi @ before

    def _kick(self, gain: float) -> Array:
        matrix = np.eye(self.dim_x)
        matrix[1, 0] = -gain
        return matrix


class _Running:
    """An observer that goes on from sample to sample."""

    def __init__(self, observer: Estimator[Any], y: Array, u: Array) -> None:
        self._observer, self._y, self._u = observer, y, u
        self._period = observer.period
        self.state = observer.initial()

    def __call__(self, sample: int) -> None:
        state, _ = self._observer.correct(self.state, self._y[sample])
        self.state = self._observer.predict(state, self._u[sample], self._period)


def _single(design: Design, seconds: float) -> dict[str, float]:
    """Return the median time of one step of each contender [µs]."""
    runs = simulate(SCENARIOS["bias_step"], [1], seconds)
    y, u = runs.measurements[0], runs.torques[0]
    ekf = _FilterpyEkf(design)
    C = design.request.flow.output_matrix
    tracker = Tracker(
        SupervisedObserver(design.observer(settle_time=0.0)),
        TrackerOptions(x_max=design.request.x_max),
    )

    def ekf_step(sample: int) -> None:
        ekf.update(y[sample][:, np.newaxis], lambda _: C, lambda x: C @ x)
        ekf.predict(u[sample])

    def tick(sample: int) -> None:
        stamp = _NANO + round(sample * _NANO / design.request.rate)
        tracker.offer(Measurement(stamp, y[sample], u[sample]), stamp)
        tracker.estimate(stamp + 1_000_000)

    contenders: dict[str, Step] = {
        "certified": _Running(design.observer(settle_time=0.0), y, u),
        "supervised": _Running(SupervisedObserver(design.observer(settle_time=0.0)), y, u),
        "riccati": _Running(design.observer(gain_mode=GainMode.RICCATI), y, u),
        "tracker": tick,
        "filterpy": ekf_step,
    }
    times: dict[str, list[int]] = {name: [] for name in contenders}
    for begin in range(0, len(y) - _TURN, _TURN):
        for name, step in contenders.items():
            for sample in range(begin, begin + _TURN):
                started = time.perf_counter_ns()
                step(sample)
                times[name].append(time.perf_counter_ns() - started)
    # The first quarter is for caches and for the certified gain to take over.
    medians = {name: float(np.median(each[len(each) // 4 :])) / 1e3 for name, each in times.items()}
    state = contenders["certified"].state  # type: ignore[attr-defined]
    assert state.certified, "the certified gain never took over, so its step was not measured"
    return medians


def _batch(design: Design, arms: int, steps: int) -> float:
    """Return the arm-steps a second of a settled batch, median over its steps."""
    runs = simulate(SCENARIOS["bias_step"], list(range(16)), 20.0)
    copies = -(-arms // 16)
    y = np.tile(np.moveaxis(runs.measurements, 0, 1), (1, copies, 1))[:, :arms]
    u = np.tile(np.moveaxis(runs.torques, 0, 1), (1, copies, 1))[:, :arms]
    observer = design.observer(settle_time=0.0)
    running = _Running(observer, y, u)
    # Settling a batch with Riccati gains takes long and is not what is measured: begin at X.
    X = observer.certified.X
    running.state = observer.initial((arms,))._replace(covariance=X, settling=0.0, certified=True)
    times = []
    for sample in range(steps):
        started = time.perf_counter()
        running(sample)
        times.append(time.perf_counter() - started)
    assert running.state.certified
    assert np.isfinite(running.state.x).all()
    return arms / float(np.median(times))


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--seconds", type=float, default=30.0, help="simulated time of one arm")
    made.add_argument("--arms", type=int, default=10_000, help="size of the batch")
    made.add_argument("--steps", type=int, default=500, help="steps of the batch")
    options = made.parse_args()
    design = design_of(options)
    single = _single(design, options.seconds)
    rate = _batch(design, options.arms, options.steps)
    ratio = single["certified"] / single["filterpy"]
    text = "\n".join(
        [
            f"one step, {design.request.flow.state_count} states, median:",
            f"  certified gain            {single['certified']:7.1f} µs",
            f"  the same, supervised      {single['supervised']:7.1f} µs",
            f"  Riccati gain              {single['riccati']:7.1f} µs",
            f"  filterpy's EKF            {single['filterpy']:7.1f} µs",
            f"  certified / filterpy      {ratio:7.2f}",
            f"  tracker, sample and tick  {single['tracker']:7.1f} µs",
            f"batch of {options.arms}, one thread:  {rate / 1e6:.2f} million arm-steps/s",
        ]
    )
    results = {
        "step_us": single,
        "certified_over_filterpy": ratio,
        "batch": {"arms": options.arms, "arm_steps_per_second": rate},
    }
    show(results, text, options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
