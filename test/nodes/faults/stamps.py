# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Good samples under stamps that are not theirs."""

from collections.abc import Callable, Iterator

from builtin_interfaces.msg import Time

from faults.arm import Arm
from faults.script import Event, Fate, kind
from tsobs_ros.estimation.records import NANOSECONDS, RejectReason
from tsobs_ros.nodes.messages import to_stamp

_FAMILY = "stamp"
_MS = 1_000_000
# The node's defaults.
_HISTORY, _TOLERANCE = 500 * _MS, 100 * _MS
_BOOT_TIME = 50 * NANOSECONDS


def _stamped(
    arm: Arm,
    begin: int,
    fate: Fate | RejectReason,
    stamp_of: Callable[[int], Time],
    seconds: float = 0.5,
) -> Iterator[Event]:
    """Send samples when they are taken, but stamped otherwise."""
    for at in arm.stamps(begin, seconds):
        message = arm.message(at)
        message.header.stamp = stamp_of(at)
        yield Event(at, message, fate)


def _shifted(
    arm: Arm, begin: int, fate: Fate | RejectReason, by: int, seconds: float = 0.5
) -> Iterator[Event]:
    return _stamped(arm, begin, fate, lambda at: to_stamp(at + by), seconds)


@kind(_FAMILY)
def zero_stamp(arm: Arm, begin: int) -> Iterator[Event]:
    """No stamp: rejected."""
    return _stamped(arm, begin, RejectReason.ZERO_STAMP, lambda _: Time())


@kind(_FAMILY)
def negative_stamp(arm: Arm, begin: int) -> Iterator[Event]:
    """Seconds before the epoch: rejected as no stamp."""
    return _stamped(arm, begin, RejectReason.ZERO_STAMP, lambda _: Time(sec=-5, nanosec=1))


@kind(_FAMILY)
def nanoseconds_beyond_a_second(arm: Arm, begin: int) -> Iterator[Event]:
    """Three of the seconds are written as nanoseconds, which the type allows: used at the sum."""

    def stamp_of(at: int) -> Time:
        seconds, rest = divmod(at, NANOSECONDS)
        return Time(sec=seconds - 3, nanosec=rest + 3 * NANOSECONDS)

    return _stamped(arm, begin, Fate.USED, stamp_of)


