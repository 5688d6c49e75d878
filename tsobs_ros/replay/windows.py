# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording in windows of bounded size, each with the ticks that nothing behind it concerns.

What a window's ticks have not used comes again at the front of the next window. So memory does not
grow with the recording, and estimates are those of a window that has all of it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from tsobs_ros.bag import estimate_topics as topics
from tsobs_ros.bag.joint_series import JointSeries
from tsobs_ros.checks import Flags
from tsobs_ros.replay.replay import Replay
from tsobs_ros.replay.schedule import Past, Schedule, as_recorded, at_rate, at_samples
from tsobs_ros.replay.source import Live, Samples, Source, places_of_innovations
from tsobs_ros.replay.table import Recorded
from tsobs_ros.series import NANOSECONDS

WINDOW = 2**15
"""Number of messages in a window: some 25 s of a bag with live estimates at 200 Hz."""


@dataclass(frozen=True)
class Window:
    """A part of a recording.

    Attributes:
        samples: Measurements in the order of use.
        schedule: Ticks, also some that may change with what follows.
        recorded: Output of the observer that ran during the recording, if the schedule is its.
        restarts: Recorded restarts that were not in a window before.
        ticks: Number of the schedule's ticks to make.
        known: Number of the first samples among which no later one will come.
        horizon: Smallest log time of what follows [ns]; infinite in the last window.
        not_recorded: Number of recorded innovations whose measurements neither it nor what follows
            has.
    """

    samples: Samples
    schedule: Schedule
    recorded: Recorded | None
    restarts: JointSeries | None
    ticks: int
    known: int
    horizon: float
    not_recorded: int = 0

    @property
    def is_last(self) -> bool:
        """Whether nothing follows."""
        return self.horizon == math.inf


class User(Protocol):
    """What runs over windows."""

    replay: Replay

    def enter(self, window: Window, dropped: int) -> None: ...


class Windows:
    """The windows of a recording.

    Args:
        source: The recording.
        rate: Estimate at this rate [Hz]; None: at every measurement.
        as_live: Estimate, instead of both, when the recorded observer did.
        size: Largest number of messages that a window has besides those of the one before,
            divisible by 4; None for a single window.

    Attributes:
        as_live: Whether estimates are made when the recorded observer made its.
    """

    def __init__(
        self, source: Source, rate: float | None, as_live: bool, size: int | None = None
    ) -> None:
        self._source, self._rate, self._size = source, rate, size
        self.as_live = as_live and source.was_observed

    def over(self, users: Sequence[User]) -> Iterator[Window]:
        """Enter each window into all users, and yield it for them to make its ticks."""
        past, dropped, frozen = Past(), 0, 0
        kept: tuple[Samples, dict[str, JointSeries]] | None = None
        for samples, others, horizon in self._source.parts(self._size, self.as_live):
            restarts = others.get(topics.RESTARTS)
            if kept is not None:
                samples = kept[0].followed_by(samples)
                others = {name: kept[1][name].followed_by(one) for name, one in others.items()}
            if (states := others.get(topics.STATES)) is not None:
                order = np.argsort(states.publish_times, kind="stable")
                others[topics.STATES] = states.take(order)
            # What was used already keeps its order.
            used = samples.take(slice(0, frozen))
            samples = used.followed_by(
                self._source.in_order(samples.take(slice(frozen, None)), others)
            )
            window = self._window(samples, others, restarts, horizon, past)
            for user in users:
                user.enter(window, dropped)
            yield window
            if window.is_last:
                return
            dropped = min(user.replay.taken for user in users)
            frozen = max(max(user.replay.reached for user in users) - dropped, 0)
            past = past.after(window.schedule, window.ticks, samples, dropped)
            newest = samples.newest_before(dropped)
            rest = replace(samples.take(slice(dropped, None)), newest=newest)
            kept = rest, self._rest(window, others, dropped)

    def _window(
        self,
        samples: Samples,
        others: dict[str, JointSeries],
        restarts: JointSeries | None,
        horizon: float,
        past: Past,
    ) -> Window:
        recorded, last = None, horizon == math.inf
        states = others.get(topics.STATES) if self.as_live else None
        if states is not None:
            innovations = others.get(topics.INNOVATION)
            schedule = as_recorded(samples, states, innovations, others.get(topics.RESTARTS), past)
            live = {name: one for name, one in others.items() if name != topics.STATES}
            recorded = Recorded(Live(states, live), schedule, samples)
        elif self._rate is None:
            schedule = at_samples(samples)
        else:
            schedule = at_rate(samples, self._rate, past, self._size)
        known, ticks, lost = samples.count, schedule.count, 0
        if not last:
            known = _first(samples.log_times >= horizon)
            ticks = _first((schedule.max_known > known) | (schedule.log_times >= horizon))
        if recorded is not None and (innovations := others.get(topics.INNOVATION)) is not None:
            since = _since(schedule, ticks, horizon)
            lost = int((innovations.log_times[recorded.unmatched] < since).sum())
        return Window(samples, schedule, recorded, restarts, ticks, known, horizon, lost)

    def _rest(
        self, window: Window, others: dict[str, JointSeries], dropped: int
    ) -> dict[str, JointSeries]:
        """Return what the next window needs of the recorded output."""
        schedule, ticks = window.schedule, window.ticks
        since = _since(schedule, ticks, window.horizon)
        rest = {}
        for name, series in others.items():
            if name == topics.STATES:
                keep = np.arange(series.count) >= ticks
            elif name == topics.RESTARTS:
                before = np.searchsorted(schedule.publish_times, series.publish_times)
                keep = before >= ticks
            elif name == topics.INNOVATION:
                places = places_of_innovations(window.samples, series)
                matched = np.full(series.count, -1)
                matched[places[places >= 0]] = np.flatnonzero(places >= 0)
                keep = (matched >= dropped) | ((matched < 0) & (series.log_times >= since))
            else:
                keep = series.log_times >= since
            rest[name] = series.take(keep)
        return rest


def _since(schedule: Schedule, ticks: int, horizon: float) -> float:
    """Return the log time from which on output of the ticks to come may have been recorded [ns]."""
    following = schedule.log_times[ticks : ticks + 1].tolist()
    # A tick's messages may have been recorded in another order than they were published.
    return float(min([horizon, *following])) - NANOSECONDS


def _first(flags: Flags) -> int:
    return int(flags.argmax()) if flags.any() else len(flags)
