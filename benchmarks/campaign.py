# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a Monte Carlo campaign: simulate, observe and score, by part and on all cores.

The observer is the one the node runs. The parts are CPU time on one thread; next to them stands
what NumPy's generators take for the random numbers alone, as a measure of the machine. The whole
is elapsed time, on one thread and on all cores, also scaled to ten thousand runs of 30 s.
"""

import os
import resource
import time
from dataclasses import replace
from typing import Any

import numpy as np
from common import at_least, parser, show, use_one_thread

from tsobs_ros.campaign import observe, run_all, score
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.simulation.plant import Scenario
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

_RUNS, _DURATION = 10_000, 30.0
_BLOCK = 8
_TURNS = 5


def _parts(design: Design, scenario: Scenario) -> dict[str, float]:
    """Return the median CPU time of each part [ns a sample]."""
    estimator = make_estimator(design, ObserverSettings())
    generator, normal = np.random.Generator(np.random.Philox(0)), np.empty(12 * 256)
    samples = _BLOCK * scenario.sample_count
    times: dict[str, list[int]] = {}
    for _ in range(_TURNS + 1):
        marks = [time.thread_time_ns()]
        runs = simulate(scenario, range(_BLOCK))
        marks.append(time.thread_time_ns())
        observed = observe(design, runs, estimator=estimator)
        marks.append(time.thread_time_ns())
        score(runs, observed)
        marks.append(time.thread_time_ns())
        for _ in range(samples // 256):
            generator.standard_normal(out=normal)
        marks.append(time.thread_time_ns())
        names = ("simulate", "observe", "score", "random numbers alone")
        for name, spent in zip(names, np.diff(marks).tolist(), strict=True):
            times.setdefault(name, []).append(spent)
    # The first turn compiles.
    return {name: float(np.median(each[1:])) / samples for name, each in times.items()}


def _whole(design: Design, scenario: Scenario, runs: int, threads: int) -> dict[str, float]:
    cases = [
        (scenario, range(begin, min(begin + _BLOCK, runs))) for begin in range(0, runs, _BLOCK)
    ]
    started = time.perf_counter()
    scores = list(run_all(design, cases, threads=threads))
    elapsed = time.perf_counter() - started
    simulated = runs * scenario.duration
    return {
        "threads": threads,
        "elapsed_s": elapsed,
        "scaled_s": elapsed * _RUNS * _DURATION / simulated,
        "times_real_time": simulated / elapsed,
        "normalised_rmse": float(np.mean(np.concatenate([s.normalised_rmse for s in scores]))),
    }


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--runs", type=at_least(1, int), default=400)
    made.add_argument("--scenario", choices=list(SCENARIOS), default="stiff_bias_step")
    options = made.parse_args()
    design = load_design(options.design or config_path(SHIPPED_DESIGN))
    scenario = replace(SCENARIOS[options.scenario], duration=_DURATION, rate=design.request.rate)
    parts = _parts(design, scenario)
    cores = os.cpu_count() or 1
    wholes = [_whole(design, scenario, options.runs, n) for n in sorted({1, cores})]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    lines = [
        f"{options.scenario}, {options.runs} runs of {_DURATION:g} s at {scenario.rate:g} Hz\n",
        *(f"{name:24s}{spent:8.0f} ns a sample" for name, spent in parts.items()),
        *(
            f"{one['threads']:g} threads: {one['elapsed_s']:.2f} s, {one['times_real_time']:.0f} "
            f"times real time; {_RUNS} runs would take {one['scaled_s']:.0f} s"
            for one in wholes
        ),
        f"peak memory {memory:.0f} MiB, mean normalised RMSE {wholes[0]['normalised_rmse']:.4f}",
    ]
    everything: dict[str, Any] = {
        "scenario": options.scenario,
        "runs": options.runs,
        "parts_ns": parts,
        "campaigns": wholes,
        "peak_memory_mib": memory,
    }
    show(everything, "\n".join(lines), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
