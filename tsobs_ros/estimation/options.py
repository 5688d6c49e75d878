# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Options of an estimator: its gain, how it learns, how it is supervised."""

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

from tsobs_ros.checks import Array, check_each, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError

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
        initial_std: 1σ of each θ before any measurement; caps the gain ever after.
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

    initial_std: float = 0.1
    random_walk_density: float = 1e-6
    start: float = 2.0
    significance: float = 25.0
    pass_time: float = 4.0
    memory: float = 10.0
    excitation: float = 400.0

    def __post_init__(self) -> None:
        check_each(positive, self, "initial_std", "memory", prefix="adaptation ")
        others = ("random_walk_density", "start", "significance", "pass_time", "excitation")
        check_each(non_negative, self, *others, prefix="adaptation ")


@dataclass(frozen=True)
class SupervisionOptions:
    """When to react, and how strongly; the defaults are for 200 Hz.

    Attributes:
        gate: An innovation of r > gate σ counts by (gate/r)². σ is the design's, times the noise's
            scale.
        reject: Innovations beyond so many σ are not used at all.
        jump_std: 1σ by which the disturbance's uncertainty grows after a jump [rad]; 0 switches
            jumps off.
        jump_duration: Riccati gains are used for at least so long after a jump [s].
        jump_quiet: No jump is looked for so soon after a start [s], when innovations are one-sided.
        jump_budget: Largest number of jumps in `jump_budget_window`: under a wrong model every
            innovation leans, and unbudgeted reactions make the error worse.
        jump_budget_window: [s].
        lost: Half-second average of |r| beyond which the estimate is given up.
        stuck_samples: From so many repetitions of the very same value on that count, see
            core/repeats.h, samples of the sensor are not used; 0: never.
        disturbance_limit: The estimated disturbance is kept within so much [rad]; beyond π the arm
            and its sensor turned together look the same.
        strain: Innovations that contradict the model by a coloured power above 1, or a parameter
            at its limit, for so long start learning over [s].
        relearn_budget: After so many times learning rests, and the parameters are nominal.
        relearn_time: One of these comes back in so long, and learning with it [s].
    """

    gate: float = 5.0
    reject: float = 50.0
    jump_std: float = 0.05
    jump_duration: float = 0.5
    jump_quiet: float = 2.5
    jump_budget: int = 8
    jump_budget_window: float = 20.0
    lost: float = 6.0
    stuck_samples: int = 10
    disturbance_limit: float = math.pi
    strain: float = 1.0
    relearn_budget: int = 4
    relearn_time: float = 20.0

    def __post_init__(self) -> None:
        limits = ("gate", "lost", "disturbance_limit", "strain", "relearn_time")
        check_each(positive, self, *limits)
        jumps = ("jump_std", "jump_duration", "jump_quiet", "jump_budget", "jump_budget_window")
        check_each(non_negative, self, *jumps, "stuck_samples", "relearn_budget")
        if self.jump_budget > native.MAX_JUMP_BUDGET:
            raise ModelError(
                f"jump_budget: expected at most {native.MAX_JUMP_BUDGET}, got {self.jump_budget!r}"
            )
        if not self.reject >= self.gate:
            raise ModelError(
                f"reject: expected at least the gate {self.gate!r}, got {self.reject!r}"
            )
