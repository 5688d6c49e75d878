# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The torque of a measurement, judged like its angle, in compiled code.

A torque that no drive of the arm can have is not used, its angle is. From that sample on the torque
is unknown, as in a gap: u + δ, u being the last plausible one, with δ and its rate as two more
states of the estimate (`GapFlow`). Angles go on correcting all of them.
"""

import math
from typing import Any

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.model.matrices import larger


@compiled
def take_torque(model: Any, state: Any, u: Array) -> None:
    """Accept the inputs of a measurement, or hold those before.

    Args:
        model: Model record.
        state: Predicted to the measurement's stamp, before the correction.
        u: Inputs from the measurement on, shape (m,).
    """
    held = state.held[:]
    if model.torque_limit > 0.0:
        # A first torque has none before it: its age is infinite. Late samples and those of two
        # sensors may be as close as can be.
        elapsed = larger(state.torque_age, model.period)
        legal = math.isfinite(u[0]) and abs(u[0]) <= model.torque_limit
        if not legal or abs(u[0] - held[0]) > model.torque_rate_limit * elapsed:
            state.torque_unknown = 1
            return
    for i in range(model.m):
        held[i] = u[i]
    state.torque_unknown, state.torque_age = 0, 0.0


@compiled
def enter_gap(model: Any, state: Any) -> None:
    """Append the unknown torque and its rate to the estimate and its covariance.

    The torque's departure begins at zero, or, if the last plausible torque is from some time ago,
    with all that it may have become since.
    """
    n, wide = model.n, model.n_gap
    x, covariance, upsilon = state.x[:], state.covariance[:], state.upsilon[:]
    for i in range(n, wide):
        x[i] = 0.0
        for j in range(wide):
            covariance[i, j], covariance[j, i] = 0.0, 0.0
        for j in range(model.k):
            upsilon[j, i] = 0.0
    if state.torque_unknown != 0:
        spread = min(math.sqrt(model.rate_variance) * state.torque_age, model.torque_spread)
        covariance[n, n] = spread * spread
    covariance[wide - 1, wide - 1] = model.rate_variance
