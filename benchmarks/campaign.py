# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a campaign: draw, simulate, observe and score, by part and on all cores.

The observer is that of the node. The parts are CPU times on one thread; for comparison, there is
the time that NumPy's generators take for the random numbers alone, as a measure of the machine. The
whole is `tsobs campaign` as a separate process, on one thread and on all cores: elapsed time from
its start to the tables, the same for a campaign of one run, and its largest memory.
"""

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from common import at_least, parser, show, use_one_thread

from tsobs_ros.campaign.batches import observe, recorded
from tsobs_ros.campaign.definition import Campaign, load_campaign
from tsobs_ros.campaign.drawing import draw_group
from tsobs_ros.campaign.folder import PART
from tsobs_ros.report.metrics import measure
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.plant import Plant

_RUNS = 10_000
_TURNS = 45
_MEMORY = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0)
sys.exit(code)
"""


def _parts(campaign: Campaign) -> dict[str, float]:
    """Return the median CPU time of each part [ns per sample]."""
    design = campaign.design
    generator, normal = np.random.Generator(np.random.Philox(0)), np.empty(12 * 256)
    times: dict[str, list[float]] = {}
    repeats = campaign.entries.repeats
    for turn in range(_TURNS):
        marks = [time.thread_time_ns()]
        group = draw_group(campaign, turn * repeats, (turn + 1) * repeats)
        marks.append(time.thread_time_ns())
        scenario = group[0].scenario
        runs = Plant(scenario, [one.seed for one in group]).run(scenario.sample_count)
        marks.append(time.thread_time_ns())
        observed = observe(design, runs, campaign.settings, campaign.estimator)
        marks.append(time.thread_time_ns())
        for run in range(repeats):
            measure(recorded(runs, run, observed.of(run)))
        marks.append(time.thread_time_ns())
        samples = repeats * scenario.sample_count
        for _ in range(samples // 256):
            generator.standard_normal(out=normal)
        marks.append(time.thread_time_ns())
        names = ("draw", "simulate", "observe", "score", "random numbers alone")
        for name, spent in zip(names, np.diff(marks).tolist(), strict=True):
            times.setdefault(name, []).append(spent / samples)
    # The first turn also loads code and data that the others find loaded.
    return {name: float(np.median(each[1:])) for name, each in times.items()}


def _whole(file: Path, runs: int, threads: int) -> tuple[float, float]:
    """Return the elapsed time [s] and the largest memory [MiB] of a campaign."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tsobs_ros.cli.main", "campaign", str(file)]
        command += ["--runs", str(runs), "--workers", str(threads), "--output", f"{folder}/runs"]
        started = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", _MEMORY, *command], check=True, capture_output=True, text=True
        )
        return time.perf_counter() - started, float(done.stdout)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, design=False)
    made.add_argument("--runs", type=at_least(PART, int), default=10 * PART)
    made.add_argument("--campaign", type=Path, default=config_path("campaign.yaml"))
    options = made.parse_args()
    campaign = load_campaign(options.campaign)
    parts = _parts(campaign)
    wholes = []
    for threads in sorted({1, os.cpu_count() or 1}):
        first, _ = _whole(options.campaign, 1, threads)
        elapsed, memory = _whole(options.campaign, options.runs, threads)
        wholes.append(
            {
                "threads": threads,
                "elapsed_s": elapsed,
                "of_one_run_s": first,
                "scaled_s": first + (elapsed - first) * _RUNS / options.runs,
                "peak_memory_mib": memory,
            }
        )
    duration = campaign.entries.duration
    lines = [
        f"{options.runs} runs of {duration:g} s\n",
        *(f"{name:24s}{spent:8.0f} ns per sample" for name, spent in parts.items()),
        *(
            f"{one['threads']:g} threads: {one['elapsed_s']:.1f} s, of one run "
            f"{one['of_one_run_s']:.1f} s; {_RUNS} runs would take {one['scaled_s']:.0f} s; "
            f"peak memory {one['peak_memory_mib']:.0f} MiB"
            for one in wholes
        ),
    ]
    everything: dict[str, Any] = {
        "runs": options.runs,
        "duration_s": duration,
        "parts_ns": parts,
        "campaigns": wholes,
    }
    show(everything, "\n".join(lines), options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
