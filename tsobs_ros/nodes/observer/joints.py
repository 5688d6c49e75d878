# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One joint of the observer node: its design, its tracker and what watches over both."""

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.errors import DesignFileError
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.faults import FaultMonitor
from tsobs_ros.estimation.health import DisturbanceLimits, InnovationMonitor, Phase, phase_of
from tsobs_ros.estimation.records import NANOSECONDS, Estimate, Innovation, Measurement
from tsobs_ros.estimation.supervised import SupervisedObserver
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import make_estimator, make_tracker
from tsobs_ros.nodes.observer.parameters import ObserverParameters
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

_IDENTITY_LENGTH = 12
_NOTHING = np.zeros(0)


class LoadedDesign(NamedTuple):
    """A design whose certificate holds, and where it comes from.

    Attributes:
        path: The file.
        identity: Beginning of the SHA-256 of its bytes, which `sha256sum` shows too.
        design: What it says.
    """

    path: Path
    identity: str
    design: Design


def load(path: str) -> LoadedDesign:
    """Read a design file, the shipped one if the path is empty, and re-check its certificate.

    Raises:
        DesignFileError: The design file is missing or malformed.
        CertificateError: The design's certificate does not hold.
    """
    file = Path(path) if path else config_path(SHIPPED_DESIGN)
    design = load_design(file)
    try:
        identity = hashlib.sha256(file.read_bytes()).hexdigest()[:_IDENTITY_LENGTH]
    except OSError as error:
        raise DesignFileError(f"{file}: {error.strerror}") from error
    return LoadedDesign(file, identity, design)


class ObservedJoint:
    """A joint with its tracker, monitors and counts.

    Attributes:
        name: The joint's name.
        loaded: Its design.
        learnt: Names of the parameters that are learnt.
        tracker: Puts its measurements in order and estimates.
        received: Number of its samples since the start: used + rejected.
        estimate: The last one, None before the first.
        innovations: Whether they are as large as the design expects.
        faults: Which fault its sensor has.
    """

    def __init__(
        self,
        name: str,
        loaded: LoadedDesign,
        estimator: Estimator[Any],
        parameters: ObserverParameters,
    ) -> None:
        self.name = name
        self.loaded = loaded
        settings = parameters.settings
        self.learnt = settings.learnt(loaded.design)
        self.tracker: Tracker[Any] = make_tracker(loaded.design, settings, estimator)
        self._limits = _limits(parameters)
        self._stale_after = round(parameters.stale_after * NANOSECONDS)
        self.reset()

    def reset(self) -> None:
        """Forget all that was computed from data, but for the tracker, which is not reset here."""
        self.received = 0
        self.estimate: Estimate | None = None
        self.innovations = InnovationMonitor()
        self.faults = FaultMonitor(self.loaded.design.request.measurement_std, self._limits)

    def retune(self, parameters: ObserverParameters) -> None:
        """Take over parameters that may be changed while it runs."""
        self._limits = self.faults.limits = _limits(parameters)
        if isinstance(self.tracker.estimator, SupervisedObserver):
            self.tracker.estimator.options = parameters.supervision.options()

    def age(self, now: int) -> float | None:
        """Return the age of the newest measurement in use [s], None before the first."""
        newest = self.tracker.newest
        return None if newest is None else max(0, now - newest) / NANOSECONDS

    def fresh(self, now: int) -> bool:
        """Return whether it is TRACKING or COASTING."""
        newest = self.tracker.newest
        return newest is not None and now - newest <= self._stale_after

    def phase(self, now: int, parameters: ObserverParameters) -> Phase:
        """Return how fresh its measurements are."""
        return phase_of(self.age(now), parameters.coast_after, parameters.stale_after)

    def used(self, sample: Measurement, innovation: Innovation) -> None:
        """Take in a sample that was used."""
        value, expected_std = float(innovation.value[0]), float(innovation.expected_std[0])
        self.innovations.update(innovation.stamp, value / expected_std)
        self.faults.measured(innovation.stamp, float(sample.y[0]), value, expected_std)

    def gated(self, sample: Measurement) -> None:
        """Take in a sample that the estimator did not believe."""
        self.faults.unused(sample.stamp, float(sample.y[0]))

    def estimated(self, estimate: Estimate) -> None:
        """Take in a new estimate."""
        self.estimate = estimate
        if estimate.disturbance.size:
            bound = estimate.disturbance_bound
            self.faults.estimated(
                estimate.stamp,
                float(estimate.disturbance[0]),
                float(bound[0]) if bound.size else math.inf,
            )

    def held(self) -> Estimate | None:
        """Return the last estimate without its bounds, none of which holds for ever."""
        return self.estimate and self.estimate._replace(
            state_bound=_NOTHING, disturbance_bound=_NOTHING, parameters_valid=False
        )


def observed_joints(parameters: ObserverParameters) -> list[ObservedJoint]:
    """Return the joints that the parameters name; those with the same design share estimators.

    Raises:
        DesignFileError: A design file is missing or malformed.
        CertificateError: A design's certificate does not hold.
    """
    paths = parameters.design_of
    loaded = {path: load(path) for path in dict.fromkeys(paths.values())}
    estimators = {
        path: make_estimator(each.design, parameters.settings) for path, each in loaded.items()
    }
    return [
        ObservedJoint(joint, loaded[path], estimators[path], parameters)
        for joint, path in paths.items()
    ]


def _limits(parameters: ObserverParameters) -> DisturbanceLimits:
    fault = parameters.fault
    return DisturbanceLimits(fault.warn, fault.error, fault.hold)
