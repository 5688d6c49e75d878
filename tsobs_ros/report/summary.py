# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A verdict on a run, in plain words."""

import math
from collections.abc import Iterable
from typing import NamedTuple

from tsobs_ros.estimation.health import Level, Phase
from tsobs_ros.replay.health import Health, JointEvent
from tsobs_ros.report.diagnosed import Diagnosed
from tsobs_ros.report.metrics import SIGMAS, RunMetrics
from tsobs_ros.report.panels import TimingSummary

# Shares of errors inside 3 sigma: a good one, and the least for any distribution with this 1σ.
_INSIDE, _TOO_FEW = 0.99, 8.0 / 9.0
_EXPECTED = (0.5, 2.0)
_MANY_LOST = 0.01
_CLAIMED = 0.4
"""Share of bounds that must be claimed in a good run: a start and a jump of 20 s leave more."""


class Summary(NamedTuple):
    """The verdict on a run: its level and its text."""

    level: Level
    text: str


def summarise(
    metrics: RunMetrics,
    health: Health | None,
    diagnosed: Diagnosed,
    timing: TimingSummary,
    events: Iterable[JointEvent] = (),
    until: float = math.inf,
) -> Summary:
    """Return the verdict on a run, by its errors if they are known, else by its innovations.

    A silence after the last measurement, `until` [ns], is no fault of the run.
    """
    parts = [_of_estimates(metrics)]
    if health is not None:
        parts.append(_of_bounds(health))
    if diagnosed.count:
        parts.append(_of_faults(diagnosed, metrics))
    silences = sum(
        one.event.text.startswith(Phase.COASTING.name) and one.event.stamp < until for one in events
    )
    rejected, total = sum(diagnosed.rejected.values()), max(metrics.measurements, 1) + timing.lost
    said = rejected if diagnosed.count else "unknown"
    parts.append(
        Summary(
            _warn_if(silences > 0 or timing.lost + rejected > _MANY_LOST * total),
            f"Measurements missing: {timing.lost} of {total}; rejected: {said}; silences: "
            f"{silences}.",
        )
    )
    return Summary(max(one.level for one in parts), " ".join(one.text for one in parts))


def _of_estimates(metrics: RunMetrics) -> Summary:
    if not metrics.windows:
        return Summary(Level.WARN, f"No part of the {metrics.duration:.1f} s counts as settled.")
    known = [
        (one.inside, one.quantity.name) for one in metrics.quantities if one.inside is not None
    ]
    if known:
        share, name = min(known)
        return Summary(
            Level.ERROR if share < _TOO_FEW else _warn_if(share < _INSIDE),
            f"Errors are inside their {SIGMAS:g}σ bound for {_percent(share)} of "
            f"{metrics.settled_time:.1f} s (worst estimate: {name}).",
        )
    if metrics.nis is None:
        return Summary(Level.WARN, "Neither the truth nor the innovations are recorded.")
    return Summary(
        _warn_if(not _EXPECTED[0] <= metrics.nis <= _EXPECTED[1]),
        f"The truth is not known. The mean square of the innovations is {metrics.nis:.2f} times "
        "what the design expects.",
    )


def _of_bounds(health: Health) -> Summary:
    if health.misfit:
        return Summary(Level.WARN, f"{health.misfit[0].upper()}{health.misfit[1:]}.")
    return Summary(
        _warn_if(health.claimed < _CLAIMED),
        f"Bounds were claimed for {_percent(health.claimed)} of the time, and proved, but for "
        f"what is uncertain of learnt parameters, for {_percent(health.proved)}.",
    )


def _of_faults(diagnosed: Diagnosed, metrics: RunMetrics) -> Summary:
    if not diagnosed.faults:
        return Summary(Level.OK, "No fault of a sensor was reported.")
    worst = max(diagnosed.faults, key=lambda one: (one.level, one.end - one.begin))
    of = f" of {worst.output}" if worst.output else ""
    size = f" of {worst.magnitude:.2g} {worst.unit}".rstrip() if worst.magnitude else ""
    until = "to the end" if worst.end > metrics.last - 2.5 else f"to {worst.end:.1f} s"
    return Summary(
        min(worst.level, Level.ERROR),
        f"Reported sensor faults: {len(diagnosed.faults)}; worst: {worst.kind}{of}{size}, from "
        f"{worst.begin:.1f} s {until}.",
    )


def _warn_if(wrong: bool) -> Level:
    return Level.WARN if wrong else Level.OK


def _percent(share: float) -> str:
    # Rounded down, so that nearly all is not shown as 100 %.
    return f"{int(1000.0 * share) / 10.0:g} %"
