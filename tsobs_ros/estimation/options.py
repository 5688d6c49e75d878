# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Options of an estimator: its gain, plausible torques, how it is supervised."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from tsobs_ros.settings import check, live_setting

TORQUE_RATE = 1.0
"""Default 1σ of an arm's torque rate in a gap [N m/s]."""


GAIN_MODES = ("certified", "riccati")
"""Which gain corrects the estimate once it has settled."""


class TorqueLimits(NamedTuple):
    """Which torques of an arm are plausible.

    Attributes:
        limit: Largest torque [N m], infinite if any is plausible.
        rate_limit: Its largest rate [N m/s], likewise.
        spread: 1σ of a torque of which nothing is known [N m].
    """

    limit: float
    rate_limit: float
    spread: float


@dataclass(frozen=True)
class SupervisionOptions:
    """When samples are not used.

    σ is times the noise's scale; a disturbance beyond π and the arm and its sensor turned together
    look the same; core/bank.c counts repetitions.
    """

    gate: float = live_setting(
        5.0,
        "Innovations as unlikely as beyond so many sigma are outliers, not used",
        minimum=1.0,
        maximum=1e3,
    )
    stuck_samples: int = live_setting(
        20, "Signs of a stuck sensor from which samples are not used; 0: never", minimum=0
    )
    disturbance_limit: float = live_setting(
        math.pi,
        "Largest disturbance that a sensor is supposed to jump to",
        unit="rad",
        minimum=1e-3,
        hidden=True,
    )

    def __post_init__(self) -> None:
        check(self)
