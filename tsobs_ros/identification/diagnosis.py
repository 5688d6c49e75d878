# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a fitted model on recordings: how well it predicts, and what it lacks.

What it lacks shows in two ways: a tone in the innovations, and a torque that a filter with an
unknown torque at the motor finds and that follows a velocity, the spring's deflection or an angle.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from tsobs_ros.checks import Array
from tsobs_ros.design.problem import DisturbanceTerm
from tsobs_ros.design.request import TorqueDisturbance
from tsobs_ros.identification.joint import Joint
from tsobs_ros.identification.likelihood import Recording, innovations
from tsobs_ros.identification.result import Lack, OutputFit, Traces

HORIZON = 1.0
"""Time for which a free run is compared [s]: longer ones of an arm without gravity drift away."""

_WARM_UP = 2.0
"""Time of filtering before a free run [s]."""

_LAGS = 20
_MAX_RUNS = 20

_TONE = 20.0
"""Power of a tone by the mean of the spectrum around it: by chance e⁻²⁰ at a given frequency."""

_EXPLAINED = 0.25
"""Share of the unknown torque that one cause must explain."""


class Residuals(NamedTuple):
    """Standardised innovations r and expected 1σ of each output, with the predicted states."""

    r: Array
    std: Array
    states: Array


def residuals(joint: Joint, recording: Recording, gate: float) -> Residuals:
    """Return the innovations of a joint over a recording, by their expected 1σ."""
    found = innovations(joint, recording, gate=gate, with_states=True)
    std = np.sqrt(found.variances)
    return Residuals(found.errors / std, std, found.states)


def output_fits(
    joint: Joint, recording: Recording, begin: int, gate: float
) -> tuple[tuple[OutputFit, ...], Traces]:
    """Return how well each output is predicted from a sample on, and the traces.

    Args:
        joint: The joint.
        recording: A recording whole, so that the filter has settled at `begin`.
        begin: First sample of the part that is judged.
        gate: Sigmas beyond which an innovation is an outlier.
    """
    request = joint.request
    found = residuals(joint, recording, gate)
    simulated = _simulated(joint, recording, begin, gate)
    measured = recording.y[begin:]
    predicted = measured - (found.r * found.std)[begin:]
    fits = []
    for place, output in enumerate(request.sensors):
        r = found.r[begin:, place]
        y = measured[:, place]
        there = np.isfinite(r)
        one_step = _fit(y[there], predicted[there, place])
        run = np.isfinite(simulated[:, place]) & there
        free = _fit(y[run], simulated[run, place]) if run.any() else math.nan
        clean = np.clip(r[there], -gate, gate)
        correlations = _correlations(clean, _LAGS)
        n = len(clean)
        q = n * (n + 2) * float((correlations**2 / (n - np.arange(1, _LAGS + 1))).sum())
        fits.append(
            OutputFit(
                output.measures,
                one_step,
                free,
                HORIZON,
                float(np.sqrt((clean**2).mean())),
                float(correlations[0]),
                float(chi2.sf(q, _LAGS)),
            )
        )
    states = request.arm.to_physical(found.states[begin:, :4])
    # Else process noise would take most of it.
    noise = replace(request.process_noise, motor=0.0)
    torque_driven = replace(joint, request=replace(request, process_noise=noise))
    traces = Traces(
        recording.time[begin:],
        measured,
        predicted,
        simulated,
        found.r[begin:],
        recording.u[begin:],
        states,
        _unexplained(torque_driven, recording, gate)[0][begin:],
    )
    return tuple(fits), traces


