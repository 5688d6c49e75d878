# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observers that can be run on a design, by name, and the trackers that run them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from tsobs_ros.checks import check_each, non_negative, shown
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import ModelError, ParameterError
from tsobs_ros.estimation import baselines
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.events import STALE_AFTER
from tsobs_ros.estimation.options import TORQUE_RATE, GainMode, SupervisionOptions
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper.observer import (
    PAPER_WARNING,
    SYSTEM_WARNING,
    paper_observer,
    paper_system_observer,
)
from tsobs_ros.yaml_files import read_yaml

METHODS = {
    "certified": "the design's observer: certified gain, supervised, learning what is uncertain",
    "ekf_plain": "extended Kalman filter of an arm, of the same model, disturbance and noise",
    "ekf": "the same with a gate for outliers",
    "ekf_augmented": "the same with the parameters that the design calls uncertain as states",
    "high_gain": "proportional observer of an arm: takes the disturbance for motion",
    "proportional_integral": "with an integral besides: takes the disturbance for motion",
    "paper": "the published method's observer, for T-S systems and the arm of its Example 3",
}
"""The methods by name, each with what to know about it."""

EKFS = ("ekf", "ekf_augmented")
"""The rivals of a report: EKFs that leave outliers out."""

FILTERS = ("ekf_plain", *EKFS)
"""All EKFs."""

CONTENDERS: Mapping[str, Mapping[str, Any]] = {
    "certified": {"method": "certified"},
    "certified_fixed": {"method": "certified", "adapt": False},
    **{name: {"method": name} for name in METHODS if name != "certified"},
}
"""What is compared, settings by name; `certified_fixed` does not learn."""

RANGES = {
    "theta": (0.1, 100.0),
    "settle_time": (0.0, 600.0),
    "torque_rate": (0.0, 1e6),
    "history": (0.0, 60.0),
    "future_tolerance": (0.0, 60.0),
    "stale_after": (0.01, 600.0),
}
"""Least and largest values of settings, with which no estimate takes for ever."""

_LINK_ANGLE = ("link_angle",)
_ARMS_ONLY = ("ekf_plain", "ekf_augmented", "high_gain", "proportional_integral")


@dataclass(frozen=True)
class ObserverSettings:
    """How an observer is run; the defaults are those of the node.

    Attributes:
        method: A name of `METHODS`.
        theta: Speed of high_gain and proportional_integral [rad/s].
        gain_mode: Gain of the certified observer once it has settled.
        settle_time: Least time with Riccati gains after a start [s].
        torque_rate: 1σ of the rate at which the torque may move in a gap [N m/s]; 0: it is held.
        torque_limit: Largest plausible torque [N m]; 0: the design's.
        torque_rate_limit: Its largest plausible rate [N m/s]; 0: the design's.
        adapt: Whether to learn the parameters that the design calls uncertain.
        history: How late a measurement may come [s].
        future_tolerance: How far ahead of the clock a stamp may lie [s].
        stale_after: Age of the newest measurement from which nothing is estimated, and after
            which the next one restarts [s].
        assume_zero_torque: Take measurements without effort as torque 0.
        supervision: Which samples are not used.

    Raises:
        ModelError: There is no such method.
    """

    method: str = "certified"
    theta: float = 2.5
    gain_mode: GainMode = GainMode.CERTIFIED
    settle_time: float = 5.0
    torque_rate: float = TORQUE_RATE
    torque_limit: float = 0.0
    torque_rate_limit: float = 0.0
    adapt: bool = True
    history: float = 0.5
    future_tolerance: float = 0.1
    stale_after: float = STALE_AFTER
    assume_zero_torque: bool = False
    supervision: SupervisionOptions = field(default_factory=SupervisionOptions)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ModelError(f"method: expected one of {', '.join(METHODS)}, got {self.method!r}")
        check_each(non_negative, self, "torque_limit", "torque_rate_limit")
        for name, (least, most) in RANGES.items():
            if not least <= (value := getattr(self, name)) <= most:
                raise ModelError(f"{name}: expected {least:g} to {most:g}, got {shown(value)}")

    def learnt(self, design: Design) -> tuple[str, ...]:
        """Return the names of the design's parameters that are learnt."""
        learns = self.method == "ekf_augmented" or (self.method == "certified" and self.adapt)
        return design.request.uncertainty_model.names if learns else ()

    def as_parameters(self) -> dict[str, bool | int | float | str]:
        """Return the settings as `with_parameters` takes them, by `SETTING_NAMES`."""
        values: dict[str, bool | int | float | str] = {}
        for name in SETTING_NAMES:
            short = name.removeprefix(_SUPERVISION)
            value = getattr(self if short == name else self.supervision, short)
            values[name] = value.value if isinstance(value, GainMode) else value
        return values

    def with_parameters(self, values: Mapping[str, Any]) -> "ObserverSettings":
        """Return the settings with some of them changed.

        Args:
            values: By the node's parameter names, `SETTING_NAMES`; text is converted.

        Raises:
            ParameterError: There is no such parameter, or the value is not of its type.
            ModelError: The value is out of range.
        """
        own: dict[str, Any] = {}
        supervision: dict[str, Any] = {}
        for name, value in values.items():
            if name not in SETTING_NAMES:
                known = ", ".join(SETTING_NAMES)
                raise ParameterError(f"parameter '{name}' decides no estimate; {known} do")
            short = name.removeprefix(_SUPERVISION)
            group, record = (own, self) if short == name else (supervision, self.supervision)
            group[short] = _converted(name, value, getattr(record, short))
        return replace(self, supervision=replace(self.supervision, **supervision), **own)


