# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node's ROS parameters."""

from dataclasses import asdict, dataclass

from tsobs_ros.errors import ParameterError
from tsobs_ros.estimation.observer import TORQUE_RATE, GainMode
from tsobs_ros.estimation.supervised import SupervisionOptions
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.nodes.managed import ManagedParameters
from tsobs_ros.nodes.parameters import parameter, parameter_group


@dataclass(frozen=True)
class FaultParameters:
    """When the estimated disturbance is reported as a fault."""

    warn: float = parameter(
        0.2, "Disturbance magnitude that is a warning", unit="rad", minimum=1e-6, maximum=10.0
    )
    error: float = parameter(
        0.5, "Disturbance magnitude that is an error", unit="rad", minimum=1e-6, maximum=10.0
    )
    hold: float = parameter(
        0.5,
        "How long a level must last before it is reported",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )

    def __post_init__(self) -> None:
        if self.error < self.warn:
            raise ParameterError(
                f"fault.error: expected at least fault.warn = {self.warn}, got {self.error}"
            )


@dataclass(frozen=True)
class SupervisionParameters:
    """When the observer distrusts measurements, its estimate or its parameters."""

    gate: float = parameter(
        5.0, "Innovations beyond so many sigma are downweighted", minimum=1.0, maximum=1e3
    )
    reject: float = parameter(
        50.0, "Innovations beyond so many sigma are not used", minimum=1.0, maximum=1e6
    )
    jump_std: float = parameter(
        0.15, "Uncertainty re-opened after a sensor jump", unit="rad", minimum=0.0, maximum=10.0
    )
    jump_duration: float = parameter(
        1.5, "Riccati gains for so long after a jump", unit="s", minimum=0.0, maximum=60.0
    )
    jump_quiet: float = parameter(
        8.0, "No jump is looked for so soon after a start", unit="s", minimum=0.0, maximum=600.0
    )
    jump_budget: int = parameter(3, "Jumps within 20 s before they are ignored", minimum=0)
    lost: float = parameter(
        6.0, "Average innovation in sigma that gives the estimate up", minimum=1.0, maximum=1e3
    )
    stuck_samples: int = parameter(
        10, "Repetitions of the same value from which samples are not used; 0: never", minimum=0
    )
    disturbance_limit: float = parameter(
        3.141592653589793, "Largest disturbance believed", unit="rad", minimum=1e-3, maximum=100.0
    )

    def __post_init__(self) -> None:
        if self.reject < self.gate:
            raise ParameterError(
                f"supervision.reject: expected at least supervision.gate = {self.gate}, "
                f"got {self.reject}"
            )

    def options(self) -> SupervisionOptions:
        """Return them as the core takes them."""
        return SupervisionOptions(**asdict(self))


