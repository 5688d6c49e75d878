# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One joint of the observer node: its design, its tracker and its monitors."""

import math
from collections import Counter
from typing import Any

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.estimation import health
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.events import Event, EventKind, EventLog
from tsobs_ros.estimation.faults import FaultMonitor
from tsobs_ros.estimation.health import Level, Phase
from tsobs_ros.estimation.records import USED, Estimate, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import make_estimator, make_tracker
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.replay.samples import NOT_NAMED
from tsobs_ros.schema import naming
from tsobs_ros.series import NANOSECONDS, Stamps

FAILURES = "numerical failures"
"""Name of the count of numerical failures."""

_ACCEPTED = (USED, RejectReason.GATED, RejectReason.IMPLAUSIBLE_TORQUE, RejectReason.UNKNOWN_INPUT)
# Time for which measurements must come at another rate before this is logged [s].
_LASTING = 3.0
# Number of 1σ bounds beyond which a torque disturbance is significant.
_SIGNIFICANT = 3.0


class ObservedJoint:
    """A joint with its tracker, monitors and counts.

    Attributes:
        signals: Places of its signals in messages.
        learnt: Names of the learnt parameters.
        received: Number of its samples since the start: used + rejected.
        latest: The latest estimate, None before the first.
        recent: Counts over the last minute: `received`, the reasons for rejection, `FAILURES` and
            the estimator's events.
        newly: The same counts since the previous call of `count`, about a second ago.
        measured_rate: Rate of the samples that the estimator gets, from the median distance of
            their stamps [Hz]; NaN before there are enough.
        torque_sides: The sides with a torque disturbance, the motor before the link.
        touched: Whether the last of these sides had a contact since the latest status.
    """

    def __init__(
        self,
        name: str,
        design: Design,
        estimator: Estimator,
        parameters: ObserverParameters,
        source: str = "joint_measurements",
    ) -> None:
        self.name = name
        self.design = design
        self.method = parameters.method
        self.request = design.request
        self.signals = self.request.signals(name, alone=len(parameters.joints) == 1)
        self.learnt = parameters.learnt(design)
        self.tracker: Tracker = make_tracker(design, parameters, estimator)
        self.torque_sides = self.request.torque_sides if estimator.shape.t else ()
        self._parameters = parameters
        self.events = EventLog(source, parameters.coast_after, parameters.stale_after)
        self.reset()

    def reset(self) -> None:
        """Forget everything that was computed from data."""
        self.tracker.reset()
        self.events.restart()
        self.received = 0
        self.recent = health.LastMinute()
        self.newly = Counter[Any]()
        self.measured_rate = math.nan
        self._stamps: list[int] = []
        self._seconds, self.touched = 0, False
        self.latest: Estimate | None = None
        self.faults = FaultMonitor(self.tracker.estimator, self._parameters.fault)
        self.torque_warn = self._parameters.torque_warn_of[self.name]

    def retune(self, parameters: ObserverParameters) -> None:
        """Take over parameters that were changed while the node runs."""
        self._parameters = parameters
        self.events.coast_after = parameters.coast_after
        self.torque_warn = parameters.torque_warn_of[self.name]
        self.faults.limits = parameters.fault
        if self.tracker.estimator.supervised:
            self.tracker.estimator.supervise(parameters.supervision)

    def age(self, now: int) -> float | None:
        """Return the age of the newest measurement in use [s], None before the first."""
        newest = self.tracker.newest
        return None if newest is None else max(0, now - newest) / NANOSECONDS

    def phase(self, now: int) -> Phase:
        """Return how fresh its measurements are."""
        age = self.age(now)
        if age is None:
            return Phase.WAITING
        if age > self._parameters.stale_after:
            return Phase.STALE
        return Phase.COASTING if age > self._parameters.coast_after else Phase.TRACKING

    def offer(self, stamps: Stamps, y: Array, u: Array, codes: Stamps, now: int) -> Array:
        """Use the samples of N messages, and count those that cannot be used.

        Args:
            stamps: Stamps in ascending order [ns], shape (N,).
            y: Measured outputs, NaN for missing ones, shape (N, p).
            u: Inputs, shape (N, m).
            codes: Codes as in `Batch`, shape (N,); outcomes replace those of samples.
            now: Time on the node's clock [ns].

        Returns:
            The innovations y − ŷ, NaN for an output that was not used, shape (N, p).
        """
        self.received += len(codes)
        if not np.count_nonzero(codes):  # takes a tenth of the time of `any`
            found = self.tracker.offer_many(stamps, y, u, now)
            codes[:], innovations = found.codes, found.innovations
        else:
            given = codes == USED
            for code, count in Counter(codes[~given].tolist()).items():
                if code == NOT_NAMED:
                    self.received -= count
                else:
                    self.tracker.reject(RejectReason(code), count)
            found = self.tracker.offer_many(stamps[given], y[given], u[given], now)
            innovations = np.full(y.shape, math.nan)
            codes[given], innovations[given] = found.codes, found.innovations
        accepted = np.isin(codes, _ACCEPTED) if np.count_nonzero(codes) else slice(None)
        self._stamps += stamps[accepted].tolist()
        return innovations

    def count(self) -> list[Event]:
        """Update the counts of the last second; return events about the measurements' rate."""
        own = {"received": self.received, FAILURES: self.tracker.failures}
        self.newly = self.recent.update({**own, **self.tracker.rejected, **self.tracker.events})
        rate, self._stamps = health.rate_of(self._stamps), []
        if math.isnan(rate):
            return []
        self.measured_rate = rate
        off, text = health.judge_rate(self.measured_rate, self.request.rate)
        judged = Level.WARN if off else Level.OK, text
        self._seconds += 1
        stamp = self._seconds * NANOSECONDS
        return self.events.changes[EventKind.RATE].report(stamp, off, judged, _LASTING)

    def estimate(self, now: int) -> Estimate | None:
        """Return the estimate to publish at a time [ns]; `when_stale` decides for a stale joint."""
        estimate = self.tracker.estimate(now)
        if estimate is not None:
            self.latest = estimate
            self.faults.update(estimate, self.tracker.state)
            return estimate
        if not (self._parameters.when_stale == "hold" and self.phase(now) is Phase.STALE):
            return None
        nothing = np.zeros(0)
        return self.latest and self.latest._replace(
            state_bound=nothing,
            disturbance_bound=nothing,
            torque_disturbance_bound=nothing,
            parameters_valid=False,
        )

    def news(self, now: int, estimate: Estimate | None, due: bool) -> list[Event]:
        """Return the events to log for a time [ns]; `due`: whether its health is published."""
        if estimate is None or estimate.stamp != now:  # none, or held
            return self.events.silence(now)
        return self._contacts(estimate) + (self.events.update(estimate) if due else [])

    def _contacts(self, estimate: Estimate) -> list[Event]:
        """Compare the torque at the link, or else at the motor, with its warning level."""
        torques, bounds = estimate.torque_disturbance, estimate.torque_disturbance_bound
        if not (self.torque_warn and torques.size):
            return []
        beyond = bool(abs(torques[-1]) >= max(self.torque_warn, _SIGNIFICANT * bounds[-1]))
        self.touched |= beyond
        judged = Level.WARN if beyond else Level.OK, self.torque_text(estimate, beyond)
        lasting = 0.0 if beyond else self._parameters.fault.hold
        changes = self.events.changes[EventKind.CONTACT]
        return changes.report(estimate.stamp, beyond, judged, lasting)

    def torque_text(self, estimate: Estimate, beyond: bool) -> str:
        """Return an estimate's torque in words, with a remark if it is beyond the warning level."""
        torque, bound = estimate.torque_disturbance[-1], estimate.torque_disturbance_bound[-1]
        side = self.torque_sides[-1]
        text = f"{torque:.3g} N m (1 sigma {bound:.2g}) at the {side}"
        cause = "a contact, a payload?" if side == "link" else "friction, an offset?"
        return text + beyond * f", beyond {self.torque_warn:g} N m: {cause}"


def observed_joints(
    parameters: ObserverParameters, source: str = "joint_measurements"
) -> list[ObservedJoint]:
    """Return the joints that the parameters name; joints with the same design share an estimator.

    Raises:
        DesignFileError: A design file is missing or malformed, or the method cannot run it.
        CertificateError: A design's certificate does not hold.
    """

    def load(path: str) -> tuple[Design, Estimator]:
        design = load_design(path)
        with naming(path):
            return design, make_estimator(design, parameters)

    return [
        ObservedJoint(joint, *loaded, parameters, source)
        for joint, loaded in parameters.read(load).items()
    ]
