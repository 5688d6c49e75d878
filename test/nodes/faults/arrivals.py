# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Good samples that come too many, too late, not at all, twice, or among what is no sample."""

from collections.abc import Iterator

import numpy as np
from std_msgs.msg import Float64MultiArray

from faults.arm import SECONDS, Arm
from faults.script import Event, Fate, Sender, good, kind
from tsobs_ros.estimation.records import NANOSECONDS, RejectReason

_FAMILY = "arrival"
_MS = 1_000_000


@kind(_FAMILY, lasts=1.0)
def burst_of_5000(arm: Arm, begin: int) -> Iterator[Event]:
    """Five thousand at once, .2 ms apart: the queue keeps at least the newest 2000, all used."""
    at = begin + NANOSECONDS
    rng = np.random.default_rng(5)
    for stamp in range(begin, at, 200_000):
        # The arm's own samples are 5 ms apart; the very same angle again would be a stuck sensor.
        angle = arm.measurement(stamp).y + rng.normal(0.0, 0.01)
        yield Event(at, arm.message(stamp, position=angle.tolist()), Fate.CROWDED)


@kind(_FAMILY, lasts=1.0)
def held_up(arm: Arm, begin: int) -> Iterator[Event]:
    """A second of samples arrives at once at its end: used, each in its place."""
    for stamp in arm.stamps(begin, 1.0):
        yield Event(begin + NANOSECONDS, arm.message(stamp))


@kind(_FAMILY, lasts=2.0)
def late_by_a_second(arm: Arm, begin: int) -> Iterator[Event]:
    """All are on the way for a second: used; COASTING, as the newest is a second old."""
    for stamp in arm.stamps(begin, 2.0):
        yield Event(min(stamp, begin + NANOSECONDS) + NANOSECONDS, arm.message(stamp))


@kind(_FAMILY, lasts=1.0)
def late_in_turn(arm: Arm, begin: int) -> Iterator[Event]:
    """Every other sample is 0.3 s late: put in its place."""
    for index, stamp in enumerate(arm.stamps(begin, 0.7)):
        yield Event(stamp + index % 2 * 300 * _MS, arm.message(stamp))


@kind(_FAMILY, lasts=1.0)
def gap_of_a_second(arm: Arm, begin: int) -> Iterator[Event]:
    """Nothing for a second: COASTING, the bounds grow, and it goes on from there."""
    return iter(())


@kind(_FAMILY, lasts=8 * SECONDS, recovery=3.0)
def gap_of_minutes(arm: Arm, begin: int) -> Iterator[Event]:
    """Nothing for minutes: STALE and silent; the next sample restarts the estimate."""
    return iter(())


@kind(_FAMILY, lasts=2.0)
def every_tenth_alone(arm: Arm, begin: int) -> Iterator[Event]:
    """Nine of ten are lost: used, at a tenth of the rate."""
    for index, stamp in enumerate(arm.stamps(begin, 2.0)):
        if index % 10 == 0:
            yield Event(stamp, arm.message(stamp))


@kind(_FAMILY)
def two_sensors_in_turn(arm: Arm, begin: int) -> Iterator[Event]:
    """Two publishers send every other sample each: used."""
    senders = (Sender.SENSOR, Sender.SECOND_SENSOR)
    for index, stamp in enumerate(arm.stamps(begin, 0.5)):
        yield Event(stamp, arm.message(stamp), sender=senders[index % 2])


@kind(_FAMILY)
def two_sensors_at_once(arm: Arm, begin: int) -> Iterator[Event]:
    """Two publishers send the same samples: one of each two is a duplicate."""
    for stamp in arm.stamps(begin, 0.5):
        yield Event(stamp, arm.message(stamp))
        yield Event(stamp, arm.message(stamp), RejectReason.DUPLICATE, Sender.SECOND_SENSOR)


@kind(_FAMILY)
def other_quality_of_service(arm: Arm, begin: int) -> Iterator[Event]:
    """A reliable, latching publisher: used, as sensor data QoS takes whatever is offered."""
    for stamp in arm.stamps(begin, 0.5):
        yield Event(stamp, arm.message(stamp), sender=Sender.LATCHING)


@kind(_FAMILY)
def other_type(arm: Arm, begin: int) -> Iterator[Event]:
    """Somebody publishes another type under the same name: the good samples go on."""
    yield from good(arm, begin, 0.5)
    numbers = Float64MultiArray(data=[1.0, 2.0])
    for stamp in arm.stamps(begin, 0.5):
        yield Event(stamp, numbers, Fate.UNSEEN, Sender.OTHER_TYPE)
