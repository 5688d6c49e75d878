# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The faults that the monitor names, the time until it does, and its false alarms.

The observer is that of the node, with the default design: its disturbance is a bias, and it learns
stiffness and gravity. Faults begin at 30 s of a minute. The share of the time in which each kind is
reported counts from 5 s later on; for a stuck sensor, until the sensor is free again.
"""

import math
import time
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from common import at_least, design_of, parser, show, use_one_thread

from tsobs_ros.design.record import Design
from tsobs_ros.estimation.faults import FaultKind, FaultMonitor
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.methods import make_tracker
from tsobs_ros.simulation.plant import Mismatch, Plant, Scenario
from tsobs_ros.simulation.scenarios import arm_with
from tsobs_ros.simulation.sensor import Sensor
from tsobs_ros.simulation.signals import (
    BiasStep,
    GaussMarkov,
    Ramp,
    Signal,
    Sinusoid,
    StuckSensor,
)

_ONSET, _SETTLED, _STUCK = 30.0, 5.0, 20.0
_NOISE = Scenario()
_ENCODER = Sensor(noise_std=0.0, resolution=math.tau / 1024)
_OUTLIERS = Sensor(outlier_probability=0.1, outlier_size=math.pi, outlier_is_uniform=True)


class _Case(NamedTuple):
    """A scenario, its sensor from the onset on, and the right kind to report."""

    expected: FaultKind
    scenario: Scenario = _NOISE
    sensor: Sensor | None = None


def _fault(expected: FaultKind, component: Signal) -> _Case:
    return _Case(expected, arm_with(component))


def _noise(**changes: Any) -> _Case:
    return _Case(FaultKind.NOISE, sensor=replace(Sensor(), **changes))


_CASES = {
    "noise": _Case(FaultKind.NONE),
    "1 % outliers": _Case(FaultKind.NONE, arm_with(Sensor(outlier_probability=0.01))),
    "10 % outliers": _Case(FaultKind.NONE, arm_with(_OUTLIERS)),
    "10-bit encoder": _Case(FaultKind.NONE, arm_with(_ENCODER)),
    "bias .1": _fault(FaultKind.BIAS, BiasStep(0.1, _ONSET)),
    "bias .03": _fault(FaultKind.BIAS, BiasStep(0.03, _ONSET)),
    "ramp .02/s": _fault(FaultKind.DRIFT, Ramp(0.02, _ONSET)),
    "ramp .004/s": _fault(FaultKind.DRIFT, Ramp(0.004, _ONSET)),
    "Gauss-Markov": _fault(FaultKind.DRIFT, GaussMarkov(0.1, 20.0, _ONSET)),
    "tone 3 rad/s": _fault(FaultKind.OSCILLATION, Sinusoid(0.2, 3.0, _ONSET)),
    "tone 8 rad/s": _fault(FaultKind.OSCILLATION, Sinusoid(0.2, 8.0, _ONSET)),
    "tone .5 rad/s": _fault(FaultKind.OSCILLATION, Sinusoid(0.2, 0.5, _ONSET)),
    "tone 1.4 rad/s": _fault(FaultKind.OSCILLATION, Sinusoid(0.2, 1.4, _ONSET)),
    "stuck": _fault(FaultKind.STUCK, StuckSensor(_ONSET, _STUCK)),
    "stuck encoder": _Case(
        FaultKind.STUCK,
        arm_with(_ENCODER, StuckSensor(_ONSET, _STUCK)),
    ),
    "noise x 3": _noise(noise_std=0.084),
    "noise x 1.3": _noise(noise_std=0.0364),
    "stiffness +20 %": _Case(FaultKind.NONE, arm_with(Mismatch(stiffness=0.2))),
}


class _Run(NamedTuple):
    """The kind and the CPU time of the monitor's call [ns] at each sample."""

    kinds: list[FaultKind]
    costs: list[int]


def _run(design: Design, case: _Case, seed: int, duration: float) -> _Run:
    scenario = replace(case.scenario, rate=design.request.rate)
    plant, tracker = Plant(scenario, seed), make_tracker(design)
    monitor, kinds, costs = FaultMonitor(tracker.estimator), [], []
    for index in range(round(duration * scenario.rate)):
        if case.sensor is not None and index == round(_ONSET * scenario.rate):
            plant.exchange(arm_with(case.sensor, rate=scenario.rate))
        sample = plant.step()
        stamp = 1_000_000_000 + round(float(sample.times) * 1e9)
        tracker.offer(Measurement(stamp, sample.measurements, sample.torques), stamp)
        known = tracker.estimate(stamp)
        assert known is not None
        started = time.thread_time_ns()
        monitor.update(known, tracker.state)
        costs.append(time.thread_time_ns() - started)
        kinds.append(monitor.faults[0].kind)
    return _Run(kinds, costs)


