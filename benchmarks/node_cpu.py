# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Share of one core that the observer and the plant simulator take as processes over DDS.

Both run as they are installed, the sensor's rate and the observer's being 200 Hz. Beside them runs
the reference: a node that does nothing but have an empty timer of that rate spun by rclpy. Their
user and system time come from /proc/<pid>/stat, so all threads of the middleware are in.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from common import parser, show

_START_TIMEOUT = 30.0
_STOP_TIMEOUT = 15.0
_WARM_UP = 10.0


_REFERENCE = "bare timer"
_BARE_TIMER = """
import sys, rclpy
rclpy.init()
node = rclpy.create_node("bare_timer")
node.create_timer(1.0 / float(sys.argv[1]), lambda: None)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
"""


class _Node:
    """One process with its output in a file."""

    def __init__(self, name: str, parameters: dict[str, Any], folder: Path, domain: int) -> None:
        self.name, self.log = name, folder / f"{name}.log"
        arguments = [sys.executable, "-m", "tsobs_ros.executables", name, "--ros-args"]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={value}"]
        if name == _REFERENCE:
            arguments = [sys.executable, "-c", _BARE_TIMER, str(parameters["rate"])]
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder),
            "PYTHONUNBUFFERED": "1",
        }
        with self.log.open("wb") as output:
            self._process = subprocess.Popen(
                arguments, env=environment, stdout=output, stderr=subprocess.STDOUT
            )

    def wait_for(self, pattern: str) -> None:
        """Wait until the node has printed something."""
        deadline = time.monotonic() + _START_TIMEOUT
        while not re.search(pattern, self.log.read_text(encoding="utf-8", errors="replace")):
            if self._process.poll() is not None or time.monotonic() > deadline:
                sys.exit(f"{self.name} did not start:\n{self.log.read_text(encoding='utf-8')}")
            time.sleep(0.05)

    def cpu_seconds(self) -> float:
        """Return the user and system time it has used [s]."""
        text = Path(f"/proc/{self._process.pid}/stat").read_text(encoding="ascii")
        # The name in brackets may hold anything, so fields count from the last bracket.
        fields = text.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def stop(self) -> int:
        """End it as Ctrl-C does and return its exit code."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                self._process.kill()
        return self._process.wait()


def _shares(nodes: list[_Node], seconds: float, turns: int) -> dict[str, list[float]]:
    """Return the shares of one core [%] in each of some turns."""
    shares: dict[str, list[float]] = {node.name: [] for node in nodes}
    for _ in range(turns):
        before, began = [node.cpu_seconds() for node in nodes], time.monotonic()
        time.sleep(seconds)
        elapsed = time.monotonic() - began
        for node, used in zip(nodes, before, strict=True):
            shares[node.name].append(100.0 * (node.cpu_seconds() - used) / elapsed)
    return shares


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--rate", type=float, default=200.0, help="of sensor and observer [Hz]")
    made.add_argument("--seconds", type=float, default=10.0, help="length of a turn")
    made.add_argument("--turns", type=int, default=5)
    made.add_argument("--domain-id", type=int, default=1 + os.getpid() % 101)
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        design = {"design": options.design.resolve()} if options.design else {}
        nodes = [_Node("observer", {"rate": options.rate, **design}, folder, options.domain_id)]
        try:
            nodes[0].wait_for("certificate holds")
            plant = {"rate": options.rate, "wait_for_subscribers": 1}
            nodes.append(_Node("plant_simulator", plant, folder, options.domain_id))
            nodes[1].wait_for("started")
            reference = {"rate": options.rate}
            nodes.append(_Node(_REFERENCE, reference, folder, options.domain_id))
            time.sleep(_WARM_UP)
            shares = _shares(nodes, options.seconds, options.turns)
        finally:
            codes = {node.name: node.stop() for node in nodes}
    medians = {name: sorted(each)[len(each) // 2] for name, each in shares.items()}
    lines = [
        f"{options.turns} turns of {options.seconds:g} s at {options.rate:g} Hz, one core = 100 %"
    ]
    ratio = medians["observer"] / medians[_REFERENCE]
    for name, each in shares.items():
        lines.append(
            f"  {name:16s} {medians[name]:5.1f} %  ({min(each):.1f}-{max(each):.1f} %), "
            f"exit code {codes[name]}"
        )
    lines.append(f"  observer / {_REFERENCE}: {ratio:.2f}")
    results = {"rate_hz": options.rate, "percent": shares, "median_percent": medians}
    show(results, "\n".join(lines), options.json)


if __name__ == "__main__":
    main()