@kind(_FAMILY)
def most_nanoseconds(arm: Arm, begin: int) -> Iterator[Event]:
    """All bits of the nanoseconds are set, four seconds ahead: rejected."""

    def stamp_of(at: int) -> Time:
        return Time(sec=at // NANOSECONDS, nanosec=2**32 - 1)

    return _stamped(arm, begin, RejectReason.FROM_FUTURE, stamp_of)


@kind(_FAMILY)
def end_of_time(arm: Arm, begin: int) -> Iterator[Event]:
    """The last stamp there is, in 2038: rejected."""
    last = Time(sec=2**31 - 1, nanosec=2**32 - 1)
    return _stamped(arm, begin, RejectReason.FROM_FUTURE, lambda _: last)


@kind(_FAMILY)
def an_hour_ahead(arm: Arm, begin: int) -> Iterator[Event]:
    """A sensor whose clock is an hour ahead: rejected."""
    return _shifted(arm, begin, RejectReason.FROM_FUTURE, 3600 * NANOSECONDS)


@kind(_FAMILY)
def just_inside_the_tolerance(arm: Arm, begin: int) -> Iterator[Event]:
    """A sample stamped ahead of the clock, by less than is tolerated: used, once it is time."""
    return _shifted(arm, begin, Fate.JUDGED, _TOLERANCE - 41 * _MS, 0.005)


@kind(_FAMILY)
def just_outside_the_tolerance(arm: Arm, begin: int) -> Iterator[Event]:
    """Stamped ahead of the clock by more than is tolerated: rejected."""
    return _shifted(arm, begin, RejectReason.FROM_FUTURE, _TOLERANCE + 41 * _MS)


@kind(_FAMILY)
def same_again(arm: Arm, begin: int) -> Iterator[Event]:
    """Every message comes twice: the second is rejected."""
    for stamp in arm.stamps(begin, 0.5):
        yield Event(stamp, arm.message(stamp))
        yield Event(stamp, arm.message(stamp), RejectReason.DUPLICATE)


@kind(_FAMILY)
def same_stamp_other_value(arm: Arm, begin: int) -> Iterator[Event]:
    """Every stamp comes twice, the second time with another angle: the first counts."""
    for stamp in arm.stamps(begin, 0.5):
        yield Event(stamp, arm.message(stamp))
        yield Event(stamp, arm.message(stamp, position=[1.0]), RejectReason.DUPLICATE)


@kind(_FAMILY)
def stopped_clock(arm: Arm, begin: int) -> Iterator[Event]:
    """The sensor's clock stands still while its samples go on: rejected; the estimate coasts."""
    last = to_stamp(begin - arm.period)
    return _stamped(arm, begin, RejectReason.DUPLICATE, lambda _: last, 0.3)


@kind(_FAMILY)
def out_of_order(arm: Arm, begin: int) -> Iterator[Event]:
    """Twenty at a time arrive in reverse order: each is put in its place."""
    stamps = list(arm.stamps(begin, 0.5))
    for first in range(0, len(stamps), 20):
        block = stamps[first : first + 20]
        for stamp in reversed(block):
            yield Event(block[-1], arm.message(stamp))


@kind(_FAMILY)
def older_than_the_history(arm: Arm, begin: int) -> Iterator[Event]:
    """Between the good ones come samples from before the history: rejected."""
    for stamp in arm.stamps(begin, 0.5):
        yield Event(stamp, arm.message(stamp))
        yield Event(stamp, arm.message(stamp - 2 * _HISTORY), RejectReason.TOO_OLD)


@kind(_FAMILY)
def clock_since_boot(arm: Arm, begin: int) -> Iterator[Event]:
    """The sensor stamps with the time since it was switched on: rejected as too old."""
    stamp_of = iter(range(_BOOT_TIME, 2 * _BOOT_TIME, arm.period))
    return _stamped(arm, begin, RejectReason.TOO_OLD, lambda _: to_stamp(next(stamp_of)))


@kind(_FAMILY)
def two_clocks_in_turn(arm: Arm, begin: int) -> Iterator[Event]:
    """Every other sample is stamped by a clock since boot, every fourth by one ahead: rejected."""
    for index, stamp in enumerate(arm.stamps(begin, 0.5)):
        if index % 2 == 0:
            yield Event(stamp, arm.message(stamp))
        elif index % 4 == 1:
            yield Event(stamp, arm.message(_BOOT_TIME + index), RejectReason.TOO_OLD)
        else:
            ahead = stamp + 7200 * NANOSECONDS
            yield Event(stamp, arm.message(ahead), RejectReason.FROM_FUTURE)


@kind(_FAMILY, warm_up=0.0, lasts=0.5, recovery=3.0)
def first_ever_since_boot(arm: Arm, begin: int) -> Iterator[Event]:
    """The very first samples come from a clock since boot: used, but STALE until good ones come."""
    stamp_of = iter(range(_BOOT_TIME, 2 * _BOOT_TIME, arm.period))
    return _stamped(arm, begin, Fate.JUDGED, lambda _: to_stamp(next(stamp_of)))


@kind(_FAMILY)
def jittered_stamps(arm: Arm, begin: int) -> Iterator[Event]:
    """Stamps a millisecond or two off, early and late in turn: used, where they say."""
    for index, at in enumerate(arm.stamps(begin, 0.5)):
        message = arm.message(at)
        message.header.stamp = to_stamp(at + (index % 5 - 2) * _MS)
        yield Event(at, message, Fate.JUDGED)
