# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One joint of the observer node: its design, its tracker and its monitors."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.file import DesignFile, load_design_file
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.estimation import health
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.events import Event, EventLog
from tsobs_ros.estimation.faults import FaultMonitor
from tsobs_ros.estimation.health import Debounce, Level, Phase, Status
from tsobs_ros.estimation.records import USED, Estimate, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import make_estimator, make_tracker
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.replay.samples import NOT_NAMED
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import naming
from tsobs_ros.series import NANOSECONDS, Stamps

FAILURES = "numerical failures"
"""Name of the count of them."""

_ACCEPTED = (
    USED,
    RejectReason.GATED,
    RejectReason.IMPLAUSIBLE_TORQUE,
    RejectReason.UNKNOWN_INPUT,
)
# For how many seconds measurements must come at another rate before that is worth a word.
_LASTING = 3.0
# Bounds beyond which a torque is no chance.
_SIGNIFICANT = 3.0


class TorqueWatch:
    """Watches the torque disturbance of one joint for a contact.

    The link's is compared with `level` [N m], 0 for never; the motor's if the design has no other.
    It must be smaller for `hold` [s] before a contact is over. Both may be changed at any time. A
    contact that is shorter than the time between two statuses is in the next one all the same.
    """

    def __init__(self, sides: Sequence[str], level: float, hold: float) -> None:
        self.level, self.hold = level, hold
        self._sides = tuple(sides)
        # Values and 1σ bounds of the sides [N m].
        self._latest: tuple[list[float], list[float]] = [], []
        self._beyond = Debounce(False)
        self._touched = False

    def update(self, estimate: Estimate) -> Status | None:
        """Take in an estimate; return what has changed, None if nothing has."""
        torques = estimate.torque_disturbance.tolist()
        if not torques:
            return None
        bounds = estimate.torque_disturbance_bound.tolist() or [math.inf] * len(torques)
        size, bound, was = abs(torques[-1]), bounds[-1], self._beyond.value
        beyond = 0.0 < self.level <= size and size >= _SIGNIFICANT * bound
        is_beyond = self._beyond.update(estimate.stamp, beyond, 0.0 if beyond else self.hold)
        self._latest = torques, bounds
        self._touched |= is_beyond
        return None if is_beyond == was else self._status(is_beyond)

    def statuses(self) -> list[Status]:
        """Return the torques, a warning if there was a contact since the last time."""
        touched, self._touched = self._touched, self._beyond.value
        return [self._status(touched)] if self._sides else []

    def _status(self, beyond: bool) -> Status:
        values = {"warn level [N m]": f"{self.level:g}"} if self.level else {}
        text = "no estimate yet"
        for side, torque, bound in zip(self._sides, *self._latest, strict=False):
            values[f"{side} [N m]"] = f"{torque:.4g}"
            values[f"{side} bound [N m]"] = f"{bound:.4g}"
            text = f"{torque:.3g} N m (1 sigma {bound:.2g}) at the {side}"
        if beyond:
            text += f", beyond {self.level:g} N m: a contact, a payload?"
        return Status("torque disturbance", Level.WARN if beyond else Level.OK, text, values)


