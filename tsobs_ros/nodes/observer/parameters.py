# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The observer node's ROS parameters."""

from dataclasses import dataclass, field

from tsobs_ros.errors import ParameterError
from tsobs_ros.estimation.events import COAST_AFTER
from tsobs_ros.estimation.health import DisturbanceLimits
from tsobs_ros.methods import ObserverSettings
from tsobs_ros.nodes.parameters import JointParameters
from tsobs_ros.settings import MIN_RATE, live_setting, setting


@dataclass(frozen=True)
class ObserverParameters(ObserverSettings, JointParameters):
    """All parameters of the observer node: the settings of its observers, and its own."""

    rate: float = setting(
        0.0,
        "Rate at which estimates are published; 0: the design's",
        unit="Hz",
        minimum=0.0,
        maximum=2000.0,
    )
    publish_on: str = setting(
        "tick",
        "When estimates are published: at `rate`; or whenever measurements come, and at `rate` "
        "as long as none do",
        choices=("tick", "measurement"),
    )
    coast_after: float = live_setting(
        COAST_AFTER,
        "Age of the newest measurement for COASTING",
        unit="s",
        minimum=1e-3,
        maximum=60.0,
    )
    reset_on_backward_jump: bool = live_setting(
        True, "Restart when the clock goes back; else nothing is published until it has caught up"
    )
    when_stale: str = live_setting(
        "silent",
        "What is published of a joint that is STALE: nothing, or its last estimate without bounds",
        choices=("silent", "hold"),
    )
    fault: DisturbanceLimits = field(default_factory=DisturbanceLimits)
    torque_warn: tuple[float, ...] = live_setting(
        (),
        "Torque disturbance that causes a warning, for each joint, 0 for never; a single number: "
        "for all joints; none: never",
        unit="N m",
        minimum=0.0,
        maximum=1e6,
        element=float,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0.0 < self.rate < MIN_RATE:
            raise ParameterError(f"rate: expected 0 or at least {MIN_RATE} Hz, got {self.rate}")
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
        """Torque disturbance that causes a warning, for each joint [N m]; 0 for never."""
        levels = self.torque_warn or (0.0,)
        if len(levels) == 1:
            levels *= len(self.joints)
        return dict(zip(self.joints, levels, strict=True))
