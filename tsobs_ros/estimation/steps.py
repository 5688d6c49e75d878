# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The steps of an estimator, compiled, each in place on one state record.

    correct:  x̂ ← x̂ + K (y − C̄ x̂)        predict:  x̂ ← flow(x̂, u, T)

The premise variable is the estimate x̂₁ itself; the flow's closed form of the T–S blend is exact
on the domain. One rule chooses the gain: the constant certified gain while the certificate's
bound X covers the error covariance, the Riccati (Kalman) gain along the estimate while it does
not: after a start, a reset or a missed sample. The hand-over rests on that covariance, which
trusts the initial one and is linearised along the estimate.

Parameters are learnt by a filtered-regressor (two-stage) adaptive observer after Q. Zhang (2002):
Υ = ∂x̂/∂θ is filtered through the observer's own error dynamics, so that the innovation is explained
as e = Ω θ̃ + noise with Ω = C̄Υ, whatever the relative degree of the sensor. A change δ of θ follows
by recursive least squares with a bounded gain, projected on its known bounds. It is used from when
it is significant. The regressor is taken at the estimate, so innovations count for less while that
is uncertain, and what was learnt far from the truth is learnt again. Learning rests if the model is
wrong in other ways, and comes back with time.

Supervision works on each output by itself. The size of white noise is that of the differences of
neighbouring innovations, in which a wrong model does not show. The colour of a wrong model is the
product of neighbours, in which white noise does not. An innovation that is far too large is an
outlier and has little influence. Eight that lean to one side of a sudden are a jump of the sensor.
A long average that is far too large, and of one side, is an estimate that has lost the arm, or a
sensor that lies if the other outputs are as expected. Everything is decided on the innovation in
sigmas of the present noise and on durations between stamps, and each decision shows in what the
bounds are said to rest on. docs/estimator.md has the rules and their reasons.

An output that is missing, or far beyond reason, is left out. The certified gain is for all of them
together, so then the gain is that of Riccati for the others.
"""

import math
from typing import Any

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.estimation.hypotheses import adopt, predict_alternatives, sleep, weigh
from tsobs_ros.estimation.options import MAX_JUMP_BUDGET
from tsobs_ros.estimation.records import Basis, Hypothesis, Learning
from tsobs_ros.estimation.repeats import count_repeats, forget_value
from tsobs_ros.estimation.state import CERTIFIED, OPEN, WINDOW
from tsobs_ros.estimation.torque import (
    begin_step,
    correct_response,
    distrust_torque,
    enter_gap,
    follow_step,
    forget_step,
    is_open,
    is_suspected,
    weigh_step,
)
from tsobs_ros.model.matrices import (
    congruence,
    copy,
    dot,
    is_below,
    is_nonnegative,
    joseph_form,
    larger,
    quadratic,
    solve,
)
from tsobs_ros.model.stepping import advance
from tsobs_ros.model.trigonometry import exponential

_CERTIFIED, _LEARNT, _STARTING = Basis.CERTIFIED.value, Basis.LEARNT.value, Basis.STARTING.value
_TORQUE, _SUSPICION, _MATTERS = Basis.TORQUE.value, 4.0, 1.0 / 9.0
_GAP, _JUMP, _CONTRADICTED = Basis.GAP.value, Basis.JUMP.value, Basis.CONTRADICTED.value
_HYPOTHESIS = Basis.HYPOTHESIS.value
_AS_DESIGNED = Hypothesis.AS_DESIGNED.value
_COLOURED_NOISE = Hypothesis.COLOURED_NOISE.value
_NONE, _YOUNG, _ACTIVE = Learning.NONE.value, Learning.STARTING.value, Learning.ACTIVE.value
_AFTER_JUMP, _STRAINED = Learning.AFTER_JUMP.value, Learning.STRAINED.value

_CLIP = 5.0
"""Innovations count up to so many σ in averages, so that outliers do not make them."""

_MEDIAN = 0.6745
_LEARNT_BY = 10.0
"""Median of a normal variable's size."""

_NEIGHBOURS = 10.0
"""Innovations are neighbours if at most so many periods lie between them."""

_LEAST_SCALE = 0.5
"""The noise's scale is kept above it, so that it grows in seconds if a quiet sensor gets noisy."""

_USELESS, _EARLY_OUTLIERS, _LOST, _JUMPED, _AS_USUAL = range(5)
"""What an output's innovation is a sign of."""

_BACK, _WIDE = 2.0, 20.0
"""Half-second average of |r| below which an excluded output is used again, and how many times wider
than after a jump the covariance of a sensor's disturbance is if all trust in it is lost."""

_REGULAR, _OUTLIER = 1, 2
"""Kinds of an innovation for the noise's scale, 0 for none."""

_LEANING, _SAME_SIGN, _FAR, _CLOSE = 8, 7, 6, 4
"""A jump: of the newest eight innovations, seven have one sign, six are beyond 1σ, and four
differences of neighbours are small. The newest four have its size."""

_LEAN = 6.0 * math.sqrt(_LEANING)
"""Their least sum: 6σ of white noise."""

_SUDDEN, _EVEN = 0.4, 0.3
"""Largest share of that sum before them, and least ratio of sizes among the newest four."""

_CALM, _STRAIN, _MAX_COLOUR, _SMOOTH = 0.7, 1.0, 0.5, 2.0
"""Coloured powers: the largest before a jump, the least of a wrong model, the largest under a
certified bound, the least of a lost arm. That of white noise has a 1σ of 0.07."""

_MAX_NIS, _DOUBT = 3.0, 3.0
"""A larger `nis` contradicts a certified bound, which then comes back after so long [s]."""

_IN_A_ROW, _EARLY = 5, 1.0
"""So many outliers in a row, within so many seconds after a start, mean that it began from one."""

_LOST_CLIP = 4.0
"""A lone innovation counts up to so many times `lost`."""

_WHITE, _ALIKE = 0.15, 0.9
"""Correlation of neighbours that white noise has by chance, and the largest that is used."""

_MOVING = 6.0
"""A state moves if its deviation over some seconds exceeds so many bounds."""

