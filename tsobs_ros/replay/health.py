# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The health of recorded estimates: their events in order, and a summary."""

from collections.abc import Mapping, Sequence
from enum import IntEnum
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np

from tsobs_ros.checks import Array, Flags
from tsobs_ros.estimation.events import COAST_AFTER, NOISY, STALE_AFTER, Event, EventLog
from tsobs_ros.estimation.records import Basis, Estimate, Hypothesis, Learning, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.replay.places import CONDITIONS
from tsobs_ros.series import NANOSECONDS, Series

C = TypeVar("C", bound=IntEnum)

BASIS, CLAIMED, HYPOTHESIS = map(CONDITIONS.index, ("basis", "claimed", "hypothesis"))
"""Places of these numbers in `CONDITIONS`."""

PROVED = (Basis.CERTIFIED, Basis.LEARNT)
"""Bases of proved bounds; a `LEARNT` bound is proved except for the parameters' uncertainty."""
_WRONG = (Basis.CONTRADICTED, Basis.HYPOTHESIS, Basis.OUTSIDE)
_OF_SENSOR = (Hypothesis.LOUD, Hypothesis.COLOURED_NOISE, Hypothesis.DRIFT, Hypothesis.TONE)
# Share of wrong bases in simulations: at most .05 if the design fits, at least .4 with another arm,
# or a torque of another sign or ten times as large. Angles in degrees have a noise scale of 47.
_OFTEN, _OTHER_UNIT = 0.3, 20.0
# Rejects that may be meant: of an encoder slower than the torque, or of inputs without a sensor.
_MEANT = (RejectReason.NON_FINITE, RejectReason.UNKNOWN_INPUT)

_MAX_EVENTS, _MAX_LINES = 200, 20


class JointEvent(NamedTuple):
    """An event of a joint, at a log time [ns]."""

    joint: str
    log_time: int
    event: Event


def map_events(events: Sequence[JointEvent], begin: int) -> dict[str, Any]:
    """Return the first events, in seconds since `begin` [ns], as plain data, and how many more."""
    mappings = [
        {
            "joint": joint,
            "time": (log_time - begin) / NANOSECONDS,
            "stamp": event.stamp,
            "kind": event.kind.value,
            "level": event.level.name,
            "text": event.text,
        }
        for joint, log_time, event in events[:_MAX_EVENTS]
    ]
    return {"events": mappings, "events_left_out": len(events) - len(mappings)}


def list_events(events: Sequence[JointEvent], begin: int) -> list[str]:
    """Return lines of events for a terminal, fewer than `map_events`; none without events."""
    mapped = map_events(events, begin)
    shown = mapped["events"]
    lines = [
        f"{one['time']:9.1f} s  {one['level']:<5}  {one['joint']}: {one['text']}"
        for one in shown[:_MAX_LINES]
    ]
    if more := len(shown) + mapped["events_left_out"] - len(lines):
        lines.append(f"and {more} more; JSON has up to {_MAX_EVENTS}")
    return ["events, in seconds since the first measurement:", *lines] if lines else []