_SUPERVISION = "supervision."
SETTING_NAMES = (
    *(field.name for field in fields(ObserverSettings) if field.name != "supervision"),
    *(_SUPERVISION + field.name for field in fields(SupervisionOptions)),
)
"""The node's parameters that decide estimates."""


def read_parameters(path: Path, node: str = "observer") -> dict[str, Any]:
    """Return a node's parameters from a parameter file, by their full names.

    Args:
        path: A file as for `--params-file` of a node.
        node: The node's name; sections for all nodes, `/**`, count too.

    Raises:
        ParameterError: The file is missing, no YAML, or has no parameters of the node.
    """
    found: dict[str, Any] = {}
    sections = read_yaml(path, "parameter file", ParameterError)
    for name, section in sections.items():
        if str(name).rpartition("/")[2] in (node, "**", "*") and isinstance(section, dict):
            found |= _flat(section.get("ros__parameters"))
    if not found:
        has = ", ".join(map(str, sections)) or "none"
        raise ParameterError(f"{path}: no ros__parameters of {node}; sections: {has}")
    return found


def _flat(section: Any, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in section.items() if isinstance(section, dict) else ():
        inner = isinstance(value, dict)
        flat |= _flat(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value}
    return flat


def _converted(name: str, value: Any, before: Any) -> Any:
    """Return a value, or its text, in the type that the parameter has now."""
    text = str(value).strip()
    try:
        if isinstance(before, bool):
            return {"true": True, "false": False}[text.lower()]
        return type(before)(text)
    except (KeyError, ValueError) as error:
        such = before.value if isinstance(before, GainMode) else before
        raise ParameterError(
            f"parameter '{name}': expected a value such as {shown(such)}, got {shown(value)}"
        ) from error


def contender(settings: ObserverSettings, name: str) -> ObserverSettings:
    """Return settings with those of a name of `CONTENDERS`.

    Raises:
        ModelError: There is no such name.
    """
    if name not in CONTENDERS:
        raise ModelError(f"method: expected one of {', '.join(CONTENDERS)}, got {name!r}")
    return replace(settings, **CONTENDERS[name])


def warning(design: Design, method: str) -> str:
    """Return what a user of a method on a design is warned of, empty if there is nothing."""
    if method == "paper":
        return PAPER_WARNING if isinstance(design.request, ArmRequest) else SYSTEM_WARNING
    if method == "certified" or method in FILTERS:
        return ""
    return (
        f"method {method}: takes any disturbance of the sensor for motion of the arm; no bound is "
        "published"
    )


def make_estimator(design: Design, settings: ObserverSettings) -> Estimator:
    """Return the observer that the settings name, for the model of a design.

    The EKF of a T–S system leaves no sample out.

    Raises:
        ModelError: The method cannot observe this model.
    """
    request, method = design.request, settings.method
    is_arm = isinstance(request, ArmRequest)
    if not is_arm:
        _require_any_model(method)
    if method in FILTERS:
        gate = baselines.GATE if is_arm and method != "ekf_plain" else math.inf
        return _extended_kalman(request, learns=method == "ekf_augmented", gate=gate)
    if not isinstance(request, ArmRequest):
        if method == "paper":
            return paper_system_observer(request)
        return _certified(design, settings, None)
    estimator = _make_arm_estimator(design, settings)
    limits = request.torque_limits(settings.torque_limit, settings.torque_rate_limit)
    estimator.limit_torque(limits)
    return estimator


def _require_any_model(method: str) -> None:
    if method in _ARMS_ONLY:
        others = ", ".join(each for each in METHODS if each not in _ARMS_ONLY)
        raise ModelError(
            f"method {method}: expected a design for an arm, got one for a T-S system, which can "
            f"be observed by {others}"
        )


def _certified(design: Design, settings: ObserverSettings, torque_rate: float | None) -> Estimator:
    return design.supervised(
        settings.settle_time,
        settings.gain_mode,
        settings.adapt,
        torque_rate,
        settings.supervision,
    )


def _make_arm_estimator(design: Design, settings: ObserverSettings) -> Estimator:
    request = design.arm_request
    if settings.method == "certified":
        return _certified(design, settings, settings.torque_rate)
    if request.output_names != _LINK_ANGLE:
        raise ModelError(
            f"method {settings.method}: expected a design with the link angle as its only output, "
            f"got {', '.join(request.output_names)}"
        )
    common = (request.period, request.sensors[0].measurement_std)
    match settings.method:
        case "high_gain":
            return baselines.high_gain(request.arm, settings.theta, *common)
        case "proportional_integral":
            return baselines.proportional_integral(request.arm, settings.theta, *common)
        case _:
            return paper_observer(request.arm, *common)


def make_tracker(
    design: Design,
    settings: ObserverSettings | None = None,
    estimator: Estimator | None = None,
) -> Tracker:
    """Return a tracker: stamped measurements in any order in, estimates at any stamp out.

    Args:
        design: The design.
        settings: Method, gates and timeouts; the node's defaults if None.
        estimator: The observer, if it is made already: joints with the same design share it.

    Raises:
        ModelError: The method cannot observe this model, or a time is negative.

    >>> import numpy as np
    >>> import tsobs_ros as ts
    >>> tracker = ts.make_tracker(ts.load_design())
    >>> for stamp in range(5_000_000, 1_000_000_000, 5_000_000):  # ns
    ...     measurement = ts.Measurement(stamp, y=np.array([0.3]), u=np.array([0.0]))
    ...     outcome = tracker.offer(measurement, now=stamp)
    >>> tracker.estimate(stamp).state.shape
    (4,)
    """
    settings = settings or ObserverSettings()
    return Tracker(estimator or make_estimator(design, settings), _limits(design, settings))


def make_ekf(
    design: Design,
    settings: ObserverSettings | None = None,
    *,
    arm: ElasticJointArm | None = None,
    learns: bool = False,
    gate: float = baselines.GATE,
) -> Tracker:
    """Return a tracker with the EKF of a design: with its disturbance model, noise and start.

    Args:
        design: The design.
        settings: Timeouts; the node's defaults if None.
        arm: The arm that it takes for the true one; the design's if None.
        learns: Whether the parameters that the design calls uncertain are states.
        gate: Sigmas of an innovation beyond which a sample is left out; infinite: none is.

    Raises:
        ModelError: The design calls nothing uncertain that is to be a state, or an arm is given for
            one that is not for an arm.
    """
    request = design.request if arm is None else replace(design.arm_request, arm=arm)
    estimator = _extended_kalman(request, learns=learns, gate=gate)
    return make_tracker(design, settings, estimator)


def _extended_kalman(request: ArmRequest | TSRequest, *, learns: bool, gate: float) -> Estimator:
    uncertainty = request.uncertainty_model if learns else None
    if uncertainty is not None and not uncertainty.count:
        raise ModelError("method ekf_augmented: the design calls no parameter uncertain")
    covariances = (request.measurement_covariance, request.initial_covariance)
    return baselines.extended_kalman(request.flow, *covariances, uncertainty, gate=gate)


def _limits(design: Design, settings: ObserverSettings) -> TrackerOptions:
    request = design.request
    return TrackerOptions(
        x_max=request.max_angle if isinstance(request, ArmRequest) else math.inf,
        history=settings.history,
        future_tolerance=settings.future_tolerance,
        restart_after=settings.stale_after,
    )