_PASSES, _CURVED = 4, 0.3
"""How often parameters are learnt again along better regressors, and which share of a distance
regressors are wrong by."""


@compiled
def correct(model: Any, state: Any, y: Array, correction: Any) -> None:
    """Use one measurement.

    Args:
        model: Model record.
        state: Predicted to the measurement's stamp; corrected in place.
        y: Measurement, NaN of an output that is missing, shape (p,).
        correction: Record of `correction_type`, written.
    """
    if state.torque_unknown == 0:
        state.in_gap = 0
    if state.torque_step != 0.0:
        if is_suspected(state):
            _leave_certified(model, state, _TORQUE)
        begin_step(model, state)
    _take_sample(model, state, y, correction)
    _expect(model, state, correction)
    adapt, jumped, suspected = True, False, False
    if model.supervised != 0:
        suspected = weigh_step(model, state, correction)
        jumped = _judge(model, state, correction)
        adapt = state.pause <= 0.0 and state.resting == 0
    used = _count_used(model, correction) if model.gain_mode != OPEN else 0
    if used > 0:
        if used < model.p:
            # The certified gain is for all outputs together.
            _leave_certified(model, state, _GAP)
            _expect(model, state, correction)
        _apply(model, state, correction, adapt)
    if jumped:
        # A jump may be so large that its samples themselves are not used.
        _follow_jumps(model, state)
    if used > 0:
        if model.supervised != 0:
            correct_response(model, state, correction)
            if suspected:
                _leave_certified(model, state, _TORQUE)
                distrust_torque(model, state)
            elif jumped:
                state.evidence = 0.0
            _limit_disturbances(model, state.x[:], state.covariance[:], _width(model, state))
            _guard(model, state)
        if (jumped or suspected) and state.hypothesis == _AS_DESIGNED:
            sleep(model, state)
    if model.supervised != 0 and model.has_alternatives != 0:
        # What is far beyond reason shows nothing, unless the design is what is far off.
        if used > 0 or (not _is_stuck(model, state) and state.hypothesis != _AS_DESIGNED):
            weigh(model, state, correction)
        if state.hypothesis != _AS_DESIGNED:
            chosen = state.alternatives[state.hypothesis - 1]
            _limit_disturbances(
                model,
                chosen.x[:],
                chosen.covariance[:],
                model.alternatives[state.hypothesis - 1].n,
            )
    state.since = 0.0
    for i in range(model.p):
        if state.y[i] == state.y[i]:
            state.sensors[i].since = 0.0
        if correction.weight[i] == 0.0:
            if state.y[i] == state.y[i]:
                state.sensors[i].gated += 1
            else:
                state.sensors[i].missing += 1


@compiled
def _take_sample(model: Any, state: Any, y: Array, correction: Any) -> None:
    """Remember the newest sample of each output, and use those that there are."""
    for i in range(model.p):
        there = math.isfinite(y[i])
        state.y[i] = y[i] if there else math.nan
        correction.weight[i] = 1.0 if there else 0.0
        if there:
            state.sample[i] = y[i]


@compiled
def _count_used(model: Any, correction: Any) -> int:
    used = 0
    for i in range(model.p):
        used += 1 if correction.weight[i] > 0.0 else 0
    return used


@compiled
def _is_stuck(model: Any, state: Any) -> bool:
    """Return whether every sensor is stuck."""
    stuck = True
    for i in range(model.p):
        stuck = stuck and 0 < model.stuck_samples <= state.sensors[i].repeats
    return stuck


@compiled
def _expect(model: Any, state: Any, correction: Any) -> None:
    """Write the innovation of a measurement, its covariance and the gain for it.

    The gain for an output of no weight is 0.
    """
    n, p, k = _width(model, state), model.p, model.k
    S, gain, C, R = correction.innovation_covariance[:], correction.gain[:], model.C[:], model.R[:]
    crossed, factor, omega = correction.crossed[:], correction.factor[:], correction.omega[:]
    innovation, D, x = correction.innovation[:], model.D[:], state.x[:]
    y, weight = state.y[:], correction.weight[:]
    for i in range(p):
        expected = dot(C[i], x, n)
        if model.gain_mode == OPEN:  # else D is zero, but not times infinity
            expected += dot(D[i], state.sample[:], p)
        innovation[i] = y[i] - expected
    if model.gain_mode == OPEN:
        copy(R, S, p, p)
    elif state.certified != 0:
        copy(model.innovation_covariance[:], S, p, p)
        copy(model.K[:], gain, n, p)
    else:
        congruence(C, state.covariance[:], R, crossed, S, p, n)
    known = correction.known[:]
    copy(S, known, p, p)
    if k > 0:
        upsilon, explained, cross = state.upsilon[:], correction.explained[:], correction.cross[:]
        for i in range(p):
            for j in range(k):
                omega[i, j] = dot(C[i], upsilon[j], n)
        congruence(omega, state.gamma[:], correction.nothing[:], cross, explained, p, k)
        for i in range(p):
            for j in range(p):
                S[i, j] += explained[i, j]
    for i in range(p):
        if weight[i] > 0.0:
            continue
        for j in range(p):
            known[i, j], known[j, i] = 0.0, 0.0
        known[i, i] = 1.0
        for j in range(n):
            crossed[i, j] = 0.0
        if k > 0:
            for j in range(k):
                omega[i, j], cross[i, j] = 0.0, 0.0
            for j in range(p):
                explained[i, j], explained[j, i] = 0.0, 0.0
    if model.gain_mode != OPEN and state.certified == 0:
        solve(known, crossed, factor, crossed, p, n)
        for i in range(n):
            for j in range(p):
                gain[i, j] = crossed[j, i]


@compiled
def _width(model: Any, state: Any) -> int:
    """Return the number of states, of the unknown torque too while it is."""
    width: int = model.n_gap if state.in_gap != 0 else model.n
    return width


