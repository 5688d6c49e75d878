# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Health of an estimator as data, which nodes, reports and `tsobs watch` only show.

`STATUSES` is the one table of codes with their levels, words and remedies: log, diagnostics,
events, reports and JSON word them from it.
"""

import enum
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.records import Basis, Hypothesis, Learning, RejectReason
from tsobs_ros.settings import check, live_setting

T = TypeVar("T")

_MINUTE = 60_000_000_000
# Distances of measurements in periods of the design that are worth a word. Beyond the one the
# estimate may never settle below the certified bound; below the other much is wasted.
_MAX_PERIODS, _MIN_PERIODS = 1.02, 0.7


class Level(enum.IntEnum):
    """Severity; the numbers are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Status(NamedTuple):
    """One concern: its level, a sentence for people and values for programs."""

    name: str
    level: Level
    message: str
    values: dict[str, str]


class Phase(enum.Enum):
    """How fresh the measurements behind an estimate are."""

    WAITING = "WAITING"
    TRACKING = "TRACKING"
    COASTING = "COASTING"
    STALE = "STALE"


class Meaning(NamedTuple):
    """What a code means.

    Attributes:
        level: How bad it is.
        text: What it says, in a sentence.
        remedy: What to do about it, "" if there is nothing to do.
    """

    level: Level
    text: str
    remedy: str = ""


STATUSES: Mapping[type[enum.Enum], Mapping[Any, Meaning]] = {
    Phase: {
        Phase.TRACKING: Meaning(Level.OK, "measurements arrive"),
        Phase.COASTING: Meaning(Level.WARN, "no measurement lately; estimates are predictions"),
        Phase.WAITING: Meaning(Level.WARN, "waiting for the first measurement"),
        Phase.STALE: Meaning(Level.ERROR, "no measurement; the next one restarts the estimate"),
    },
    Basis: {
        Basis.CERTIFIED: Meaning(Level.OK, "the bound is certified"),
        Basis.LEARNT: Meaning(
            Level.OK,
            "the bound holds: it is certified but for the uncertainty of the learnt parameters",
        ),
        Basis.COVARIANCE: Meaning(
            Level.OK, "the bound is not certified: it is the covariance along the estimate"
        ),
        Basis.STARTING: Meaning(
            Level.OK, "the bound is not certified yet: the estimate settles after a start"
        ),
        Basis.GAP: Meaning(
            Level.OK, "the bound is not certified: measurements or torques are missing or rejected"
        ),
        Basis.JUMP: Meaning(Level.OK, "the bound is not certified: the sensor has jumped"),
        Basis.CONTRADICTED: Meaning(
            Level.WARN,
            "the bound is void: the measurements contradict the design",
            "the arm, the noise or the disturbance differs from it",
        ),
        Basis.HYPOTHESIS: Meaning(
            Level.WARN,
            "the bound is not certified: it is a covariance for an arm or a sensor unlike the "
            "design's",
        ),
        Basis.OUTSIDE: Meaning(
            Level.WARN, "the bound is void: the link angle is outside of the certificate's domain"
        ),
    },
    Learning: {
        Learning.NONE: Meaning(Level.OK, "nothing is learnt"),
        Learning.STARTING: Meaning(Level.OK, "learning waits until the estimate has settled"),
        Learning.ACTIVE: Meaning(Level.OK, "the parameters are being learnt"),
    },
    Hypothesis: {
        Hypothesis.AS_DESIGNED: Meaning(Level.OK, "arm and sensor behave as designed"),
        Hypothesis.FORCE: Meaning(
            Level.WARN,
            "the arm is pushed by something the model lacks: friction, contact, a payload?",
            "a torque_disturbance in the design, or damping as an uncertain parameter, may explain "
            "it",
        ),
        Hypothesis.IMPERFECT: Meaning(
            Level.WARN,
            "the arm moves in ways that the model lacks",
            "its parameters are wrong, or process_noise in the design is too small",
        ),
        Hypothesis.LOUD: Meaning(
            Level.WARN,
            "the sensor is much noisier than designed",
            "a larger measurement_std would expect that",
        ),
        Hypothesis.COLOURED_NOISE: Meaning(
            Level.WARN,
            "the sensor's noise is alike from sample to sample: a filter in the sensor?",
            "a gauss_markov disturbance of 0.02 to 0.1 s in the design would estimate it",
        ),
        Hypothesis.DRIFT: Meaning(
            Level.WARN,
            "the sensor moves away, or is wrong for a while",
            "a larger density of its disturbance in the design would follow it",
        ),
        Hypothesis.TONE: Meaning(
            Level.WARN,
            "the sensor oscillates",
            "a sinusoid among the design's disturbances would estimate it",
        ),
    },
    RejectReason: {
        reason: Meaning(Level.WARN, reason.value, remedy)
        for reason, remedy in (
            (RejectReason.NON_FINITE, "the driver has no reading; see what it logs"),
            (
                RejectReason.WRONG_JOINT,
                "compare the names in the messages with the parameter `joints`",
            ),
            (
                RejectReason.DUPLICATE,
                "does a second publisher, or a bridge, send the same samples?",
            ),
            (
                RejectReason.TOO_OLD,
                "compare the clocks of sensor and node; `history` is the limit",
            ),
            (
                RejectReason.FROM_FUTURE,
                "compare the clocks of sensor and node; in simulations, `use_sim_time`",
            ),
            (RejectReason.GATED, "is the design this arm's, the unit rad, the sign right?"),
            (
                RejectReason.ZERO_STAMP,
                "let the driver stamp with the time of sampling, or republish its messages with "
                "stamps",
            ),
            (
                RejectReason.IMPLAUSIBLE_TORQUE,
                "is the unit N m? `torque_limit` has what is plausible",
            ),
            (
                RejectReason.MISSING_INPUT,
                "publish it in the same messages; `assume_zero_torque` takes a missing effort as 0",
            ),
            (
                RejectReason.UNKNOWN_INPUT,
                "the outputs are used; publish numbers to have narrower bounds",
            ),
        )
    },
}
"""What every code means."""


