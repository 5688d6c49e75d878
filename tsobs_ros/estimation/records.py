# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Input and output of an estimator as plain records."""

import enum
from typing import NamedTuple

from tsobs_ros.checks import Array

NANOSECONDS = 1_000_000_000
"""Stamps are integer nanoseconds, so that differences of them are exact."""


class Measurement(NamedTuple):
    """One sample of a joint.

    Attributes:
        stamp: When the angle was sampled [ns].
        y: Measured link angle [rad], shape (1,).
        u: Torque applied from this stamp until the next sample [N m], shape (1,).
    """

    stamp: int
    y: Array
    u: Array


class RejectReason(enum.Enum):
    """Why a measurement was not used; the value is its name in reports."""

    NON_FINITE = "non-finite"
    WRONG_JOINT = "wrong joint or shape"
    DUPLICATE = "duplicate stamp"
    TOO_OLD = "too old"
    FROM_FUTURE = "from the future"
    GATED = "gated"
    ZERO_STAMP = "zero stamp"


class Innovation(NamedTuple):
    """How far a used measurement was from its prediction.

    Attributes:
        stamp: The measurement's stamp [ns].
        value: y − ŷ [rad], shape (1,).
        expected_std: 1σ expected of it [rad], shape (1,).
    """

    stamp: int
    value: Array
    expected_std: Array


class Estimate(NamedTuple):
    """The estimate at one instant, in physical units.

    Attributes:
        stamp: The instant it is for [ns].
        state: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (4,).
        state_bound: 1σ bound of each, shape (4,).
        disturbance: Output disturbance or fault [rad], shape (1,).
        disturbance_rate: Its modelled rate [rad/s], shape (1,).
        disturbance_bound: 1σ bound of the disturbance [rad], shape (1,).
        certified: Whether the bound is the certificate's; else it is the larger of that and the
            covariance along the estimate.
        parameters: Estimated changes θ of the model's parameters, shape (k,).
        parameter_bound: 1σ of each, shape (k,).
        parameters_valid: Whether the motion was rich enough for them to count.
        in_domain: Whether the estimated link angle lies in the certificate's domain.
        age: Time since the newest measurement behind it [s].
    """

    stamp: int
    state: Array
    state_bound: Array
    disturbance: Array
    disturbance_rate: Array
    disturbance_bound: Array
    certified: bool
    parameters: Array
    parameter_bound: Array
    parameters_valid: bool
    in_domain: bool
    age: float