@compiled
def _apply(model: Any, state: Any, correction: Any, adapt: bool) -> None:
    """Correct estimate and parameters by an innovation, with the outlier's weight.

    The covariance shrinks with the weighted gain too. If it shrank as for a full correction, an
    estimate that is wrong would take sample after sample for an outlier, and its bound would fall.
    """
    n, p, k = _width(model, state), model.p, model.k
    gain, weight, x = correction.gain[:], correction.weight[:], state.x[:]
    innovation = correction.innovation[:]
    adapt = adapt and state.age >= model.adaptation_start
    for j in range(p):
        adapt = adapt and not 0.0 < weight[j] < 1.0
    inflation = 1.0
    if adapt and k > 0 and state.certified == 0:
        # κ ≥ 1, the mean of the error covariance relative to the certified bound, tr(PΣ)/n.
        total, P, covariance = 0.0, model.P[:], state.covariance[:]
        for i in range(model.n):
            total += dot(P[i], covariance[i], model.n)
        inflation = larger(total / model.n, 1.0)
    if model.supervised != 0:
        scale = larger(state.noise_scale, 1.0)
        inflation *= scale * scale * larger(state.nis, 1.0) * _repetition(state)
    for i in range(n):
        for j in range(p):
            if weight[j] > 0.0:
                gain[i, j] *= weight[j]
                x[i] += gain[i, j] * innovation[j]
    state.corrected = 1
    if state.certified != 0:
        state.settling = 0.0
    else:
        joseph_form(
            model.C[:],
            model.R[:],
            state.covariance[:],
            gain,
            correction.squares[:],
            correction.nothing[:],
            state.covariance[:],
            n,
            p,
        )
    if k > 0:
        moves = _moves(model, state)
        _learn(model, state, correction, adapt and moves, inflation)


@compiled
def _moves(model: Any, state: Any) -> bool:
    """Return whether the plant has moved by more than its bounds in the last seconds.

    At rest, regressors follow the noise of the estimate: what they show is false.
    """
    moves, centre, spread, x = False, state.centre[:], state.spread[:], state.x[:]
    share = model.motion_share if state.age >= model.adaptation_start else 1.0
    noise = larger(state.noise_scale, 1.0)
    for i in range(model.plant):
        off = x[i] - centre[i]
        centre[i] += share * off
        spread[i] = (1.0 - share) * (spread[i] + share * off * off)
        least = _MOVING * noise * model.state_std[i]
        moves = moves or spread[i] > least * least
    return moves


@compiled
def _learn(model: Any, state: Any, correction: Any, adapt: bool, inflation: float) -> None:
    """Correct the regressor and, if wanted, the parameters and with them the estimate."""
    n, p, k = _width(model, state), model.p, model.k
    omega, known, explained = correction.omega[:], correction.known[:], correction.explained[:]
    turned, cross, gain = correction.turned[:], correction.cross[:], correction.gain[:]
    upsilon, gram, gamma, theta = state.upsilon[:], state.gram[:], state.gamma[:], state.theta[:]
    limits, x, innovation = model.limits[:], state.x[:], correction.innovation[:]
    factor = correction.factor[:]
    for a in range(p):
        for i in range(k):
            for j in range(n):
                upsilon[i, j] -= omega[a, i] * gain[j, a]
    solve(known, omega, factor, turned, p, k)
    _add_square(gram, omega, turned, 1.0, p, k)
    if adapt:
        for a in range(p):
            for b in range(p):
                known[a, b] = known[a, b] * inflation + explained[a, b]
        solve(known, cross, factor, turned, p, k)  # the transposed gain of θ
        _add_square(gamma, cross, turned, -1.0, p, k)
        shift, pending = correction.shift[:], state.pending[:]
        for i in range(k):
            shift[i, 0] = 0.0
        for a in range(p):
            if correction.weight[a] > 0.0:
                left = innovation[a] - dot(omega[a], pending, k)
                for i in range(k):
                    shift[i, 0] += turned[a, i] * left
        for i in range(k):
            moved = theta[i] + pending[i] + shift[i, 0]
            pending[i] = min(max(moved, -limits[i]), limits[i]) - theta[i]
            shift[i, 0] = pending[i]
        if state.significant == 0:
            solve(gamma, shift, correction.root[:], correction.scaled[:], k, 1)
            total = 0.0
            for i in range(k):
                total += pending[i] * correction.scaled[i, 0]
            if total > model.significance:
                state.significant = 1
        if state.significant != 0:
            for i in range(k):
                for j in range(n):
                    x[j] += upsilon[i, j] * pending[i]
                theta[i] += pending[i]
                pending[i] = 0.0


@compiled
def _add_square(s: Array, a: Array, b: Array, sign: float, p: int, k: int) -> None:
    """Add ± aᵀ b, which is symmetric, to a symmetric matrix."""
    for i in range(k):
        for j in range(i, k):
            total = 0.0
            for c in range(p):
                total += a[c, i] * b[c, j]
            s[i, j] += sign * total
            s[j, i] = s[i, j]


@compiled
def _judge(model: Any, state: Any, correction: Any) -> bool:
    """Weigh each output by its innovation, which the supervision remembers.

    Returns:
        Whether a sensor jumped.
    """
    there, early, lost, off = 0, 0, 0, 0
    jumped, regular, contradicted, colour = False, False, False, 0.0
    for i in range(model.p):
        sensor = state.sensors[i]
        sensor.jumped = 0
        if correction.weight[i] == 0.0:
            continue
        verdict = _judge_output(model, state, i, correction)
        if verdict == _USELESS:
            continue
        if sensor.excluded != 0 and verdict != _JUMPED:
            correction.weight[i] = 0.0
            if sensor.magnitude < _BACK:
                sensor.excluded = 0
            continue
        there += 1
        early += 1 if verdict == _EARLY_OUTLIERS else 0
        lost += 1 if verdict == _LOST else 0
        off += 1 if verdict == _LOST or sensor.nis > _MAX_NIS else 0
        jumped = jumped or verdict == _JUMPED
        if verdict == _AS_USUAL:
            regular, colour = True, larger(sensor.coloured_power, colour)
            contradicted = contradicted or sensor.nis > _MAX_NIS
    if early > 0 and early == there:
        # The first samples were outliers themselves, and the others are taken for some.
        sleep(model, state)
        restart(model, state)
        for i in range(model.p):
            _forget(state.sensors[i])
            state.sensors[i].in_a_row = 0
            correction.weight[i] = 1.0 if math.isfinite(state.y[i]) else 0.0
        state.strained, state.watch_age = 0.0, 0.0
        _expect(model, state, correction)
        jumped = False
    elif lost > 0 and off == there:
        _give_up(model, state, correction)
        jumped = False
    elif jumped or lost > 0:
        jumped = True
        for i in range(model.p):
            sensor = state.sensors[i]
            if lost > 0 and sensor.excluded == 0 and _is_lost(model, sensor):
                # The other outputs are as expected: it is not the arm that is lost.
                if model.disturbed[i] != 0:
                    _forget(sensor)
                sensor.jumped, sensor.excluded = 2, 1 - model.disturbed[i]
                correction.weight[i] = 0.0
        _doubt(state, _JUMP)
        state.strained = 0.0
    elif regular:
        if contradicted or colour > _MAX_COLOUR:
            _doubt(state, _CONTRADICTED)
        state.strained = state.strained + model.period if colour > _STRAIN else 0.0
    _sum_up(model, state)
    return jumped


