# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Events of an estimate: changes of what it is worth, once each, in words.

They are a function of the health that an estimator reports ten times a second, so a node's log,
an estimate over a recording and a report on it list the same ones.
"""

import enum
from typing import Any, NamedTuple

from tsobs_ros.estimation.health import Debounce, Level, Phase, judged, phase_of
from tsobs_ros.estimation.records import Basis, Estimate, Hypothesis, Learning
from tsobs_ros.series import NANOSECONDS

COAST_AFTER, STALE_AFTER = 0.1, 5.0
"""Default ages of the newest measurement for COASTING and for STALE [s]."""

NOISY, NOT_NOISY = 1.5, 1.3
"""Noise scales from which on the noise counts as larger than the design's, and below which as usual
again."""

_LASTING = 1.0
_BURST, _INTERVAL = 5.0, 10.0
_SHORTEST_SILENCE = 0.2


class EventKind(enum.Enum):
    """What has changed; the value is its name in reports."""

    STATE = "state"
    BOUND = "bound"
    NOISE = "noise"
    LEARNING = "learning"
    HYPOTHESIS = "hypothesis"


class Event(NamedTuple):
    """A change.

    Attributes:
        stamp: When it began [ns].
        kind: What has changed.
        level: How bad what follows is.
        text: What follows, for people.
    """

    stamp: int
    kind: EventKind
    level: Level
    text: str


_USUAL: dict[EventKind, Any] = {
    EventKind.STATE: None,
    EventKind.BOUND: Basis.STARTING,
    EventKind.NOISE: False,
    EventKind.LEARNING: Learning.STARTING,
    EventKind.HYPOTHESIS: Hypothesis.AS_DESIGNED,
}
"""States that need no report."""


class EventLog:
    """Finds the events of one joint's estimates.

    A state of bounds, noise, learning or hypothesis must last a second to be reported, but void
    bounds are reported at once. A state that flickers is reported five times, and then every ten
    seconds with the number of its changes.

    Args:
        source: Where the measurements come from, such as a topic.
        coast_after: Age of the newest measurement for COASTING [s].
        stale_after: Age of it for STALE [s].

    Attributes:
        coast_after: May be changed at any time.

    Example:
        >>> log = EventLog("/joint_measurements", coast_after=0.1, stale_after=5.0)
        >>> good = Estimate(stamp=10**9)
        >>> [event.text for event in log.update(good)]
        ['TRACKING: measurements arrive on /joint_measurements']
        >>> silent = good._replace(stamp=2 * 10**9, age=0.15)
        >>> [event.text for event in log.update(silent)]
        ['COASTING: no measurement on /joint_measurements for 0.15 s; estimates are predictions']
    """

    def __init__(self, source: str, coast_after: float, stale_after: float) -> None:
        self.coast_after = coast_after
        self._source, self._stale_after = source, stale_after
        self._began: int | None = None
        self._newest: int | None = None
        self._noisy = False
        self._basis = Basis.STARTING
        self._gap_since: int | None = None
        self._tellers = {kind: _Teller(kind, usual) for kind, usual in _USUAL.items()}

    def update(self, estimate: Estimate) -> list[Event]:
        """Return what an estimate gives occasion to report, in the order of its beginning.

        Args:
            estimate: The next one, about a tenth of a second after the last.
        """
        stamp, scale = estimate.stamp, estimate.noise_scale
        newest = stamp - round(estimate.age * NANOSECONDS)
        events = []
        if self._newest is not None:
            missing = newest - self._newest
            if missing > max(self._stale_after, _SHORTEST_SILENCE) * NANOSECONDS:
                events += self._go_stale(self._newest)
        events += self._tell_phase(estimate, newest)
        self._newest = newest
        events += self._tell_bound(stamp, estimate.basis)
        self._noisy = scale >= (NOT_NOISY if self._noisy else NOISY)
        level, text = Level.OK, f"the sensor's noise is below {NOT_NOISY} times the design's"
        if self._noisy:
            level, text = Level.WARN, f"the sensor's noise is {scale:.2g} times the design's"
        events += self._tell(EventKind.NOISE, stamp, self._noisy, level, text, _LASTING)
        learning, hypothesis = estimate.learning, estimate.hypothesis
        if learning is not Learning.NONE:
            events += self._tell(EventKind.LEARNING, stamp, learning, *judged(learning), _LASTING)
        events += self._tell(EventKind.HYPOTHESIS, stamp, hypothesis, *judged(hypothesis), _LASTING)
        return sorted(events, key=lambda event: event.stamp)

    def silence(self, now: int) -> list[Event]:
        """Return what it gives occasion to report that there is no estimate.

        Args:
            now: Time on the clock of the stamps [ns].
        """
        state = self._tellers[EventKind.STATE]
        if self._newest is not None:
            late = now - self._newest > self._stale_after * NANOSECONDS
            return [*(self._go_stale(self._newest) if late else ()), *state.due(now)]
        if self._began is None:
            self._began = now
        if state.state is Phase.WAITING or now - self._began < _LASTING * NANOSECONDS:
            return []
        state.state = Phase.WAITING
        text = f"WAITING for the first measurement on {self._source}"
        return [Event(self._began, EventKind.STATE, Level.WARN, text)]

    def _tell(self, kind: EventKind, *news: Any) -> list[Event]:
        return self._tellers[kind].update(*news)

    def since(self, kind: EventKind) -> int | None:
        """Return the stamp at which something became what it is [ns], None if it never changed."""
        return self._tellers[kind].since

    def restart(self) -> None:
        """Forget the states, but not how much has been reported, as the estimate has no past."""
        self._began = self._newest = self._gap_since = None
        self._noisy, self._basis = False, Basis.STARTING
        for teller in self._tellers.values():
            teller.restart()

    def _tell_bound(self, stamp: int, basis: Basis) -> list[Event]:
        lasting = 0.0 if judged(basis)[0] is Level.WARN else _LASTING
        if basis is not Basis.GAP:
            self._basis, self._gap_since = basis, None
        else:
            # A late measurement is a gap, but a short one is no news, however often it comes.
            if self._gap_since is None:
                self._gap_since = stamp
            if stamp - self._gap_since < _LASTING * NANOSECONDS:
                basis = self._basis
            else:
                stamp, lasting = self._gap_since, 0.0
        return self._tell(EventKind.BOUND, stamp, basis, *judged(basis), lasting)

    def _tell_phase(self, estimate: Estimate, newest: int) -> list[Event]:
        age, source = estimate.age, self._source
        if phase_of(age, self.coast_after, self._stale_after) is Phase.TRACKING:
            text = f"TRACKING: measurements arrive on {source}"
            if self._newest is not None:
                gap = (estimate.stamp - self._newest) / NANOSECONDS
                text = f"TRACKING again: measurements arrive on {source}, after {gap:.2g} s without"
            return self._tell(EventKind.STATE, estimate.stamp, Phase.TRACKING, Level.OK, text)
        text = f"COASTING: no measurement on {source} for {age:.2g} s; estimates are predictions"
        at = newest + round(self.coast_after * NANOSECONDS)
        return self._tell(EventKind.STATE, at, Phase.COASTING, Level.WARN, text)

    def _go_stale(self, newest: int) -> list[Event]:
        text = (
            f"STALE: no measurement on {self._source} for {self._stale_after:g} s; the next one "
            "restarts the estimate"
        )
        at = newest + round(self._stale_after * NANOSECONDS)
        return self._tell(EventKind.STATE, at, Phase.STALE, Level.ERROR, text)


class _Teller:
    """Reports the changes of one kind.

    Args:
        kind: The kind.
        state: The state that needs no report.

    Attributes:
        state: The state that has lasted.
    """

    def __init__(self, kind: EventKind, state: Any) -> None:
        self.state = state
        self._kind, self._initial = kind, state
        self._credit = _BURST
        self.restart()

    def restart(self) -> None:
        """Return to the state that needs no report."""
        self.state = self._initial
        self._lasting = Debounce(self._initial)
        self._event = Event(0, self._kind, Level.OK, "")
        self._changed = self._changes = 0
        self._told: int | None = None

    @property
    def since(self) -> int | None:
        """Stamp at which the state began [ns], None if it is the first."""
        return self._lasting.since

    def update(
        self, stamp: int, state: Any, level: Level, text: str, lasting: float = 0.0
    ) -> list[Event]:
        """Take in the state at a stamp [ns], at or after the last; it must last so long [s]."""
        events = self.due(stamp)
        value = self._lasting.update(stamp, state, lasting)
        if value != self.state:
            self.state, self._changed = value, stamp
            self._event = Event(self._lasting.since or stamp, self._kind, level, text)
            self._changes += 1
        return events + self.due(stamp)

    def due(self, stamp: int) -> list[Event]:
        """Return the report that is due by a stamp [ns], if any."""
        if not self._changes:
            return []
        # Stamps may have gone back at a restart.
        rested = 0 if self._told is None else self._changed - self._told
        credit = self._credit + rested / (_INTERVAL * NANOSECONDS)
        missing = max(0.0, 1.0 - credit)
        at = self._changed + round(missing * _INTERVAL * NANOSECONDS)
        if stamp < at:
            return []
        event, changes, self._changes = self._event, self._changes, 0
        self._credit, self._told = min(_BURST, credit + missing) - 1.0, at
        if changes > 1:
            event = event._replace(text=f"{event.text} ({changes} changes since the last report)")
        return [event]