def _first(kinds: list[FaultKind], rate: float, wanted: set[FaultKind]) -> float:
    """Return the time from the onset to the first report of one of the kinds [s], or infinity."""
    begin = round(_ONSET * rate)
    found = (place for place, kind in enumerate(kinds[begin:]) if kind in wanted)
    return next(found, math.inf) / rate


def _alarms(kinds: list[FaultKind]) -> int:
    """Return how often a report follows a time without one."""
    none = FaultKind.NONE
    return sum(a is none and b is not none for a, b in pairwise(kinds))


def _measure(design: Design, case: _Case, seeds: list[int], noise_duration: float) -> Any:
    rate = design.request.rate
    pure = case.expected is FaultKind.NONE
    duration = noise_duration if pure else 60.0
    runs = [_run(design, case, seed, duration) for seed in seeds]
    constant = case.scenario.mismatch != Mismatch()
    begin = 0 if pure else round((_ONSET + _SETTLED) * rate)
    end = round((_ONSET + _STUCK) * rate) if case.expected is FaultKind.STUCK else None
    counts = Counter(kind for run in runs for kind in run.kinds[begin:end])
    others = set(FaultKind) - {FaultKind.NONE}
    timed = not (pure or constant)
    noticed = [_first(run.kinds, rate, others) for run in runs] if timed else []
    named = [_first(run.kinds, rate, {case.expected}) for run in runs] if timed else []
    costs = np.concatenate([np.array(run.costs) for run in runs])
    # Before its onset there is no fault; a wrong arm is wrong from the start.
    quiet = None if pure else round(_ONSET * rate)
    hours = 0.0 if constant else sum(len(run.kinds[:quiet]) for run in runs) / rate / 3600.0
    return {
        "expected": case.expected.value,
        "share": {kind.value: counts[kind] / counts.total() for kind in FaultKind},
        "noticed": _median(noticed),
        "named": _median(named),
        "false_alarms": 0 if constant else sum(_alarms(run.kinds[:quiet]) for run in runs),
        "quiet_hours": hours,
        "cost_mean_us": float(costs.mean()) / 1e3,
    }


def _median(delays: list[float]) -> float | None:
    """Return the median, or None if too many delays are infinite for a finite median."""
    middle = sorted(delays)[len(delays) // 2] if delays else math.inf
    return middle if math.isfinite(middle) else None


def _seconds(delay: float | None) -> str:
    return f"{delay:8.2f}" if delay is not None else "       -"


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument(
        "--seeds", type=at_least(1, int), default=20, help="number of runs of each scenario"
    )
    made.add_argument("--first-seed", type=at_least(0, int), default=3000)
    made.add_argument("--noise-duration", type=at_least(1.0), default=180.0, metavar="S")
    made.add_argument("cases", nargs="*", metavar="CASE", help="default: all")
    options = made.parse_args()
    unknown = [name for name in options.cases if name not in _CASES]
    if unknown:
        made.error(f"no case {unknown[0]!r}; there is {', '.join(_CASES)}")
    design = design_of(options)
    seeds = list(range(options.first_seed, options.first_seed + options.seeds))
    lines = [
        f"share of the time each kind is reported [%], {options.seeds} seeds from "
        f"{options.first_seed}; medians of the time until anything, and the right kind, is "
        "reported [s]\n",
        f"{'case':16s}{'expected':13s}"
        + "".join(f"{kind.value:>12s}" for kind in FaultKind)
        + "  noticed   named  false alarms",
    ]
    results = {}
    for name in options.cases or _CASES:
        one = _measure(design, _CASES[name], seeds, options.noise_duration)
        results[name] = one
        shares = "".join(f"{100.0 * share:12.1f}" for share in one["share"].values())
        alarms = f"{one['false_alarms']} in {one['quiet_hours']:.2f} h"
        lines.append(
            f"{name:16s}{one['expected']:13s}{shares} {_seconds(one['noticed'])}"
            f"{_seconds(one['named'])}  {alarms}"
        )
    costs = [one["cost_mean_us"] for one in results.values()]
    lines.append(
        f"\nthe monitor takes {min(costs):.1f} to {max(costs):.1f} µs per sample, mean of each case"
    )
    show({"seeds": options.seeds, "cases": results}, "\n".join(lines), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
