# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Speed of `tsobs estimate` relative to real time, on a bag recorded at 200 Hz.

The bag has measurements and ground truth of a simulated arm; a new bag with both and the estimates
is written. A bag with a live observer's estimates has all topics in the same chunks, as the
recorder writes them, so the recorded messages must be picked out; otherwise chunks are copied
unchanged. The time is that of the work itself, from opening the bag to the last fsync of the new
one. Starting Python and loading the design take another half second, for a bag of any length.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import at_least, design_of, parser, show, timed, use_one_thread

from tsobs_ros.bag.estimate_topics import sides
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.design.record import Design
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.replay.estimate import Observer, run_observers
from tsobs_ros.replay.source import BagSource
from tsobs_ros.simulation.plant import Plant
from tsobs_ros.simulation.scenarios import SCENARIOS

_JOINT = "elastic_joint"
_START = 1_700_000_000_000_000_000
_LATENCY = 200_000
_TOPICS = "/joint_measurements", "/ground_truth/joint_states", "/ground_truth/disturbance"
_BLOCK = 20_000


def _record(path: Path, design: Design, seconds: float) -> None:
    """Write a bag of a simulated run as the recorder does, in blocks."""
    scenario = SCENARIOS["bias_step"]
    plant = Plant(scenario, [1])
    own, arm = JointStateEncoder([_JOINT]), JointStateEncoder(sides(_JOINT))
    left = round(seconds * scenario.rate) + 1
    with BagWriter(path) as writer:
        for topic in _TOPICS:
            writer.add_topic(topic, JOINT_STATE)
        while left:
            runs = plant.run(min(left, _BLOCK))
            left -= len(runs.times)
            truth = design.request.arm.to_physical(runs.states[0])
            stamps = (_START + np.round(runs.times * 1e9)).astype(np.int64)
            data = [
                own.encode_rows(stamps, runs.measurements[0], effort=runs.torques[0]),
                arm.encode_rows(stamps, truth[:, 0::2], truth[:, 1::2]),
                own.encode_rows(stamps, runs.disturbances[0]),
            ]
            logs = (stamps + _LATENCY).tolist()
            for *row, log in zip(*data, logs, strict=True):
                for topic, one in zip(_TOPICS, row, strict=True):
                    writer.write(topic, one.tobytes(), log, log)


def _estimate(bag: Path, design: Design, output: Path | None) -> None:
    source = BagSource(bag)
    observer = Observer("observer", ObserverSettings(), (design,))
    done = run_observers(source, [observer], output)[0].estimates
    assert done == source.count, f"{done} estimates of {source.count} samples"


def _record_again(bag: Path, new: Path) -> None:
    """Write a bag's messages as a recorder does, in order of time."""
    reader = BagReader(bag)
    with BagWriter(new) as writer:
        writer.add_topics(reader.topics.values())
        for one in reader.messages():
            writer.write(one.topic, one.data, one.log_time, one.publish_time)


def _measure(folder: Path, design: Design, seconds: float, repeats: int) -> dict[str, Any]:
    bag, live = folder / "bag", folder / "live"
    _record(bag, design, seconds)
    _estimate(bag, design, folder / "made")
    _record_again(folder / "made", live)
    times: dict[str, list[float]] = {"all": [], "read": [], "estimate": [], "with live": []}
    outputs = [folder / f"new_{repeat}" for repeat in range(2 * repeats)]
    for _ in range(repeats):
        times["all"].append(timed(lambda: _estimate(bag, design, outputs.pop())))
        times["read"].append(timed(lambda: BagSource(bag).observe([design.request])))
        times["estimate"].append(timed(lambda: _estimate(bag, design, None)))
        times["with live"].append(timed(lambda: _estimate(live, design, outputs.pop())))
    medians = {name: float(np.median(each)) for name, each in times.items()}
    samples = BagReader(bag).topics["/joint_measurements"].count
    parts = {
        "read and decode the measurements": medians["read"],
        "estimate and encode": medians["estimate"] - medians["read"],
        "copy the recorded topics and write": medians["all"] - medians["estimate"],
    }
    return {
        "seconds_of_bag": seconds,
        "samples": samples,
        "times_real_time": seconds / medians["all"],
        "times_real_time_with_recorded_estimates": seconds / medians["with live"],
        "us_per_sample": {name: 1e6 * each / samples for name, each in parts.items()},
    }


def _use(arguments: list[str]) -> dict[str, float]:
    """Return the time [s] and the largest memory [MB] of a command."""
    begun = time.monotonic()
    child = subprocess.Popen(
        [sys.executable, "-m", "tsobs_ros.cli.main", *arguments, "--json"],
        stdout=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(child.pid, 0)
    assert status == 0, arguments
    return {"seconds": time.monotonic() - begun, "megabytes": usage.ru_maxrss / 1000}


def _memory(folder: Path, design: Design, seconds: float) -> dict[str, dict[str, float]]:
    """Return the time and memory of each command that reads a bag and its estimates."""
    bag, live = str(folder / "bag"), str(folder / "live")
    # A first use takes memory for loading that later uses do not need; it should not count.
    first = folder / "first"
    _record(first, design, 10.0)
    _use(["estimate", str(first), "--output", str(folder / "of_first")])
    _use(["report", str(folder / "of_first"), "--output", str(folder / "report_of_first")])
    _record(Path(bag), design, seconds)
    commands = {
        "estimate": ["estimate", bag, "--output", live],
        "estimate again": ["estimate", live, "--output", str(folder / "again")],
        "compare": ["compare", live, "--method", "certified", "ekf"],
        "report": ["report", live, "--output", str(folder / "report")],
        "export": ["export", live, "--output", str(folder / "tables")],
        "bag info": ["bag", "info", live],
        "bag verify": ["bag", "verify", live],
    }
    return {name: _use(arguments) for name, arguments in commands.items()}


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--seconds", type=at_least(1.0), default=120.0, help="length of the bag")
    made.add_argument("--repeats", type=at_least(1, int), default=5)
    made.add_argument("--memory", action="store_true", help="measure the memory of all commands")
    options = made.parse_args()
    if options.memory:
        with tempfile.TemporaryDirectory() as folder:
            used = _memory(Path(folder), design_of(options), options.seconds)
        lines = [
            f"  {name:<16}{one['seconds']:8.0f} s{one['megabytes']:8.0f} MB"
            for name, one in used.items()
        ]
        text = "\n".join([f"{options.seconds:g} s at 200 Hz:", *lines])
        show({"seconds_of_bag": options.seconds, **used}, text, options.json)
        return
    with tempfile.TemporaryDirectory() as folder:
        design = design_of(options)
        results = _measure(Path(folder), design, options.seconds, options.repeats)
    parts = results["us_per_sample"]
    text = "\n".join(
        [
            f"tsobs estimate, {options.seconds:g} s at 200 Hz, median of {options.repeats}:",
            f"  {results['times_real_time']:.0f} × real time; "
            f"{results['times_real_time_with_recorded_estimates']:.0f} × where the bag has a live "
            "observer's estimates, which are reproduced",
            *(f"  {name:<36}{each:6.1f} µs per sample" for name, each in parts.items()),
            f"  {'together':<36}{sum(parts.values()):6.1f} µs per sample",
        ]
    )
    show(results, text, options.json)


if __name__ == "__main__":
    use_one_thread()
    main()
