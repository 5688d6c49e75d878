# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Share of one core that the observer takes as a process over DDS, next to a bare rclpy timer.

Each case has a sensor in a separate process, at the observer's rate; with a listener, another
process takes everything that the observer publishes. The reference, in the same run, is a node with
only an empty timer of that rate, spun by rclpy. User and system time come from /proc/<pid>/stat, so
all threads of the middleware are included. The design is made for the rate, and the certified gain
is in use before the first turn.
"""

import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from common import at_least, claim_domain, design_of, parser, show
from node_processes import Process, design_for, executable, helper, joint_names

_WARM_UP = 12.0


class _Case(NamedTuple):
    """The settings of one measurement."""

    rate: float
    joints: int
    publish_on: str
    listener: bool

    @property
    def label(self) -> str:
        joints = f"{self.joints} joint{'s' * (self.joints > 1)}"
        heard = "all topics heard" if self.listener else "nobody listens"
        return f"{self.rate:g} Hz, {joints}, on {self.publish_on}, {heard}"


CASES = (
    _Case(200.0, 1, "tick", False),
    _Case(200.0, 1, "tick", True),
    _Case(200.0, 1, "measurement", True),
    _Case(500.0, 7, "tick", False),
    _Case(500.0, 7, "tick", True),
    _Case(1000.0, 1, "tick", False),
    _Case(1000.0, 1, "tick", True),
)


def _measure(case: _Case, options: Any) -> dict[str, list[float]]:
    """Return the shares of one core [%] of each process in each turn."""
    domain = claim_domain()
    with tempfile.TemporaryDirectory() as name:
        folder, processes = Path(name), list[Process]()
        parameters: dict[str, Any] = {
            "rate": case.rate,
            "joints": joint_names(case.joints),
            "publish_on": case.publish_on,
            "design": str(design_for(design_of(options), case.rate, folder)),
        }
        try:
            processes.append(executable("observer", parameters, folder, domain))
            processes[0].wait_for("certificate holds")
            if case.listener:
                processes.append(helper("listener", folder, domain))
            processes.append(helper("sensor", folder, domain, case.rate, case.joints))
            processes.append(helper("bare-timer", folder, domain, case.rate))
            for process in processes[1:]:
                process.wait_for("started")
            time.sleep(_WARM_UP)
            return _shares(processes, options.seconds, options.turns)
        finally:
            for process in reversed(processes):
                process.stop()


def _shares(processes: list[Process], seconds: float, turns: int) -> dict[str, list[float]]:
    shares: dict[str, list[float]] = {process.name: [] for process in processes}
    for _ in range(turns):
        before, began = [process.cpu_seconds() for process in processes], time.monotonic()
        time.sleep(seconds)
        elapsed = time.monotonic() - began
        for process, used in zip(processes, before, strict=True):
            shares[process.name].append(100.0 * (process.cpu_seconds() - used) / elapsed)
    return shares


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--seconds", type=at_least(1.0), default=6.0, help="length of a turn")
    made.add_argument("--turns", type=at_least(1, int), default=5)
    made.add_argument("--only", type=float, metavar="RATE", help="only cases of this rate [Hz]")
    options = made.parse_args()
    lines = [
        f"share of one core [%]: median (range) of {options.turns} turns of {options.seconds:g} s",
        f"{'':52s} {'observer':>20s} {'bare timer':>11s} {'ratio':>6s}",
    ]
    results = []
    for case in CASES:
        if options.only not in (None, case.rate):
            continue
        shares = _measure(case, options)
        own, bare = shares["observer"], median(shares["bare-timer"])
        spread = f"{median(own):.1f} ({min(own):.1f}-{max(own):.1f})"
        lines.append(f"{case.label:52s} {spread:>20s} {bare:11.1f} {median(own) / bare:6.2f}")
        results.append({**case._asdict(), "percent": shares})
    show({"cases": results}, "\n".join(lines), options.json)


if __name__ == "__main__":
    main()
