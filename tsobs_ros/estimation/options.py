# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Options of an estimator: its gain, how it learns, how it is supervised."""

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

from tsobs_ros.checks import Array, check_each, non_negative, positive
from tsobs_ros.settings import check, live_setting

TORQUE_RATE = 1.0
"""Default 1σ of an arm's torque rate in a gap [N m/s]."""


class GainMode(enum.Enum):
    """Which gain corrects the estimate once it has settled."""

    CERTIFIED = "certified"
    RICCATI = "riccati"


class CertifiedGain(NamedTuple):
    """The constant gain and the bound that is proved for it.

    Attributes:
        K: Filter gain, shape (n, p).
        X: Bound on the error covariance before each sample, shape (n, n).
        late: Factor of the bound's root for a period from when the next sample is late; NaN if none
            is known.
    """

    K: Array
    X: Array
    late: float = math.nan


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

    @classmethod
    def of(cls, limit: float | None, rate_limit: float | None, largest: float) -> "TorqueLimits":
        """Return limits of which 0 means none and None the default.

        Args:
            limit: [N m].
            rate_limit: [N m/s]; the default goes through the whole range in 2 ms.
            largest: Default of the limit [N m].
        """
        known = limit or largest
        rate = known / 1e-3 if rate_limit is None else rate_limit or math.inf
        return cls(math.inf if limit == 0.0 else known, rate, known / 3.0)


@dataclass(frozen=True)
class AdaptationOptions:
    """How fast parameters are learnt, and when they count as known.

    Attributes:
        initial_std: 1σ of each θ before any measurement, that of an even draw from its range if
            None; caps the gain ever after.
        random_walk_density: Growth of each θ's variance, which keeps the gain alive [1/s].
        start: Adaptation begins so long after a (re)start [s], when the innovations are not
            one-sided any more.
        significance: Parameters are used from when they differ from nominal ones by so much,
            squared and relative to their covariance: 25 is 5σ. A nominal arm stays nominal.
        pass_time: What was learnt far from the truth, along wrong regressors, is learnt again after
            so long [s].
        memory: Time constant of the measure of excitation [s].
        excitation: Smallest eigenvalue of the excitation from which θ counts as valid.
    """

    initial_std: float | None = None
    random_walk_density: float = 1e-6
    start: float = 2.0
    significance: float = 25.0
    pass_time: float = 4.0
    memory: float = 10.0
    excitation: float = 400.0

    def __post_init__(self) -> None:
        named = ("memory",) if self.initial_std is None else ("initial_std", "memory")
        check_each(positive, self, *named, prefix="adaptation ")
        others = ("random_walk_density", "start", "significance", "pass_time", "excitation")
        check_each(non_negative, self, *others, prefix="adaptation ")


@dataclass(frozen=True)
class SupervisionOptions:
    """When samples are not used.

    σ is times the noise's scale; a disturbance beyond π and the arm and its sensor turned together
    look the same; core/repeats.h counts repetitions.
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
