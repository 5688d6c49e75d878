# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bank of hypotheses about what the design lacks, each an extended Kalman filter, compiled.

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

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled
from tsobs_ros.estimation.records import Hypothesis
from tsobs_ros.model.flow import ArmFlow, ForceFlow
from tsobs_ros.model.matrices import copy, dot, quadratic
from tsobs_ros.model.prediction import Flow, fill_matrix
from tsobs_ros.model.stepping import advance
from tsobs_ros.model.trigonometry import exponential, logarithm
from tsobs_ros.model.uncertainty import Uncertainty

ALTERNATIVES = len(Hypothesis) - 1
"""Hypotheses besides the design, in the order of `Hypothesis`."""

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

_HYSTERESIS, _MAX_SCORE = 1.0, 9.0
"""What the selected design gains, and how far a score can fall behind the best."""

_SIGN_TIME, _SIGN_POWER_TIME, _SCORE_TIME = 0.4, 5.0, 20.0
"""Time constants of the slow innovation, of its power, and of what a score forgets [s]."""

_WAKING_SLOW, _WAKING_COLOUR = 0.7, 0.3
"""Powers of the slow and of the coloured innovations, either of which wakes the bank."""

_CALM_SLOW, _CALM_COLOUR = 0.5, 0.2
"""The same below which both let it sleep."""

_SETTLED, _SURE_TIME, _LEAST_TIME = 4.0, 1.0, 5.0
"""Times from a start to the earliest waking, from there to a selection, and to sleep [s]."""

_LEARNT, _PASS = 10.0, 2.5
"""Ages of learning, and of learning again, before which θ̂ may be wrong [s]."""

_CLIP, _MAX_WHITE = 3.0, 2.0
"""The largest innovation that counts [σ], and the white power above which none does."""

_DESIGNED_COLOUR, _LEAST_COLOUR = 0.6, 0.05
"""Coloured powers: of coloured noise as assumed, and the least that counts in its favour."""

_SMOOTH = 0.8
"""A noise scale below it means that neighbours differ by less than white noise."""

_AS_DESIGNED, _LAST_FORCE = Hypothesis.AS_DESIGNED.value, Hypothesis.STRONG_FORCE.value
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
    whites = [variances] * ALTERNATIVES
    whites[_COLOURED - 1] = variances * WHITE_SHARE
    own[_COLOURED - 1] = (*stds, *own[_COLOURED - 1])
    numbers = zip(flows, whites, own, _PRIORS, _HYSTERESES, strict=True)
    bank: list[Alternative | None] = [Alternative(*each) for each in numbers]
    if flow.torque_disturbance is not None:
        # The design has a force of its own.
        bank[: len(FORCES)] = [None] * len(FORCES)
    return bank


def enter_alternatives(
    model: Any, bank: list[Alternative | None], uncertainty: Uncertainty | None
) -> None:
    """Enter the hypotheses into one model record, whose period is there already."""
    model["has_alternatives"] = 1
    for record, assumed in zip(model["alternatives"], bank, strict=True):
        if assumed is None:
            continue
        n = assumed.flow.state_count
        assumed.flow.fill(record["flow"], uncertainty)
        fill_matrix(record["C"], assumed.flow.output_matrix)
        fill_matrix(record["variances"], assumed.variances)
        for place, std in enumerate(assumed.initial_std, n - len(assumed.initial_std)):
            record["added"][place] = std * std
        record["n"] = n
        record["prior"], record["hysteresis"] = assumed.prior, assumed.hysteresis
    period = float(model["period"])
    model["sign_share"] = 1.0 - exponential(-period / _SIGN_TIME)
    model["sign_power_share"] = 1.0 - exponential(-period / _SIGN_POWER_TIME)
    model["score_fade"] = exponential(-period / _SCORE_TIME)


