# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One step of a prediction model in compiled code: estimate, regressor and error covariance.

A model's numbers are a record, the same kind for an arm, a T–S system and an observer that is
integrated. Its arrays have room for a class of sizes, so that few kinds of records are compiled
for; the sizes in use are among its numbers. Υ = ∂x̂/∂θ moves with the step's own Jacobian and
gathers the effect of θ on the state's derivative; it is kept by rows, one a parameter.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled, inlined
from tsobs_ros.model.linear_flow import MAX_TERMS, cut_into_steps, flow_over
from tsobs_ros.model.matrices import apply, congruence, copy, dot, multiply, multiply_padded
from tsobs_ros.model.memberships import rule_weights, rule_weights_and_slopes
from tsobs_ros.model.trigonometry import sine, sine_and_cosine

EFFECTS = 14
"""What θ = 1 adds to both accelerations of an arm: by x (4 each), by sin x₁, by the torque of the
motor and by a torque at the link."""

LINK_SINE, MOTOR_SINE, LINK_TORQUE, MOTOR_TORQUE, LINK_EXTERNAL, MOTOR_EXTERNAL = range(8, 14)

ARM, SYSTEM, INTEGRATED = 0, 1, 2
"""Kinds of models."""


class Room(NamedTuple):
    """Sizes that the arrays of records have room for.

    Attributes:
        n: Augmented states, those of a gap included.
        p: Outputs.
        m: Inputs and scheduled signals.
        k: Parameters.
        rules: Rules.
        premises: Premise variables.
    """

    n: int
    p: int = 1
    m: int = 1
    k: int = 0
    rules: int = 0
    premises: int = 0

    @classmethod
    def fitting(cls, *sizes: int) -> "Room":
        """Return the smallest class of sizes that some sizes fit into.

        They are powers of two, of states multiples of four.
        """
        least = (8, 2, 4, 4, 4, 2)
        classes = [_power_of_two(max(pair)) for pair in zip(sizes, least, strict=True)]
        return cls(max(least[0], -(-sizes[0] // 4) * 4), *classes[1:])


def _power_of_two(size: int) -> int:
    return 1 << (size - 1).bit_length()


def record_type(fields: list[tuple[Any, ...]]) -> np.dtype[Any]:
    """Return the type of a record whose fields are attributes too, in compiled code and out.

    Keep it: a compiled function recognises the very same type ten times faster than an equal one.
    """
    return np.dtype((np.record, np.dtype(fields, align=True)))


@cache
def flow_type(room: Room) -> np.dtype[Any]:
    """Return the type of a model's numbers.

    kind: ARM, SYSTEM or INTEGRATED. n, m, inputs, p, k, plant, rules, premises: sizes in use; the
    m signals are the inputs and then the scheduled ones. period to noise: a `LinearFlow` with its
    nominal step; turned: phi transposed. gravity_gain, effects: of an arm; has_unknown,
    motor_torque, link_torque: whether it has unknown torques, and the states that make them up.
    deviations to parameters: of a T–S system. The rest is of an integrated observer.
    """
    n, p, m, k, rules, premises = room
    number, count = np.float64, np.int64
    return record_type(
        [
            ("kind", count),
            ("n", count),
            ("m", count),
            ("inputs", count),
            ("p", count),
            ("k", count),
            ("plant", count),
            ("rules", count),
            ("premises", count),
            ("period", number),
            ("terms", count),
            ("reach", number),
            ("series", number, (MAX_TERMS, n * (2 * n + m))),
            ("phi", number, (n, n)),
            ("turned", number, (n, n)),
            ("gamma", number, (n, m)),
            ("noise", number, (n, n)),
            ("gravity_gain", number),
            ("effects", number, (k, EFFECTS)),
            ("has_unknown", count),
            ("motor_torque", number, (n,)),
            ("link_torque", number, (n,)),
            ("deviations", number, (rules, n, n + m)),
            ("directions", number, (k, rules, n, n + m)),
            ("premise", number, (premises, n)),
            ("schedule", number, (premises, m)),
            ("shapes", count, (rules, premises)),
            ("parameters", number, (rules, premises, 4)),
            ("max_step", number),
            ("F", number, (rules, n, n)),
            ("Y", number, (rules, n, p)),
            ("U", number, (rules, n, m)),
        ]
    )


@cache
def work_type(room: Room) -> np.dtype[Any]:
    """Return the type of a step's scratch numbers.

    stack: what is moved, x̄ and behind it the rows of Υᵀ. covariance: Σ. theta, y, u: as of
    `advance`. What is behind the numbers in use is zero in these.
    """
    n, p, m, k, rules, premises = room
    number = np.float64
    return record_type(
        [
            ("stack", number, (k + 1, n)),
            ("covariance", number, (n, n)),
            ("theta", number, (k,)),
            ("y", number, (p,)),
            ("u", number, (m,)),
            ("phi", number, (n, n)),
            ("turned", number, (n, n)),
            ("gamma", number, (n, m)),
            ("noise", number, (n, n)),
            ("squares", number, (4, n, n)),
            ("forced", number, (n, m)),
            ("values", number, (n * (2 * n + m),)),
            ("vectors", number, (6, n)),
            ("kicks", number, (2, n)),
            ("changes", number, (2, n)),
            ("before", number, (4,)),
            ("moved", number, (k + 1, n)),
            ("rows", number, (4, k, n)),
            ("effects", number, (EFFECTS,)),
            ("rates", number, (rules, n)),
            ("weights", number, (rules,)),
            ("slopes", number, (rules, premises)),
            ("premises", number, (premises,)),
            ("signals", number, (n + m,)),
        ]
    )


@inlined
def advance(
    flow: Any,
    x: Array,
    upsilon: Array,
    covariance: Array,
    with_covariance: bool,
    theta: Array,
    y: Array,
    u: Array,
    duration: float,
    work: Any,
) -> None:
    """Move x̄, Υ and the error covariance over a time, in place.

    Args:
        flow: Record of `flow_type`.
        x: Augmented state.
        upsilon: Υᵀ, one row a parameter.
        covariance: Error covariance.
        with_covariance: Whether the covariance is moved too.
        theta: θ̂.
        y: Sample in use, for observers that are integrated.
        u: Inputs and scheduled signals held over the time.
        duration: [s], at least 0.
        work: Scratch record of `work_type`.
    """
    n, k, width = flow.n, flow.k, work.covariance.shape[1]
    stack, sigma = work.stack[:], work.covariance[:]
    for j in range(width):
        stack[0, j] = x[j] if j < n else 0.0
    for i in range(k):
        for j in range(width):
            stack[i + 1, j] = upsilon[i, j] if j < n else 0.0
        work.theta[i] = theta[i]
    for i in range(flow.m):
        work.u[i] = u[i]
    if flow.kind == INTEGRATED:
        for i in range(flow.p):
            work.y[i] = y[i]
    if with_covariance:
        for i in range(width):
            for j in range(width):
                sigma[i, j] = covariance[i, j] if i < n and j < n else 0.0
    move(flow, with_covariance, duration, work)
    for j in range(n):
        x[j] = stack[0, j]
    for i in range(k):
        for j in range(n):
            upsilon[i, j] = stack[i + 1, j]
    if with_covariance:
        copy(sigma, covariance, n, n)


@compiled
def move(flow: Any, with_covariance: bool, duration: float, work: Any) -> None:
    """Move what is in a scratch record over a time [s]; see `advance`.

    Functions of records alone know all sizes when they are compiled, and count no references.
    """
    x, upsilon, theta, u = work.stack[0], work.stack[1:], work.theta[:], work.u[:]
    if flow.kind == INTEGRATED:
        _integrate(flow, x, work.y[:], u, duration, work)
        return
    whole, rest = cut_into_steps(duration, flow.period)
    for step in range(whole + 1):
        nominal = step < whole
        if not (nominal or rest > 0.0):
            return
        if not nominal:
            _fill_flow(flow, rest, with_covariance, work)
        length = flow.period if nominal else rest
        if flow.kind == ARM:
            _step_arm(flow, with_covariance, length, nominal, work)
        else:
            _step_system(
                flow,
                flow.phi[:] if nominal else work.phi[:],
                flow.gamma[:] if nominal else work.gamma[:],
                flow.noise[:] if nominal else work.noise[:],
                length,
                x,
                upsilon,
                work.covariance[:],
                with_covariance,
                theta,
                u,
                work,
            )


@compiled
def _fill_flow(flow: Any, duration: float, with_noise: bool, work: Any) -> None:
    """Write the linear flow over a time [s] into the scratch record."""
    n, phi, turned = flow.n, work.phi[:], work.turned[:]
    flow_over(
        flow.series[:],
        flow.terms,
        flow.reach,
        # A step of a T–S system has two equal halves.
        0.5 * duration if flow.kind == SYSTEM else duration,
        phi,
        work.gamma[:],
        work.noise[:],
        work.squares[:],
        work.forced[:],
        work.values[:],
        n,
        flow.inputs,
        with_noise,
    )
    for i in range(phi.shape[0]):
        for j in range(phi.shape[1]):
            if i >= n or j >= n:
                phi[i, j] = 0.0
            turned[j, i] = phi[i, j]


@compiled
def _step_arm(flow: Any, with_covariance: bool, duration: float, nominal: bool, work: Any) -> None:
    """Kick both velocities by gravity and by θ̂, take the linear flow, and kick again."""
    n, k, half, torque = flow.n, flow.k, 0.5 * duration, work.u[0]
    total, effects, theta, before = work.effects[:], flow.effects[:], work.theta[:], work.before[:]
    stack, moved, x, upsilon = work.stack[:], work.moved[:], work.stack[0], work.stack[1:]
    link, motor = work.kicks[0], work.kicks[1]
    turned = flow.turned[:] if nominal else work.turned[:]
    gamma = flow.gamma[:] if nominal else work.gamma[:]
    for place in range(EFFECTS):
        total[place] = 0.0
        for i in range(k):
            total[place] += half * (theta[i] * effects[i, place])
    total[LINK_SINE] -= half * flow.gravity_gain
    for part in range(2):
        if part == 1:
            if with_covariance:
                _carry(flow, nominal, work)
            multiply_padded(stack, turned, moved, k + 1, turned.shape[1])
            copy(moved, stack, k + 1, n)
            for j in range(n):
                x[j] += gamma[j, 0] * torque
        sin, cos = sine_and_cosine(x[0])
        # What a kick adds to both accelerations, by the state.
        for j in range(4):
            link[j], motor[j], before[j] = total[j], total[4 + j], x[j]
        for j in range(4, link.shape[0]):
            link[j], motor[j] = 0.0, 0.0
        drive, external = torque, 0.0
        if flow.has_unknown != 0:
            # What θ̂ does to the known torque, it does to its unknown part.
            drive += dot(flow.motor_torque[:], x, n)
            external = dot(flow.link_torque[:], x, n)
        x[1] += (
            dot(link, before, 4)
            + total[LINK_SINE] * sin
            + total[LINK_TORQUE] * drive
            + total[LINK_EXTERNAL] * external
        )
        x[3] += (
            dot(motor, before, 4)
            + total[MOTOR_SINE] * sin
            + total[MOTOR_TORQUE] * drive
            + total[MOTOR_EXTERNAL] * external
        )
        link[0] += total[LINK_SINE] * cos
        motor[0] += total[MOTOR_SINE] * cos
        if flow.has_unknown != 0:
            for j in range(4, n):
                share, other = flow.motor_torque[j], flow.link_torque[j]
                link[j] = total[LINK_TORQUE] * share + total[LINK_EXTERNAL] * other
                motor[j] = total[MOTOR_TORQUE] * share + total[MOTOR_EXTERNAL] * other
        for i in range(k):
            effect = effects[i]
            on_link = dot(link, upsilon[i], link.shape[0])
            on_motor = dot(motor, upsilon[i], link.shape[0])
            upsilon[i, 1] += on_link + half * (
                dot(effect, before, 4)
                + effect[LINK_SINE] * sin
                + effect[LINK_TORQUE] * drive
                + effect[LINK_EXTERNAL] * external
            )
            upsilon[i, 3] += on_motor + half * (
                dot(effect[4:], before, 4)
                + effect[MOTOR_SINE] * sin
                + effect[MOTOR_TORQUE] * drive
                + effect[MOTOR_EXTERNAL] * external
            )
        if with_covariance:
            _shear(n, work)


@compiled
def _carry(flow: Any, nominal: bool, work: Any) -> None:
    """Write Φ Σ Φᵀ + Q into Σ."""
    n, c, half, whole = flow.n, work.covariance[:], work.squares[0], work.squares[1]
    phi = flow.phi[:] if nominal else work.phi[:]
    turned = flow.turned[:] if nominal else work.turned[:]
    noise = flow.noise[:] if nominal else work.noise[:]
    multiply_padded(phi, c, half, n, c.shape[1])
    multiply_padded(half, turned, whole, n, c.shape[1])
    for i in range(n):
        for j in range(i, n):
            total = whole[i, j] + noise[i, j]
            c[i, j], c[j, i] = total, total


@compiled
def _shear(n: int, work: Any) -> None:
    """Write J Σ Jᵀ into Σ for J = I + the two kicks as rows of x₂ and x₄."""
    c, kicks, changes, width = work.covariance[:], work.kicks[:], work.changes[:], work.phi.shape[1]
    multiply_padded(kicks, c, changes, 2, width)
    for j in range(width):
        c[1, j] += changes[0, j]
        c[3, j] += changes[1, j]
    # Of the columns only what is in these rows is not known yet, as Σ is symmetric.
    corner, both = dot(kicks[0], c[1], width), dot(kicks[0], c[3], width)
    c[3, 3] += dot(kicks[1], c[3], width)
    c[1, 1] += corner
    c[3, 1] += both
    c[1, 3] = c[3, 1]
    for j in range(n):
        c[j, 3] = c[3, j]
    for j in range(n):
        c[j, 1] = c[1, j]


@compiled
def _step_system(
    flow: Any,
    phi: Array,
    gamma: Array,
    noise: Array,
    duration: float,
    x: Array,
    upsilon: Array,
    covariance: Array,
    with_covariance: bool,
    theta: Array,
    u: Array,
    work: Any,
) -> None:
    """Take the exponential midpoint step; see `ts_flow`."""
    n, k = flow.n, flow.k
    vectors, rows, squares = work.vectors[:], work.rows[:], work.squares[:]
    forced, coasted, middle, turned = vectors[0], vectors[1], vectors[3], vectors[4]
    carried, half_way, entering = rows[0], rows[1], rows[2]
    first, second, inner, outer = squares[0], squares[1], squares[2], squares[3]
    apply(gamma, u, forced, n, flow.inputs)
    apply(phi, x, coasted, n, n)
    for p in range(k):
        apply(phi, upsilon[p], carried[p], n, n)
    for j in range(n):
        coasted[j] += forced[j]
        middle[j] = x[j]
        for p in range(k):
            half_way[p, j] = upsilon[p, j]
    for part in range(2):
        # First at the start, for half a step, then in the middle, for the whole.
        jacobian = first if part == 0 else second
        _enter(flow, middle, half_way, theta, u, entering, jacobian, work)
        rate = vectors[2]
        if part == 0:
            apply(phi, rate, turned, n, n)
            for j in range(n):
                middle[j] = coasted[j] + 0.5 * duration * turned[j]
            for p in range(k):
                apply(phi, entering[p], turned, n, n)
                for j in range(n):
                    half_way[p, j] = carried[p, j] + 0.5 * duration * turned[j]
        else:
            for j in range(n):
                middle[j] = coasted[j] + duration * rate[j]
            apply(phi, middle, x, n, n)
            for p in range(k):
                for j in range(n):
                    carried[p, j] += duration * entering[p, j]
                apply(phi, carried[p], upsilon[p], n, n)
    for j in range(n):
        x[j] += forced[j]
    if with_covariance:
        # e⁺ = Φ [Φ + T N₂ Φ (I + (T/2) N₁)] e + Φ (I + T N₂) n₁ + n₂
        for i in range(n):
            for j in range(n):
                first[i, j] *= 0.5 * duration
                second[i, j] *= duration
            first[i, i] += 1.0
        multiply(phi, first, inner, n, n, n)
        multiply(second, inner, outer, n, n, n)
        for i in range(n):
            for j in range(n):
                outer[i, j] += phi[i, j]
            second[i, i] += 1.0
        multiply(phi, outer, inner, n, n, n)
        multiply(phi, second, outer, n, n, n)
        congruence(outer, noise, noise, first, second, n, n)
        congruence(inner, covariance, second, first, covariance, n, n)


@compiled
def _enter(
    flow: Any,
    x: Array,
    upsilon: Array,
    theta: Array,
    u: Array,
    entering: Array,
    jacobian: Array,
    work: Any,
) -> None:
    """Write what enters x and Υ besides the linear flow, and its Jacobian in x."""
    n, k, rules, plant, inputs = flow.n, flow.k, flow.rules, flow.plant, flow.inputs
    signals, premises = plant + inputs, flow.premises
    z, weights, slopes, each = work.premises[:], work.weights[:], work.slopes[:], work.rates[:]
    rate, signal, turning = work.vectors[2], work.signals[:], work.vectors[5]
    premise, schedule = flow.premise[:], flow.schedule[:]
    deviations, directions = flow.deviations[:], flow.directions[:]
    for j in range(signals):
        signal[j] = x[j] if j < plant else u[j - plant]
    for j in range(premises):
        z[j] = dot(premise[j], x, plant) + dot(schedule[j], u[inputs:], flow.m - inputs)
    rule_weights_and_slopes(
        flow.shapes[:rules, :premises],
        flow.parameters[:rules, :premises],
        z[:premises],
        weights[:rules],
        slopes[:rules, :premises],
    )
    for i in range(n):
        rate[i] = 0.0
        for j in range(n):
            jacobian[i, j] = 0.0
    for rule in range(rules):
        for i in range(plant):
            total = 0.0
            for j in range(signals):
                entry = deviations[rule, i, j]
                for p in range(k):
                    entry += theta[p] * directions[p, rule, i, j]
                total += entry * signal[j]
                if j < plant:
                    jacobian[i, j] += weights[rule] * entry
            each[rule, i] = total
            rate[i] += weights[rule] * total
    for rule in range(rules):
        for j in range(plant):
            turning[j] = 0.0
            for q in range(premises):
                turning[j] += slopes[rule, q] * premise[q, j]
        for i in range(plant):
            for j in range(plant):
                jacobian[i, j] += each[rule, i] * turning[j]
    for p in range(k):
        apply(jacobian, upsilon[p], entering[p], n, n)
        for rule in range(rules):
            for i in range(plant):
                entering[p, i] += weights[rule] * dot(directions[p, rule, i], signal, signals)


@compiled
def _integrate(flow: Any, x: Array, y: Array, u: Array, duration: float, work: Any) -> None:
    """Integrate x' = Σ hᵢ(y)(Fᵢ x + Yᵢ y + Uᵢ u) − g sin x₁ in the row of x₂, by Runge–Kutta."""
    n, rules, premises = flow.n, flow.rules, flow.premises
    matrix, vectors, weights = work.squares[0], work.vectors[:], work.weights[:]
    F, Y, U = flow.F[:], flow.Y[:], flow.U[:]
    constant, at, start, sum_of_slopes, slope = (
        vectors[0],
        vectors[1],
        vectors[2],
        vectors[3],
        vectors[4],
    )
    rule_weights(
        flow.shapes[:rules, :premises],
        flow.parameters[:rules, :premises],
        y[:premises],
        weights[:rules],
    )
    for i in range(n):
        constant[i] = 0.0
        for j in range(n):
            matrix[i, j] = 0.0
        for rule in range(rules):
            total = dot(Y[rule, i], y, flow.p) + dot(U[rule, i], u, flow.m)
            constant[i] += weights[rule] * total
            for j in range(n):
                matrix[i, j] += weights[rule] * F[rule, i, j]
    steps = max(1, math.ceil(duration / flow.max_step - 1e-9))
    h = duration / steps
    for _ in range(steps):
        for i in range(n):
            start[i], at[i], sum_of_slopes[i] = x[i], x[i], 0.0
        for stage in range(4):
            apply(matrix, at, slope, n, n)
            if flow.gravity_gain != 0.0:
                slope[1] -= flow.gravity_gain * sine(at[0])
            share = 0.5 * h if stage < 2 else h
            weight = 2.0 if 0 < stage < 3 else 1.0
            for i in range(n):
                slope[i] += constant[i]
                sum_of_slopes[i] += weight * slope[i]
                at[i] = start[i] + share * slope[i]
        for i in range(n):
            x[i] = start[i] + (h / 6.0) * sum_of_slopes[i]