@compiled
def _judge_output(model: Any, state: Any, i: int, correction: Any) -> int:
    """Weigh one output by its innovation and return what that is a sign of."""
    sensor, y = state.sensors[i], state.y[i]
    variance = correction.innovation_covariance[i, i]
    innovation = correction.innovation[i]
    count_repeats(sensor, y, innovation, variance, model.R[i, i], 0.0)
    if 0 < model.stuck_samples <= sensor.repeats:
        if sensor.repeats == model.stuck_samples:
            _distrust(model, state, i, correction, model.stuck_samples)
        correction.weight[i] = 0.0
        return _USELESS
    r = innovation / math.sqrt(variance) if variance >= 0.0 else math.nan
    if not math.isfinite(r):
        correction.weight[i] = 0.0
        return _USELESS
    _scale_noise(model, sensor, innovation, model.innovation_covariance[i, i])
    r /= larger(sensor.noise_scale, 1.0)
    size, recent, calm, sizes = abs(r), sensor.recent[:], sensor.calm[:], sensor.sizes[:]
    limit = model.gate * math.sqrt(larger(sensor.coloured_power, 1.0))
    weight = 1.0
    if size > limit:
        weight = (limit / size) * (limit / size)
    if size > model.reject:
        weight = 0.0
    correction.weight[i] = weight
    clipped = min(max(r, -_CLIP), _CLIP)
    coloured = sensor.coloured_power
    if sensor.watched > 0:
        product = clipped * recent[sensor.watched - 1]
        coloured += model.second_share * (product - coloured)
    if sensor.watched == WINDOW:
        for j in range(WINDOW - 1):
            recent[j], calm[j], sizes[j] = recent[j + 1], calm[j + 1], sizes[j + 1]
    else:
        sensor.watched += 1
    recent[sensor.watched - 1] = clipped
    sizes[sensor.watched - 1] = abs(innovation)
    calm[sensor.watched - 1] = sensor.coloured_power
    sensor.nis += model.second_share * (clipped * clipped - sensor.nis)
    # A lone value of any size must not give the estimate up.
    bounded = min(size, _LOST_CLIP * model.lost)
    sensor.magnitude += model.magnitude_share * (bounded - sensor.magnitude)
    sensor.coloured_power = coloured
    sensor.in_a_row = sensor.in_a_row + 1 if weight < 1.0 else 0
    early = state.settling > 0.0 and state.watch_age < _EARLY
    if early and sensor.in_a_row >= _IN_A_ROW:
        return _EARLY_OUTLIERS
    if _is_lost(model, sensor):
        return _LOST
    if weight < 1.0:
        state.outliers += 1
    leans = _leans(model, sensor) and calm[0] < _CALM and state.evidence < _SUSPICION
    if leans and _may_jump(model, state, sensor):
        least = abs(innovation)
        for j in range(WINDOW - _CLOSE, WINDOW):
            least = min(least, sizes[j])
        sensor.leap, sensor.jumped = math.copysign(least, innovation), 1
        if model.p > 1 and model.disturbed[i] == 0:
            # It may be wrong all the same, which the other outputs decide.
            _distrust(model, state, i, correction, _LEANING)
            sensor.excluded, correction.weight[i] = 1, 0.0
        # The averages start over: they belong to the time before the jump.
        _forget(sensor)
        if sensor.excluded != 0:
            sensor.magnitude = model.lost
        _note_jump(model, state, sensor)
        return _JUMPED
    return _AS_USUAL


@compiled
def _distrust(model: Any, state: Any, i: int, correction: Any, samples: int) -> None:
    """Add to the covariance what an output's newest samples have done, as they may be wrong."""
    sensor, gain, total = state.sensors[i], correction.gain[:], 0.0
    for j in range(max(sensor.watched - samples, 0), sensor.watched):
        total += math.copysign(sensor.sizes[j], sensor.recent[j])
    _leave_certified(model, state, _GAP)
    covariance = state.covariance[:]
    for a in range(model.n):
        for b in range(model.n):
            covariance[a, b] += total * gain[a, i] * (total * gain[b, i])


@compiled
def _is_lost(model: Any, sensor: Any) -> bool:
    """Return whether innovations of one side have been far too large for long."""
    lost: bool = sensor.magnitude > model.lost and sensor.coloured_power > _SMOOTH
    return lost


@compiled
def _give_up(model: Any, state: Any, correction: Any) -> None:
    """Start the estimate over, after the sample, which may be the worst of those that led here.

    The disturbance is wide open, as a sensor is lost more often than the arm.
    """
    if state.hypothesis != _AS_DESIGNED:
        adopt(model, state)
    else:
        sleep(model, state)
        restart(model, state)
        for i in range(model.p):
            if math.isfinite(model.disturbance_limit[i]):
                _inflate(model, state, i, model.disturbance_limit[i])
        state.corrected = 1
    for i in range(model.p):
        sensor = state.sensors[i]
        _forget(sensor)
        sensor.jump_count, sensor.excluded, correction.weight[i] = 0, 0, 0.0
        ages = sensor.jump_ages[:]
        for j in range(MAX_JUMP_BUDGET):
            ages[j] = 0.0
    state.strained, state.watch_age, state.losses = 0.0, 0.0, state.losses + 1
    _doubt(state, _STARTING)
    chosen = state.alternatives[max(state.hypothesis - 1, 0)]
    if state.hypothesis == _AS_DESIGNED or chosen.nis > _MAX_NIS:
        sleep(model, state)


