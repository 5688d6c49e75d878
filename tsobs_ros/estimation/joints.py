# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several joints side by side, each with a tracker of its own, stepped as one batch.

The batch is another way of evaluating the same steps, never another estimate: what is plain for
several joints (the next measurement in order, after the same time) is computed at once, and a
joint with anything more to it (late, first, after a gap) steps alone.
"""

from collections.abc import Hashable, Sequence
from typing import Any

from tsobs_ros.checks import Array
from tsobs_ros.estimation.bank import Members, in_groups, of
from tsobs_ros.estimation.records import Estimate, Innovation, Measurement, RejectReason
from tsobs_ros.estimation.supervised_bank import SupervisedBank, structure
from tsobs_ros.estimation.tracker import NUMERICAL_FAILURES, Tracker, quiet

_LEAST = 4
"""Fewer joints are quicker one by one."""

_REMEMBERED = 32
"""Banks to keep; which joints step together changes with what each one's messages bring."""

_Plain = tuple[Any, Array, float]
"""State, torque [N m] and duration [s] of a plain step."""


class JointTrackers:
    """Trackers of k independent joints, stepped together.

    Each joint's numbers are, bit for bit, those of its tracker alone.

    Attributes:
        trackers: One a joint, to be asked for counts and events.
    """

    def __init__(self, trackers: Sequence[Tracker[Any]]) -> None:
        self.trackers = tuple(trackers)
        self._structures: list[tuple[Any, Hashable]] = [(None, None)] * len(self.trackers)
        self._banks: dict[tuple[Any, ...], SupervisedBank] = {}

    def reset(self) -> None:
        """Forget everything; afterwards every tracker is as a new one."""
        for tracker in self.trackers:
            tracker.reset()

    def offer(
        self, measurements: Sequence[Measurement | None], now: int
    ) -> list[Innovation | RejectReason | None]:
        """Use a measurement of each joint, or say why not; see `Tracker.offer`.

        Args:
            measurements: One entry a joint, None where there is nothing for it.
            now: Time on the clock of the stamps [ns].

        Returns:
            One entry a joint; None where there was nothing for it.

        Raises:
            ValueError: There are not as many entries as joints.
        """
        each = list(zip(self.trackers, measurements, strict=True))
        if len(each) < _LEAST:
            return [one and tracker.offer(one, now) for tracker, one in each]
        return self._offer_together(each, now)

    def estimate(self, stamp: int, wanted: Sequence[bool] | None = None) -> list[Estimate | None]:
        """Return the estimate of each joint at a stamp; see `Tracker.estimate`.

        Args:
            stamp: The instant [ns].
            wanted: One entry a joint, False where no estimate is; None: of all.

        Returns:
            One entry a joint; None where there is no estimate, or none was wanted.
        """
        asked = [True] * len(self.trackers) if wanted is None else wanted
        each = list(zip(self.trackers, asked, strict=True))
        if len(each) < _LEAST:
            return [tracker.estimate(stamp) if one else None for tracker, one in each]
        return self._estimate_together(stamp, each)

    @quiet()
    def _offer_together(
        self, each: Sequence[tuple[Tracker[Any], Measurement | None]], now: int
    ) -> list[Innovation | RejectReason | None]:
        """Do what `offer` does for enough joints to pay."""

        def one_by_one(members: Members) -> list[Innovation | RejectReason | None]:
            return [one and tracker.offer(one, now) for tracker, one in of(members, each)]

        def step(members: Members) -> list[Innovation | RejectReason | None]:
            if len(members) < _LEAST:
                return one_by_one(members)
            trackers = of(members, self.trackers)
            offered = [one for _, one in of(members, each) if one is not None]
            bank, states, torques, duration = self._gathered(members, steps)
            try:
                predicted = bank.predict(states, torques, duration)
                corrected = bank.correct(predicted, [measurement.y for measurement in offered])
            except NUMERICAL_FAILURES:
                return one_by_one(members)
            return [
                tracker.take(measurement, *outcome)
                for tracker, measurement, outcome in zip(trackers, offered, corrected, strict=True)
            ]

        steps = [one and tracker.plain_step(one, now) for tracker, one in each]
        return in_groups(self._keys(steps), step)

    @quiet()
    def _estimate_together(
        self, stamp: int, each: Sequence[tuple[Tracker[Any], bool]]
    ) -> list[Estimate | None]:
        """Do what `estimate` does for enough joints to pay."""

        def one_by_one(members: Members) -> list[Estimate | None]:
            chosen = of(members, each)
            return [tracker.estimate(stamp) if one else None for tracker, one in chosen]

        def read(members: Members) -> list[Estimate | None]:
            if len(members) < _LEAST:
                return one_by_one(members)
            trackers = of(members, self.trackers)
            bank, states, torques, elapsed = self._gathered(members, bases)
            try:
                if elapsed > 0.0:
                    states = bank.extrapolate(states, torques, elapsed)
                readouts = bank.readout(states)
            except NUMERICAL_FAILURES:
                return one_by_one(members)
            return [
                tracker.published(stamp, readout)
                for tracker, readout in zip(trackers, readouts, strict=True)
            ]

        bases = [tracker.basis(stamp) if one else None for tracker, one in each]
        return in_groups(self._keys(bases), read)

    def _keys(self, steps: Sequence[_Plain | None]) -> list[Hashable]:
        """Return keys that are equal for the joints that can step at once."""
        keys: list[Hashable] = []
        for place, step in enumerate(steps):
            shape = None if step is None else self._structure(place)
            keys.append(place if step is None or shape is None else (shape, step[2]))
        return keys

    def _structure(self, place: int) -> Hashable:
        estimator = self.trackers[place].estimator
        if self._structures[place][0] is not estimator:
            self._structures[place] = (estimator, structure(estimator))
        return self._structures[place][1]

    def _gathered(
        self, members: Members, steps: Sequence[_Plain | None]
    ) -> tuple[SupervisedBank, list[Any], list[Array], float]:
        """Return the bank of some joints, and the states, torques and duration of their step."""
        estimators: tuple[Any, ...] = tuple(self.trackers[place].estimator for place in members)
        if estimators not in self._banks:
            if len(self._banks) >= _REMEMBERED:
                self._banks.clear()
            self._banks[estimators] = SupervisedBank(estimators)
        given = [step for step in of(members, steps) if step is not None]
        states, torques = [step[0] for step in given], [step[1] for step in given]
        return self._banks[estimators], states, torques, given[0][2]
