# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node's ROS parameters."""

import math
from dataclasses import dataclass

from tsobs_ros.errors import ParameterError
from tsobs_ros.estimation.events import COAST_AFTER, STALE_AFTER
from tsobs_ros.estimation.health import DisturbanceLimits
from tsobs_ros.estimation.options import (
    TORQUE_RATE,
    GainMode,
    SupervisionOptions,
)
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.nodes.managed import ManagedParameters
from tsobs_ros.nodes.parameters import design_paths, fixed_parameter, parameter, parameter_group


@dataclass(frozen=True)
class ObserverParameters(ManagedParameters):
    """All parameters of the observer node."""

    joints: tuple[str, ...] = fixed_parameter(
        ("elastic_joint",), "Names of the joints in joint_measurements"
    )
    design: str = fixed_parameter("", "Path of the design file; empty for the one that is shipped")
    joint_designs: tuple[str, ...] = fixed_parameter(
        (),
        "Design file of each of the joints, empty for the one that `design` names; no list: "
        "that one for all",
    )
    method: str = fixed_parameter(
        "certified",
        "Observer to run: the certified one, or one to compare with, which publishes no bound",
        choices=("certified", "paper", "high_gain", "proportional_integral"),
    )
    theta: float = fixed_parameter(
        2.5,
        "Speed of the high_gain and proportional_integral observers",
        unit="rad/s",
        minimum=0.1,
        maximum=100.0,
    )
    rate: float = fixed_parameter(
        0.0,
        "Rate at which estimates are published; 0: the design's",
        unit="Hz",
        minimum=0.0,
        maximum=2000.0,
    )
    publish_on: str = fixed_parameter(
        "tick",
        "When estimates are published: at `rate`; or whenever measurements come, and at `rate` "
        "as long as none do",
        choices=("tick", "measurement"),
    )
    gain_mode: str = fixed_parameter(
        "certified",
        "Gain once settled: the constant certified one, or the Riccati gain throughout",
        choices=("certified", "riccati"),
    )
    settle_time: float = fixed_parameter(
        5.0, "Least time with Riccati gains after a start", unit="s", minimum=0.0, maximum=600.0
    )
    torque_rate: float = fixed_parameter(
        TORQUE_RATE,
        "1 sigma of the torque's rate while no measurement comes; 0: the last torque holds",
        unit="N m/s",
        minimum=0.0,
        maximum=1e6,
    )
    torque_limit: float = fixed_parameter(
        0.0, "Largest plausible torque; 0: the design's", unit="N m", minimum=0.0
    )
    torque_rate_limit: float = fixed_parameter(
        0.0, "Largest plausible rate of the torque; 0: the design's", unit="N m/s", minimum=0.0
    )
    adapt: bool = fixed_parameter(True, "Learn the parameters that the design calls uncertain")
    history: float = fixed_parameter(
        0.5, "How late a measurement may come and be used", unit="s", minimum=0.0, maximum=60.0
    )
    future_tolerance: float = fixed_parameter(
        0.1, "How far ahead of the clock a stamp may lie", unit="s", minimum=0.0, maximum=60.0
    )
    assume_zero_torque: bool = fixed_parameter(
        False, "Take measurements without effort as torque 0 instead of rejecting them"
    )
    coast_after: float = parameter(
        COAST_AFTER,
        "Age of the newest measurement for COASTING",
        unit="s",
        minimum=1e-3,
        maximum=60.0,
    )
    stale_after: float = fixed_parameter(
        STALE_AFTER,
        "Age of the newest measurement to stop publishing and restart",
        unit="s",
        minimum=1e-2,
        maximum=600.0,
    )
    reset_on_backward_jump: bool = parameter(
        True, "Restart when the clock goes back; else nothing is published until it has caught up"
    )
    when_stale: str = parameter(
        "silent",
        "What is published of a joint that is STALE: nothing, or its last estimate without bounds",
        choices=("silent", "hold"),
    )
    fault: DisturbanceLimits = parameter_group(
        DisturbanceLimits,
        warn=parameter(
            0.2, "Disturbance magnitude for a warning", unit="rad", minimum=1e-6, maximum=10.0
        ),
        error=parameter(
            0.5, "Disturbance magnitude for an error", unit="rad", minimum=1e-6, maximum=10.0
        ),
        hold=parameter(
            0.5, "Time a level must last to be reported", unit="s", minimum=0.0, maximum=60.0
        ),
    )
    torque_warn: tuple[float, ...] = parameter(
        (),
        "Torque disturbance from which on each joint's is a warning, 0 for never; a single number: "
        "of all joints; none: never",
        unit="N m",
        minimum=0.0,
        maximum=1e6,
    )
    supervision: SupervisionOptions = parameter_group(
        SupervisionOptions,
        gate=parameter(
            5.0,
            "Innovations as unlikely as beyond so many sigma are outliers, not used",
            minimum=1.0,
            maximum=1e3,
        ),
        stuck_samples=parameter(
            20, "Signs of a stuck sensor from which samples are not used; 0: never", minimum=0
        ),
        disturbance_limit=parameter(
            math.pi, "Largest disturbance estimated", unit="rad", minimum=1e-3, maximum=100.0
        ),
    )

    def __post_init__(self) -> None:
        if self.coast_after > self.stale_after:
            raise ParameterError(
                f"coast_after: expected at most stale_after = {self.stale_after}, "
                f"got {self.coast_after}"
            )
        _ = self.design_of
        if len(self.torque_warn) not in (0, 1, len(self.joints)):
            raise ParameterError(
                f"torque_warn: expected a number for each of the {len(self.joints)} joints, a "
                f"single one or none, got {len(self.torque_warn)}"
            )

    @property
    def torque_warn_of(self) -> dict[str, float]:
        """Torque disturbance for a warning of each joint [N m], 0 for never."""
        levels = self.torque_warn or (0.0,)
        if len(levels) == 1:
            levels *= len(self.joints)
        return dict(zip(self.joints, levels, strict=True))

    @property
    def design_of(self) -> dict[str, str]:
        """Path of each joint's design file, empty for the one that is shipped."""
        return design_paths(self.joints, self.joint_designs, self.design)

    @property
    def settings(self) -> ObserverSettings:
        """The parameters that decide numbers, which live and offline runs have in common."""
        return ObserverSettings(
            method=self.method,
            theta=self.theta,
            gain_mode=GainMode(self.gain_mode),
            settle_time=self.settle_time,
            torque_rate=self.torque_rate,
            torque_limit=self.torque_limit,
            torque_rate_limit=self.torque_rate_limit,
            adapt=self.adapt,
            history=self.history,
            future_tolerance=self.future_tolerance,
            stale_after=self.stale_after,
            assume_zero_torque=self.assume_zero_torque,
            supervision=self.supervision,
        )
