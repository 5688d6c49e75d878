# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bad numbers in messages that are otherwise as they ought to be."""

import math
from collections.abc import Iterator

import numpy as np

from faults.arm import Arm
from faults.script import Event, Fate, kind
from tsobs_ros.estimation.records import RejectReason

_FAMILY = "numbers"
_LARGEST = 1.7976931348623157e308
_SMALLEST = 5e-324
# As many repetitions of a value as the node believes, `supervision.stuck_samples`.
_BELIEVED_REPETITIONS = 9


def _angles(arm: Arm, begin: int, seconds: float, *angles: float) -> Iterator[Event]:
    """Send the angles over and over instead of the measured ones."""
    fate = Fate.JUDGED if math.isfinite(angles[0]) else RejectReason.NON_FINITE
    for index, stamp in enumerate(arm.stamps(begin, seconds)):
        yield Event(stamp, arm.message(stamp, position=[angles[index % len(angles)]]), fate)


def _torques(arm: Arm, begin: int, seconds: float, *torques: float) -> Iterator[Event]:
    """Send the torques over and over instead of the applied ones."""
    fate = Fate.JUDGED if math.isfinite(torques[0]) else RejectReason.NON_FINITE
    for index, stamp in enumerate(arm.stamps(begin, seconds)):
        yield Event(stamp, arm.message(stamp, effort=[torques[index % len(torques)]]), fate)


def _shifted(
    arm: Arm, begin: int, seconds: float, by: float, scale: float = 1.0
) -> Iterator[Event]:
    for stamp in arm.stamps(begin, seconds):
        angle = scale * float(arm.measurement(stamp).y[0]) + by
        yield Event(stamp, arm.message(stamp, position=[angle]), Fate.JUDGED)


@kind(_FAMILY)
def nan_angle(arm: Arm, begin: int) -> Iterator[Event]:
    """The angle is not a number: rejected; the estimate coasts."""
    return _angles(arm, begin, 0.5, math.nan)


@kind(_FAMILY)
def infinite_angle(arm: Arm, begin: int) -> Iterator[Event]:
    """The angle is plus and minus infinity in turn: rejected; the estimate coasts."""
    return _angles(arm, begin, 0.5, math.inf, -math.inf)


@kind(_FAMILY)
def nan_torque(arm: Arm, begin: int) -> Iterator[Event]:
    """The torque is not a number: rejected with its good angle; the last good torque holds."""
    return _torques(arm, begin, 0.5, math.nan)


@kind(_FAMILY)
def infinite_torque(arm: Arm, begin: int) -> Iterator[Event]:
    """The torque is infinite: rejected with its good angle; the last good torque holds."""
    return _torques(arm, begin, 0.5, math.inf, -math.inf)


@kind(_FAMILY)
def largest_angle(arm: Arm, begin: int) -> Iterator[Event]:
    """The largest finite angles, of both signs: gated; an overflow restarts the estimate."""
    return _angles(arm, begin, 0.5, _LARGEST, -_LARGEST)


@kind(_FAMILY)
def largest_torque(arm: Arm, begin: int) -> Iterator[Event]:
    """The largest finite torques: the prediction overflows and the estimate restarts."""
    return _torques(arm, begin, 0.05, _LARGEST, -_LARGEST)


@kind(_FAMILY, recovery=3.0)
def denormal_numbers(arm: Arm, begin: int) -> Iterator[Event]:
    """Angle and torque are the smallest doubles there are: numbers like any other."""
    for stamp in arm.stamps(begin, 0.025):
        yield Event(
            stamp, arm.message(stamp, position=[_SMALLEST], effort=[-_SMALLEST]), Fate.JUDGED
        )


@kind(_FAMILY, lasts=1.0)
def stuck_angle(arm: Arm, begin: int) -> Iterator[Event]:
    """The same angle over and over: gated from the tenth repetition on."""
    angle = arm.measurement(begin - arm.period).y.tolist()
    for index, stamp in enumerate(arm.stamps(begin, 1.0)):
        fate = Fate.JUDGED if index < _BELIEVED_REPETITIONS else RejectReason.GATED
        yield Event(stamp, arm.message(stamp, position=angle), fate)


@kind(_FAMILY)
def single_outlier(arm: Arm, begin: int) -> Iterator[Event]:
    """One angle is 1 rad off: downweighted or gated."""
    return _shifted(arm, begin, 0.005, 1.0)


@kind(_FAMILY)
def every_fifth_an_outlier(arm: Arm, begin: int) -> Iterator[Event]:
    """Every fifth angle is up to 3 rad off: downweighted or gated."""
    for index, stamp in enumerate(arm.stamps(begin, 0.5)):
        if index % 5:
            yield Event(stamp, arm.message(stamp), Fate.JUDGED)
        else:
            yield from _shifted(arm, stamp, 0.005, 3.0 * math.sin(index))


@kind(_FAMILY, warm_up=9.0, lasts=3.0, recovery=3.0)
def jump(arm: Arm, begin: int) -> Iterator[Event]:
    """The sensor jumps by 0.3 rad and back after three seconds: taken for its disturbance."""
    return _shifted(arm, begin, 3.0, 0.3)


@kind(_FAMILY, warm_up=9.0, recovery=10.0)
def short_jump(arm: Arm, begin: int) -> Iterator[Event]:
    """A jump that is over within `jump_duration`: it takes ten seconds to get over it."""
    return _shifted(arm, begin, 0.5, 0.3)


@kind(_FAMILY, lasts=1.0, recovery=5.0)
def wrapped_angle(arm: Arm, begin: int) -> Iterator[Event]:
    """The encoder loses a turn and finds it a second later: 2 pi off, gated, or a restart."""
    return _shifted(arm, begin, 1.0, 2.0 * math.pi)


@kind(_FAMILY, lasts=1.0, recovery=5.0)
def degrees(arm: Arm, begin: int) -> Iterator[Event]:
    """The angle is in degrees for a second: gated, or a restart."""
    return _shifted(arm, begin, 1.0, 0.0, math.degrees(1.0))


@kind(_FAMILY, lasts=1.0, recovery=5.0)
def noise(arm: Arm, begin: int) -> Iterator[Event]:
    """The noise is 0.2 rad for a second: downweighted; the innovations are said not to fit."""
    rng = np.random.default_rng(1)
    for stamp in arm.stamps(begin, 1.0):
        yield from _shifted(arm, stamp, 0.005, float(rng.normal(0.0, 0.2)))


@kind(_FAMILY, recovery=5.0)
def torque_steps(arm: Arm, begin: int) -> Iterator[Event]:
    """The torque is said to be a million newton metres, of either sign: a restart follows."""
    return _torques(arm, begin, 0.5, 1e6, -1e6)


@kind(_FAMILY, recovery=5.0)
def torque_in_other_units(arm: Arm, begin: int) -> Iterator[Event]:
    """The torque is in millinewton metres for half a second."""
    for stamp in arm.stamps(begin, 0.5):
        torque = (1e3 * arm.measurement(stamp).u).tolist()
        yield Event(stamp, arm.message(stamp, effort=torque), Fate.JUDGED)
