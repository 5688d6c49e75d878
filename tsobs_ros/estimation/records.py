# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Input and output of an estimator as plain records, and the meaning of their codes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.health import Code, Level


class Measurement(NamedTuple):
    """One sample of a joint or a system.

    Attributes:
        stamp: When the outputs were sampled [ns].
        y: Measured outputs, for an arm [rad] or [rad/s], NaN if missing, shape (p,).
        u: Inputs applied from this stamp until the next sample, for an arm the torque [N m],
            shape (m,).
    """

    stamp: int
    y: Array
    u: Array


USED = 0
"""Outcome of a measurement that was used, instead of a `RejectReason`."""


class RejectReason(Code):
    """The reason why a measurement was not used in full; the text is its name in reports.

    If its torque is implausible or an input is unknown, its outputs are still used. If it has no
    outputs, its inputs are still used.
    """

    NON_FINITE = 1, "non-finite", "the driver has no reading; see what it logs"
    WRONG_JOINT = 2, "wrong joint or shape", "compare the names in messages with `joints`"
    DUPLICATE = 3, "duplicate stamp", "does a second publisher, or a bridge, send the same samples?"
    TOO_OLD = 4, "too old", "compare the clocks of sensor and node; `history` is the limit"
    FROM_FUTURE = 5, "from the future", "compare the clocks; in simulations, set `use_sim_time`"
    GATED = 6, "gated", "is the design this arm's, the unit rad, the sign right?"
    ZERO_STAMP = 7, "zero stamp", "let the driver stamp its messages with the time of sampling"
    IMPLAUSIBLE_TORQUE = 8, "implausible torque", "is the unit N m? `torque_limit` is the limit"
    MISSING_INPUT = 9, "missing input", "publish it with the outputs, or set `assume_zero_torque`"
    UNKNOWN_INPUT = 10, "unknown input", "publish numbers to have narrower bounds"


def rejections(counts: Any) -> dict[RejectReason, int]:
    """Return the counts of rejected measurements that are not 0, from counts by outcome."""
    return {reason: int(counts[reason]) for reason in RejectReason if counts[reason]}


class Basis(Code):
    """The basis of the published bounds; bad from `CONTRADICTED` on."""

    CERTIFIED = 0, "the bound is certified"
    LEARNT = 1, "the bound is certified but for the uncertainty of the learnt parameters"
    COVARIANCE = 2, "the bound is not certified: it is the covariance along the estimate"
    STARTING = 3, "the bound is not certified yet: the estimate settles after a start"
    GAP = 4, "the bound is not certified: measurements or torques are missing or rejected"
    JUMP = 5, "the bound is not certified: the sensor has jumped"
    CONTRADICTED = (
        6,
        "the bound is void: the measurements contradict the design",
        "the arm, the noise or the disturbance differs from it",
    )
    HYPOTHESIS = 7, "the bound is not certified: it is that of another arm or sensor model"
    OUTSIDE = 8, "the bound is void: the link angle is outside of the certificate's domain"

    @property
    def level(self) -> Level:
        return Level.WARN if self >= Basis.CONTRADICTED else Level.OK


class Learning(Code):
    """The state of the parameter learning."""

    NONE = 0, "nothing is learnt"
    STARTING = 1, "learning waits until the estimate has settled"  # up to version 0.7
    ACTIVE = 2, "the parameters are being learnt"


class Hypothesis(Code):
    """The named hypothesis: the design until it is 400 times less likely; any other one is bad."""

    AS_DESIGNED = 0, "arm and sensor behave as designed"
    FORCE = (
        1,
        "something pushes that the model lacks: friction, contact, a payload?",
        "a torque_disturbance in the design, or damping as an uncertain parameter, may explain it",
    )
    IMPERFECT = (
        2,
        "the arm moves in ways that the model lacks",
        "its parameters are wrong, or process_noise in the design is too small",
    )
    LOUD = 3, "the sensor is much noisier than designed", "a larger measurement_std would expect it"
    COLOURED_NOISE = (
        4,
        "the sensor's noise is correlated in time: a filter in the sensor?",
        "a gauss_markov disturbance of 0.02 to 0.1 s in the design would estimate it",
    )
    DRIFT = (
        5,
        "the sensor moves away, or is wrong for a while",
        "a larger density of its disturbance in the design would follow it",
    )
    TONE = (
        6,
        "the sensor oscillates, or the torque is wrong",
        "check its sign and unit; a sinusoid in the design's disturbances would estimate a tone",
    )

    @property
    def level(self) -> Level:
        return Level.WARN if self else Level.OK


_HEALTH: dict[str, Any] = {
    "noise_scale": float, "coloured_power": float, "basis": Basis, "claimed": bool,
    "learning": Learning, "hypothesis": Hypothesis, "age": float,
}  # fmt: skip
HEALTH = tuple(_HEALTH)
"""Fields of an estimate that give the quality of its numbers, in the order of the health topic."""

_EMPTY = np.zeros(0)


class Estimate(NamedTuple):
    """The estimate at one instant, in physical units; absent quantities have length 0.

    Its fields are those of `tsobs_ros.Estimates` at that instant, and these:

    Attributes:
        stamp: The instant [ns].
        disturbance_rate: Modelled rate of each disturbance [1/s], shape (p,).
        age: Time since the newest measurement behind it [s].

    Arrays of estimates are rows with the same fields as numbers, `Estimator.row_type`.
    """

    stamp: int
    state: Array = _EMPTY
    state_bound: Array = _EMPTY
    disturbance: Array = _EMPTY
    disturbance_rate: Array = _EMPTY
    disturbance_bound: Array = _EMPTY
    parameters: Array = _EMPTY
    parameter_bound: Array = _EMPTY
    torque_disturbance: Array = _EMPTY
    torque_disturbance_bound: Array = _EMPTY
    basis: Basis = Basis.STARTING
    claimed: bool = True
    parameters_valid: bool = False
    noise_scale: float = 1.0
    coloured_power: float = 0.0
    learning: Learning = Learning.NONE
    hypothesis: Hypothesis = Hypothesis.AS_DESIGNED
    in_domain: bool = True
    age: float = 0.0

    @property
    def health(self) -> list[float]:
        """The quality of the numbers, the fields of `HEALTH`."""
        return [float(getattr(self, name)) for name in HEALTH]

    @classmethod
    def of_health(cls, stamp: int, numbers: Sequence[float]) -> "Estimate":
        """Return an estimate that has only the fields of its `health`."""
        known = zip(_HEALTH.items(), numbers, strict=True)
        return cls(stamp, **{name: kind(number) for (name, kind), number in known})
