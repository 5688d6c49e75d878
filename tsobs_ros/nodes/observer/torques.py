# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The watch over a joint's torque disturbance: how large it is, and whether that is a collision.

Statuses come once a second and a contact may be shorter, so the largest torque in between is kept.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from tsobs_ros.estimation.health import Debounce, Level, Status
from tsobs_ros.estimation.records import Estimate

_SIGNIFICANT = 3.0
"""Bounds beyond which a torque is no chance."""


class Torque(NamedTuple):
    """An estimated torque disturbance.

    Attributes:
        value: [N m].
        bound: 1σ of it [N m]; infinite if there is none.
    """

    value: float
    bound: float

    def __str__(self) -> str:
        return f"{self.value:.3g} N m (1 sigma {self.bound:.2g})"


class TorqueWatch:
    """Watches the torque disturbance of one joint.

    The link's is compared with the level, or the motor's if the design has no other.

    Args:
        sides: The sides whose torque is estimated, some of motor and link.

    Attributes:
        level: Size from which on it is a warning [N m]; 0: never. May be changed at any time.
        hold: How long it must be smaller before that is over [s]. May be changed at any time.
    """

    def __init__(self, sides: Sequence[str], level: float, hold: float) -> None:
        self.level, self.hold = level, hold
        self._sides = tuple(sides)
        self._latest: list[Torque] = []
        self._largest: list[Torque] = []
        self._beyond = Debounce(False)

    def update(self, estimate: Estimate) -> Status | None:
        """Take in an estimate; return what has changed, None if nothing has."""
        values, bounds = estimate.torque_disturbance, estimate.torque_disturbance_bound
        if not values.size:
            return None
        known = bounds.tolist() or [math.inf] * len(self._sides)
        self._latest = list(map(Torque, values.tolist(), known))
        pairs = zip(self._largest or self._latest, self._latest, strict=True)
        self._largest = [max(pair, key=_size) for pair in pairs]
        judged = self._latest[-1]
        was, beyond = self._beyond.value, self._is_beyond(judged)
        if self._beyond.update(estimate.stamp, beyond, 0.0 if beyond else self.hold) == was:
            return None
        return self._judged(judged, beyond=beyond)

    def statuses(self) -> list[Status]:
        """Return the torques, and the largest since the last time, for diagnostics.

        There is no status without sides.
        """
        if not self._sides:
            return []
        if not self._latest:
            return [Status("torque disturbance", Level.OK, "no estimate yet", {})]
        values = {"warn level [N m]": f"{self.level:g}"} if self.level else {}
        for side, latest, largest in zip(self._sides, self._latest, self._largest, strict=True):
            values[f"{side} [N m]"] = f"{latest.value:.4g}"
            values[f"{side} bound [N m]"] = f"{latest.bound:.4g}"
            values[f"{side}, largest since the last status [N m]"] = f"{largest.value:.4g}"
        judged, self._largest = self._largest[-1], self._latest
        beyond = self._beyond.value or self._is_beyond(judged)
        return [self._judged(judged, beyond=beyond)._replace(values=values)]

    def _is_beyond(self, torque: Torque) -> bool:
        size = abs(torque.value)
        return 0.0 < self.level <= size and size >= _SIGNIFICANT * torque.bound

    def _judged(self, torque: Torque, *, beyond: bool) -> Status:
        text = f"{torque} at the {self._sides[-1]}"
        if beyond:
            text += f", beyond {self.level:g} N m: a contact, a payload?"
        return Status("torque disturbance", Level.WARN if beyond else Level.OK, text, values={})


def _size(torque: Torque) -> float:
    return abs(torque.value)