@compiled
def _sum_up(model: Any, state: Any) -> None:
    """Take the largest of the used outputs' averages for those of all."""
    nis, coloured, scale, there = -math.inf, -math.inf, -math.inf, 0
    for i in range(model.p):
        sensor = state.sensors[i]
        if model.p == 1 or (state.y[i] == state.y[i] and sensor.excluded == 0):
            nis, coloured = max(nis, sensor.nis), max(coloured, sensor.coloured_power)
            scale, there = max(scale, sensor.noise_scale), there + 1
    if there > 0:
        state.nis, state.coloured_power, state.noise_scale = nis, coloured, scale


@compiled
def _follow_jumps(model: Any, state: Any) -> None:
    """Move the disturbance of a sensor that jumped, and open its covariance."""
    disturbed = False
    for i in range(model.p):
        disturbed = disturbed or (state.sensors[i].jumped != 0 and model.disturbed[i] != 0)
    if not disturbed:
        return
    _unlearn(model, state)
    for i in range(model.p):
        if state.sensors[i].jumped == 1 and model.disturbed[i] != 0:
            _leap(model, state, i)
    _leave_certified(model, state, _JUMP)
    for i in range(model.p):
        sensor = state.sensors[i]
        if sensor.jumped != 0 and model.disturbed[i] != 0:
            widest = min(model.disturbance_limit[i], _WIDE * model.jump_std[i])
            _inflate(model, state, i, model.jump_std[i] if sensor.jumped == 1 else widest)
            state.jumps += 1
    state.settling = max(model.jump_duration, state.settling)
    state.corrected, state.pause = 1, model.jump_duration


@compiled
def _doubt(state: Any, basis: int) -> None:
    state.doubt, state.doubted = _DOUBT, basis


@compiled
def _repetition(state: Any) -> float:
    """Return how many innovations say as much about parameters as one of white noise.

    Neighbours that are alike repeat each other. Slow innovations may come of what is not learnt;
    soon after a start they come of what is still to be learnt.
    """
    share = min(max(state.coloured_power / larger(state.nis, 1.0) - _WHITE, 0.0), _ALIKE)
    if state.hypothesis == _COLOURED_NOISE:
        share = _ALIKE
    samples: float = (1.0 + share) / (1.0 - share)
    if state.hypothesis != _AS_DESIGNED or state.age >= _LEARNT_BY:
        samples = larger(state.slow_power, samples)
    return samples


@compiled
def _scale_noise(model: Any, sensor: Any, innovation: float, variance: float) -> None:
    """Follow the size of white noise by the running median of neighbouring differences.

    It is a stochastic approximation in the logarithm of the scale.

    Args:
        model: Model record.
        sensor: Of the output.
        innovation: Of its newest sample.
        variance: Of its innovations under the certified gain.
    """
    elapsed = sensor.since
    limit = larger(sensor.noise_scale, 1.0) * model.gate
    kind = _REGULAR
    if abs(innovation) > limit * math.sqrt(variance):
        kind = _OUTLIER
    # An outlier and its neighbour show nothing; if most are outliers, the noise is larger.
    if sensor.paired == kind and elapsed <= _NEIGHBOURS * model.period:
        expected = math.sqrt(2.0 * variance) * _MEDIAN
        rate = larger(20.0 / (1.0 + 20.0 * sensor.scale_age), 1.0)
        step = 1.0 + 0.5 * rate * elapsed
        if abs(innovation - sensor.previous) > sensor.noise_scale * expected:
            sensor.noise_scale *= step
        else:
            sensor.noise_scale = larger(sensor.noise_scale / step, _LEAST_SCALE)
        sensor.scale_age += elapsed
    sensor.previous, sensor.paired = innovation, kind


@compiled
def _note_jump(model: Any, state: Any, sensor: Any) -> None:
    jump_ages = sensor.jump_ages[:]
    while sensor.jump_count >= model.jump_budget:
        sensor.jump_count -= 1
        for i in range(sensor.jump_count):
            jump_ages[i] = jump_ages[i + 1]
    jump_ages[sensor.jump_count] = state.watch_age
    sensor.jump_count += 1


@compiled
def _forget(sensor: Any) -> None:
    """Start the averages and the window of the innovations over."""
    sensor.nis, sensor.magnitude, sensor.coloured_power = 1.0, 1.0, 0.0
    sensor.watched, sensor.paired = 0, 0
    recent, calm = sensor.recent[:], sensor.calm[:]
    for i in range(WINDOW):
        recent[i], calm[i] = 0.0, 0.0


@compiled
def _leans(model: Any, sensor: Any) -> bool:
    """Return whether the newest innovations lean to one side, of a sudden and all alike."""
    if sensor.watched < WINDOW:
        return False
    total, before, positives, up, down, recent = 0.0, 0.0, 0, 0, 0, sensor.recent[:]
    # A torque makes them lean as the second power of time: within a window, but not at once.
    for i in range(_LEANING if model.t == 0 else 2 * _LEANING):
        before += recent[i]
    for i in range(WINDOW - _LEANING, WINDOW):
        total += recent[i]
        positives += 1 if recent[i] > 0.0 else 0
        up += 1 if recent[i] > 1.0 else 0
        down += 1 if recent[i] < -1.0 else 0
    # A few outliers can make the sum.
    same = max(positives, _LEANING - positives) >= _SAME_SIGN and max(up, down) >= _FAR
    if not same or abs(total) <= _LEAN:
        return False
    # A wrong model makes them lean little by little.
    if before * math.copysign(1.0, total) > _SUDDEN * abs(total):
        return False
    # All of the newest must be from after the jump, since they show its size.
    least, most = _CLIP, 0.0
    for i in range(WINDOW - _CLOSE, WINDOW):
        least, most = min(least, abs(recent[i])), max(most, abs(recent[i]))
    if least < _EVEN * most:
        return False
    # Nor is it a jump if the samples differ as much among themselves, as in a burst of noise.
    close, reach = 0, 0.5 * abs(total) / _LEANING
    for i in range(WINDOW - _LEANING + 1, WINDOW):
        close += 1 if abs(recent[i] - recent[i - 1]) < reach else 0
    return close >= _CLOSE


