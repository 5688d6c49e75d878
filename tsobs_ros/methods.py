# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observers that can be run on a design, by name, and trackers that run them, here and in C."""

import math
import sys
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from tsobs_ros.checks import expect
from tsobs_ros.core import native
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.estimator import GAIN_MODES, Estimator, SupervisionOptions
from tsobs_ros.estimation.events import STALE_AFTER
from tsobs_ros.estimation.tracker import Tracker, require_steps
from tsobs_ros.files import write_whole
from tsobs_ros.paper.observer import (
    PAPER_WARNING,
    SYSTEM_WARNING,
    paper_observer,
    paper_system_observer,
)
from tsobs_ros.settings import check, setting
from tsobs_ros.yaml_files import read_yaml

METHODS = {
    "certified": "the design's observer: certified gain, supervised, learning what is uncertain",
    "certified_fixed": "the same without learning",
    "ekf_plain": "extended Kalman filter of an arm, of the same model, disturbance and noise",
    "ekf": "the same with a gate for outliers",
    "ekf_augmented": "the same with the parameters that the design calls uncertain as states",
    "high_gain": "proportional observer of an arm: takes the disturbance for motion",
    "proportional_integral": "the same with an integral: takes the disturbance for motion",
    "paper": "the published method's observer, for T-S systems and the arm of its Example 3",
}
"""The methods by name, each with a description."""

EKFS = ("ekf", "ekf_augmented")
"""The EKFs in comparisons of a report: they leave outliers out."""

FILTERS = ("ekf_plain", *EKFS)
"""All EKFs."""

CERTIFIED = ("certified", "certified_fixed")
"""The design's observer, with and without learning."""

_ARMS_ONLY = ("ekf_plain", "ekf_augmented", "high_gain", "proportional_integral")


@dataclass(frozen=True)
class ObserverSettings:
    """Settings of an observer, live and offline: everything that determines its numbers.

    The observer's `--help` and the reference of its parameters describe each of them.

    Raises:
        ParameterError: A value is out of range, or there is no such method.
    """

    method: str = setting(
        "certified",
        "Observer to run: the certified one, or one to compare with",
        choices=tuple(METHODS),
    )
    theta: float = setting(
        2.5,
        "Speed of the high_gain and proportional_integral observers",
        unit="rad/s",
        minimum=0.1,
        maximum=100.0,
    )
    gain_mode: str = setting(
        "certified",
        "Gain once settled: the constant certified one, or the Riccati gain throughout",
        choices=GAIN_MODES,
    )
    settle_time: float = setting(
        5.0, "Least time with Riccati gains after a start", unit="s", minimum=0.0, maximum=600.0
    )
    torque_rate: float = setting(
        0.0,
        "1 sigma of the torque's rate in gaps; 0: a tenth of the arm's usual torque per second",
        unit="N m/s",
        minimum=0.0,
        maximum=1e6,
    )
    torque_limit: float = setting(
        0.0, "Largest plausible torque; 0: the design's", unit="N m", minimum=0.0
    )
    torque_rate_limit: float = setting(
        0.0, "Largest plausible rate of the torque; 0: the design's", unit="N m/s", minimum=0.0
    )
    adapt: bool = setting(True, "Learn the parameters that the design calls uncertain")
    history: float = setting(
        0.5, "How late a measurement may come and be used", unit="s", minimum=0.0, maximum=60.0
    )
    future_tolerance: float = setting(
        0.1, "How far ahead of the clock a stamp may lie", unit="s", minimum=0.0, maximum=60.0
    )
    stale_after: float = setting(
        STALE_AFTER,
        "Age of the newest measurement to stop publishing and restart",
        unit="s",
        minimum=1e-2,
        maximum=600.0,
    )
    assume_zero_torque: bool = setting(
        False, "Take measurements without effort as torque 0 instead of rejecting them"
    )
    supervision: SupervisionOptions = field(default_factory=SupervisionOptions)

    def __post_init__(self) -> None:
        check(self)

    def learnt(self, design: Design) -> tuple[str, ...]:
        """Return the names of the design's parameters that are learnt."""
        learns = self.method == "ekf_augmented" or (self.method == "certified" and self.adapt)
        return design.request.uncertainty_model.names if learns else ()


def read_parameters(path: Path, node: str = "observer") -> dict[str, Any]:
    """Return a node's parameters, by their full names, from a file as for its `--params-file`.

    Sections for all nodes, `/**`, count too.

    Raises:
        ParameterError: The file is missing, is not YAML, or has no parameters of the node.
    """
    sections = read_yaml(path, ParameterError)
    found = dict[str, Any]()
    for name, section in sections.items():
        if str(name).rpartition("/")[2] in (node, "**", "*") and isinstance(section, dict):
            found |= _flat(section.get("ros__parameters"))
    if not found:
        has = ", ".join(map(str, sections)) or "none"
        raise ParameterError(f"{path}: no ros__parameters of {node}; sections: {has}")
    return found


def _flat(section: Any, prefix: str = "") -> dict[str, Any]:
    found = dict[str, Any]()
    for name, value in section.items() if isinstance(section, dict) else ():
        is_group = isinstance(value, dict)
        found |= _flat(value, f"{prefix}{name}.") if is_group else {f"{prefix}{name}": value}
    return found


