# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The torque of a measurement, judged like its angle, in compiled code.

A torque that no drive of the arm can have is not used, its angle is. From that sample on the torque
is unknown, as in a gap: u + δ, u being the last plausible one, with δ and its rate as two more
states of the estimate (`GapFlow`). Angles go on correcting all of them.

A torque that is plausible may be wrong, too. A step of it is a suspect for a second. What it has
done to the estimate, the response ρ, follows from the linear model, and the likelihoods of the
innovations with and without ρ decide whether the arm made the step. Until then nothing is
certified, and for a while the bounds have room for ρ. If the arm did not make it, ρ is taken back.
"""

import math
from typing import Any

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.model.matrices import apply, dot, larger, quadratic
from tsobs_ros.model.stepping import LINK_SINE, LINK_TORQUE, MOTOR_SINE, MOTOR_TORQUE
from tsobs_ros.model.trigonometry import cosine

_SMALL_STEP = 0.25
_SUSPECT, _LONGEST_SUSPECT, _WINDOW = 1.0, 10.0, 0.1
_CERTAIN = 8.0
_CLIP, _STRANGE = 5.0, 2.5
_DISTRUST = 5.0
_LEAST_DISTRUST = 0.5


@compiled
def is_suspected(state: Any) -> bool:
    """Return whether it is open if the arm made the last step of the torque."""
    suspected: bool = math.isfinite(state.step_age)
    return suspected


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
        step = u[0] - held[0]
        # A first torque has none before it: its age is infinite. Late samples and those of two
        # sensors may be as close as can be.
        elapsed = larger(state.torque_age, model.period)
        legal = math.isfinite(u[0]) and abs(u[0]) <= model.torque_limit
        legal = legal and not abs(step) > model.torque_rate_limit * elapsed
        if not legal or _is_distrusted(model, state, u[0]):
            state.torque_unknown = 1
            return
        if math.isfinite(state.torque_age):
            _note_step(model, state, step)
    for i in range(model.m):
        held[i] = u[i]
    state.torque_unknown, state.torque_age, state.distrust = 0, 0.0, 0.0


@compiled
def _is_distrusted(model: Any, state: Any, torque: float) -> bool:
    """Return whether a torque is still contradicted, a while after one of its steps was."""
    if state.distrust <= 0.0 or state.in_gap == 0:
        return False
    n = model.n
    if state.distrust > _DISTRUST - _LEAST_DISTRUST:
        return True
    departure = torque - state.held[0] - state.x[n]
    spread = 9.0 * larger(state.covariance[n, n], 0.0)
    distrusted: bool = departure * departure > spread + model.torque_doubt * model.torque_doubt
    return distrusted


@compiled
def _note_step(model: Any, state: Any, step: float) -> None:
    """Remember a step of the torque, which a smooth one does not make, while it is a suspect."""
    sudden, state.torque_change = abs(step - state.torque_change), step
    least, size = _SMALL_STEP * model.torque_doubt, min(abs(step), sudden)
    if not size > (least if is_suspected(state) else 2.0 * least) or model.torque_doubt <= 0.0:
        return
    if abs(state.departure + step) <= least:
        state.departure, state.step_age = 0.0, 0.0
    else:
        # If there is one before it, it is not decided whether the arm made that.
        state.torque_step = step


@compiled
def begin_step(model: Any, state: Any) -> None:
    """Suspect the newest step, and leave one before it to the covariance."""
    if is_suspected(state):
        add_response(model, state, model.n)
    forget_step(model, state)
    state.departure, state.torque_step, state.step_age = state.torque_step, 0.0, 0.0


@compiled
def forget_step(model: Any, state: Any) -> None:
    """Suspect the last step of the torque no longer."""
    response = state.response[:]
    for i in range(model.n):
        response[i] = 0.0
    state.departure, state.evidence, state.step_age = 0.0, 0.0, math.inf


@compiled
def follow_step(model: Any, state: Any, duration: float, work: Any) -> None:
    """Move what the suspected steps have done to the estimate over a regular step."""
    if not is_suspected(state):
        return
    if duration > model.longest or state.torque_unknown != 0:
        forget_step(model, state)
        return
    n, flow, response = model.n, model.flow, state.response[:]
    moved, phi, gamma = work.flow.vectors[0], flow.phi[:], flow.gamma[:]
    for part in range(2):
        if part == 1:
            apply(phi, response, moved, n, n)
            for i in range(n):
                response[i] = moved[i] + gamma[i, 0] * state.departure
        # Half a kick, by gravity and by what θ̂ adds to both accelerations.
        angle = cosine(state.x[0]) * response[0]
        link, motor = -flow.gravity_gain * angle, 0.0
        for i in range(model.k):
            effect, theta = flow.effects[i], state.theta[i]
            link += theta * (
                dot(effect, response, 4)
                + effect[LINK_SINE] * angle
                + effect[LINK_TORQUE] * state.departure
            )
            motor += theta * (
                dot(effect[4:], response, 4)
                + effect[MOTOR_SINE] * angle
                + effect[MOTOR_TORQUE] * state.departure
            )
        response[1] += 0.5 * flow.period * link
        response[3] += 0.5 * flow.period * motor
    state.step_age += duration
    if state.step_age >= _SUSPECT:
        over = state.departure == 0.0 and state.step_age < _LONGEST_SUSPECT
        if not over or quadratic(model.P[:], response, n) < 1.0 / 9.0:
            forget_step(model, state)


@compiled
def weigh_step(model: Any, state: Any, correction: Any) -> bool:
    """Weigh by an innovation whether the arm made the suspected steps of the torque.

    Returns:
        Whether it is as good as certain that it did not.
    """
    if not is_suspected(state) or state.torque_unknown != 0:
        return False
    response, weighed = state.response[:], bool(0)
    for i in range(model.p):
        innovation = correction.innovation[i]
        variance = correction.innovation_covariance[i, i]
        if not (math.isfinite(innovation) and variance > 0.0):
            continue
        expected = dot(model.C[i], response, model.n)
        spread = math.sqrt(variance) * larger(state.sensors[i].noise_scale, 1.0)
        made = min(abs(innovation) / spread, _CLIP)
        not_made = min(abs(innovation + expected) / spread, _CLIP)
        # If both are strange, it is the sensor's fault, which says nothing of the torque.
        if not (made > _STRANGE and not_made > _STRANGE):
            state.evidence += 0.5 * (made * made - not_made * not_made)
            weighed = bool(1)
    if not weighed:
        return False
    if state.evidence < -_CERTAIN:
        forget_step(model, state)
        return False
    suspected: bool = state.evidence > _CERTAIN
    return suspected


@compiled
def correct_response(model: Any, state: Any, correction: Any) -> None:
    """Correct what the suspected steps have done to the estimate, as that is."""
    if not is_suspected(state):
        return
    response, gain, moved = state.response[:], correction.gain[:], correction.squares[0, 0]
    for i in range(model.n):
        moved[i] = 0.0
    for j in range(model.p):
        if correction.weight[j] > 0.0:
            expected = correction.weight[j] * dot(model.C[j], response, model.n)
            for i in range(model.n):
                moved[i] += gain[i, j] * expected
    for i in range(model.n):
        response[i] -= moved[i]


@compiled
def is_open(model: Any, state: Any) -> bool:
    """Return whether the bounds cover both answers to whether the arm made the suspected steps.

    They do for a while after a step, and once the torque is back where it was.
    """
    recent: bool = state.step_age <= _WINDOW
    return recent or (is_suspected(state) and state.departure == 0.0)


@compiled
def distrust_torque(model: Any, state: Any) -> None:
    """Go back to the torque before the suspected steps, and take it to be unknown for a while.

    That the arm made them after all remains possible: the covariance has both.

    Args:
        model: Model record.
        state: Corrected, with Riccati gains.
    """
    n, x, response = model.n, state.x[:], state.response[:]
    for i in range(n):
        x[i] -= response[i]
    if model.n_gap > 0 and state.departure != 0.0:
        state.torque_unknown, state.distrust, state.torque_age = 1, _DISTRUST, 0.0
        state.held[0] -= state.departure
        enter_gap(model, state)
        state.in_gap = 1
    else:
        add_response(model, state, n)
    forget_step(model, state)


@compiled
def add_response(model: Any, state: Any, width: int) -> None:
    """Add to the covariance what the suspected steps have done, of all states or also of δ."""
    n, covariance, response = model.n, state.covariance[:], state.response[:]
    for i in range(min(width, n + 1)):
        first = response[i] if i < n else state.departure
        for j in range(min(width, n + 1)):
            covariance[i, j] += first * (response[j] if j < n else state.departure)


@compiled
def enter_gap(model: Any, state: Any) -> None:
    """Append the unknown torque and its rate to the estimate and its covariance.

    The torque's departure begins at zero, or, if the last plausible torque is from some time ago,
    with all that it may have become since. Suspected steps remain possible, and so does that the
    arm did not make them.
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
    if is_suspected(state):
        add_response(model, state, wide)
