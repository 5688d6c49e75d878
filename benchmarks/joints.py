# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a tick of one joint and of seven: a measurement offered and an estimate asked for.

Stamps jitter by 20 µs about the period, as those of a real clock do, and every joint has a design
of its own. The batch and the loop over the joints' own trackers take the same samples one after
another in short turns, so that a change of the machine's speed meets both.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from common import parser, show, use_one_thread

from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.joints import JointTrackers
from tsobs_ros.estimation.records import NANOSECONDS, Measurement
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_tracker
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_TURN = 50
_JITTER = 20_000
_DESIGNS = {
    "shipped": ("elastic_joint.design.yaml", "bias_step"),
    "adaptive": ("elastic_joint_adaptive.design.yaml", "stiff"),
}

Row = list[Measurement]


def _trackers(kind: str, count: int) -> list[Tracker[Any]]:
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


def _cost(kind: str, count: int, seconds: float) -> dict[str, float]:
    """Return the median time of a tick, by the batch and by a loop [µs]."""
    batch, alone = JointTrackers(_trackers(kind, count)), _trackers(kind, count)

    def together(now: int, row: Row) -> None:
        batch.offer(row, now)
        batch.estimate(now)

    def one_by_one(now: int, row: Row) -> None:
        for tracker, measurement in zip(alone, row, strict=True):
            tracker.offer(measurement, now)
        for tracker in alone:
            tracker.estimate(now)

    contenders: dict[str, Callable[[int, Row], None]] = {"batch": together, "loop": one_by_one}
    times: dict[str, list[int]] = {name: [] for name in contenders}
    rows = _rows(kind, count, seconds)
    for begin in range(0, len(rows), _TURN):
        for name, tick in contenders.items():
            for now, row in rows[begin : begin + _TURN]:
                started = time.perf_counter_ns()
                tick(now, row)
                times[name].append(time.perf_counter_ns() - started)
    # The first half is for caches and for the certified gain to take over.
    return {name: float(np.median(each[len(each) // 2 :])) / 1e3 for name, each in times.items()}


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, design=False)
    made.add_argument("--seconds", type=float, default=30.0, help="simulated time")
    made.add_argument("--joints", type=int, default=7, help="size of the batch")
    options = made.parse_args()
    costs = {
        f"{kind}, {count} joint{'s' * (count > 1)}": _cost(kind, count, options.seconds)
        for kind in _DESIGNS
        for count in (1, options.joints)
    }
    lines = ["one tick, offer and estimate, median:     batch      loop   batch / loop"]
    for name, cost in costs.items():
        ratio = cost["batch"] / cost["loop"]
        lines.append(f"  {name:34s} {cost['batch']:7.1f} µs {cost['loop']:7.1f} µs {ratio:10.2f}")
    show({"tick_us": costs}, "\n".join(lines), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
