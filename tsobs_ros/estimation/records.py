# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Input and output of an estimator as plain records."""

import enum
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array


class Measurement(NamedTuple):
    """One sample of a joint or a system.

    Attributes:
        stamp: When the outputs were sampled [ns].
        y: Measured outputs, of an arm [rad] or [rad/s], NaN if one is missing, shape (p,).
        u: Inputs applied from this stamp until the next sample, of an arm the torque [N m],
            shape (m,).
    """

    stamp: int
    y: Array
    u: Array


class RejectReason(enum.Enum):
    """Why a measurement was not used; the value is its name in reports.

    Of one with an implausible torque or an unknown input the outputs are used all the same.
    """

    NON_FINITE = "non-finite"
    WRONG_JOINT = "wrong joint or shape"
    DUPLICATE = "duplicate stamp"
    TOO_OLD = "too old"
    FROM_FUTURE = "from the future"
    GATED = "gated"
    ZERO_STAMP = "zero stamp"
    IMPLAUSIBLE_TORQUE = "implausible torque"
    MISSING_INPUT = "missing input"
    UNKNOWN_INPUT = "unknown input"


REASONS = (None, *RejectReason)
"""Reasons of rejection by their codes; 0 is a measurement that was used."""

USED = 0
NON_FINITE, GATED, IMPLAUSIBLE_TORQUE, UNKNOWN_INPUT = (
    REASONS.index(RejectReason[name])
    for name in ("NON_FINITE", "GATED", "IMPLAUSIBLE_TORQUE", "UNKNOWN_INPUT")
)

CORRECTING = (USED, IMPLAUSIBLE_TORQUE, UNKNOWN_INPUT)
"""Outcomes of measurements whose outputs were used."""


class Basis(enum.IntEnum):
    """What the published bounds rest on; `health.STATUSES` says what each means."""

    CERTIFIED = 0
    LEARNT = 1
    COVARIANCE = 2
    STARTING = 3
    GAP = 4
    JUMP = 5
    CONTRADICTED = 6
    HYPOTHESIS = 7
    OUTSIDE = 8


class Learning(enum.IntEnum):
    """What the learning of parameters does; `health.STATUSES` says what each means."""

    NONE = 0
    STARTING = 1
    ACTIVE = 2


class Hypothesis(enum.IntEnum):
    """What the estimate takes the arm and its sensor for; `health.STATUSES` says more."""

    AS_DESIGNED = 0
    FORCE = 1
    IMPERFECT = 2
    LOUD = 3
    COLOURED_NOISE = 4
    DRIFT = 5
    TONE = 6


class Innovation(NamedTuple):
    """How far a used measurement was from its prediction.

    Attributes:
        stamp: The measurement's stamp [ns].
        value: y − ŷ of each output, NaN if it is missing, shape (p,).
        expected_std: 1σ expected of it, shape (p,).
    """

    stamp: int
    value: Array
    expected_std: Array


HEALTH = (
    "noise_scale",
    "coloured_power",
    "basis",
    "claimed",
    "learning",
    "hypothesis",
    "age",
)
"""Fields of an estimate that say what its numbers are worth, in the order of the health topic."""

_EMPTY = np.zeros(0)


class Estimate(NamedTuple):
    """The estimate at one instant, in physical units; what there is none of has length 0.

    Arrays of estimates are rows with the same fields as numbers, `Estimator.row_type`.

    Attributes:
        stamp: The instant it is for [ns].
        state: Of an arm [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (plant,).
        state_bound: 1σ bound of each, shape (plant,).
        disturbance: Disturbance or fault of each output, in its unit, shape (p,).
        disturbance_rate: Its modelled rate [1/s], shape (p,).
        disturbance_bound: 1σ bound of the disturbance, shape (p,).
        parameters: Estimated changes θ of the model's parameters, shape (k,).
        parameter_bound: 1σ of each, shape (k,).
        torque_disturbance: Unknown torques that the design has a model of, the motor's before the
            link's [N m], shape (t,).
        torque_disturbance_bound: 1σ bound of each [N m], shape (t,).
        basis: What the bounds rest on.
        claimed: Whether the bounds are claimed to hold.
        parameters_valid: Whether the motion was rich enough for the parameters to count.
        noise_scale: Size of the sensor's noise relative to the design's, at least 1; of several
            outputs the largest.
        coloured_power: Mean product of neighbouring innovations relative to their expected power,
            0 if the model is right.
        learning: What the learning does.
        hypothesis: What the arm and its sensor are taken for.
        in_domain: Whether the estimated link angle lies in the certificate's domain.
        age: Time since the newest measurement behind it [s].
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
    def certified(self) -> bool:
        """Whether the bounds are the certificate's."""
        return self.basis is Basis.CERTIFIED

    @property
    def health(self) -> list[float]:
        """What the numbers are worth, the fields of `HEALTH`."""
        return [float(getattr(self, name)) for name in HEALTH]

    @classmethod
    def of_health(cls, stamp: int, numbers: Sequence[float]) -> "Estimate":
        """Return what is known of an estimate from its `health` alone."""
        scale, coloured, basis, claimed, learning, hypothesis, age = numbers
        return cls(
            stamp,
            basis=Basis(int(basis)),
            claimed=claimed != 0.0,
            noise_scale=scale,
            coloured_power=coloured,
            learning=Learning(int(learning)),
            hypothesis=Hypothesis(int(hypothesis)),
            age=age,
        )
