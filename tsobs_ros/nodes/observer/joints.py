# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One joint of the observer node: its design, its tracker and its monitors."""

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.file import DesignFile, load_design_file
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.design.signals import signals
from tsobs_ros.estimation import health, records
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.events import Event, EventKind, EventLog
from tsobs_ros.estimation.faults import FaultMonitor
from tsobs_ros.estimation.health import Debounce, Level, Phase, Status
from tsobs_ros.estimation.records import REASONS, USED, Estimate, RejectReason
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import make_estimator, make_tracker
from tsobs_ros.nodes.observer.messages import NOT_NAMED
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import naming
from tsobs_ros.series import NANOSECONDS, Stamps

NAMES = tuple(reason.value if reason else "" for reason in REASONS)
"""Names of the reasons of rejection by their codes."""
OF_INPUT = (records.IMPLAUSIBLE_TORQUE, records.UNKNOWN_INPUT)
"""Of such a sample the outputs are used all the same."""

_ACCEPTED = (*records.CORRECTING, records.GATED)
# For how many seconds measurements must come at another rate before that is worth a word.
_LASTING = 3.0
# Stamps that make a median period.
_ENOUGH = 8
# Bounds beyond which a torque is no chance.
_SIGNIFICANT = 3.0


def main_of(counts: Counter[str]) -> str:
    """Return the reason of rejection with the most counts, "" if there are none."""
    most = max(NAMES[1:], key=counts.__getitem__)
    return most if counts[most] > 0 else ""


