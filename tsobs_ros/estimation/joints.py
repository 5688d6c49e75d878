# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several joints side by side, each with a tracker of its own."""

from collections.abc import Sequence
from typing import Any

from tsobs_ros.estimation.records import Estimate, Innovation, Measurement, RejectReason
from tsobs_ros.estimation.tracker import Tracker


class JointTrackers:
    """Trackers of k independent joints, stepped together.

    Each joint's numbers are, bit for bit, those of its tracker alone.

    Attributes:
        trackers: One a joint, to be asked for counts and events.
    """

    def __init__(self, trackers: Sequence[Tracker[Any]]) -> None:
        self.trackers = tuple(trackers)

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
        return [
            None if measurement is None else tracker.offer(measurement, now)
            for tracker, measurement in zip(self.trackers, measurements, strict=True)
        ]

    def estimate(self, stamp: int, wanted: Sequence[bool] | None = None) -> list[Estimate | None]:
        """Return the estimate of each joint at a stamp; see `Tracker.estimate`.

        Args:
            stamp: The instant [ns].
            wanted: One entry a joint, False where no estimate is, as of a joint that has been
                silent for so long that predicting up to the stamp would take long; None: of all.

        Returns:
            One entry a joint; None where there is no estimate, or none was wanted.
        """
        if wanted is None:
            wanted = (True,) * len(self.trackers)
        return [
            tracker.estimate(stamp) if asked else None
            for tracker, asked in zip(self.trackers, wanted, strict=True)
        ]