def warning(design: Design, method: str) -> str:
    """Return the warning to users of a method on a design, empty if there is none."""
    if method == "paper":
        return PAPER_WARNING if isinstance(design.request, ArmRequest) else SYSTEM_WARNING
    if method in (*CERTIFIED, *FILTERS):
        return ""
    return (
        f"method {method}: takes any disturbance of the sensor for motion of the arm; no bound is "
        "published"
    )


def make_estimator(design: Design, settings: ObserverSettings) -> Estimator:
    """Return the observer that the settings name, for the model of a design.

    The EKF of a T–S system has no gate for outliers.

    Raises:
        ModelError: The method cannot observe this model.
    """
    request, method = design.request, settings.method
    is_arm = isinstance(request, ArmRequest)
    if method in _ARMS_ONLY and not is_arm:
        others = ", ".join(each for each in METHODS if each not in _ARMS_ONLY)
        raise ModelError(
            f"method {method}: expected a design for an arm, got one for a T-S system, which can "
            f"be observed by {others}"
        )
    if method in FILTERS:
        uncertainty = request.uncertainty_model if method == "ekf_augmented" else None
        if uncertainty is not None and not uncertainty.count:
            raise ModelError("method ekf_augmented: the design calls no parameter uncertain")
        gate = baselines.GATE if is_arm and method != "ekf_plain" else math.inf
        covariances = (request.measurement_covariance, request.initial_covariance)
        return baselines.extended_kalman(request.flow, *covariances, uncertainty, gate=gate)
    if method in CERTIFIED:
        estimator = design.observer(
            settings.settle_time,
            settings.gain_mode,
            settings.torque_rate,
            adapt=bool(settings.learnt(design)),
            supervision=settings.supervision,
        )
    elif isinstance(request, TSRequest):
        return paper_system_observer(request)
    elif request.output_names != ("link_angle",):
        raise ModelError(
            f"method {method}: expected a design with the link angle as its only output, "
            f"got {', '.join(request.output_names)}"
        )
    else:
        known = (request.period, float(request.output_std[0]), request.torque)
        if method == "paper":
            estimator = paper_observer(request.arm, *known)
        else:
            integral = method == "proportional_integral"
            theta = settings.theta
            estimator = baselines.high_gain(request.arm, theta, *known, integral=integral)
    limits = settings.torque_limit, settings.torque_rate_limit
    estimator.limit_torque(request.torque_limits(*limits))
    return estimator


def given_or_default(settings: ObserverSettings | None) -> ObserverSettings:
    """Return settings, the node's defaults if None, or raise `ModelError` if they are none."""
    expect("settings", settings, ObserverSettings | None, "an ObserverSettings")
    return settings or ObserverSettings()


def make_tracker(
    design: Design, settings: ObserverSettings | None = None, estimator: Estimator | None = None
) -> Tracker:
    """Return a tracker: stamped measurements in any order in, estimates at any stamp out.

    Args:
        design: The design.
        settings: Method, gates and timeouts; the node's defaults if None.
        estimator: The observer if it exists already, as joints with the same design share one.

    Raises:
        ModelError: The method cannot observe this model, a time is negative, `stale_after` is not
            longer than the design's period, or an argument is of another type.

    >>> import numpy as np
    >>> import tsobs_ros as ts
    >>> tracker = ts.make_tracker(ts.load_design())
    >>> for stamp in range(5_000_000, 1_000_000_000, 5_000_000):  # ns
    ...     measurement = ts.Measurement(stamp, y=np.array([0.3]), u=np.array([0.0]))
    ...     outcome = tracker.offer(measurement, now=stamp)
    >>> tracker.estimate(stamp).state.shape
    (4,)
    """
    expect("design", design, Design, "a Design (of load_design or synthesise)")
    settings = given_or_default(settings)
    if settings.stale_after <= design.request.period:
        raise ModelError(
            f"stale_after: expected more than the design's period, {design.request.period:g} s, "
            f"got {settings.stale_after:g} s, with which every sample would restart the estimate"
        )
    return Tracker(
        estimator or make_estimator(design, settings),
        x_max=design.request.max_angle,
        history=settings.history,
        future_tolerance=settings.future_tolerance,
        restart_after=settings.stale_after,
    )


def export_c(
    design: Design,
    output: str | PathLike[str],
    settings: ObserverSettings | None = None,
    *,
    max_steps: int = 1024,
) -> tuple[int, int]:
    """Write a design's estimator into a file for C and C++ programs, as `tsobs export-c`.

    The file has all parts of a tracker: a header, the model record and the memory record of a new
    tracker, as little-endian words of 8 bytes. core/tsobs.h has the functions that open it.

    Args:
        design: From `load_design` or `synthesise`.
        output: The file, which is replaced.
        settings: Method, gates and timeouts; the node's defaults if None.
        max_steps: Most measurements that a late one can rewind, by default as many as in the node.
            Each takes the memory of a state.

    Returns:
        The size of the file and of the memory that a tracker needs in the program [bytes].

    Raises:
        ModelError: The method cannot observe this model, or `max_steps` is not between 1 and a
            million.
        OutputError: The file cannot be written.
    """
    require_steps(max_steps)
    tracker = make_tracker(design, settings)
    tracker.memory["max_steps"] = max_steps
    model = tracker.estimator.model.view(np.int64)
    words = np.concatenate([[0, 0, 0], model, tracker.memory.view(np.int64)])
    native.exported_seal(words)
    room = native.exported_open(words)
    if sys.byteorder == "big":
        words = words.byteswap()
    write_whole(output, words.tobytes())
    return words.nbytes, 8 * room
