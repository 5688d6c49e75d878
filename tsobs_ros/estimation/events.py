# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Events of an estimate: the changes of its quality, each reported once, in words.

They depend only on the health that an estimator reports ten times per second. So a node's log,
an estimate over a recording and a report on that recording list the same events.
"""

import enum
from typing import Any, NamedTuple

from tsobs_ros.estimation.health import Debounce, Level, Phase
from tsobs_ros.estimation.records import Basis, Estimate, Hypothesis
from tsobs_ros.series import NANOSECONDS

COAST_AFTER, STALE_AFTER = 0.1, 5.0
"""Default ages of the newest measurement for COASTING and for STALE [s]."""

NOISY, NOT_NOISY = 1.5, 1.3
"""Noise scale from which on the noise counts as larger than the design's, and noise scale below
which it counts as usual again."""

_LASTING = 1.0
_BURST, _INTERVAL = 5.0, 10.0
_SHORTEST_SILENCE = 0.2


class EventKind(enum.Enum):
    """The kind of a change; the value is its name in reports."""

    STATE = "state"
    BOUND = "bound"
    NOISE = "noise"
    HYPOTHESIS = "hypothesis"
    RATE = "rate"
    CONTACT = "contact"


class Event(NamedTuple):
    """A change: the stamp at which it began [ns], its kind, and the level of the new state."""

    stamp: int
    kind: EventKind
    level: Level
    text: str


class EventLog:
    """Finds the events of one joint's estimates.

    A state of bounds, noise or hypothesis must last a second to be reported, but void
    bounds are reported at once. A flickering state is reported five times, and then every ten
    seconds with the number of its changes.

    Args:
        source: Origin of the measurements, such as a topic.
        coast_after: Age of the newest measurement for COASTING [s]; may be changed at any time.
        stale_after: Age of the newest measurement for STALE [s].

    Attributes:
        changes: The changes of each kind.

    Example:
        >>> log = EventLog("/joint_measurements", coast_after=0.1, stale_after=5.0)
        >>> good = Estimate(stamp=10**9)
        >>> [event.text for event in log.update(good)]
        ['TRACKING: measurements arrive on /joint_measurements']
        >>> silent = good._replace(stamp=2 * 10**9, age=0.15)
        >>> [event.text for event in log.update(silent)]
        ['COASTING: nothing usable on /joint_measurements for 0.15 s; estimates are predictions']
    """

    def __init__(self, source: str, coast_after: float, stale_after: float) -> None:
        self.coast_after = coast_after
        self._source, self._stale_after = source, stale_after
        usual = (None, Basis.STARTING, False, Hypothesis.AS_DESIGNED, 0, False)
        self.changes = {
            kind: Changes(kind, one) for kind, one in zip(EventKind, usual, strict=True)
        }
        self.restart()

    def restart(self) -> None:
        """Forget the states, as the estimate has no past, but remember how much was reported."""
        self._waits_since: int | None = None
        self._newest: int | None = None
        self._noisy = False
        for changes in self.changes.values():
            changes.restart()

    def update(self, estimate: Estimate) -> list[Event]:
        """Return the events due at the next estimate, which is about 0.1 s after the last."""
        stamp, scale = estimate.stamp, estimate.noise_scale
        newest, before = stamp - round(estimate.age * NANOSECONDS), self._newest
        events = []
        limit = max(self._stale_after, _SHORTEST_SILENCE) * NANOSECONDS
        if before is not None and newest - before > limit:
            events += self._go_stale(before)
        self._newest, state = newest, self.changes[EventKind.STATE]
        if estimate.age <= self.coast_after:
            text = f"TRACKING: measurements arrive on {self._source}"
            if before is not None:
                gap = f"after {(stamp - before) / NANOSECONDS:.2g} s without"
                text = f"TRACKING again: measurements arrive on {self._source}, {gap}"
            events += state.report(stamp, Phase.TRACKING, (Level.OK, text))
        else:
            missing = f"nothing usable on {self._source} for {estimate.age:.2g} s"
            text = f"COASTING: {missing}; estimates are predictions"
            since = newest + round(self.coast_after * NANOSECONDS)
            events += state.report(since, Phase.COASTING, (Level.WARN, text))
        self._noisy = scale >= (NOT_NOISY if self._noisy else NOISY)
        judged = Level.OK, f"the sensor's noise is below {NOT_NOISY} times the design's"
        if self._noisy:
            judged = Level.WARN, f"the sensor's noise is {scale:.2g} times the design's"
        events += self.changes[EventKind.NOISE].report(stamp, self._noisy, judged, _LASTING)
        for kind, code in (
            (EventKind.BOUND, estimate.basis),
            (EventKind.HYPOTHESIS, estimate.hypothesis),
        ):
            void = kind is EventKind.BOUND and code.level is Level.WARN
            lasting = 0.0 if void else _LASTING
            events += self.changes[kind].report(stamp, code, code.judged, lasting)
        return sorted(events, key=lambda event: event.stamp)

    def silence(self, now: int) -> list[Event]:
        """Return the events due at a time [ns] without an estimate."""
        state = self.changes[EventKind.STATE]
        if self._newest is not None:
            late = now - self._newest > self._stale_after * NANOSECONDS
            return [*(self._go_stale(self._newest) if late else ()), *state.due(now)]
        if self._waits_since is None:
            self._waits_since = now
        if state.value is Phase.WAITING or now - self._waits_since < _LASTING * NANOSECONDS:
            return []
        state.value = Phase.WAITING
        text = f"WAITING for the first measurement on {self._source}"
        return [Event(self._waits_since, EventKind.STATE, Level.WARN, text)]

    def _go_stale(self, newest: int) -> list[Event]:
        missing = f"nothing usable on {self._source} for {self._stale_after:g} s"
        text = f"STALE: {missing}; the next one restarts the estimate"
        since = newest + round(self._stale_after * NANOSECONDS)
        return self.changes[EventKind.STATE].report(since, Phase.STALE, (Level.ERROR, text))


class Changes(Debounce[Any]):
    """The changes of one kind, reported at once up to five times and then every ten seconds."""

    def __init__(self, kind: EventKind, usual: Any) -> None:
        self._kind, self._usual = kind, usual
        self._credit = _BURST
        self.restart()

    def restart(self) -> None:
        """Return to the value that needs no report."""
        super().__init__(self._usual)
        self._changed = self._count = 0
        self._reported: int | None = None

    def report(
        self, stamp: int, value: Any, judged: tuple[Level, str], lasting: float = 0.0
    ) -> list[Event]:
        """Take in a value, which must last `lasting` [s], and return the reports that are due."""
        events, before = self.due(stamp), self.value
        if self.update(stamp, value, lasting) != before:
            self._changed = stamp
            self._event = Event(self.since or stamp, self._kind, *judged)
            self._count += 1
        return events + self.due(stamp)

    def due(self, stamp: int) -> list[Event]:
        """Return the report that is due by a stamp [ns], if any."""
        if not self._count:
            return []
        # A restart may have set the stamps back.
        rested = 0 if self._reported is None else self._changed - self._reported
        credit = self._credit + rested / (_INTERVAL * NANOSECONDS)
        missing = max(0.0, 1.0 - credit)
        at = self._changed + round(missing * _INTERVAL * NANOSECONDS)
        if stamp < at:
            return []
        event, count, self._count = self._event, self._count, 0
        self._credit, self._reported = min(_BURST, credit + missing) - 1.0, at
        if count > 1:
            event = event._replace(text=f"{event.text} ({count} changes since the last report)")
        return [event]
