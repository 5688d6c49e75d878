# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Punctuality of the observer at 1 kHz for a minute, and its latency at 500 Hz.

The sensor is a separate process, at the observer's rate, and another one takes everything that the
observer publishes. A tick is on time if it came within a period of its due time. The node leaves
out all others, so they are missing in the estimates' stamps. The lag is the time from an estimate's
stamp to its arrival at the listener, in the first and in the last fifth of the run.

The first two seconds of listening are left out, because discovery delays the observer once.

The latency is the node's own, from diagnostics, per second: from the middleware's received stamp of
a measurement to the moment when the first estimate that uses it has been sent on all topics. With
`publish_on: tick` it includes the wait for the tick, up to a period.
"""

import json
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

from common import at_least, claim_domain, design_of, parser, show
from node_processes import Process, design_for, executable, helper, joint_names

_WARM_UP = 10.0
_DISCOVERY = 2.0
"""The discovery of a new listener delays the observer's middleware once, by up to .3 s."""


def _run(rate: float, publish_on: str, seconds: float, options: Any) -> dict[str, Any]:
    """Return the data that the listener has taken."""
    domain = claim_domain()
    with tempfile.TemporaryDirectory() as name:
        folder, processes = Path(name), list[Process]()
        parameters = {
            "rate": rate,
            "joints": joint_names(1),
            "publish_on": publish_on,
            "design": str(design_for(design_of(options), rate, folder)),
        }
        try:
            processes.append(executable("observer", parameters, folder, domain))
            processes[0].wait_for("certificate holds")
            sensor = helper("sensor", folder, domain, rate, 1)
            processes.append(sensor)
            sensor.wait_for("started")
            time.sleep(_WARM_UP)
            listener = helper("listener", folder, domain)
            processes.append(listener)
            listener.wait_for("started")
            time.sleep(seconds)
            listener.stop()
            taken: dict[str, Any] = json.loads(listener.output.splitlines()[-1])
            return taken
        finally:
            for process in reversed(processes):
                process.stop()


def _percentile(values: list[float], fraction: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]


def _punctuality(estimates: list[list[int]], rate: float) -> dict[str, float]:
    """Return the share of ticks on time [%], and the lag [ms] at the beginning and at the end."""
    begin = estimates[0][0] + round(_DISCOVERY * 1e9)
    estimates = [each for each in estimates if each[0] >= begin]
    stamps = [stamp for stamp, _ in estimates]
    steps = [later - earlier for earlier, later in pairwise(stamps)]
    due = round((stamps[-1] - stamps[0]) * rate * 1e-9) + 1
    lags = [(came - stamp) * 1e-6 for stamp, came in estimates]
    fifth = len(lags) // 5
    return {
        "seconds": (stamps[-1] - stamps[0]) * 1e-9,
        "ticks_due": due,
        "on_time_percent": 100.0 * len(stamps) / due,
        "longest_gap_ms": max(steps) * 1e-6,
        "lag_p99_first_ms": _percentile(lags[:fifth], 0.99),
        "lag_p99_last_ms": _percentile(lags[-fifth:], 0.99),
    }


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--seconds", type=at_least(1.0), default=60.0, help="of the run at 1 kHz")
    made.add_argument(
        "--latency-seconds", type=at_least(1.0), default=20.0, help="of each run at 500 Hz"
    )
    options = made.parse_args()
    taken = _run(1000.0, "tick", options.seconds, options)
    punctuality = _punctuality(taken["estimates"], 1000.0)
    lines = [
        f"1 kHz for {punctuality['seconds']:.0f} s: {punctuality['on_time_percent']:.2f} % of "
        f"{punctuality['ticks_due']} ticks on time, "
        f"longest gap {punctuality['longest_gap_ms']:.1f} ms",
        f"  lag p99 {punctuality['lag_p99_first_ms']:.2f} ms in the first fifth, "
        f"{punctuality['lag_p99_last_ms']:.2f} ms in the last",
        "latency at 500 Hz, medians over seconds [ms]:",
    ]
    latencies: dict[str, dict[str, list[float]]] = {}
    for publish_on in ("tick", "measurement"):
        timing = _run(500.0, publish_on, options.latency_seconds, options)["timing"]
        found = {
            name: [float(each[f"{name} [ms]"]) for each in timing if f"{name} [ms]" in each]
            for name in ("latency p50", "latency p99", "tick time p50", "tick time p99")
        }
        latencies[publish_on] = found
        shown = ", ".join(f"{name} {median(values):.2f}" for name, values in found.items())
        lines.append(f"  publish_on {publish_on:12s} {shown}")
    results = {"punctuality": punctuality, "latency_ms": latencies}
    show(results, "\n".join(lines), options.json)


if __name__ == "__main__":
    main()
