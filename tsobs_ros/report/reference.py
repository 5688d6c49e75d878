# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers run again over recorded measurements, above all a plain EKF to compare with.

The reference has the same model, disturbance states and noise densities as the design; only its
gain is the Kalman gain along its own estimate for ever. It has no gates and no health logic.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.observer import GainMode
from tsobs_ros.estimation.tracker import JointTrackers, Tracker, TrackerOptions
from tsobs_ros.replay.replay import Estimated, Replay, Schedule, Used
from tsobs_ros.replay.source import Samples
from tsobs_ros.replay.table import EstimateTable
from tsobs_ros.report.metrics import MetricsOptions, RunMetrics, measure
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.report.series import Series, Stamps


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
    samples = _known_samples(run)
    trackers = JointTrackers([Tracker(observer, TrackerOptions(x_max=x_max))])
    known = np.searchsorted(np.maximum.accumulate(samples.stamps), run.stamps, side="right")
    schedule = Schedule(
        stamps=run.stamps,
        now=run.stamps,
        min_known=known,
        max_known=known,
        reset_after=np.full(len(run.stamps), -1),
        log_times=run.stamps,
        publish_times=run.stamps,
    )
    table = EstimateTable(len(run.stamps), samples.count, 1)
    for event in Replay(trackers, samples, schedule, stale_after=math.inf).run():
        match event:
            case Estimated(tick, estimates):
                table.add([tick], [estimates])
            case Used(_, message, outcomes):
                table.add_innovations(message, outcomes)
    return replace(run, **estimates_of(table, samples.stamps))


def estimates_of(
    table: EstimateTable,
    stamps: Stamps,
    joint: int = 0,
    ticks: slice | NDArray[np.intp] = slice(None),
) -> dict[str, Any]:
    """Return what a replay estimated of a joint, as a `RecordedRun` has it.

    Args:
        table: What it estimated.
        stamps: Of the measurements [ns].
        joint: Its index.
        ticks: Some of the ticks.
    """
    used = ~np.isnan(table.innovations[:, joint])
    return {
        "states": table.states[ticks, joint],
        "state_bounds": table.state_bounds[ticks, joint],
        "disturbance": table.disturbances[ticks, joint, 0],
        "disturbance_bounds": table.disturbance_bounds[ticks, joint, 0],
        "innovations": Series(stamps[used], table.innovations[used, joint, np.newaxis]).ordered(),
    }


def _known_samples(run: RecordedRun) -> Samples:
    """Return the measurements, but for those that no estimate could know of."""
    known = run.measurements.stamps <= run.stamps[-1]
    stamps, values = (array[known] for array in run.measurements)
    there = np.ones((len(stamps), 1), np.bool_)
    return Samples(
        stamps, stamps, stamps, values[:, :1], values[:, 1:], named=there, complete=there
    )


def _ratio(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or not theirs else ours / theirs