@compiled
def _may_jump(model: Any, state: Any, sensor: Any) -> bool:
    if model.jump_std[0] == 0.0 or model.jump_budget == 0 or state.watch_age < model.jump_quiet:
        return False
    count = sensor.jump_count
    if count > 0 and state.watch_age - sensor.jump_ages[count - 1] < model.jump_duration:
        return False
    full = count >= model.jump_budget
    return not full or state.watch_age - sensor.jump_ages[0] > model.jump_budget_window


@compiled
def _limit_disturbances(model: Any, x: Array, covariance: Array, n: int) -> None:
    """Keep each disturbance ω = h w within its limit, by the likeliest change of all states.

    A change of w alone would leave the innovation unexplained.
    """
    for i in range(model.p):
        h, limit = model.disturbance_map[i], model.disturbance_limit[i]
        omega = dot(h, x, model.n)
        if abs(omega) <= limit:
            continue
        variance = quadratic(covariance, h, model.n)
        if variance > 0.0:
            excess = omega - math.copysign(limit, omega)
            for j in range(n):
                x[j] -= excess * (dot(h, covariance[j], model.n) / variance)


@compiled
def _leap(model: Any, state: Any, output: int) -> None:
    """Move a disturbance by the least of the innovations that lean, by the smallest change."""
    h, x = model.disturbance_map[output], state.x[:]
    square = dot(h, h, model.n)
    for j in range(model.n):
        x[j] += state.sensors[output].leap * (h[j] / square)


@compiled
def _unlearn(model: Any, state: Any) -> None:
    """Go back to the parameters of before a jump, of which the first samples were learnt from."""
    k, theta, pending, upsilon = model.k, state.theta[:], state.pending[:], state.upsilon[:]
    x = state.x[:]
    for i in range(k):
        change = state.theta_before[1, i] - theta[i]
        theta[i] += change
        pending[i] = state.pending_before[1, i]
        for j in range(model.n):
            x[j] += upsilon[i, j] * change
        for j in range(k):
            state.gamma[i, j] = state.gamma_before[1, i, j]
    _keep_nothing_else(model, state)


@compiled
def _keep(model: Any, state: Any) -> None:
    """Remember what was learnt, the last two times that as many samples as a window had passed."""
    k = model.k
    if state.kept > 0:
        state.kept -= 1
        return
    state.kept = _LEANING
    for i in range(k):
        state.theta_before[1, i] = state.theta_before[0, i]
        state.theta_before[0, i] = state.theta[i]
        state.pending_before[1, i] = state.pending_before[0, i]
        state.pending_before[0, i] = state.pending[i]
        for j in range(k):
            state.gamma_before[1, i, j] = state.gamma_before[0, i, j]
            state.gamma_before[0, i, j] = state.gamma[i, j]


@compiled
def _guard(model: Any, state: Any) -> None:
    """Learn from the start if learning goes astray; let it rest if that happens too often."""
    k = model.k
    if k == 0:
        return
    _keep(model, state)
    far, at_limit = False, False
    theta, anchor, limits = state.theta[:], state.anchor[:], model.limits[:]
    reach = model.pass_reach * math.sqrt(model.theta_variance)
    for i in range(k):
        at_limit = at_limit or abs(theta[i]) >= limits[i]
        far = far or abs(theta[i] - anchor[i]) > reach
    state.pinned = state.pinned + model.period if at_limit else 0.0
    if state.relearned <= model.relearn_budget - 1.0:
        state.resting = 0
    if far and state.passes < _PASSES and state.pass_age > model.pass_time:
        # What was learnt far from the truth was learnt along wrong regressors.
        state.passes += 1
        _relearn(model, state)
    if state.pass_age < model.pass_time:
        state.strained, state.pinned = 0.0, 0.0
    astray = state.strained >= model.strain or state.pinned >= model.strain
    if state.hypothesis != _AS_DESIGNED or not astray or state.resting != 0:
        return
    state.pinned, state.strained = 0.0, 0.0
    if state.relearned > model.relearn_budget - 1.0:
        state.resting = 1
        for i in range(k):
            theta[i] = 0.0
        copy(model.initial.gram[:], state.gram[:], k, k)
        _relearn(model, state)
        return
    state.relearned += 1.0
    state.adaptation_resets += 1
    state.passes = 0
    _relearn(model, state)


@compiled
def _relearn(model: Any, state: Any) -> None:
    """Forget how well the parameters are known, but not the parameters."""
    k = model.k
    copy(model.initial.gamma[:], state.gamma[:], k, k)
    copy(model.initial.upsilon[:], state.upsilon[:], k, model.n)
    theta, anchor, pending = state.theta[:], state.anchor[:], state.pending[:]
    state.pass_age = 0.0
    for i in range(k):
        anchor[i], pending[i] = theta[i], 0.0
    _keep_nothing_else(model, state)


@compiled
def _keep_nothing_else(model: Any, state: Any) -> None:
    for _ in range(2):
        state.kept = 0
        _keep(model, state)


@compiled
def restart(model: Any, state: Any) -> None:
    """Set the estimate and the adaptation to those before any measurement; the rest stays."""
    initial = model.initial
    state.settling, state.age = initial.settling, 0.0
    state.certified, state.corrected, state.in_gap, state.cause = 0, 0, 0, _STARTING
    for i in range(model.p):
        forget_value(state.sensors[i])
    n, k, x, theta = model.n, model.k, state.x[:], state.theta[:]
    for i in range(n):
        x[i] = 0.0
    anchor, pending, state.significant, state.pass_age = state.anchor[:], state.pending[:], 0, 0.0
    state.passes = 0
    for i in range(k):
        theta[i], anchor[i], pending[i] = 0.0, 0.0, 0.0
    copy(initial.covariance[:], state.covariance[:], n, n)
    copy(initial.gamma[:], state.gamma[:], k, k)
    copy(initial.upsilon[:], state.upsilon[:], k, n)
    copy(initial.gram[:], state.gram[:], k, k)
    _keep_nothing_else(model, state)
    forget_step(model, state)


