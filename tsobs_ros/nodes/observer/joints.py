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
from tsobs_ros.design.signals import Place, signals
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.events import Event, EventKind, EventLog
from tsobs_ros.estimation.faults import (
    FaultKind,
    FaultMonitor,
    add_estimates,
    add_samples,
    new_watches,
)
from tsobs_ros.estimation.health import Debounce, LastMinute, Level, Phase, Status, phase_of
from tsobs_ros.estimation.history import CORRECTING, GATED, REASONS, USED
from tsobs_ros.estimation.records import (
    Estimate,
)
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import make_estimator, make_tracker
from tsobs_ros.nodes.observer.io import Stamps
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.nodes.observer.rejections import (
    ADVICE,
    NAMES,
    main_of,
)
from tsobs_ros.nodes.observer.torques import TorqueWatch
from tsobs_ros.resources import SHIPPED_DESIGN, config_path
from tsobs_ros.schema import naming
from tsobs_ros.series import NANOSECONDS

_NOTHING = np.zeros(0)
_ACCEPTED = (*CORRECTING, GATED)
# Distances of measurements in periods of the design that are worth a word, and for how many seconds
# they must last. Beyond the one the estimate may never settle below the certified bound; below the
# other much is wasted.
_FAR, _NEAR = 1.02, 0.7
_LASTING = 3.0
# Stamps that make a median period.
_ENOUGH = 8


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
        faults: Recognise the faults of its outputs, one each.
        events: Finds changes of what its estimates are worth.
        torques: Watches its torque disturbance.
        torque_news: What changed of that with the latest estimate, None if nothing did.
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
        settings = parameters.settings
        self.signals = signals(loaded.design.request, name, alone=len(parameters.joints) == 1)
        self.learnt = settings.learnt(loaded.design)
        self.tracker: Tracker = make_tracker(loaded.design, settings, estimator)
        self._limits, self._torque_warn = parameters.fault, parameters.torque_warn_of[name]
        self._coast_after, self._stale_after = parameters.coast_after, parameters.stale_after
        self.events = EventLog(source, self._coast_after, self._stale_after)
        self.reset()

    def reset(self) -> None:
        """Forget everything that was computed from data."""
        self.tracker.reset()
        self.events.restart()
        self.received = 0
        self.recent = LastMinute()
        self.newly, self._totals = Counter[str](), Counter[str]()
        self.in_vain = Counter[str]()
        self.measured_rate = math.nan
        self._stamps: list[int] = []
        self._pace = Debounce(0)
        self._newest = 0
        self.latest: Estimate | None = None
        request = self.loaded.design.request
        stds = np.sqrt(np.diag(request.measurement_covariance)).tolist()
        self.watches, self._open = new_watches(stds), np.full(len(stds), math.inf)
        self.faults = tuple(
            FaultMonitor(std, self._limits, self.watches[place : place + 1], unit)
            for place, (std, unit) in enumerate(zip(stds, self.signals.units, strict=True))
        )
        self.torques = TorqueWatch(
            request.torque_sides if isinstance(request, ArmRequest) else (),
            self._torque_warn,
            self._limits.hold,
        )
        self.torque_news: Status | None = None
        self._known_missing: set[str] = set()

    def retune(self, parameters: ObserverParameters) -> None:
        """Take over parameters that were changed while the node runs."""
        self._coast_after = self.events.coast_after = parameters.coast_after
        self._limits, self._torque_warn = parameters.fault, parameters.torque_warn_of[self.name]
        self.torques.level, self.torques.hold = self._torque_warn, self._limits.hold
        for monitor in self.faults:
            monitor.limits = self._limits
        if self.tracker.estimator.supervised:
            self.tracker.estimator.supervise(parameters.supervision)

    def age(self, now: int) -> float | None:
        """Return the age of the newest measurement in use [s], None before the first."""
        return max(0, now - self._newest) / NANOSECONDS if self._newest else None

    def phase(self, now: int) -> Phase:
        """Return how fresh its measurements are."""
        return phase_of(self.age(now), self._coast_after, self._stale_after)

    def offer(self, stamps: Stamps, y: Array, u: Array, now: int) -> tuple[list[int], Array]:
        """Use samples, N of them.

        Args:
            stamps: In ascending order [ns], shape (N,).
            y: Measured outputs, NaN of those that are missing, shape (N, p).
            u: Inputs, shape (N, m).
            now: Time on the node's clock [ns].

        Returns:
            Outcomes by the codes of `rejections.NAMES`, and the innovations y − ŷ, NaN of an output
            that was not used, shape (N, p).
        """
        self.received += len(stamps)
        codes = np.zeros(len(stamps), np.int64)
        output_codes = np.zeros(y.shape, np.int64)
        innovations, expected_std = np.empty((2, *y.shape))
        self.tracker.history.offer(
            stamps, y, u, now, codes, output_codes, innovations, expected_std
        )
        # A column of one and a row of one are the same numbers.
        by_output = [
            np.ascontiguousarray(each.T) for each in (y, output_codes, innovations, expected_std)
        ]
        add_samples(self.watches, stamps, *by_output)
        outcomes: list[int] = codes.tolist()
        accepted = [k for k, code in enumerate(outcomes) if code in _ACCEPTED]
        if accepted:
            self._newest = max(self._newest, int(stamps[accepted[-1]]))
            self.in_vain.clear()
            self._stamps += [int(stamps[k]) for k in accepted]
        self._note_in_vain(outcomes[accepted[-1] + 1 :] if accepted else outcomes)
        # Of several outputs one may be missing from a sample that is used.
        if any(outcomes) or y.shape[1] > 1:
            innovations[output_codes != USED] = math.nan
        return outcomes, innovations

    def missing(self, since: int) -> list[tuple[str, Place]]:
        """Return the outputs missing since a stamp [ns] or before, each only once, and places."""
        found = []
        for output, place, monitor in zip(
            self.loaded.design.request.output_names, self.signals.outputs, self.faults, strict=True
        ):
            fault = monitor.fault
            if fault.kind is not FaultKind.MISSING or fault.since is None:
                self._known_missing.discard(output)
            elif fault.since <= since and output not in self._known_missing:
                self._known_missing.add(output)
                found.append((output, place))
        return found

    def count(self, steady: int) -> None:
        """Enter the counts there are into those of the last minute.

        Args:
            steady: Time that neither stands still nor goes back [ns].
        """
        totals = Counter({"received": self.received, **self.rejected, **self.tracker.events})
        self.newly, self._totals = totals - self._totals, totals
        self.recent.update(steady, totals)

    def pace_news(self, steady: int) -> tuple[Level, str] | None:
        """Measure the rate of samples since the last call; return a change that has lasted.

        Args:
            steady: Time that neither stands still nor goes back [ns].
        """
        stamps, self._stamps = np.sort(self._stamps), []
        if len(stamps) < _ENOUGH:
            return None
        self.measured_rate = NANOSECONDS / max(1.0, float(np.median(np.diff(stamps))))
        wanted, before = self.loaded.design.request.rate, self._pace.value
        periods = wanted / self.measured_rate
        now = self._pace.update(steady, int(periods > _FAR) - int(periods < _NEAR), _LASTING)
        if now == before:
            return None
        text = f"measurements come at {_digits(self.measured_rate)} Hz, the design"
        if not now:
            return Level.OK, f"{text} is for that"
        what = "the bound may never be certified" if now > 0 else "no narrower bound comes of it"
        return Level.WARN, (
            f"{text} is for {wanted:g} Hz: {what}; set `rate` of its request to what comes and "
            "design again, or let the driver send as often as it says"
        )

    @property
    def rejected(self) -> Counter[str]:
        """Number of samples not used, by reason."""
        return Counter({reason.value: n for reason, n in self.tracker.rejected.items()})

    def reject(self, codes: Sequence[int]) -> None:
        """Count samples that cannot be read, by the codes of the reasons."""
        self.received += len(codes)
        for code, count in Counter(codes).items():
            reason = REASONS[code]
            assert reason is not None
            self.tracker.reject(reason, count)
        self._note_in_vain(codes)

    def explained(self, event: Event) -> str:
        """Return an event's text, with the reason if nothing but refused samples came before it."""
        main = main_of(self.in_vain)
        if not main or event.kind is not EventKind.STATE or event.level is Level.OK:
            return event.text
        text = event.text.replace("no measurement", "no usable measurement")
        return (
            f"{text}; {self.in_vain.total()} came and all were rejected, most: {main}; "
            f"{ADVICE[main]}"
        )

    def _note_in_vain(self, codes: Sequence[int]) -> None:
        if codes:
            self.in_vain.update(NAMES[code] for code in codes)

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
            self.torque_news = self.torques.update(estimate)
            disturbance = estimate.disturbance
            if disturbance.size:
                bound = estimate.disturbance_bound
                if not bound.size:
                    bound = self._open
                if add_estimates(self.watches, now, disturbance, bound):
                    for monitor, *each in zip(
                        self.faults, disturbance.tolist(), bound.tolist(), strict=True
                    ):
                        monitor.judge(*each)
        return estimate

    def _held(self) -> Estimate | None:
        return self.latest and self.latest._replace(
            state_bound=_NOTHING,
            disturbance_bound=_NOTHING,
            torque_disturbance_bound=_NOTHING,
            parameters_valid=False,
        )


def _digits(rate: float) -> str:
    return f"{rate:.3g}" if rate < 1000.0 else f"{rate:.0f}"


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