class ObservedJoint:
    """A joint with its tracker, monitors and counts.

    Attributes:
        signals: Places of its signals in messages.
        learnt: Names of the learnt parameters.
        received: Number of its samples since the start: used + rejected.
        latest: The latest estimate, None before the first.
        recent: Counts over the last minute: `received`, the reasons of rejection, `FAILURES` and
            the estimator's events, by name.
        newly: The same since the counts before, a second or so.
        measured_rate: Samples a second in use, by the median of their stamps' distances [Hz]; NaN
            if there are few.
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
        self.method = parameters.method
        self.request, settings = loaded.design.request, parameters.settings
        self.signals = self.request.signals(name, alone=len(parameters.joints) == 1)
        self.learnt = settings.learnt(loaded.design)
        self.tracker: Tracker = make_tracker(loaded.design, settings, estimator)
        self._parameters = parameters
        self.events = EventLog(source, parameters.coast_after, parameters.stale_after)
        self.reset()

    def reset(self) -> None:
        """Forget everything that was computed from data."""
        self.tracker.reset()
        self.events.restart()
        self.received = 0
        self.recent = health.LastMinute()
        self.newly = Counter[str]()
        self.measured_rate = math.nan
        self._stamps: list[int] = []
        self._pace, self._seconds = Debounce(0), 0
        self.latest: Estimate | None = None
        request, limits = self.request, self._parameters.fault
        self.faults = FaultMonitor(self.tracker.estimator, limits)
        sides = request.torque_sides if isinstance(request, ArmRequest) else ()
        self.torques = TorqueWatch(sides, self._parameters.torque_warn_of[self.name], limits.hold)

    def retune(self, parameters: ObserverParameters) -> None:
        """Take over parameters that were changed while the node runs."""
        self._parameters = parameters
        self.events.coast_after = parameters.coast_after
        self.torques.level = parameters.torque_warn_of[self.name]
        self.torques.hold = parameters.fault.hold
        self.faults.limits = parameters.fault
        if self.tracker.estimator.supervised:
            self.tracker.estimator.supervise(parameters.supervision)

    def age(self, now: int) -> float | None:
        """Return the age of the newest measurement in use [s], None before the first."""
        newest = self.tracker.newest
        return None if newest is None else max(0, now - newest) / NANOSECONDS

    def phase(self, now: int) -> Phase:
        """Return how fresh its measurements are."""
        return health.phase_of(
            self.age(now), self._parameters.coast_after, self._parameters.stale_after
        )

    def offer(self, stamps: Stamps, y: Array, u: Array, codes: Stamps, now: int) -> Array:
        """Use the samples of N messages, and count those that cannot be used.

        Args:
            stamps: In ascending order [ns], shape (N,).
            y: Measured outputs, NaN of those that are missing, shape (N, p).
            u: Inputs, shape (N, m).
            codes: Those of `Batch`, shape (N,); of samples the outcomes are written.
            now: Time on the node's clock [ns].

        Returns:
            The innovations y − ŷ, NaN of an output that was not used, shape (N, p).
        """
        given = codes == USED
        innovations = np.full(y.shape, math.nan)
        counts = Counter(codes[~given].tolist())
        self.received += len(codes) - counts.pop(NOT_NAMED, 0)
        for code, count in counts.items():
            self.tracker.reject(RejectReason(code), count)
        found = self.tracker.offer_many(stamps[given], y[given], u[given], now)
        # Of several outputs one may be missing from a sample that is used.
        found.innovations[found.output_codes != USED] = math.nan
        codes[given], innovations[given] = found.codes, found.innovations
        outcomes = zip(stamps.tolist(), codes.tolist(), strict=True)
        self._stamps += [stamp for stamp, code in outcomes if code in _ACCEPTED]
        return innovations

    def count(self) -> Iterator[tuple[Level, str]]:
        """Count what has come in the last second; yield what to log of it."""
        own = {"received": self.received, FAILURES: self.tracker.failures}
        self.newly = self.recent.update({**own, **self.rejected, **self.tracker.events})
        if self.newly[FAILURES]:
            yield Level.ERROR, "numerical failure: an estimate was not finite; restarted"
        rate, self._stamps = health.rate_of(self._stamps), []
        if math.isnan(rate):
            return
        self.measured_rate = rate
        before = self._pace.value
        off, text = health.judge_rate(self.measured_rate, self.request.rate)
        self._seconds += 1
        if self._pace.update(self._seconds * NANOSECONDS, off, _LASTING) != before:
            yield Level.WARN if off else Level.OK, text

    @property
    def rejected(self) -> Counter[str]:
        """Number of samples not used, by reason."""
        return Counter({reason.text: n for reason, n in self.tracker.rejected.items()})

    def estimate(self, now: int) -> Estimate | None:
        """Return the estimate to publish at a time [ns]; of a stale joint as the parameters say."""
        if self.phase(now) in (Phase.WAITING, Phase.STALE):
            # To predict through a long silence would take long, and tell nothing.
            return self._held() if self._parameters.when_stale == "hold" else None
        estimate = self.tracker.estimate(now)
        if estimate is None:
            return None
        self.latest = estimate
        self.faults.update(estimate, self.tracker.state)
        return estimate

    def news(self, now: int, estimate: Estimate | None, due: bool) -> Iterator[tuple[Level, str]]:
        """Yield what is to be logged of the estimate for a time [ns]; `due`: as is its health."""
        events: Sequence[Event] = ()
        if estimate is None:
            events = self.events.silence(now)
        else:
            if (contact := self.torques.update(estimate)) is not None:
                yield contact.level, contact.message
            if due:
                events = self.events.update(estimate)
        for event in events:
            yield event.level, event.text

    def _held(self) -> Estimate | None:
        nothing = np.zeros(0)
        return self.latest and self.latest._replace(
            state_bound=nothing,
            disturbance_bound=nothing,
            torque_disturbance_bound=nothing,
            parameters_valid=False,
        )


def observed_joints(
    parameters: ObserverParameters, source: str = "joint_measurements"
) -> list[ObservedJoint]:
    """Return the joints that the parameters name; those with the same design share estimators.

    Raises:
        DesignFileError: A design file is missing or malformed, or the method cannot run it.
        CertificateError: A design's certificate does not hold.
    """
    shipped = str(config_path(SHIPPED_DESIGN))
    paths = {joint: path or shipped for joint, path in parameters.design_of.items()}
    loaded = {path: load_design_file(path) for path in dict.fromkeys(paths.values())}
    estimators = {}
    for path, each in loaded.items():
        with naming(path):
            estimators[path] = make_estimator(each.design, parameters.settings)
    return [
        ObservedJoint(joint, loaded[path], estimators[path], parameters, source)
        for joint, path in paths.items()
    ]