@compiled
def weigh(model: Any, state: Any, correction: Any) -> None:
    """Weigh the hypotheses by one measurement, and correct those that are awake.

    Args:
        model: Model record.
        state: Corrected by the measurement.
        correction: Its effect.
    """
    expected = correction.innovation_covariance[:]
    for i in range(model.p):
        if _shows(model, state, i) and not (
            expected[i, i] > 0.0 and math.isfinite(correction.innovation[i])
        ):
            return
    # White noise that has just grown is not in the scale yet, and a jump not in the estimate.
    bursting = state.nis - max(state.coloured_power, 0.0) > _MAX_WHITE
    if state.awake == 0 and (bursting or state.pause > 0.0):
        return
    designed, smooth = _weigh_design(model, state, correction), True
    for i in range(model.p):
        smooth = smooth and state.sensors[i].noise_scale < _SMOOTH
    if state.awake == 0:
        suspicious = state.slow_power > _WAKING_SLOW or state.coloured_power > _WAKING_COLOUR
        # They begin from an estimate that has settled.
        if suspicious and state.watch_age > _SETTLED:
            _wake(model, state)
        return
    # A wrong θ̂ looks like a force until it is learnt, and like noise if that is not small between
    # neighbours.
    young = model.k > 0 and (state.age < _LEARNT or state.pass_age < _PASS)
    young = young and not 0 < state.hypothesis <= _LAST_FORCE
    state.score = state.score * model.score_fade + designed
    best, finite = state.score, True
    for i in range(ALTERNATIVES):
        if model.alternatives[i].n == 0:
            continue
        alternative = state.alternatives[i]
        gain, ratio = _correct(model, state, i, correction)
        if bursting or (young and not (smooth and i == _COLOURED - 1)):
            gain = designed
        if i == _COLOURED - 1 and state.coloured_power < _LEAST_COLOUR:
            # Its white part is small, which is likely of any sensor that is quieter than designed.
            gain = min(gain, designed)
        alternative.nis += model.second_share * (ratio - alternative.nis)
        alternative.score = alternative.score * model.score_fade + gain
        finite = finite and math.isfinite(alternative.score)
        best = max(best, alternative.score)
    if not finite:
        sleep(model, state)
        return
    state.score = max(state.score - best, -_MAX_SCORE)
    for i in range(ALTERNATIVES):
        alternative = state.alternatives[i]
        alternative.score = max(alternative.score - best, -_MAX_SCORE)
    # A jump or a loss of track is found sooner.
    if state.awake_time < _SURE_TIME:
        return
    selected, most = _AS_DESIGNED, state.score
    if state.hypothesis == _AS_DESIGNED:
        most += _HYSTERESIS
    for i in range(ALTERNATIVES):
        if model.alternatives[i].n == 0:
            continue
        value = state.alternatives[i].score - model.alternatives[i].prior
        if state.hypothesis == i + 1:
            value += model.alternatives[i].hysteresis
        if value > most:
            selected, most = i + 1, value
    state.hypothesis = selected
    calm = state.slow_power < _CALM_SLOW and state.coloured_power < _CALM_COLOUR
    if calm and selected == _AS_DESIGNED and state.awake_time > _LEAST_TIME:
        sleep(model, state)


@compiled
def _shows(model: Any, state: Any, i: int) -> bool:
    """Return whether an output's newest sample shows what arm and sensor are."""
    sensor = state.sensors[i]
    stuck = 0 < model.stuck_samples <= sensor.repeats
    there: bool = state.y[i] == state.y[i] and sensor.excluded == 0 and not stuck
    return model.p == 1 or there


@compiled
def _weigh_design(model: Any, state: Any, correction: Any) -> float:
    """Follow the slow innovations; return the logarithm of the sample's likelihood as designed.

    The outputs are weighed one after the other, each given those before it.
    """
    expected, factor = correction.innovation_covariance[:], correction.factor[:]
    whitened, likelihood, power = correction.crossed[0], 0.0, -math.inf
    for i in range(model.p):
        if not _shows(model, state, i):
            for j in range(i + 1):
                factor[i, j] = 0.0
            whitened[i] = 0.0
            continue
        sensor = state.sensors[i]
        scale = max(sensor.noise_scale, 1.0)
        variance = scale * scale * expected[i, i]
        innovation = correction.innovation[i]
        r = min(max(innovation / math.sqrt(variance), -_CLIP), _CLIP)
        share = model.sign_share
        sensor.slow += share * (r - sensor.slow)
        slow = sensor.slow * sensor.slow * ((2.0 - share) / share)
        sensor.slow_power += model.sign_power_share * (slow - sensor.slow_power)
        power = max(power, sensor.slow_power)
        for j in range(i):
            other = max(state.sensors[j].noise_scale, 1.0)
            entry = scale * other * expected[i, j]
            for a in range(j):
                entry -= factor[i, a] * factor[j, a]
            factor[i, j] = entry / factor[j, j] if factor[j, j] > 0.0 else 0.0
            innovation -= factor[i, j] * whitened[j]
            variance -= factor[i, j] * factor[i, j]
        factor[i, i] = math.sqrt(variance)
        whitened[i] = innovation / factor[i, i]
        r = min(max(whitened[i], -_CLIP), _CLIP)
        likelihood += -0.5 * (r * r + logarithm(variance))
    if power >= 0.0:
        state.slow_power = power
    return likelihood


