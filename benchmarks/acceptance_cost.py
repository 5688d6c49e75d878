# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a step that learns two parameters, next to filterpy's EKF with the same states.

A step is correct + predict. All contenders take the same samples in short turns on one thread, so
that a change of the machine's speed meets all.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from acceptance_ekf import FilterpyAugmentedFilter
from acceptance_runs import supervised, uncertainty_of

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.observer import GainMode
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_TURN = 200


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


def _stepping(observer: Estimator[Any], y: Array, u: Array) -> Callable[[int], None]:
    state = observer.initial()
    period = observer.period

    def step(sample: int) -> None:
        nonlocal state
        corrected, _ = observer.correct(state, y[sample])
        state = observer.predict(corrected, u[sample], period)

    return step
