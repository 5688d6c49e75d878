# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Memory, CPU and tick time of the observer over ten minutes at 1 kHz, one sample in fifty bad.

The observer and the sensor are processes; the numbers come from /proc and from the observer's own
diagnostics. The script writes soak.csv and soak.png, and reports whether anything grows.
"""

import csv
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from common import at_least, claim_domain, design_of, join_ros, parser, show
from node_processes import Process, design_for, executable, hear

_JOINT = "elastic_joint"
_SETTLING = 0.2
"""Share of the run after which memory is expected to stay: caches and queues are full by then."""

_LARGEST_SLOPE, _LARGEST_GROWTH = 100.0, 512.0
"""Growth of memory [KiB/min] and [KiB]; a growth below either one counts as chance."""

_LARGEST_DRIFT = 1.25
"""Largest ratio of the tick time at the end to that at the beginning that counts as chance."""

_COLUMNS = (
    "time [s]",
    "rss [KiB]",
    "cpu [%]",
    "tick time p50 [ms]",
    "tick time p99 [ms]",
    "missed ticks",
    "received",
    "used",
    "rejected",
)


class _Monitor:
    """Reads the observer's diagnostics, and receives everything else that it publishes."""

    def __init__(self, domain: int) -> None:
        from diagnostic_msgs.msg import DiagnosticArray

        # The measuring process must discover the others on this host, and no other host.
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self._rclpy = join_ros(domain)
        self._node = self._rclpy.create_node("soak")
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 10)
        self.values: dict[str, str] = {}
        self._heard = hear(self._node)

    def spin(self, seconds: float) -> None:
        """Listen for a while."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            self._rclpy.spin_once(self._node, timeout_sec=min(left, 0.5))
            for subscription in self._heard.values():
                subscription.drain()

    def close(self) -> None:
        """End listening."""
        self._node.destroy_node()
        self._rclpy.shutdown()

    def _keep(self, message: Any) -> None:
        for status in message.status:
            if status.name.startswith("observer: "):
                self.values |= {item.key: item.value for item in status.values}


def _rows(
    observer: Process, monitor: _Monitor, seconds: float, every: float
) -> Iterator[list[float]]:
    """Return a row of `_COLUMNS` every few seconds."""
    begin = time.monotonic()
    used, since = observer.cpu_seconds(), begin
    while since - begin < seconds:
        monitor.spin(every)
        now, cpu = time.monotonic(), observer.cpu_seconds()
        said = monitor.values
        rejected = sum(int(n) for key, n in said.items() if key.startswith("rejected: "))
        yield [
            now - begin,
            observer.resident_kib(),
            100.0 * (cpu - used) / (now - since),
            *(float(said[name]) for name in _COLUMNS[3:8]),
            rejected,
        ]
        used, since = cpu, now


def _verdict(rows: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Return the trends of memory and tick time, and whether they count as none."""
    import numpy as np

    table = np.array(rows)
    settled = table[int(_SETTLING * len(table)) :]
    columns = dict(zip(_COLUMNS, settled.T, strict=True))
    slope = float(np.polyfit(columns["time [s]"] / 60.0, columns["rss [KiB]"], 1)[0])
    growth = float(settled[-1, 1] - settled[0, 1])
    quarter = max(1, len(settled) // 4)
    ticks = columns["tick time p50 [ms]"]
    drift = float(np.median(ticks[-quarter:]) / np.median(ticks[:quarter]))
    return {
        "seconds": float(table[-1, 0]),
        "received": int(table[-1, 6]),
        "rejected": int(table[-1, 8]),
        "balanced": bool((table[:, 6] == table[:, 7] + table[:, 8]).all()),
        "rss_kib": float(table[-1, 1]),
        "rss_slope_kib_per_min": slope,
        "rss_growth_kib": growth,
        "cpu_percent": float(np.median(settled[:, 2])),
        "tick_p50_ms": float(np.median(ticks)),
        "tick_p99_ms": float(np.median(settled[:, 4])),
        "tick_drift": drift,
        "missed_ticks": int(table[-1, 5] - table[0, 5]),
        "holds": (slope <= _LARGEST_SLOPE or growth <= _LARGEST_GROWTH) and drift <= _LARGEST_DRIFT,
    }


def _draw(rows: Sequence[Sequence[float]], path: Path) -> None:
    """Draw the curves."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    table = dict(zip(_COLUMNS, zip(*rows, strict=True), strict=True))
    figure, axes = plt.subplots(4, 1, sharex=True, figsize=(8, 9), layout="constrained")
    curves = [
        ["rss [KiB]"],
        ["cpu [%]"],
        ["tick time p50 [ms]", "tick time p99 [ms]"],
        ["missed ticks", "rejected"],
    ]
    for axis, names in zip(axes, curves, strict=True):
        for name in names:
            axis.plot(table["time [s]"], table[name], label=name)
        axis.legend(loc="upper left")
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("time [s]")
    figure.savefig(path, dpi=120)


def _sensor(rate: float, share: float) -> None:
    """Publish measurements of a simulated arm with bad input among them, without end."""
    from dataclasses import replace

    import numpy as np
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import JointState

    from tsobs_ros.bag.joint_states import JointStateEncoder
    from tsobs_ros.simulation.plant import Plant
    from tsobs_ros.simulation.scenarios import SCENARIOS

    node = join_ros().create_node("sensor")
    publisher = node.create_publisher(JointState, "joint_measurements", qos_profile_sensor_data)
    while publisher.get_subscription_count() < 1:
        time.sleep(0.05)
    print("started")
    plant = Plant(replace(SCENARIOS["noise"], rate=rate), 1)
    rng, good, foreign = (
        np.random.default_rng(1),
        JointStateEncoder([_JOINT]),
        JointStateEncoder(["x"]),
    )
    spoilt: list[Callable[[int, list[float], list[float]], bytes]] = [
        lambda stamp, y, u: good(stamp, [float("nan")], (), u),
        lambda stamp, y, u: good(stamp, y, (), [float("inf")]),
        lambda stamp, y, u: good(stamp, [y[0] + 3.0], (), u),
        lambda stamp, y, u: good(stamp, y),
        lambda stamp, y, u: foreign(stamp, y, (), u),
        lambda stamp, y, u: good(0, y, (), u),
        lambda stamp, y, u: good(stamp + 3600 * 10**9, y, (), u),
        lambda stamp, y, u: good(stamp - 2 * 10**9, y, (), u),
        lambda stamp, y, u: good(stamp - 20_000_001, y, (), u),
        lambda stamp, y, u: good(stamp, y, (), u)[:40],
    ]
    period, stamp = round(1e9 / rate), time.time_ns()
    while True:
        sample = plant.step()
        y, u = sample.measurements.tolist(), sample.torques.tolist()
        publisher.publish(good(stamp, y, (), u))
        if rng.random() < share:
            publisher.publish(spoilt[rng.integers(len(spoilt))](stamp, y, u))
        stamp += period
        time.sleep(max(0, stamp - time.time_ns()) * 1e-9)


def _soak(options: Any, folder: Path) -> list[list[float]]:
    """Run everything, and return the table."""
    processes, rows, domain = list[Process](), list[list[float]](), claim_domain()
    try:
        design = str(design_for(design_of(options), options.rate, folder))
        parameters = {"rate": options.rate, "design": design}
        observer = executable("observer", parameters, folder, domain)
        processes.append(observer)
        observer.wait_for("certificate holds")
        command = [__file__, "--sensor", "--rate", str(options.rate), "--share", str(options.share)]
        sensor = Process("sensor", command, folder, domain)
        processes.append(sensor)
        sensor.wait_for("started")
        monitor = _Monitor(domain)
        monitor.spin(5.0)
        with (options.output / "soak.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(_COLUMNS)
            for row in _rows(observer, monitor, options.seconds, options.every):
                rows.append(row)
                writer.writerow([f"{value:g}" for value in row])
                file.flush()
        monitor.close()
    finally:
        codes = {process.name: process.stop() for process in reversed(processes)}
    if codes["observer"] != 0:
        sys.exit(f"the observer ended with {codes['observer']}:\n{processes[0].output}")
    return rows


def main() -> int:
    """Soak, draw and judge; return 1 if anything grows."""
    made = parser(__doc__)
    made.add_argument("--seconds", type=at_least(1.0), default=600.0)
    made.add_argument("--every", type=at_least(0.1), default=2.0, help="time between rows [s]")
    made.add_argument(
        "--rate", type=at_least(1.0), default=1000.0, help="of sensor and observer [Hz]"
    )
    made.add_argument("--share", type=at_least(0.0), default=0.02, help="of bad input")
    made.add_argument("--output", type=Path, default=Path("soak"), help="folder to write to")
    made.add_argument("--sensor", action="store_true", help="be the sensor; for the script itself")
    options = made.parse_args()
    if options.sensor:
        try:
            _sensor(options.rate, options.share)
        except KeyboardInterrupt:
            return 0
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        rows = _soak(options, Path(name))
    _draw(rows, options.output / "soak.png")
    verdict = _verdict(rows)
    lines = [
        f"{verdict['seconds']:.0f} s at {options.rate:g} Hz: {verdict['received']} received, "
        f"{verdict['rejected']} rejected, {verdict['missed_ticks']} ticks missed",
        f"  memory {verdict['rss_kib'] / 1024:.1f} MiB, {verdict['rss_slope_kib_per_min']:+.1f} "
        f"KiB/min (at most {_LARGEST_SLOPE:g}) or {verdict['rss_growth_kib']:+.0f} KiB in all "
        f"(at most {_LARGEST_GROWTH:g}), once settled",
        f"  tick p50 {verdict['tick_p50_ms']:.3f} ms, p99 {verdict['tick_p99_ms']:.3f} ms, drift "
        f"x{verdict['tick_drift']:.2f} (at most {_LARGEST_DRIFT:g}), "
        f"CPU {verdict['cpu_percent']:.0f} %",
        f"  {'nothing grows' if verdict['holds'] else 'IT GROWS'}; curves in {options.output}",
    ]
    show(verdict, "\n".join(lines), options.json)
    return 0 if verdict["holds"] else 1


if __name__ == "__main__":
    sys.exit(main())
