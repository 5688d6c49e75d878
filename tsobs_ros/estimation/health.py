# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Health of an estimator as data; nodes, reports and `tsobs watch` only show it."""

import enum
import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.errors import ModelError
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.settings import check, live_setting

T = TypeVar("T")

# Intervals between measurements, in periods of the design, that are reported. Above the first, the
# estimate may never settle below the certified bound; below the second, many samples are wasted.
_MAX_PERIODS, _MIN_PERIODS = 1.02, 0.7
# Least number of intervals between stamps for a median.
_ENOUGH = 7


class Level(enum.IntEnum):
    """Severity; the numbers are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Status(NamedTuple):
    """One aspect of the health: its level, a sentence for people and values for programs."""

    name: str
    level: Level
    message: str
    values: dict[str, str]


class Code(enum.IntEnum):
    """A code of the compiled core with its meaning, which log, diagnostics and reports share.

    Attributes:
        text: Its meaning, in a sentence.
        remedy: The remedy, "" if there is nothing to do.
    """

    text: str
    remedy: str

    def __new__(cls, value: int, text: str = "", remedy: str = "") -> Self:
        code = int.__new__(cls, value)
        code._value_, code.text, code.remedy = value, text, remedy
        return code

    @property
    def level(self) -> Level:
        """Its severity."""
        return Level.OK

    @property
    def judged(self) -> tuple[Level, str]:
        """Its severity, and its text with the remedy."""
        return self.level, f"{self.text}; {self.remedy}" if self.remedy else self.text

    @property
    def words(self) -> str:
        """Its name, for people."""
        return self.name.lower().replace("_", " ")


class Phase(enum.IntEnum):
    """Freshness of the measurements behind an estimate, from best to worst."""

    TRACKING = 0
    COASTING = 1
    WAITING = 2
    STALE = 3

    @property
    def level(self) -> Level:
        """Its severity."""
        return (Level.OK, Level.WARN, Level.WARN, Level.ERROR)[self]


@dataclass(frozen=True)
class DisturbanceLimits:
    """The limits from which on a disturbance counts as a fault."""

    warn: float = live_setting(
        0.2, "Disturbance magnitude for a warning", unit="rad", minimum=1e-6, maximum=10.0
    )
    error: float = live_setting(
        0.5, "Disturbance magnitude for an error", unit="rad", minimum=1e-6, maximum=10.0
    )
    hold: float = live_setting(
        0.5, "Time a level must last to be reported", unit="s", minimum=0.0, maximum=60.0
    )

    def __post_init__(self) -> None:
        check(self)
        if not self.error >= self.warn:
            raise ModelError(
                f"disturbance error level: expected at least the warn level {self.warn!r}, "
                f"got {self.error!r}"
            )

    def level_of(self, magnitude: float) -> Level:
        """Return the level of a magnitude [rad] at the moment."""
        if magnitude >= self.error:
            return Level.ERROR
        return Level.WARN if magnitude >= self.warn else Level.OK


class Debounce(Generic[T]):
    """Passes a value on once it has lasted, with its first stamp [ns], None for the first value."""

    def __init__(self, value: T) -> None:
        self.value = value
        self.since: int | None = None
        self._candidate = value
        self._from: int | None = None

    def update(self, stamp: int, value: T, hold: float) -> T:
        """Take in the value at a stamp [ns]; return the value that has lasted `hold` [s]."""
        if value != self._candidate or self._from is None:
            self._candidate, self._from = value, stamp
        if stamp - self._from >= hold * 1e9 and value != self.value:
            self.value, self.since = value, self._from
        return self.value


def lasting(since: int | None, now: int) -> dict[str, str]:
    """Return the time since a change, for a status; nothing if there was no change."""
    return {} if since is None else {"since": f"for {max(0, now - since) * 1e-9:.1f} s"}


class LastMinute:
    """The growth of counts over the last sixty updates, which are a second apart.

    The first update includes everything counted before. A count that falls, as after a restart,
    goes on from its new value.
    """

    def __init__(self) -> None:
        self.growth, self._totals = Counter[Any](), Counter[Any]()
        self._past = deque([Counter[Any]()] * 60)

    def update(self, totals: Mapping[Any, int]) -> Counter[Any]:
        """Take in counts since the start; return their growth since the last update."""
        latest = Counter(totals)
        grown = latest - self._totals
        self._totals = latest
        self._past.append(grown)
        self.growth += grown
        self.growth -= self._past.popleft()
        return grown


def rate_of(stamps: ArrayLike) -> float:
    """Return the rate of stamps [ns] in Hz, by the median of their distances; NaN if there are too
    few."""
    apart = np.diff(np.sort(stamps))
    apart = apart[apart > 0]
    return NANOSECONDS / float(np.median(apart)) if len(apart) >= _ENOUGH else math.nan


def judge_rate(measured: float, wanted: float) -> tuple[int, str]:
    """Return 1 if measurements come at a lower rate [Hz] than the design's, -1 if at a much higher
    one, else 0; and a sentence with the finding and the remedy."""
    text = f"measurements come at {measured:{'.3g' if measured < 1000.0 else '.0f'}} Hz, the design"
    off = int(wanted > _MAX_PERIODS * measured) - int(wanted < _MIN_PERIODS * measured)
    if not off:
        return 0, f"{text} is for that"
    what = "the bound may never be certified" if off > 0 else "no narrower bound comes of it"
    unit = "" if 0.1 < wanted / measured < 10.0 else ", or is the time in another unit?"
    return off, (
        f"{text} is for {wanted:g} Hz: {what}; set `rate` of its request to what comes and "
        f"design again, or let the driver send as often as it says{unit}"
    )
