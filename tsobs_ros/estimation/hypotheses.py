# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bank of hypotheses about what the design lacks, each an extended Kalman filter.

The certified gain answers slow innovations at once, so a low-passed one stays small if the model is
right, and grows if the arm is pushed by a force that the model lacks, long before single
innovations look odd. Noise that is alike from sample to sample shows in the product of neighbours.
Either sign wakes the alternatives, which begin from the estimate. Each has the design's states and
a Gauss–Markov torque of the motor besides, which is large in a *force*; *coloured noise* has a
Gauss–Markov part of the noise too, and in a *drift* the disturbance moves faster than designed.

They take θ̂ and Γ of the estimator, with a regressor Υ of their own. The logarithm of each
innovation's likelihood adds up to a score that is forgotten slowly. The best hypothesis is
selected, if its score exceeds the design's clearly; its estimate and covariance are published. The
estimator goes on as designed meanwhile. While the design is selected and the signs are gone, the
bank sleeps and costs nothing.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.model.flow import ArmFlow, ForceFlow
from tsobs_ros.model.prediction import Flow, fill_matrix

FORCES = (0.01, 0.05)
"""1σ of the torques of the two forces, relative to the gravity torque."""

OTHER_FORCES = (0.005, 0.002)
"""The same of coloured noise and of a drift."""

FORCE_TIME = 1.0
"""Correlation time of an unknown torque [s]."""

COLOUR_TIME = 0.1
"""Correlation time of coloured noise [s]."""

WHITE_SHARE = 0.1
"""White part of the variance of coloured noise."""

DRIFT_SPEED = 4.0
"""How much faster than designed the disturbance drifts."""

_PRIORS, _HYSTERESES = (2.5, 2.5, 7.0, 3.0), (1.0, 1.0, 6.0, 1.0)
"""`prior` and `hysteresis` of the alternatives."""

_SIGN_TIME, _SIGN_POWER_TIME, _SCORE_TIME = 0.4, 5.0, 20.0
"""Time constants of the slow innovation, of its power, and of what a score forgets [s]."""

_COLOURED, _DRIFT = Hypothesis.COLOURED_NOISE.value, Hypothesis.DRIFT.value


class Alternative(NamedTuple):
    """What another hypothesis assumes.

    Attributes:
        flow: Prediction model, whose states are the design's and then those of its own.
        variances: Of the white noise of one sample of each output, shape (p,).
        initial_std: 1σ of its own states before any measurement.
        prior: By how much its score must exceed the design's.
        hysteresis: By how much less, once it is selected.
    """

    flow: Flow
    variances: Array
    initial_std: tuple[float, ...]
    prior: float
    hysteresis: float


def alternatives(flow: ArmFlow, variances: Array) -> list[Alternative | None]:
    """Return what the hypotheses assume, in the order of `Hypothesis`; None if one has no use.

    Args:
        flow: The design's prediction model.
        variances: Of the white noise of one sample of each output, shape (p,).
    """
    torque = flow.arm.reference_torque
    forces = [share * torque for share in (*FORCES, *OTHER_FORCES)]
    stds = np.sqrt(variances).tolist()
    drifting = ArmFlow(
        flow.arm,
        replace(flow.disturbance, G=DRIFT_SPEED * flow.disturbance.G),
        flow.process_noise,
        flow.period,
        flow.outputs,
        flow.torque_disturbance,
    )
    flows = [ForceFlow(flow, force, FORCE_TIME) for force in forces]
    flows[_COLOURED - 1] = ForceFlow(flow, forces[_COLOURED - 1], FORCE_TIME, stds, COLOUR_TIME)
    flows[_DRIFT - 1] = ForceFlow(drifting, forces[_DRIFT - 1], FORCE_TIME)
    own: list[tuple[float, ...]] = [(force,) for force in forces]
    whites = [variances] * native.ALTERNATIVES
    whites[_COLOURED - 1] = variances * WHITE_SHARE
    own[_COLOURED - 1] = (*stds, *own[_COLOURED - 1])
    numbers = zip(flows, whites, own, _PRIORS, _HYSTERESES, strict=True)
    bank: list[Alternative | None] = [Alternative(*each) for each in numbers]
    if flow.torque_disturbance is not None:
        # The design has a force of its own.
        bank[: len(FORCES)] = [None] * len(FORCES)
    return bank


def enter_alternatives(model: Any, bank: list[Alternative | None]) -> None:
    """Enter the hypotheses into one model record, which has its period and their flows."""
    for record, assumed in zip(model["alternatives"], bank, strict=True):
        if assumed is None:
            continue
        n = assumed.flow.state_count
        fill_matrix(record["C"], assumed.flow.output_matrix)
        fill_matrix(record["variances"], assumed.variances)
        for place, std in enumerate(assumed.initial_std, n - len(assumed.initial_std)):
            record["added"][place] = std * std
        record["n"] = n
        record["prior"], record["hysteresis"] = assumed.prior, assumed.hysteresis
    period = float(model["period"])
    model["sign_share"] = 1.0 - native.exponential(-period / _SIGN_TIME)
    model["sign_power_share"] = 1.0 - native.exponential(-period / _SIGN_POWER_TIME)
    model["score_fade"] = native.exponential(-period / _SCORE_TIME)