@compiled
def _inflate(model: Any, state: Any, output: int, std: float) -> None:
    """Add uncertainty to a disturbance's states, for a change that the model does not foresee.

    Args:
        model: Model record.
        state: After a correction, with a Riccati gain.
        output: The one that is disturbed.
        std: 1σ of what is added to each state that the disturbance is read from.
    """
    h, covariance = model.disturbance_map[output], state.covariance[:]
    for i in range(model.n):
        if h[i] != 0.0:
            covariance[i, i] += std * std


@compiled
def _leave_certified(model: Any, state: Any, cause: int) -> None:
    if cause == _JUMP:
        state.cause = cause
    if state.certified != 0:
        state.cause = cause
        bound = model.posterior[:] if state.corrected != 0 else model.X[:]
        copy(bound, state.covariance[:], model.n, model.n)
        state.certified = 0


@compiled
def predict(
    model: Any, state: Any, u: Array, duration: float, between_samples: bool, work: Any
) -> None:
    """Predict over a time.

    Args:
        model: Model record.
        state: Corrected, or not if the measurement is missing; moved in place.
        u: Inputs held over the time, shape (m,).
        duration: [s], at least 0.
        between_samples: Whether the time ends before the next sample and the result is only read.
            The certified bound serves the whole interval to the next regular sample, and with
            `late_factor` a period beyond.
        work: Scratch record of the flow, and of the flow in a gap.
    """
    shortest = 0.0 if between_samples else model.shortest
    regular = shortest <= duration and duration <= model.longest and state.torque_unknown == 0
    as_proved = state.certified != 0 and state.corrected != 0
    late = between_samples and not regular and state.torque_unknown == 0
    late = late and as_proved and duration <= 2.0 * model.period and model.late_factor >= 1.0
    state.late = 1 if late else 0
    simple = model.gain_mode == OPEN or late or (as_proved and regular)
    if not simple:
        _leave_certified(model, state, _GAP)
    n, k = model.n, model.k
    unknown = state.in_gap != 0 or state.torque_unknown != 0 or duration > model.longest
    in_gap = not simple and model.n_gap > 0 and unknown
    if in_gap and state.in_gap == 0:
        enter_gap(model, state)
    advance(
        model.gap if in_gap else model.flow,
        state.x[:],
        state.upsilon[:],
        state.covariance[:],
        not simple,
        state.theta[:],
        state.sample[:],
        u,
        duration,
        work.flow,
    )
    state.in_gap = 1 if in_gap else 0
    state.corrected = 0
    if not simple:
        state.settling = max(0.0, state.settling - duration)
        if (
            not (between_samples or in_gap)
            and model.gain_mode == CERTIFIED
            and state.settling <= 0.0
            and is_below(state.covariance[:], model.X[:], work.square[:], n)
        ):
            state.certified = 1
            copy(model.X[:], state.covariance[:], n, n)
    if state.awake != 0:
        predict_alternatives(model, state, u, duration, work)
    if not between_samples:
        follow_step(model, state, duration, work)
        state.torque_age += duration
        state.distrust = max(0.0, state.distrust - duration)
        state.pause = max(0.0, state.pause - duration)
        state.watch_age += duration
        state.since += duration
        for i in range(model.p):
            state.sensors[i].since += duration
        state.doubt = max(0.0, state.doubt - duration)
        state.relearned = max(0.0, state.relearned - duration / model.relearn_time)
        if k > 0:
            _forget_slowly(model, state, duration)


@compiled
def _forget_slowly(model: Any, state: Any, duration: float) -> None:
    """Let the excitation fade and Γ grow, but no variance beyond the initial one."""
    k, gamma, gram = model.k, state.gamma[:], state.gram[:]
    fade = exponential(-duration / model.memory)
    for i in range(k):
        gamma[i, i] += model.random_walk * duration
        for j in range(k):
            gram[i, j] *= fade
    for i in range(k):
        variance = gamma[i, i]
        if variance > model.theta_variance:
            shrink = math.sqrt(model.theta_variance / variance)
            for j in range(k):
                gamma[i, j] *= shrink
                gamma[j, i] *= shrink
    state.age += duration
    if state.age >= model.adaptation_start:
        state.pass_age += duration