class Health(NamedTuple):
    """A summary of the health of a joint's estimates.

    Attributes:
        noise_scale: Median of the noise's scale.
        max_noise_scale: Largest scale of the noise.
        claimed: Share of the estimates whose bounds are claimed to hold.
        bases: Shares of the estimates by the basis of their bounds, without zeros.
        hypotheses: Shares of the estimates by the hypothesis on arm and sensor, without zeros.
        learning: State of the learning at the end.
        hypothesis: Hypothesis on arm and sensor at the end.
        rejects: If many measurements were rejected, a sentence with their share, reason and remedy.
    """

    noise_scale: float
    max_noise_scale: float
    claimed: float
    bases: dict[Basis, float]
    hypotheses: dict[Hypothesis, float]
    learning: Learning
    hypothesis: Hypothesis
    rejects: str | None = None

    @property
    def proved(self) -> float:
        """Share of the estimates whose bound has a basis in `PROVED`."""
        return sum(self.bases.get(basis, 0.0) for basis in PROVED)

    @property
    def misfit(self) -> str | None:
        """The misfit of measurements and design, and its likely cause, in a sentence; else None."""
        wrong = sum(self.bases.get(basis, 0.0) for basis in _WRONG)
        often = f"for {100.0 * wrong:.0f} % of the time the measurements do not fit the design"
        if wrong >= _OFTEN and self.noise_scale >= _OTHER_UNIT:
            return f"{often}: the angles seem to be in another unit than rad, or of another joint"
        if self.rejects:
            return self.rejects
        if self.noise_scale >= NOISY:
            return (
                f"innovations are {self.noise_scale:.1f} times as large as the design expects, as "
                "of a noisier sensor: measurement_std in its request seems to be too small"
            )
        if wrong < _OFTEN:
            return None
        outside = self.bases.get(Basis.OUTSIDE, 0.0)
        if 2.0 * outside >= wrong:
            return (
                f"for {100.0 * outside:.0f} % of the time the link's angle is outside of x_max, "
                "where no bound holds: a larger x_max in the request would include it, unless the "
                "angle's zero is not the link hanging down"
            )
        shares = {one: share for one, share in self.hypotheses.items() if one}
        likeliest = max(shares, key=shares.__getitem__, default=Hypothesis.AS_DESIGNED)
        # A hypothesis about the sensor is no cause if most of these bounds are void all the same.
        if likeliest in _OF_SENSOR and self.bases.get(Basis.CONTRADICTED, 0.0) <= 0.5 * wrong:
            return f"{often}: {likeliest.judged[1]}"
        cause = (
            f"{often}: it seems to be of another arm, the torque of another sign, unit or "
            "joint, or there is a force that the design lacks"
        )
        if self.claimed < 0.95:
            return cause
        # Under a precise encoder an error of the model by a percent is enough.
        return f"{cause}; the bounds allow for it, and may be narrow enough"

    def as_mapping(self) -> dict[str, Any]:
        """Return the summary as plain data."""
        return {
            "misfit": self.misfit,
            "noise_scale": {"median": self.noise_scale, "max": self.max_noise_scale},
            "certified": self.bases.get(Basis.CERTIFIED, 0.0),
            "claimed": self.claimed,
            "bases": {basis.name.lower(): share for basis, share in self.bases.items()},
            "hypotheses": {one.name.lower(): share for one, share in self.hypotheses.items()},
            "learning": self.learning.name.lower(),
            "learning_text": self.learning.judged[1],
            "hypothesis": self.hypothesis.name.lower(),
        }

    def lines(self) -> tuple[str, ...]:
        """Return the summary as lines for a terminal."""
        misfit, at_end = self.misfit, [self.learning.judged[1]]
        if self.hypothesis or not misfit:  # else it would deny the misfit, as `taken for` would
            at_end.append(self.hypothesis.judged[1])
        lines = (
            f"noise {self.noise_scale:.2f} times the design's, at most {self.max_noise_scale:.2f}",
            f"bounds {_shares(self.bases)}; claimed to hold {100.0 * self.claimed:.3g} %",
            "" if misfit and not any(self.hypotheses) else f"taken for {_shares(self.hypotheses)}",
            f"at the end {'; '.join(at_end)}",
            misfit and f"warning: {misfit}",
        )
        return tuple(filter(None, lines))


def _shares(parts: Mapping[Any, float]) -> str:
    return ", ".join(f"{100.0 * share:.3g} % {one.words}" for one, share in parts.items())


def _rejects(tracker: Tracker) -> str | None:
    """Return the sentence on rejects if they are many."""
    rejected = tracker.rejected
    total = tracker.used + rejected.total()
    for reason in _MEANT:
        del rejected[reason]
    if (many := rejected.total()) <= _OFTEN * total:
        return None
    reason = max(rejected, key=rejected.__getitem__)
    share = f"{100.0 * many / total:.0f} % of the measurements were rejected"
    return f"{share} (most: {reason.text}): {reason.remedy}"


def health_of(conditions: Array, tracker: Tracker | None = None) -> Health | None:
    """Return the health from rows of `CONDITIONS`, NaN without an estimate; None if all are NaN.

    The tracker is the one that made them, if it is known.
    """
    known = conditions[~np.isnan(conditions[:, 0])]
    if not len(known):
        return None

    def shares(kind: type[C], place: int) -> dict[C, float]:
        counts = np.bincount(known[:, place].astype(int), minlength=len(kind)).tolist()
        return {code: n / len(known) for code, n in zip(kind, counts, strict=True) if n}

    last = Estimate.of_health(0, known[-1].tolist())
    return Health(
        float(np.median(known[:, 0])),
        float(known[:, 0].max()),
        float(known[:, CLAIMED].mean()),
        shares(Basis, BASIS),
        shares(Hypothesis, HYPOTHESIS),
        last.learning,
        last.hypothesis,
        None if tracker is None else _rejects(tracker),
    )


def find_events(
    joint: str,
    source: str,
    health: Series,
    restarted: Flags | None = None,
    *,
    stale_after: float = STALE_AFTER,
    same_clock: bool = True,
) -> list[JointEvent]:
    """Return the events that a node would have logged, in the order of their log times.

    `health` has rows of `CONDITIONS`, NaN without an estimate, with log times. `restarted` marks
    rows that follow a restart. `same_clock` is true if stamps and log times are of one clock.
    """
    log, found = EventLog(source, COAST_AFTER, stale_after), list[JointEvent]()
    restarted = np.zeros(len(health.stamps), bool) if restarted is None else restarted
    stamps, log_times = health.stamps.tolist(), health.log_times.tolist()
    rows = zip(health.values.tolist(), restarted.tolist(), strict=True)
    for place, (row, is_restarted) in enumerate(rows):
        if is_restarted:
            log.restart()
        if row[0] == row[0]:
            for event in log.update(Estimate.of_health(stamps[place], row)):
                log_time, before = log_times[place], place
                if same_clock:
                    # Stamps may leap where log times do not: count from the row before the event.
                    while before > 0 and stamps[before] > event.stamp:
                        before -= 1
                    log_time = min(log_time, log_times[before] + event.stamp - stamps[before])
                found.append(JointEvent(joint, log_time, event))
    return sorted(found, key=attrgetter("log_time"))
