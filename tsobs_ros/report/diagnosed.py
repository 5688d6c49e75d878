# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Faults and rejected measurements from the observer's recorded diagnostics."""

import math
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from tsobs_ros.estimation.health import Level
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.series import NANOSECONDS

_FAULT, _REASONS = "sensor fault", tuple(reason.text for reason in RejectReason)
# A fault that no status repeats within this time has ended [s]; statuses are a second apart.
_APART = 2.5
_MAX_KIND = 40


class RecordedStatus(NamedTuple):
    """A status from a recorded DiagnosticArray.

    Attributes:
        stamp: Stamp of the array's header, ns since the epoch.
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        name: Parts of its name, such as the node, a joint and the concern.
        values: The values by key.
    """

    stamp: int
    level: int
    name: tuple[str, ...]
    values: dict[str, str]


@dataclass
class FaultSpan:
    """A reported fault of an output, whose name is empty if there is only one.

    Level and magnitude are the largest reported ones. Begin and end are in seconds since the run's
    origin; a fault ends with the first report without it.
    """

    output: str
    kind: str
    level: Level
    begin: float
    end: float
    magnitude: float
    unit: str = ""


@dataclass
class Diagnosed:
    """A summary of an observer's diagnostics for a joint.

    Attributes:
        count: Number of statuses.
        rejected: Number of rejected measurements by reason, without zeros.
    """

    count: int = 0
    faults: list[FaultSpan] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)

    def as_mapping(self) -> dict[str, Any]:
        """Return the summary as plain data."""
        return {
            "faults": [{**asdict(one), "level": one.level.name} for one in self.faults],
            "rejected": self.rejected,
        }


def diagnose(statuses: Iterable[RecordedStatus], origin: int, until: float) -> Diagnosed:
    """Gather the statuses of a run that ends at `until` [s]; times count from `origin` [ns]."""
    found, running, counted = Diagnosed(), dict[str, FaultSpan](), Counter[str]()
    for status in statuses:
        time = (status.stamp - origin) / NANOSECONDS
        if not 0.0 <= time <= until + 1.0:
            continue
        found.count += 1
        if status.name[-1].startswith(_FAULT):
            fault, output = _fault(status, time), status.name[-1].removeprefix(_FAULT)
            known = running.pop(output, None)
            if known is not None and time - known.end < _APART:
                known.end = time
                if known.kind == fault.kind:
                    known.level = max(known.level, fault.level)
                    known.magnitude, fault = max(known.magnitude, fault.magnitude), known
            if fault.kind not in ("", "none"):
                running[output] = fault
                found.faults += [fault] if fault is not known else []
            continue
        latest = Counter(
            {
                reason: int(_number(status.values[key]))
                for reason in _REASONS
                if (key := f"rejected: {reason}") in status.values
            }
        )
        if latest:
            if any(latest[reason] < count for reason, count in counted.items()):
                counted.clear()  # the observer was restarted
            found.rejected += latest - counted
            counted = latest
    return found


def _fault(status: RecordedStatus, time: float) -> FaultSpan:
    """Return the fault in a status at a time [s]; the next status ends it."""
    lasted = re.search(r"[\d.]+", status.values.get("since", ""))
    sizes = ((key, text) for key, text in status.values.items() if key.startswith("magnitude"))
    name, size = next(sizes, ("", ""))
    return FaultSpan(
        status.name[-1].removeprefix(_FAULT).removeprefix(" of "),
        status.values.get("kind", "")[:_MAX_KIND],
        Level(min(status.level, Level.STALE)),
        max(0.0, time - (_number(lasted.group()) if lasted else 0.0)),
        time,
        _number(size),
        name.partition("[")[2].rstrip("]")[:_MAX_KIND],
    )


def _number(text: str) -> float:
    """Return a number in a text, 0 if it is none: any node may publish on /diagnostics."""
    try:
        value = float(text)
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0