@compiled
def _correct(model: Any, state: Any, place: int, correction: Any) -> tuple[float, float]:
    """Correct an alternative by one output after the other.

    Returns:
        The logarithm of the sample's likelihood, and the mean square of its innovations in sigmas,
        each clipped.
    """
    assumed, alternative = model.alternatives[place], state.alternatives[place]
    n, k = assumed.n, model.k
    x, covariance, upsilon = alternative.x[:], alternative.covariance[:], alternative.upsilon[:]
    crossed, gain = correction.crossed[0], correction.crossed[1]
    omega, width = correction.turned[0], covariance.shape[1]
    # Whole rows of four become vector instructions; behind the numbers in use are zeros.
    padded = (n + 3) // 4 * 4
    likelihood, total, count = 0.0, 0.0, 0
    for output in range(model.p):
        if not _shows(model, state, output):
            continue
        sensor, C = state.sensors[output], assumed.C[output]
        scale = max(sensor.noise_scale, 1.0)
        if place == _COLOURED - 1:
            # The white scale is of differences, which coloured noise hardly has.
            scale *= math.sqrt(max(sensor.coloured_power / _DESIGNED_COLOUR, 1.0))
        for j in range(padded):
            entry = 0.0
            for i in range(width):
                entry += covariance[i, j] * C[i]
            crossed[j] = entry
        known = dot(C, crossed, n) + assumed.variances[output]
        for a in range(k):
            omega[a] = dot(C, upsilon[a], width)
        variance = scale * scale * (known + quadratic(state.gamma[:], omega, k))
        alternative.variances[output] = variance
        innovation = state.y[output] - dot(C, x, width)
        ratio, weight = innovation * innovation / variance, 1.0
        if ratio > model.gate * model.gate:
            weight = model.gate * model.gate / ratio
        for i in range(padded):
            gain[i] = crossed[i] / known
            x[i] += gain[i] * (weight * innovation)
        for i in range(n):
            for j in range(padded):
                covariance[i, j] -= crossed[i] * crossed[j] / known
        for a in range(k):
            for i in range(padded):
                upsilon[a, i] -= omega[a] * gain[i]
        ratio = min(ratio, _CLIP * _CLIP)
        likelihood += -0.5 * (ratio + logarithm(variance))
        total, count = total + ratio, count + 1
    return likelihood, total / max(count, 1)


@compiled
def _wake(model: Any, state: Any) -> None:
    """Begin the alternatives from the estimate."""
    n, k = model.n, model.k
    for i in range(ALTERNATIVES):
        assumed, alternative = model.alternatives[i], state.alternatives[i]
        x, covariance, upsilon = alternative.x[:], alternative.covariance[:], alternative.upsilon[:]
        # All the room, so that there is no trace of numbers that were not finite.
        for a in range(x.shape[0]):
            x[a] = state.x[a] if a < n else 0.0
            for b in range(x.shape[0]):
                covariance[a, b] = 0.0
            covariance[a, a] = assumed.added[a]
            for b in range(k):
                upsilon[b, a] = state.upsilon[b, a] if a < n else 0.0
        if assumed.n > 0:
            copy(
                model.posterior[:] if state.certified != 0 else state.covariance[:],
                covariance,
                n,
                n,
            )
        alternative.score, alternative.nis = 0.0, 1.0
    state.awake, state.awake_time, state.score = 1, 0.0, 0.0


@compiled
def sleep(model: Any, state: Any) -> None:
    """Take arm and sensor for what the design says, until there are new signs."""
    state.awake, state.hypothesis, state.slow_power = 0, _AS_DESIGNED, 0.0
    for i in range(model.p):
        state.sensors[i].slow, state.sensors[i].slow_power = 0.0, 0.0


@compiled
def adopt(model: Any, state: Any) -> None:
    """Take the selected hypothesis' estimate and covariance for those of the estimator."""
    alternative = state.alternatives[state.hypothesis - 1]
    for i in range(model.n):
        state.x[i] = alternative.x[i]
    copy(alternative.covariance[:], state.covariance[:], model.n, model.n)
    state.certified, state.corrected, state.in_gap = 0, 1, 0


@compiled
def predict_alternatives(model: Any, state: Any, u: Array, duration: float, work: Any) -> None:
    """Predict the alternatives over a time.

    Args:
        model: Model record.
        state: Predicted over the time, which is not in its ages yet.
        u: Inputs held over the time, shape (m,).
        duration: [s].
        work: Scratch record of a prediction.
    """
    begin = state.torque_age if state.torque_unknown != 0 else state.since
    wider = 0.0
    if state.in_gap != 0 and math.isfinite(begin):
        # The known torque moves unseen.
        wider = model.rate_variance * (2.0 * begin + duration) * duration
    for i in range(ALTERNATIVES):
        assumed, alternative = model.alternatives[i], state.alternatives[i]
        if assumed.n == 0:
            continue
        covariance, force = alternative.covariance[:], assumed.n - 1
        covariance[force, force] += wider
        advance(
            assumed.flow,
            alternative.x[:],
            alternative.upsilon[:],
            covariance,
            bool(1),
            state.theta[:],
            state.y[:],
            u,
            duration,
            work.flow,
        )
    state.awake_time += duration