def _simulated(joint: Joint, recording: Recording, begin: int, gate: float) -> Array:
    """Return the outputs simulated from the torque alone, from some starts for a horizon each."""
    period = joint.request.period
    span, warm = round(HORIZON / period), round(_WARM_UP / period)
    made = np.full((recording.count - begin, recording.y.shape[1]), np.nan)
    starts = list(range(max(begin, 1), recording.count - 1, span))
    for start in starts[:: max(1, len(starts) // _MAX_RUNS)]:
        end = min(start + span, recording.count)
        first = max(0, start - warm)
        part = recording.part(first, end)
        if (part.durations[:-1] < 0.0).any():
            continue
        found = innovations(joint, part, gate=gate, corrected_until=start - first)
        made[start - begin : end - begin] = (part.y - found.errors)[start - first :]
    return made


def _fit(measured: Array, made: Array) -> float:
    """Return 100 (1 − |y − ŷ|/|y − mean y|) [%]."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return 100.0 * (1.0 - float(np.linalg.norm(measured - made)) / spread) if spread else math.nan


def _correlations(r: Array, lags: int) -> Array:
    power = float(r @ r) or 1.0
    return np.array([float(r[lag:] @ r[:-lag]) / power for lag in range(1, lags + 1)])


def lacks(joint: Joint, recordings: Sequence[Recording], gate: float) -> tuple[Lack, ...]:
    """Return what a fitted model still lacks.

    Args:
        joint: The joint.
        recordings: The samples.
        gate: Sigmas beyond which an innovation is an outlier.
    """
    longest = max(recordings, key=lambda recording: recording.count)
    return (*_tones(joint, longest, gate), *_torques(joint, longest, gate))


def _tones(joint: Joint, recording: Recording, gate: float) -> list[Lack]:
    """Return the tones of an output's innovations."""
    found, request = [], joint.request
    r = residuals(joint, recording, gate).r
    for place, output in enumerate(request.sensors):
        clean = np.nan_to_num(np.clip(r[:, place], -gate, gate))
        power = np.abs(np.fft.rfft(clean * np.hanning(len(clean)))) ** 2
        frequencies = np.fft.rfftfreq(len(clean), request.period)
        half = max(10, len(power) // 100)
        # The median of a wide neighbourhood, by the mean of an exponential variable's.
        around = np.array(
            [np.median(power[max(0, i - half) : i + half + 1]) for i in range(0, len(power), half)]
        )
        level = np.interp(np.arange(len(power)), np.arange(0, len(power), half), around) / math.log(
            2
        )
        ratio = power / np.maximum(level, 1e-300)
        ratio[:4] = 0.0
        peak = int(ratio.argmax())
        if ratio[peak] > _TONE:
            hertz = float(frequencies[peak])
            std = float(np.sqrt(request.measurement_covariance[place, place]))
            # A window's gain of a tone's power by that of noise.
            size = std * math.sqrt(2.0 * float(ratio[peak]) / len(clean) * 3.0)
            found.append(
                Lack(
                    f"a tone of {hertz:.3g} Hz in {output.measures}, about {size:.2g} in size",
                    f"disturbance of {output.measures}: "
                    f"{{kind: sinusoid, frequency: {2.0 * math.pi * hertz:.4g}}}",
                )
            )
    return found


def _unexplained(joint: Joint, recording: Recording, gate: float) -> tuple[Array, Array]:
    """Return the torque at the motor that a model lacks, and the states."""
    request = joint.request
    size = 0.1 * request.arm.reference_torque
    quick = DisturbanceTerm("gauss_markov", {"std": size, "time_constant": 0.05})
    known = request.torque_disturbance
    looking = replace(
        joint,
        request=replace(
            request, torque_disturbance=TorqueDisturbance((*known.motor, quick), known.link)
        ),
    )
    states = innovations(looking, recording, gate=gate, with_states=True).states
    torque = states @ looking.request.flow.motor_torque
    return torque, request.arm.to_physical(states[:, :4])


def _torques(joint: Joint, recording: Recording, gate: float) -> list[Lack]:
    """Return what a torque depends on that the model has not."""
    request = joint.request
    skip = min(recording.count // 10, round(1.0 / request.period))
    smooth = replace(joint, friction=(0.0, 0.0))
    torque, states = (each[skip:] for each in _unexplained(smooth, recording, gate))
    link, link_speed, motor, motor_speed = states.T
    deflection = link - motor
    slow_speed = 0.02 * float(np.abs(motor_speed).max() or 1.0)
    slack = 0.1 * float(np.abs(deflection).max() or 1.0)
    causes = {
        "Coulomb friction of the motor": np.tanh(motor_speed / slow_speed),
        "friction that grows with the square of the motor's velocity": (
            motor_speed * np.abs(motor_speed)
        ),
        "backlash or a spring that is softer about its middle": np.tanh(deflection / slack),
        "a spring that stiffens": deflection**3,
        "a torque that depends on the motor's angle, such as cogging or an offset of the angle's "
        "zero": np.sin(motor),
    }
    # What the model has already takes its share of each.
    modelled = np.stack(
        [np.ones(len(torque)), motor_speed, deflection, recording.u[skip:], link_speed], axis=1
    )
    basis, _ = np.linalg.qr(modelled / np.maximum(np.linalg.norm(modelled, axis=0), 1e-300))
    rest = torque - basis @ (basis.T @ torque)
    total = float(rest @ rest)
    best: tuple[float, str, float] = (0.0, "", 0.0)
    for text, shape in causes.items():
        part = shape - basis @ (basis.T @ shape)
        norm = float(part @ part)
        if norm < 1e-9 * float(shape @ shape) or not total:
            continue
        share = float(part @ rest) ** 2 / norm / total
        if share > best[0]:
            best = (share, text, abs(float(part @ rest) / norm) * float(np.abs(part).max()))
    share, text, amount = best
    least = 0.003 * request.arm.reference_torque
    if share < _EXPLAINED or amount < least:
        return []
    term = f"{{kind: gauss_markov, std: {amount:.2g}, time_constant: 0.3}}"
    entry = f"torque_disturbance: {{motor: [{term}]}}"
    if request.torque_disturbance.motor:
        entry = "the torque disturbance of the motor takes it up"
    return [Lack(f"{text}, up to {amount:.2g} N m", entry)]
