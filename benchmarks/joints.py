# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a tick of one joint and of seven: offering a measurement and getting an estimate.

Joints are stepped one by one, or all of them in one call. Stamps jitter by 20 µs about the period,
like those of a real clock, and the joints share no design. All contenders take turns on the same
samples.
"""

import time

import numpy as np
from common import at_least, parser, show, use_one_thread

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.estimation.tracker import Tracker, step_joints
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_JITTER = 20_000
_TURN = 200
_DESIGNS = {
    "fixed": (FIXED_DESIGN, "noise"),
    "adaptive": (SHIPPED_DESIGN, "stiff"),
}

Row = list[Measurement]


def _trackers(kind: str, count: int) -> list[Tracker]:
    """Return trackers that share nothing, not even an equal design."""
    designs = [load_design(config_path(_DESIGNS[kind][0])) for _ in range(count)]
    return [make_tracker(each, ObserverSettings()) for each in designs]


def _rows(kind: str, count: int, seconds: float) -> list[tuple[int, Row]]:
    """Return the measurements of each sample and the stamp of the tick after it."""
    runs = simulate(SCENARIOS[_DESIGNS[kind][1]], list(range(count)), seconds)
    period = round((runs.times[1] - runs.times[0]) * NANOSECONDS)
    samples = runs.measurements.shape[1]
    jitter = np.random.default_rng(1).integers(-_JITTER, _JITTER + 1, (2, samples)).tolist()
    rows: list[tuple[int, Row]] = []
    for k in range(samples):
        stamp = NANOSECONDS + k * period + jitter[0][k]
        row: Row = [
            Measurement(stamp, runs.measurements[j, k], runs.torques[j, k]) for j in range(count)
        ]
        rows.append((stamp + period // 5 + jitter[1][k], row))
    return rows


def _one_by_one(trackers: list[Tracker], row: Row, now: int) -> int:
    """Return the time of a tick, joint by joint [ns]."""
    started = time.perf_counter_ns()
    for tracker, measurement in zip(trackers, row, strict=True):
        tracker.offer(measurement, now)
        tracker.estimate(now)
    return time.perf_counter_ns() - started


def _together(trackers: list[Tracker], row: Row, now: int) -> int:
    """Return the time of a tick in one call [ns]."""
    stamps, y, u = (np.array(each) for each in zip(*row, strict=True))
    started = time.perf_counter_ns()
    step_joints(trackers, stamps, y, u, now)
    return time.perf_counter_ns() - started


def _costs(counts: list[int], seconds: float) -> dict[str, float]:
    """Return the median time of a tick of each kind and number of joints [µs]."""
    cases = {
        f"{kind}, {count} joint{'s' * (count > 1)}, {way}": (
            tick,
            _trackers(kind, count),
            _rows(kind, count, seconds),
        )
        for kind in _DESIGNS
        for count in counts
        for way, tick in (("one by one", _one_by_one), ("in one call", _together))
    }
    times: dict[str, list[int]] = {name: [] for name in cases}
    for begin in range(0, min(len(rows) for *_, rows in cases.values()), _TURN):
        for name, (tick, trackers, rows) in cases.items():
            times[name] += [tick(trackers, row, now) for now, row in rows[begin : begin + _TURN]]
    # During the first half, caches fill and the certified gain takes over.
    return {name: float(np.median(each[len(each) // 2 :])) / 1e3 for name, each in times.items()}


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, design=False)
    made.add_argument("--seconds", type=at_least(1.0), default=30.0, help="simulated time")
    made.add_argument("--joints", type=at_least(1, int), default=7, help="number of joints")
    options = made.parse_args()
    costs = _costs([1, options.joints], options.seconds)
    lines = ["one tick, offer and estimate, median:"]
    lines += [f"  {name:34s} {cost:7.1f} µs" for name, cost in costs.items()]
    show({"tick_us": costs}, "\n".join(lines), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