class TorqueWatch:
    """Watches the torque disturbance of one joint: how large it is, and if it is a contact.

    The link's is compared with the level, or the motor's if the design has no other. Statuses come
    once a second and a contact may be shorter, so the largest torque in between is kept.

    Args:
        sides: The sides whose torque is estimated, some of motor and link.

    Attributes:
        level: Size from which on it is a warning [N m]; 0: never. May be changed at any time.
        hold: How long it must be smaller before that is over [s]. May be changed at any time.
    """

    def __init__(self, sides: Sequence[str], level: float, hold: float) -> None:
        self.level, self.hold = level, hold
        self._sides = tuple(sides)
        # Values and 1σ bounds of each side [N m].
        self._latest: list[tuple[float, float]] = []
        self._largest: list[tuple[float, float]] = []
        self._beyond = Debounce(False)

    def update(self, estimate: Estimate) -> Status | None:
        """Take in an estimate; return what has changed, None if nothing has."""
        values, bounds = estimate.torque_disturbance, estimate.torque_disturbance_bound
        if not values.size:
            return None
        known = bounds.tolist() or [math.inf] * len(values)
        self._latest = list(zip(values.tolist(), known, strict=True))
        pairs = zip(self._largest or self._latest, self._latest, strict=True)
        self._largest = [max(pair, key=lambda torque: abs(torque[0])) for pair in pairs]
        was, beyond = self._beyond.value, self._is_beyond(self._latest[-1])
        if self._beyond.update(estimate.stamp, beyond, 0.0 if beyond else self.hold) == was:
            return None
        return self._judged(self._latest[-1], beyond=beyond)

    def statuses(self) -> list[Status]:
        """Return the torques, and the largest since the last time; nothing without sides."""
        if not self._sides:
            return []
        if not self._latest:
            return [Status("torque disturbance", Level.OK, "no estimate yet", {})]
        values = {"warn level [N m]": f"{self.level:g}"} if self.level else {}
        for side, latest, largest in zip(self._sides, self._latest, self._largest, strict=True):
            values[f"{side} [N m]"] = f"{latest[0]:.4g}"
            values[f"{side} bound [N m]"] = f"{latest[1]:.4g}"
            values[f"{side}, largest since the last status [N m]"] = f"{largest[0]:.4g}"
        torque, self._largest = self._largest[-1], self._latest
        beyond = self._beyond.value or self._is_beyond(torque)
        return [self._judged(torque, beyond=beyond)._replace(values=values)]

    def _is_beyond(self, torque: tuple[float, float]) -> bool:
        size, bound = abs(torque[0]), torque[1]
        return 0.0 < self.level <= size and size >= _SIGNIFICANT * bound

    def _judged(self, torque: tuple[float, float], *, beyond: bool) -> Status:
        text = f"{torque[0]:.3g} N m (1 sigma {torque[1]:.2g}) at the {self._sides[-1]}"
        if beyond:
            text += f", beyond {self.level:g} N m: a contact, a payload?"
        return Status("torque disturbance", Level.WARN if beyond else Level.OK, text, values={})


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
        signals: Places of its signals in messages.
        learnt: Names of the learnt parameters.
        tracker: Orders its measurements and estimates.
        received: Number of its samples since the start: used + rejected.
        latest: The latest estimate, None before the first.
        faults: Recognises the faults of its outputs.
        events: Finds changes of what its estimates are worth.
        torques: Watches its torque disturbance.
        method: Name of the method that estimates.
        recent: Counts over the last minute: `received`, the reasons of rejection and the
            estimator's events, by name.
        newly: The same since the counts before, a second or so.
        in_vain: Samples that were refused since one was accepted, by reason.
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
        request, settings = loaded.design.request, parameters.settings
        self.signals = signals(request, name, alone=len(parameters.joints) == 1)
        self.learnt = settings.learnt(loaded.design)
        self.tracker: Tracker = make_tracker(loaded.design, settings, estimator)
        self._sides = request.torque_sides if isinstance(request, ArmRequest) else ()
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
        self.in_vain = Counter[str]()
        self.measured_rate = math.nan
        self._stamps: list[int] = []
        self._pace = Debounce(0)
        self._newest = 0
        self.latest: Estimate | None = None
        limits = self._parameters.fault
        stds = np.sqrt(np.diag(self.loaded.design.request.measurement_covariance)).tolist()
        self.faults = FaultMonitor(stds, limits)
        self.torques = TorqueWatch(
            self._sides, self._parameters.torque_warn_of[self.name], limits.hold
        )

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
        return max(0, now - self._newest) / NANOSECONDS if self._newest else None

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
            codes: Those of `Batch`, shape (N,); of samples the outcomes are written, by `NAMES`.
            now: Time on the node's clock [ns].

        Returns:
            The innovations y − ŷ, NaN of an output that was not used, shape (N, p).
        """
        given = codes == USED
        innovations = np.full(y.shape, math.nan)
        for code, count in Counter(codes[~given].tolist()).items():
            if code != NOT_NAMED:
                self.tracker.reject(RejectReason(NAMES[code]), count)
        codes[given], innovations[given] = self._use(stamps[given], y[given], u[given], now)
        self.received += len(codes) - int(np.count_nonzero(codes == NOT_NAMED))
        outcomes = codes.tolist()
        accepted = [k for k, code in enumerate(outcomes) if code in _ACCEPTED]
        if accepted:
            self._newest = max(self._newest, int(stamps[accepted[-1]]))
            self.in_vain.clear()
            self._stamps += stamps[accepted].tolist()
        refused = outcomes[accepted[-1] + 1 :] if accepted else outcomes
        if refused:
            self.in_vain.update(NAMES[code] for code in refused if code != NOT_NAMED)
        return innovations

    def _use(self, stamps: Stamps, y: Array, u: Array, now: int) -> tuple[Stamps, Array]:
        """Return the outcomes of samples and their innovations."""
        codes, output_codes, innovations, std = self.tracker.offer_many(stamps, y, u, now)
        self.faults.measured(stamps, y, output_codes, innovations, std)
        # Of several outputs one may be missing from a sample that is used.
        innovations[output_codes != USED] = math.nan
        return codes, innovations

    def count(self, steady: int) -> None:
        """Enter the counts there are into those of the last minute.

        Args:
            steady: Time that neither stands still nor goes back [ns].
        """
        totals = {"received": self.received, **self.rejected, **self.tracker.events}
        self.newly = self.recent.update(steady, totals)

    def pace_news(self, steady: int) -> tuple[Level, str] | None:
        """Measure the rate of samples since the last call; return a change that has lasted.

        Args:
            steady: Time that neither stands still nor goes back [ns].
        """
        stamps, self._stamps = np.sort(self._stamps), []
        if len(stamps) < _ENOUGH:
            return None
        self.measured_rate = NANOSECONDS / max(1.0, float(np.median(np.diff(stamps))))
        before = self._pace.value
        off, text = health.judge_rate(self.measured_rate, self.loaded.design.request.rate)
        if self._pace.update(steady, off, _LASTING) == before:
            return None
        return Level.WARN if off else Level.OK, text

    @property
    def rejected(self) -> Counter[str]:
        """Number of samples not used, by reason."""
        return Counter({reason.value: n for reason, n in self.tracker.rejected.items()})

    def explained(self, event: Event) -> str:
        """Return an event's text, with the reason if nothing but refused samples came before it."""
        main = main_of(self.in_vain)
        if not main or event.kind is not EventKind.STATE or event.level is Level.OK:
            return event.text
        text = event.text.replace("no measurement", "no usable measurement")
        return (
            f"{text}; {self.in_vain.total()} came and all were rejected, most: {main}; "
            f"{RejectReason(main).remedy}"
        )

    def estimate(self, now: int, *, hold: bool) -> tuple[Estimate | None, Status | None]:
        """Return the estimate to publish, and a change of the torque that it shows, if any.

        Args:
            now: Time on the node's clock [ns].
            hold: Whether a stale joint keeps its latest estimate, without bounds.
        """
        if self.phase(now) in (Phase.WAITING, Phase.STALE):
            # To predict through a long silence would take long, and tell nothing.
            return self._held() if hold else None, None
        estimate = self.tracker.estimate(now)
        if estimate is None:
            return None, None
        self.latest = estimate
        if estimate.disturbance.size:
            self.faults.estimated(now, estimate.disturbance, estimate.disturbance_bound)
        return estimate, self.torques.update(estimate)

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

    Args:
        parameters: Of the node.
        source: Where their measurements come from, for events.

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
