# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recorded measurements of some joints as arrays, in the order in which they arrived."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.bag.messages.joint_series import Flags, JointSeries, Times
from tsobs_ros.checks import Array
from tsobs_ros.estimation.records import NANOSECONDS, Measurement, RejectReason, Sample

# Stamps this far back are not late any more: time restarted (a looped bag, a new simulation).
_RESTART = NANOSECONDS
# So many messages in a row must lie back, for a single straggler is not a new beginning.
_RESTART_MESSAGES = 10
# Clocks that differ by more than this are not the same clock.
_SAME_CLOCK = NANOSECONDS


@dataclass(frozen=True)
class Samples:
    """Messages with measurements of J joints, n of them in order of arrival.

    Attributes:
        stamps: When the angles were sampled [ns], shape (n,).
        log_times: When the messages were recorded, ns since the epoch, shape (n,).
        publish_times: When they were published, ns since the epoch, shape (n,).
        y: Angles [rad], shape (n, J).
        u: Torques [N m], shape (n, J).
        named: Whether the message names the joint, shape (n, J).
        complete: Whether it has an angle and a torque of it, shape (n, J).
    """

    stamps: Times
    log_times: Times
    publish_times: Times
    y: Array
    u: Array
    named: Flags
    complete: Flags

    @property
    def count(self) -> int:
        """The number of messages."""
        return len(self.stamps)

    @cached_property
    def same_clock(self) -> bool:
        """Whether stamps and log times seem to be of the same clock."""
        if not self.count:
            return True
        return abs(float(np.median(self.log_times - self.stamps))) < _SAME_CLOCK

    @cached_property
    def arrivals(self) -> Times:
        """When the messages arrived on the clock of their stamps, as well as that is known [ns]."""
        if self.same_clock:
            return self.log_times
        # Another clock says nothing: each is taken to come when it is sampled, in this order.
        spans = passes(self.stamps.tolist())
        return np.concatenate([np.maximum.accumulate(self.stamps[a:b]) for a, b in spans])

    def of_each_joint(self) -> Iterator[list[Sample]]:
        """Yield, message by message, what the observer node reads in it."""
        plain: list[bool] = np.all(self.complete, axis=1).tolist()
        joints = range(self.y.shape[1])
        for place, (stamp, y, u) in enumerate(
            zip(self.stamps.tolist(), self.y, self.u, strict=True)
        ):
            if plain[place]:
                yield [Measurement(stamp, y[j : j + 1], u[j : j + 1]) for j in joints]
            else:
                yield self._partly(place, stamp)

    def _partly(self, place: int, stamp: int) -> list[Sample]:
        named, complete = self.named[place].tolist(), self.complete[place].tolist()
        if not any(named):
            return [RejectReason.WRONG_JOINT] * len(named)
        return [
            None
            if not named[j]
            else Measurement(stamp, self.y[place, j : j + 1], self.u[place, j : j + 1])
            if complete[j]
            else RejectReason.WRONG_JOINT
            for j in range(len(named))
        ]

    def take(self, places: NDArray[np.intp]) -> "Samples":
        """Return some of the messages, or all of them in another order."""
        return Samples(**{field.name: getattr(self, field.name)[places] for field in fields(self)})

    def in_order_of_publishing(self) -> "Samples":
        """Return them as a subscriber receives them: each publisher's come in its own order."""
        return self.take(np.argsort(self.publish_times, kind="stable"))


def samples_of(series: JointSeries, assume_zero_torque: bool) -> Samples:
    """Return the measurements in a topic's positions and efforts.

    Args:
        series: With the fields position and effort, in this order.
        assume_zero_torque: Take messages without effort as torque 0.
    """
    y, u = series.values[..., 0], series.values[..., 1]
    there: Flags = series.given[..., 0] & series.given[..., 1]
    if assume_zero_torque:
        silent = series.given[..., 0] & ~series.given[..., 1]
        u, there = np.where(silent, 0.0, u), there | silent
    return Samples(series.stamps, series.log_times, series.publish_times, y, u, series.named, there)


def restarts(stamps: Sequence[int]) -> list[int]:
    """Return where stamps [ns] restart: back by more than a second, and staying back."""
    found, highest = [], 0
    for place, stamp in enumerate(stamps):
        floor = highest - _RESTART
        if 0 < stamp < floor and max(stamps[place : place + _RESTART_MESSAGES]) < floor:
            found.append(place)
            highest = stamp
        highest = max(highest, stamp)
    return found


def passes(stamps: Sequence[int]) -> list[tuple[int, int]]:
    """Return the begin and end of each pass of time, of which there are usually one."""
    return list(pairwise([0, *restarts(stamps), len(stamps)]))