def meaning(code: enum.Enum) -> Meaning:
    """Return what a code means."""
    return STATUSES[type(code)][code]


def judged(code: enum.Enum) -> tuple[Level, str]:
    """Return how bad a code is, and its text with the remedy."""
    level, text, remedy = meaning(code)
    return level, f"{text}; {remedy}" if remedy else text


def words(code: enum.Enum) -> str:
    """Return a code's name, for people."""
    return code.name.lower().replace("_", " ")


def phase_of(age: float | None, coast_after: float, stale_after: float) -> Phase:
    """Return the phase for the age [s] of the newest measurement, None before the first."""
    if age is None:
        return Phase.WAITING
    if age > stale_after:
        return Phase.STALE
    return Phase.COASTING if age > coast_after else Phase.TRACKING


@dataclass(frozen=True)
class DisturbanceLimits:
    """When a disturbance counts as a fault."""

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
    """Passes a value on once it has lasted.

    Attributes:
        value: What is passed on.
        since: When that began [ns], None as long as it is the one from the start.
    """

    def __init__(self, value: T) -> None:
        self.value = value
        self.since: int | None = None
        self._candidate = value
        self._from: int | None = None

    def update(self, stamp: int, value: T, hold: float) -> T:
        """Take in the value at a stamp [ns]; return the one that lasted `hold` [s]."""
        if value != self._candidate or self._from is None:
            self._candidate, self._from = value, stamp
        if stamp - self._from >= hold * 1e9 and value != self.value:
            self.value, self.since = value, self._from
        return self.value


def duration_text(nanoseconds: int) -> str:
    """Return for how long something has lasted, such as "for 12.3 s"."""
    return f"for {max(0, nanoseconds) * 1e-9:.1f} s"


class LastMinute:
    """The growth of counts over a sliding minute.

    What was counted before the first update belongs to it. A count that falls, as after a restart,
    goes on from there.

    Attributes:
        growth: Of each count that has grown.

    Example:
        >>> recent = LastMinute()
        >>> for second in range(100):
        ...     grown = recent.update(second * 1_000_000_000, {"received": 200 * (second + 1)})
        >>> recent.growth["received"]
        12000
    """

    def __init__(self) -> None:
        self.growth: Counter[str] = Counter()
        self._totals: Counter[str] = Counter()
        self._past: deque[tuple[int, Counter[str]]] = deque()

    def update(self, now: int, totals: Mapping[str, int]) -> Counter[str]:
        """Take in counts since the start; return how much they have grown since the last.

        Args:
            now: A steady time [ns].
            totals: The counts, by name.
        """
        latest = Counter(totals)
        grown = latest - self._totals
        self._totals = latest
        self._past.append((now, grown))
        self.growth += grown
        while self._past[0][0] <= now - _MINUTE:
            self.growth -= self._past.popleft()[1]
        return grown


def judge_rate(measured: float, wanted: float) -> tuple[int, str]:
    """Compare the rate of measurements with the design's.

    Args:
        measured: Of the measurements [Hz].
        wanted: Of the design [Hz].

    Returns:
        1 if it is too slow, -1 if much faster, else 0; and a sentence on it, with what to do.
    """
    text = f"measurements come at {measured:{'.3g' if measured < 1000.0 else '.0f'}} Hz, the design"
    off = int(wanted > _MAX_PERIODS * measured) - int(wanted < _MIN_PERIODS * measured)
    if not off:
        return 0, f"{text} is for that"
    what = "the bound may never be certified" if off > 0 else "no narrower bound comes of it"
    return off, (
        f"{text} is for {wanted:g} Hz: {what}; set `rate` of its request to what comes and "
        "design again, or let the driver send as often as it says"
    )
