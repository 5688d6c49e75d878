# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers run again over recorded measurements, above all a plain EKF to compare with.

The reference has the same model, disturbance states and noise densities as the design; only its
gain is the Kalman gain along its own estimate for ever. It has no gates and no health logic.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.observer import GainMode
from tsobs_ros.estimation.records import Estimate, Innovation, Measurement
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.report.metrics import MetricsOptions, RunMetrics, measure
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.report.series import Series


@dataclass(frozen=True)
class EkfComparison:
    """Errors of a run's observer next to an EKF's on the same data and windows.

    Attributes:
        observer: Metrics of the recorded estimates.
        ekf: Metrics of the EKF.
    """

    observer: RunMetrics
    ekf: RunMetrics

    @property
    def ratios(self) -> dict[str, float | None]:
        """RMSE of the observer over that of the EKF, by quantity; None without truth."""
        return {
            ours.key: _ratio(ours.rmse, theirs.rmse)
            for ours, theirs in zip(self.observer.quantities, self.ekf.quantities, strict=True)
        }

    @property
    def normalised_ratio(self) -> float | None:
        """Normalised RMSE of the observer over that of the EKF; None without truth."""
        return _ratio(self.observer.normalised_rmse, self.ekf.normalised_rmse)

    def as_mapping(self) -> dict[str, Any]:
        """Return the EKF's errors and the ratios as plain data."""
        return {
            "rmse": {one.key: one.rmse for one in self.ekf.quantities},
            "normalised_rmse": self.ekf.normalised_rmse,
            "ratio": self.ratios,
            "normalised_ratio": self.normalised_ratio,
        }


def compare_with_ekf(
    run: RecordedRun, design: Design, options: MetricsOptions | None = None
) -> EkfComparison:
    """Run an EKF over the measurements of a run and measure both over the same windows.

    Args:
        run: The recorded run.
        design: Whose model, disturbance states and noise densities the EKF has.
        options: How to measure.
    """
    ekf = rerun(run, design.observer(gain_mode=GainMode.RICCATI), design.request.x_max)
    return EkfComparison(measure(run, options), measure(ekf, options))


def rerun(run: RecordedRun, observer: Estimator[Any], x_max: float) -> RecordedRun:
    """Return the run with the estimates that another observer makes of its measurements.

    The measurements are offered in their order of arrival and the estimates asked for at the
    recorded stamps, each after the measurements up to its stamp.

    Args:
        run: The recorded run.
        observer: The other observer.
        x_max: Half width of its domain [rad].
    """
    tracker = Tracker(observer, TrackerOptions(x_max=x_max))
    innovations: list[Innovation] = []
    waiting = _in_order_of_arrival(run)
    upcoming = next(waiting, None)
    estimates: list[Estimate | None] = []
    for stamp in run.stamps.tolist():
        while upcoming is not None and upcoming.stamp <= stamp:
            outcome = tracker.offer(upcoming, now=stamp)
            if isinstance(outcome, Innovation):
                innovations.append(outcome)
            upcoming = next(waiting, None)
        estimates.append(tracker.estimate(stamp))
    return _with_estimates(run, estimates, innovations)


def _in_order_of_arrival(run: RecordedRun) -> Iterator[Measurement]:
    """Yield the measurements but those that no estimate could know of."""
    last = int(run.stamps[-1])
    stamps, values = run.measurements
    for stamp, (y, u) in zip(stamps.tolist(), values, strict=True):
        if stamp <= last:
            yield Measurement(stamp, np.array([y]), np.array([u]))


def _with_estimates(
    run: RecordedRun, estimates: list[Estimate | None], innovations: list[Innovation]
) -> RecordedRun:
    blank = np.full(4, np.nan)
    states = [blank if one is None else one.state for one in estimates]
    bounds = [blank if one is None else one.state_bound for one in estimates]
    faults = [np.nan if one is None else one.disturbance.item() for one in estimates]
    fault_bounds = [np.nan if one is None else one.disturbance_bound.item() for one in estimates]
    return replace(
        run,
        states=np.array(states),
        state_bounds=np.array(bounds),
        disturbance=np.array(faults),
        disturbance_bounds=np.array(fault_bounds),
        innovations=Series(
            np.array([one.stamp for one in innovations], dtype=np.int64),
            np.array([one.value for one in innovations]).reshape(-1, 1),
        ).ordered(),
    )


def _ratio(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or not theirs else ours / theirs
