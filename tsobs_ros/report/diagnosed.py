# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Faults, rejected measurements and timing, as the observer's recorded diagnostics have them."""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from tsobs_ros.bag.diagnostics import RecordedStatus
from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.series import NANOSECONDS

_FAULT = "sensor fault"
_REJECTED = "rejected: "
_TIMING = (
    "latency p50 [ms]",
    "latency p99 [ms]",
    "tick time p50 [ms]",
    "tick time p99 [ms]",
    "achieved rate [Hz]",
)
# A fault that the next status does not repeat has ended by then; they are a second apart.
_APART = 2.5
_REASONS = {reason.value for reason in RejectReason}
_MAX_KIND = 40


@dataclass
class FaultSpan:
    """A reported fault of an output.

    Attributes:
        output: Name of the output, empty if there is one only.
        kind: What it looks like.
        level: The worst level.
        begin: Seconds since the run's origin.
        end: The same of its last report.
        magnitude: The largest one.
        unit: Its unit, empty if it is not known.
    """

    output: str
    kind: str
    level: Level
    begin: float
    end: float
    magnitude: float
    unit: str = ""

    def as_mapping(self) -> dict[str, str | float]:
        """Return it as plain data."""
        return {
            "output": self.output,
            "kind": self.kind,
            "level": self.level.name,
            "begin": self.begin,
            "end": self.end,
            "magnitude": self.magnitude,
            "unit": self.unit,
        }


@dataclass
class Diagnosed:
    """What the diagnostics of an observer have of a joint.

    Attributes:
        count: Number of arrays.
        faults: In order.
        rejected: Number of rejected measurements by reason, without those that are zero.
        reject_rates: Times [s] and rejects a second of the same reasons.
        missed: Number of missed ticks.
        timing: Times [s] and values of the node's timing, by name with the unit.
    """

    count: int = 0
    faults: list[FaultSpan] = field(default_factory=list)
    rejected: dict[str, int] = field(default_factory=dict)
    reject_rates: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    missed: int = 0
    timing: dict[str, tuple[Array, Array]] = field(default_factory=dict)

    def as_mapping(self) -> dict[str, object]:
        """Return it as plain data, without the curves."""
        return {
            "faults": [one.as_mapping() for one in self.faults],
            "rejected": self.rejected,
            "missed_ticks": self.missed,
        }


def diagnose(statuses: Iterable[RecordedStatus], origin: int, until: float) -> Diagnosed:
    """Gather what the statuses of an observer's joint have.

    Args:
        statuses: Those of the observer, in order.
        origin: Stamp that times count from [ns].
        until: End of the run [s]; what is later is left out.
    """
    found = Diagnosed()
    open_faults: dict[str, FaultSpan] = {}
    counts: dict[str, list[tuple[float, float]]] = {}
    timing: dict[str, list[tuple[float, float]]] = {name: [] for name in _TIMING}
    last = -math.inf
    for status in statuses:
        time = (status.stamp - origin) / NANOSECONDS
        if not 0.0 <= time <= until + 1.0:
            continue
        found.count += time != last
        last = time
        concern = status.name[-1]
        if concern.startswith(_FAULT):
            output = concern.removeprefix(_FAULT).removeprefix(" of ")
            _note_fault(found.faults, open_faults, output, time, status)
        elif concern == "measurements":
            for key, value in status.values.items():
                if (reason := key.removeprefix(_REJECTED)) in _REASONS:
                    counts.setdefault(reason, []).append((time, _number(value)))
        elif concern == "timing":
            found.missed = max(
                found.missed, int(max(0.0, _number(status.values.get("missed ticks"))))
            )
            for name in _TIMING:
                if name in status.values:
                    timing[name].append((time, _number(status.values[name])))
    for reason, pairs in counts.items():
        times, totals = np.array(pairs).T
        grown = np.maximum(np.diff(totals, prepend=0.0), 0.0)
        if total := int(grown.sum()):
            found.rejected[reason] = total
            lengths = np.maximum(np.diff(times, prepend=times[0] - 1.0), 0.1)
            found.reject_rates[reason] = (times, grown / lengths)
    for name, pairs in timing.items():
        if pairs:
            times, values = np.array(pairs).T
            found.timing[name] = (times, values)
    return found


def _note_fault(
    faults: list[FaultSpan],
    open_faults: dict[str, FaultSpan],
    output: str,
    time: float,
    status: RecordedStatus,
) -> None:
    kind = status.values.get("kind", "")[:_MAX_KIND]
    known = open_faults.get(output)
    if kind in ("", "none"):
        if known is not None and time - known.end < _APART:
            known.end = time
        open_faults.pop(output, None)
        return
    level = Level(min(status.level, Level.STALE))
    size, unit = _size(status.values)
    if known is not None and known.kind == kind and time - known.end < _APART:
        known.end, known.level = time, max(known.level, level)
        known.magnitude = max(known.magnitude, size)
        return
    if known is not None and time - known.end < _APART:
        known.end = time
    lasted = re.search(r"[\d.]+", status.values.get("since", ""))
    begin = time - (_number(lasted.group()) if lasted else 0.0)
    begin = min(time, max(0.0, begin if math.isfinite(begin) else time))
    open_faults[output] = FaultSpan(output, kind, level, begin, time, size, unit)
    faults.append(open_faults[output])


def _size(values: Mapping[str, str]) -> tuple[float, str]:
    """Return the magnitude of a fault and its unit."""
    for key, text in values.items():
        if key.startswith("magnitude"):
            return _number(text), key.partition("[")[2].rstrip("]")[:_MAX_KIND]
    return 0.0, ""


def _number(text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0
