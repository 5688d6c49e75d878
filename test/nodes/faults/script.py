# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a kind of bad input is: messages, when they are sent, and what must become of each."""

import enum
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from faults.arm import Arm
from tsobs_ros.estimation.records import NANOSECONDS, RejectReason

_LONG = 7 * NANOSECONDS


class Fate(enum.Enum):
    """What else than a rejection may become of a message."""

    USED = "used"
    JUDGED = "used or gated"
    """As the supervision sees fit; a number, so it is counted as one of the two."""
    CROWDED = "used, or dropped by the middleware"
    """One of more messages than the queue holds between two ticks."""
    UNSEEN = "not seen"
    """Not a message of the topic: it must not even be counted."""


class Sender(enum.Enum):
    """Who sends a message."""

    SENSOR = "sensor data QoS, like any sensor"
    SECOND_SENSOR = "another publisher of the same QoS"
    LATCHING = "reliable and transient local"
    OTHER_TYPE = "a Float64MultiArray publisher on the same topic"
    RAW = "bytes instead of a message"


class Event(NamedTuple):
    """One message of a script.

    Attributes:
        at: When it is sent [ns].
        message: The message, or its CDR bytes.
        fate: What must become of it.
        sender: Who sends it.
    """

    at: int
    message: Any
    fate: Fate | RejectReason = Fate.USED
    sender: Sender = Sender.SENSOR


Write = Callable[[Arm, int], Iterable[Event]]


@dataclass(frozen=True)
class Kind:
    """A kind of bad input.

    Attributes:
        name: As in reports.
        family: What is bad: the numbers, the message, its stamp or its arrival.
        about: What happens, and what the node makes of it.
        write: The bad stretch for an arm, from a stamp on.
        warm_up: Good data before it [s].
        lasts: How long the stretch takes [s].
        recovery: Good data after which the error must be inside the bounds again [s].
    """

    name: str
    family: str
    about: str
    write: Write = field(repr=False)
    warm_up: float
    lasts: float
    recovery: float

    def script(self, arm: Arm) -> list[Event]:
        """Return everything that is sent, from the arm's first sample on, in order."""
        bad_from = arm.origin + round(self.warm_up * NANOSECONDS)
        good_from = bad_from + round(self.lasts * NANOSECONDS)
        events = [
            *good(arm, arm.origin, self.warm_up),
            *self.write(arm, bad_from),
            *good(arm, good_from, self.recovery),
        ]
        return sorted(events, key=lambda event: event.at)

    def fates(self, arm: Arm) -> list[str]:
        """Return what becomes of the messages of the stretch, each once."""
        events = self.write(arm, arm.origin + round(self.warm_up * NANOSECONDS))
        return list(dict.fromkeys(event.fate.value for event in events))

    @property
    def seconds(self) -> float:
        """Length of the whole script [s]."""
        return self.warm_up + self.lasts + self.recovery


KINDS: dict[str, Kind] = {}
"""The catalogue, by name; filled by the modules that `kinds` imports."""


def kind(
    family: str, *, warm_up: float = 1.0, lasts: float = 0.5, recovery: float = 2.0
) -> Callable[[Write], Write]:
    """Enter the decorated function into the catalogue, under its name and with its docstring."""

    def enter(write: Write) -> Write:
        name = write.__name__.replace("_", " ")
        about = " ".join((write.__doc__ or "").split())
        KINDS[name] = Kind(name, family, about, write, warm_up, lasts, recovery)
        return write

    return enter


def table(arm: Arm) -> str:
    """Return the catalogue as a table in Markdown."""
    lines = ["| kind | what happens | each message is |", "|---|---|---|"]
    family = ""
    for each in KINDS.values():
        if each.family != family:
            family = each.family
            lines.append(f"| **{family}** | | |")
        lines.append(f"| {each.name} | {each.about} | {'; '.join(each.fates(arm)) or 'absent'} |")
    return "\n".join(lines) + "\n"


def good(arm: Arm, begin: int, seconds: float) -> Iterator[Event]:
    """Send what the good sensor says, as it is sampled."""
    return (Event(stamp, arm.message(stamp)) for stamp in arm.stamps(begin, seconds))


def steps(
    events: Sequence[Event], begin: int, end: int, period: int
) -> Iterator[tuple[int, list[Event]]]:
    """Cut events into what is sent until each of evenly spaced instants; leap over long silence."""
    place, silent_since = 0, begin
    for now in range(begin, end + period, period):
        first = place
        while place < len(events) and events[place].at <= now:
            place += 1
            silent_since = now
        upcoming = events[place].at if place < len(events) else end
        if not silent_since + _LONG < now < upcoming - period:
            yield now, list(events[first:place])


class Counts(NamedTuple):
    """What a node says became of the messages."""

    received: int
    used: int
    rejected: Mapping[RejectReason, int]


def complaints(events: Iterable[Event], counts: Counts, may_lose: bool = False) -> list[str]:
    """Return how the counts differ from what was to become of the events; nothing if not.

    Args:
        events: What was sent.
        counts: What the node says.
        may_lose: Whether messages may be lost on the way, as between processes.
    """
    wanted = Counter(event.fate for event in events)
    crowded, judged = wanted[Fate.CROWDED], wanted[Fate.JUDGED]
    certain = wanted.total() - wanted[Fate.UNSEEN] - crowded
    lost = max(0, certain - counts.received) if may_lose else 0
    said = []
    if not certain <= counts.received + lost <= certain + crowded:
        said.append(f"{counts.received} received instead of {certain} (+ {crowded})")
    if counts.received != counts.used + sum(counts.rejected.values()):
        said.append(f"received is not used + rejected: {counts}")
    for reason in RejectReason:
        least, came = wanted[reason], counts.rejected.get(reason, 0)
        most = least + judged if reason is RejectReason.GATED else least
        if not least - lost <= came <= most:
            said.append(f"{came} {reason.value} instead of {least} to {most}")
    return said