@compiled
def read(model: Any, state: Any, readout: Any, work: Any) -> None:
    """Write the estimate and its bounds in physical units into a record of `readout_type`.

    The bounds include the uncertainty of the parameters, for x − x̂ is the observer's own error plus
    Υ(θ − θ̂), of covariance ΥΓΥᵀ.
    """
    n, p, k, plant = model.n, model.p, model.k, model.plant
    states, bounds, scale, std = (
        readout.state[:],
        readout.state_bound[:],
        model.scale[:],
        model.state_std[:],
    )
    x, y, covariance = state.x[:], state.sample[:], state.covariance[:]
    upsilon, gamma, theta = state.upsilon[:], state.gamma[:], state.theta[:]
    pending = state.pending[:]
    noise = larger(state.noise_scale, 1.0) if model.supervised != 0 else 1.0
    uncertain = model.gain_mode != OPEN and state.certified == 0
    response, open_torque = state.response[:], is_open(model, state)
    spread = noise * model.late_factor if state.late != 0 else noise
    if state.hypothesis != _AS_DESIGNED:
        alternative = state.alternatives[state.hypothesis - 1]
        x, covariance, upsilon = (
            alternative.x[:],
            alternative.covariance[:],
            alternative.upsilon[:],
        )
        spread *= math.sqrt(larger(alternative.nis, 1.0))
        uncertain = bool(1)
    share = work.small[0]
    total, doubtful = 0.0, 0.0
    for i in range(plant):
        for a in range(k):
            share[a] = upsilon[a, i]
        if open_torque:
            doubtful = response[i]
        variance = covariance[i, i] if uncertain else 0.0
        states[i] = scale[i] * x[i]
        bound = _bound(std[i], variance, spread, gamma, share, pending, k, doubtful)
        bounds[i] = scale[i] * bound
        total += states[i] + bounds[i]
    for i in range(p + model.t):
        is_output = i < p
        h = model.disturbance_map[i] if is_output else model.torque_map[i - p]
        least = model.disturbance_std[i] if is_output else model.torque_std[i - p]
        for a in range(k):
            share[a] = dot(h, upsilon[a], n)
        if open_torque:
            doubtful = dot(h, response, n)
        variance = quadratic(covariance, h, n) if uncertain else 0.0
        value = dot(h, x, n)
        bound = _bound(least, variance, spread, gamma, share, pending, k, doubtful)
        if is_output:
            if model.gain_mode == OPEN:
                value += dot(model.disturbance_direct[i], y, p)
            readout.disturbance[i], readout.disturbance_bound[i] = value, bound
            rate = dot(model.rate_map[i], x, n)
            readout.disturbance_rate[i] = rate
            total += rate
            if state.hypothesis == _AS_DESIGNED:
                readout.designed_disturbance[i], readout.designed_bound[i] = value, bound
            else:
                readout.designed_disturbance[i] = dot(h, state.x[:], n)
                readout.designed_bound[i] = noise * least
        else:
            readout.torque_disturbance[i - p] = value
            readout.torque_disturbance_bound[i - p] = bound
        total += value + bound
    for i in range(k):
        readout.parameters[i] = theta[i]
        # What was learnt over a distance is wrong by a share of it: regressors move with x̂.
        moved = _CURVED * (theta[i] + pending[i] - state.anchor[i])
        readout.parameter_bound[i] = _root(gamma[i, i] + pending[i] * pending[i] + moved * moved)
        total += readout.parameters[i] + readout.parameter_bound[i]
    readout.basis = _basis(model, state)
    readout.noise_scale, readout.coloured_power = noise, state.coloured_power
    readout.learning = _learning(model, state)
    readout.hypothesis = state.hypothesis
    readout.parameters_valid = 0
    designed = state.hypothesis == _AS_DESIGNED
    trusted = designed and state.resting == 0 and state.coloured_power <= _MAX_COLOUR
    if k > 0 and trusted and _is_excited(model, state, work):
        readout.parameters_valid = 1
    readout.finite = 1 if math.isfinite(total) else 0


@compiled
def _bound(
    least: float,
    variance: float,
    spread: float,
    gamma: Array,
    share: Array,
    pending: Array,
    k: int,
    doubtful: float,
) -> float:
    """Return the 1σ bound of a linear function of the estimate.

    Args:
        least: Of the certificate.
        variance: Along the estimate, 0 if that does not count.
        spread: Factor of both.
        gamma: Covariance of the parameters.
        share: What the function gains by each parameter.
        pending: Changes of the parameters that are not used yet.
        k: Number of parameters.
        doubtful: What suspected steps of the torque have done to the function.
    """
    own = larger(_root(variance), least) * spread
    shift = dot(share, pending, k)
    added = larger(quadratic(gamma, share, k), 0.0) + shift * shift + doubtful * doubtful
    return _root(own * own + added)


@compiled
def _basis(model: Any, state: Any) -> int:
    """Return the code of `Basis` that a state's bounds have."""
    if state.hypothesis != _AS_DESIGNED:
        nis = state.alternatives[state.hypothesis - 1].nis
        return _CONTRADICTED if nis > _MAX_NIS else _HYPOTHESIS
    if state.doubt > 0.0:
        doubted: int = state.doubted
        return doubted
    if state.certified == 0:
        cause: int = state.cause
        return cause
    if is_suspected(state) and quadratic(model.P[:], state.response[:], model.n) > _MATTERS:
        return _TORQUE
    return _LEARNT if model.k > 0 and model.covered == 0 else _CERTIFIED


@compiled
def _learning(model: Any, state: Any) -> int:
    """Return the code of `Learning` of a state."""
    if model.k == 0:
        return _NONE
    if state.resting != 0:
        return _STRAINED
    if state.pause > 0.0:
        return _AFTER_JUMP
    return _ACTIVE if state.age >= model.adaptation_start else _YOUNG


@compiled
def _root(variance: float) -> float:
    return math.sqrt(variance) if variance >= 0.0 else math.nan


@compiled
def _is_excited(model: Any, state: Any, work: Any) -> bool:
    """Return whether the motion has been rich enough for θ̂ to count."""
    gram = work.small[:]
    copy(state.gram[:], gram, model.k, model.k)
    for i in range(model.k):
        gram[i, i] -= model.excitation
    return is_nonnegative(gram, model.k)


@compiled
def write_row(model: Any, readout: Any, row: Array) -> int:
    """Write the numbers of a readout one after the other; return how many they are.

    State, its bound, disturbance, its rate, its bound, parameters, their bounds, the disturbance
    and its bound if all is as designed, torques, their bounds; then those of `state.CONDITIONS`.
    """
    plant, p, k = model.plant, model.p, model.k
    states, bounds = readout.state[:], readout.state_bound[:]
    for i in range(plant):
        row[i], row[plant + i] = states[i], bounds[i]
    at = 2 * plant
    for i in range(p):
        row[at + i] = readout.disturbance[i]
        row[at + p + i] = readout.disturbance_rate[i]
        row[at + 2 * p + i] = readout.disturbance_bound[i]
    at += 3 * p
    for i in range(k):
        row[at + i], row[at + k + i] = readout.parameters[i], readout.parameter_bound[i]
    at += 2 * k
    for i in range(p):
        row[at + i], row[at + p + i] = readout.designed_disturbance[i], readout.designed_bound[i]
    at += 2 * p
    for i in range(model.t):
        row[at + i] = readout.torque_disturbance[i]
        row[at + model.t + i] = readout.torque_disturbance_bound[i]
    at += 2 * model.t
    row[at], row[at + 1] = readout.basis, readout.parameters_valid
    row[at + 2], row[at + 3] = readout.noise_scale, readout.coloured_power
    row[at + 4], row[at + 5] = readout.learning, readout.hypothesis
    end: int = at + 6
    return end
