# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One joint of the observer node: its design, its tracker and its monitors."""

import math
from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.file import DesignFile, load_arm_design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.events import EventLog
from tsobs_ros.estimation.faults import FaultMonitor, add_estimates, add_samples, new_watches
from tsobs_ros.estimation.health import LastMinute, Phase, phase_of
from tsobs_ros.estimation.history import CORRECTING, GATED, offer
from tsobs_ros.estimation.records import (
    NANOSECONDS,
    Estimate,
    RejectReason,
)
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import make_estimator, make_tracker
from tsobs_ros.nodes.observer.io import Stamps
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

_NOTHING = np.zeros(0)
_OPEN = np.array([math.inf])
_ACCEPTED = (*CORRECTING, GATED)


class ObservedJoint:
    """A joint with its tracker, monitors and counts.

    Args:
        name: The joint's name.
        loaded: Its design.
        estimator: The design's estimator.
        parameters: Of the node.
        source: Where its measurements come from, for events.

    Attributes:
        name: The joint's name.
        loaded: Its design.
        learnt: Names of the learnt parameters.
        tracker: Orders its measurements and estimates.
        received: Number of its samples since the start: used + rejected.
        latest: The latest estimate, None before the first.
        faults: Recognises faults of its sensor.
        events: Finds changes of what its estimates are worth.
        recent: Counts over the last minute: `received`, the reasons of rejection and the
            estimator's events, by name.
    """

    def __init__(
        self,
        name: str,
        loaded: DesignFile,
        estimator: Estimator,
        parameters: ObserverParameters,
        source: str = "joint_measurements",
    ) -> None:
        self.name = name
        self.loaded = loaded
        settings = parameters.settings
        self.learnt = settings.learnt(loaded.design)
        self.tracker: Tracker = make_tracker(loaded.design, settings, estimator)
        self._limits = parameters.fault
        self._coast_after, self._stale_after = parameters.coast_after, parameters.stale_after
        self.events = EventLog(source, self._coast_after, self._stale_after)
        self.reset()

    def reset(self) -> None:
        """Forget everything that was computed from data."""
        self.tracker.reset()
        self.events.restart()
        self.received = 0
        self.recent = LastMinute()
        self._newest = 0
        self.latest: Estimate | None = None
        std = self.loaded.design.arm_request.measurement_std
        self.watch = new_watches([std])
        self.faults = FaultMonitor(std, self._limits, self.watch)

    def retune(self, parameters: ObserverParameters) -> None:
        """Take over parameters that were changed while the node runs."""
        self._coast_after = self.events.coast_after = parameters.coast_after
        self._limits = self.faults.limits = parameters.fault
        if self.tracker.estimator.supervised:
            self.tracker.estimator.supervise(parameters.supervision)

    def age(self, now: int) -> float | None:
        """Return the age of the newest measurement in use [s], None before the first."""
        return max(0, now - self._newest) / NANOSECONDS if self._newest else None

    def phase(self, now: int) -> Phase:
        """Return how fresh its measurements are."""
        return phase_of(self.age(now), self._coast_after, self._stale_after)

    def offer(self, stamps: Stamps, y: Array, u: Array, now: int) -> tuple[list[int], Array]:
        """Use samples, m of them.

        Args:
            stamps: In ascending order [ns], shape (m,).
            y: Measured angles [rad], shape (m,).
            u: Torques [N m], shape (m,).
            now: Time on the node's clock [ns].

        Returns:
            Outcomes by the codes of `history.REASONS`, and the innovations y − ŷ, NaN of a sample
            whose angle was not used [rad], shape (m,).
        """
        count = len(stamps)
        self.received += count
        tracker, codes = self.tracker, np.zeros((1, count), np.int64)
        innovations, expected_std = np.empty((2, 1, count))
        # A column of one and a row of one are the same numbers.
        offer(
            tracker.estimator.model,
            tracker.memory,
            tracker.ring,
            stamps,
            y.reshape(count, 1),
            u.reshape(count, 1),
            now,
            codes[0],
            innovations.reshape(count, 1),
            expected_std.reshape(count, 1),
        )
        add_samples(self.watch, stamps, y.reshape(1, count), codes, innovations, expected_std)
        outcomes: list[int] = codes[0].tolist()
        accepted = [k for k, code in enumerate(outcomes) if code in _ACCEPTED]
        if accepted:
            self._newest = max(self._newest, int(stamps[accepted[-1]]))
        if any(outcomes):
            innovations[~np.isin(codes, CORRECTING)] = math.nan
        return outcomes, innovations[0]

    def count(self, steady: int) -> None:
        """Enter the counts there are into those of the last minute.

        Args:
            steady: Time that neither stands still nor goes back [ns].
        """
        rejected = {reason.value: count for reason, count in self.tracker.rejected.items()}
        self.recent.update(steady, {"received": self.received, **rejected, **self.tracker.events})

    def reject(self, count: int) -> None:
        """Count samples that cannot be read."""
        self.received += count
        self.tracker.reject(RejectReason.WRONG_JOINT, count)

    def estimate(self, now: int, *, hold: bool) -> Estimate | None:
        """Return the estimate to publish, None if there is none.

        Args:
            now: Time on the node's clock [ns].
            hold: Whether a stale joint keeps its latest estimate, without bounds.
        """
        if self.phase(now) in (Phase.WAITING, Phase.STALE):
            # To predict through a long silence would take long, and tell nothing.
            return self._held() if hold else None
        estimate = self.tracker.estimate(now)
        if estimate is not None:
            self.latest = estimate
            # Another hypothesis may take a fault of the sensor for something else.
            disturbance = estimate.designed_disturbance
            if disturbance.size:
                bound = estimate.designed_bound if estimate.designed_bound.size else _OPEN
                if add_estimates(self.watch, now, disturbance, bound):
                    self.faults.judge(float(disturbance[0]), float(bound[0]))
        return estimate

    def _held(self) -> Estimate | None:
        return self.latest and self.latest._replace(
            state_bound=_NOTHING, disturbance_bound=_NOTHING, parameters_valid=False
        )


def rehearse(joints: Sequence[ObservedJoint]) -> None:
    """Run everything that is compiled on joints that have no past yet; they have none after it."""
    zero = np.zeros(1)
    for joint in joints:
        period = round(joint.loaded.design.request.period * NANOSECONDS)
        for place in (1, 2, 4, 3, 3):  # one of them late, one twice
            stamp = NANOSECONDS + place * period
            joint.offer(np.array([stamp]), zero, zero, stamp + period)
        for ahead in (0.5, 10.0):
            joint.estimate(stamp + round(ahead * period), hold=False)
        joint.reset()


def observed_joints(
    parameters: ObserverParameters, source: str = "joint_measurements"
) -> list[ObservedJoint]:
    """Return the joints that the parameters name; those with the same design share estimators.

    Args:
        parameters: Of the node.
        source: Where their measurements come from, for events.

    Raises:
        DesignFileError: A design file is missing or malformed.
        CertificateError: A design's certificate does not hold.
    """
    paths = parameters.design_of
    shipped = config_path(SHIPPED_DESIGN)
    loaded = {path: load_arm_design(path or shipped) for path in dict.fromkeys(paths.values())}
    estimators = {
        path: make_estimator(each.design, parameters.settings) for path, each in loaded.items()
    }
    return [
        ObservedJoint(joint, loaded[path], estimators[path], parameters, source)
        for joint, path in paths.items()
    ]
