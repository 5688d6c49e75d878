# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run in plain words: how it went, and what its page has beside the panels."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from tsobs_ros.estimation.health import Level, Phase
from tsobs_ros.replay.health import Health, JointEvent
from tsobs_ros.report.diagnosed import Diagnosed
from tsobs_ros.report.metrics import SIGMAS, RunMetrics
from tsobs_ros.report.panels import TimingSummary

# Of errors inside 3 sigma: as many as the bound implies for any distribution, and too few.
_INSIDE, _TOO_FEW = 0.99, 8.0 / 9.0
_EXPECTED = (0.5, 2.0)
_MANY_LOST = 0.01
_CLAIMED = 0.4
"""Share of bounds that have to be claimed in a good run: a start and a jump of 20 s leave more."""


class Table(NamedTuple):
    """A table of a page, which is not shown without rows.

    `numbers` is the place of the first column of numbers, which are aligned to the right.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: int = 1
    note: str = ""


class Summary(NamedTuple):
    """How a run went: how well, and in plain words."""

    level: Level = Level.OK
    text: str = ""


class About(NamedTuple):
    """What a page has beside the panels: a verdict, and tables below and above the panels."""

    summary: Summary = Summary()
    tables: Sequence[Table] = ()
    first: Sequence[Table] = ()


def summarise(
    metrics: RunMetrics,
    health: Health | None,
    diagnosed: Diagnosed,
    timing: TimingSummary,
    events: Iterable[JointEvent] = (),
    until: float = math.inf,
) -> Summary:
    """Return how a run went, by its errors if they are known, else by its innovations.

    A silence after the last measurement, `until` [ns], is no fault of the run.
    """
    silences = sum(
        one.event.text.startswith(Phase.COASTING.name) and one.event.stamp < until for one in events
    )
    parts = [_of_estimates(metrics)]
    if health is not None:
        parts.append(_of_bounds(health))
    if diagnosed.count:
        parts.append(_of_faults(diagnosed, metrics))
    parts.append(_of_data(metrics, diagnosed, timing, silences))
    levels, sentences = zip(*parts, strict=True)
    return Summary(max(levels), " ".join(sentences))


def _of_estimates(metrics: RunMetrics) -> tuple[Level, str]:
    if not metrics.windows:
        return Level.WARN, f"No part of the {metrics.duration:.1f} s counts as settled."
    known = [one for one in metrics.quantities if one.inside is not None]
    if known:
        share, name = min((one.inside or 0.0, one.quantity.name) for one in known)
        level = Level.OK if share >= _INSIDE else Level.WARN if share >= _TOO_FEW else Level.ERROR
        return level, (
            f"Errors are inside their {SIGMAS:g}σ bound for {_percent(share)} of "
            f"{metrics.settled_time:.1f} s (worst estimate: {name})."
        )
    if metrics.nis is None:
        return Level.WARN, "Neither the truth nor the innovations are recorded."
    good = _EXPECTED[0] <= metrics.nis <= _EXPECTED[1]
    return Level.OK if good else Level.WARN, (
        f"The truth is not known. The mean square of the innovations is {metrics.nis:.2f} times "
        "what the design expects."
    )


def _of_bounds(health: Health) -> tuple[Level, str]:
    if health.misfit:
        return Level.WARN, f"{health.misfit[0].upper()}{health.misfit[1:]}."
    return Level.OK if health.claimed >= _CLAIMED else Level.WARN, (
        f"Bounds were claimed for {_percent(health.claimed)} of the time, and proved, but for "
        f"what is uncertain of learnt parameters, for {_percent(health.proved)}."
    )


def _of_faults(diagnosed: Diagnosed, metrics: RunMetrics) -> tuple[Level, str]:
    if not diagnosed.faults:
        return Level.OK, "No fault of a sensor was reported."
    worst = max(diagnosed.faults, key=lambda one: (one.level, one.end - one.begin))
    of = f" of {worst.output}" if worst.output else ""
    size = f" of {worst.magnitude:.2g} {worst.unit}".rstrip() if worst.magnitude else ""
    until = "to the end" if worst.end > metrics.last - 2.5 else f"to {worst.end:.1f} s"
    return min(worst.level, Level.ERROR), (
        f"Reported sensor faults: {len(diagnosed.faults)}; worst: {worst.kind}{of}{size}, from "
        f"{worst.begin:.1f} s {until}."
    )


def _of_data(
    metrics: RunMetrics, diagnosed: Diagnosed, timing: TimingSummary, silences: int
) -> tuple[Level, str]:
    rejected = sum(diagnosed.rejected.values())
    total = max(metrics.measurements, 1) + timing.lost
    many = timing.lost + rejected > _MANY_LOST * total
    return Level.WARN if many or silences else Level.OK, (
        f"Measurements missing: {timing.lost} of {total}; rejected: {rejected}; silences: "
        f"{silences}."
    )


def _percent(share: float) -> str:
    # Downwards, so that nearly all is not all.
    return f"{int(1000.0 * share) / 10.0:g} %"