@dataclass(frozen=True)
class ObserverParameters(ManagedParameters):
    """All parameters of the observer node."""

    joints: tuple[str, ...] = parameter(
        ("elastic_joint",), "Names of the joints in joint_measurements", read_only=True
    )
    design: str = parameter(
        "", "Path of the design file; empty for the one that is shipped", read_only=True
    )
    joint_designs: tuple[str, ...] = parameter(
        (),
        "Design file of each of the joints, empty for the one that `design` names; no list: "
        "that one for all",
        read_only=True,
    )
    method: str = parameter(
        "certified",
        "Observer to run: the certified one, or one to compare with, which publishes no bound",
        choices=("certified", "paper", "high_gain", "proportional_integral"),
        read_only=True,
    )
    theta: float = parameter(
        2.5,
        "Speed of the high_gain and proportional_integral observers",
        unit="rad/s",
        minimum=0.1,
        maximum=100.0,
        read_only=True,
    )
    rate: float = parameter(
        200.0,
        "Rate at which estimates are published",
        unit="Hz",
        minimum=1.0,
        maximum=2000.0,
        read_only=True,
    )
    publish_on: str = parameter(
        "tick",
        "When estimates are published: at `rate`; or whenever measurements come, and at `rate` "
        "as long as none do",
        choices=("tick", "measurement"),
        read_only=True,
    )
    gain_mode: str = parameter(
        "certified",
        "Gain once settled: the constant certified one, or the Riccati gain throughout",
        choices=("certified", "riccati"),
        read_only=True,
    )
    settle_time: float = parameter(
        5.0,
        "Least time with Riccati gains after a start or reset",
        unit="s",
        minimum=0.0,
        maximum=600.0,
        read_only=True,
    )
    torque_rate: float = parameter(
        TORQUE_RATE,
        "1 sigma of the rate at which the torque may move while nothing is heard of it; 0: the "
        "last one is taken to hold",
        unit="N m/s",
        minimum=0.0,
        maximum=1e6,
        read_only=True,
    )
    adapt: bool = parameter(
        True, "Learn the parameters that the design calls uncertain", read_only=True
    )
    history: float = parameter(
        0.5,
        "How late a measurement may come and still be put in its place",
        unit="s",
        minimum=0.0,
        maximum=60.0,
        read_only=True,
    )
    future_tolerance: float = parameter(
        0.1,
        "How far ahead of the clock a stamp may lie",
        unit="s",
        minimum=0.0,
        maximum=60.0,
        read_only=True,
    )
    assume_zero_torque: bool = parameter(
        False,
        "Take measurements without effort as torque 0 instead of rejecting them",
        read_only=True,
    )
    coast_after: float = parameter(
        0.1,
        "Age of the newest measurement to report COASTING",
        unit="s",
        minimum=1e-3,
        maximum=60.0,
    )
    stale_after: float = parameter(
        5.0,
        "Age of the newest measurement to stop publishing and restart",
        unit="s",
        minimum=1e-2,
        maximum=600.0,
        read_only=True,
    )
    reset_on_backward_jump: bool = parameter(
        True,
        "Restart when the clock goes back; else nothing is published until it has caught up",
    )
    when_stale: str = parameter(
        "silent",
        "What is published of a joint that is STALE: nothing, or its last estimate without bounds",
        choices=("silent", "hold"),
    )
    fault: FaultParameters = parameter_group(FaultParameters)
    supervision: SupervisionParameters = parameter_group(SupervisionParameters)

    def __post_init__(self) -> None:
        if self.coast_after > self.stale_after:
            raise ParameterError(
                f"coast_after: expected at most stale_after = {self.stale_after}, "
                f"got {self.coast_after}"
            )
        if not self.joints or "" in self.joints:
            raise ParameterError(f"joints: expected names, got {list(self.joints)}")
        if len(set(self.joints)) < len(self.joints):
            raise ParameterError(f"joints: expected each name once, got {list(self.joints)}")
        if self.joint_designs and len(self.joint_designs) != len(self.joints):
            raise ParameterError(
                f"joint_designs: expected one for each of the {len(self.joints)} joints or none, "
                f"got {len(self.joint_designs)}"
            )

    @property
    def design_of(self) -> dict[str, str]:
        """Path of each joint's design file, empty for the one that is shipped."""
        own = self.joint_designs or ("",) * len(self.joints)
        return {joint: path or self.design for joint, path in zip(self.joints, own, strict=True)}

    @property
    def settings(self) -> ObserverSettings:
        """What of them decides numbers, as live runs and runs over bags have it in common."""
        return ObserverSettings(
            method=self.method,
            theta=self.theta,
            gain_mode=GainMode(self.gain_mode),
            settle_time=self.settle_time,
            torque_rate=self.torque_rate,
            adapt=self.adapt,
            history=self.history,
            future_tolerance=self.future_tolerance,
            stale_after=self.stale_after,
            assume_zero_torque=self.assume_zero_torque,
            supervision=self.supervision.options(),
        )
