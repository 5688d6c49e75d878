# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a fitted model on recordings: how well it predicts, and what it lacks.

What it lacks shows in two ways: a tone in the innovations, and a torque that a filter with an
unknown torque at the motor finds and that follows a velocity, the spring's deflection or an angle.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from tsobs_ros.checks import Array
from tsobs_ros.design.problem import DisturbanceTerm
from tsobs_ros.design.request import TorqueDisturbance
from tsobs_ros.identification.joint import (
    DELAY,
    FRICTION,
    OFFSET,
    Joint,
    Unknowns,
    with_values,
)
from tsobs_ros.identification.likelihood import GATE, Recording, innovations
from tsobs_ros.identification.result import Found, Lack, OutputFit, Traces, Unseen

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


def output_fits(
    joint: Joint, recording: Recording, begin: int
) -> tuple[tuple[OutputFit, ...], Traces]:
    """Return how well each output is predicted from a sample on, and the traces.

    Args:
        joint: The joint.
        recording: A recording whole, so that the filter has settled at `begin`.
        begin: First sample of the part that is judged.
    """
    request = joint.request
    found = innovations(joint, recording)
    residual = found.standardised
    simulated = _simulated(joint, recording, begin)
    measured = recording.y[begin:]
    predicted = measured - (residual * np.sqrt(found.variances))[begin:]
    fits = []
    for place, output in enumerate(request.sensors):
        r, y, made = residual[begin:, place], measured[:, place], simulated[:, place]
        there = np.isfinite(r)
        run = np.isfinite(made) & there
        clean = np.clip(r[there], -GATE, GATE)
        power, n, lags = float(clean @ clean) or 1.0, len(clean), np.arange(1, _LAGS + 1)
        correlations = np.array([float(clean[lag:] @ clean[:-lag]) / power for lag in lags])
        q = n * (n + 2) * float((correlations**2 / (n - lags)).sum())
        fits.append(
            OutputFit(
                output.measures,
                one_step=_fit(y[there], predicted[there, place]),
                free_run=_fit(y[run], made[run]) if run.any() else math.nan,
                horizon=HORIZON,
                innovation_std=float(np.sqrt((clean**2).mean())),
                correlation=float(correlations[0]),
                whiteness=float(chi2.sf(q, _LAGS)),
            )
        )
    # Else process noise would take most of it.
    noise = replace(request.process_noise, motor=0.0)
    torque_driven = replace(joint, request=replace(request, process_noise=noise))
    traces = Traces(
        recording.time[begin:],
        measured,
        predicted,
        simulated,
        residual[begin:],
        recording.u[begin:],
        request.arm.to_physical(found.states[begin:, :4]),
        _unexplained(torque_driven, recording)[0][begin:],
    )
    return tuple(fits), traces


def _simulated(joint: Joint, recording: Recording, begin: int) -> Array:
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
        found = innovations(joint, part, corrected_until=start - first)
        made[start - begin : end - begin] = (part.y - found.errors)[start - first :]
    return made


def _fit(measured: Array, made: Array) -> float:
    """Return 100 (1 − |y − ŷ|/|y − mean y|) [%]."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    return 100.0 * (1.0 - float(np.linalg.norm(measured - made)) / spread) if spread else math.nan


def unseen(unknowns: Unknowns, information: Array) -> tuple[Unseen, ...]:
    """Return the directions in which recordings know less than the prior.

    Args:
        unknowns: What was estimated.
        information: Of the recordings, shape (k, k).
    """
    values, vectors = np.linalg.eigh(information)
    names = [each.name for each in unknowns.numbers]
    found = []
    for value, vector in zip(values.tolist(), vectors.T.tolist(), strict=True):
        if value > 3.0:
            break
        pairs = [each for each in zip(names, vector, strict=True) if abs(each[1]) >= 0.3]
        parts = tuple(sorted(pairs, key=lambda each: -abs(each[1])))
        *others, last = [name.removeprefix("arm.") for name, _ in parts]
        shown = f"{', '.join(others)} and {last}, which look alike" if others else last
        motion = next((text for name, text in _MOTIONS.items() if name in parts[0][0]), "")
        found.append(Unseen(parts, f"{shown}{motion}"))
    return tuple(found)


_MOTIONS = {
    "stiffness": ": a motion near the joint's resonance would show it",
    "gravity": ": slow motion through larger angles would show it",
    "inertia": ": faster accelerations would show it",
    "damping": ": long motion at several speeds would show it",
    "friction": ": slow motion with many reversals would show it, if there is any",
    "offset": ": rest at several angles, or motion in both directions, would show it",
    "delay": ": steps of the torque would show it",
    "process_noise": ": it is too small to matter beside the other noises",
    "time_constant": ": a longer recording would show it",
    "density": ": a longer recording would show it",
}
"""What would show a number, by a part of its name."""


def found_lacks(numbers: Sequence[Found]) -> list[Lack]:
    """Return what was found that the request did not have."""
    made = []
    for each in numbers:
        if not each.significant or each.before:
            continue
        value = f"{each.value:.3g} {each.unit}"
        if each.name in FRICTION:
            side = each.name.removesuffix("_friction")
            entry = f"the fitted request has a torque disturbance of the {side} for it"
            made.append(Lack(f"Coulomb friction of the {side}, {value}", entry, True))
        elif each.name == OFFSET:
            made.append(Lack(f"an offset of the torque, {value}", _HAS_IT, True))
        elif each.name.endswith(".offset"):
            name = each.name.removesuffix(".offset")
            entry = "subtract it from what the driver publishes"
            made.append(Lack(f"an offset of {name}, {value}", entry))
        elif each.name == DELAY and each.value > 0.0:
            made.append(Lack(f"a delay of the torque, {value}", _HAS_IT, True))
        elif each.name == DELAY:
            made.append(Lack(f"a torque that acts {-each.value:.3g} s before its stamp", ""))
        elif each.name.endswith("damping"):
            made.append(Lack(f"{each.name.removeprefix('arm.')} of {value}", _HAS_IT, True))
    return made


_HAS_IT = "the fitted request has it"


def remaining_lacks(joint: Joint, recordings: Sequence[Recording]) -> list[Lack]:
    """Return what a fitted model still lacks, by the longest recording."""
    longest = max(recordings, key=lambda recording: recording.count)
    return [*_tones(joint, longest), *_torques(joint, longest)]


def _tones(joint: Joint, recording: Recording) -> list[Lack]:
    """Return the tones of an output's innovations."""
    found, request = [], joint.request
    r = innovations(joint, recording).standardised
    for place, output in enumerate(request.sensors):
        clean = np.nan_to_num(np.clip(r[:, place], -GATE, GATE))
        power = np.abs(np.fft.rfft(clean * np.hanning(len(clean)))) ** 2
        frequencies = np.fft.rfftfreq(len(clean), request.period)
        half = max(10, len(power) // 100)
        # The median of a wide neighbourhood, by the mean of an exponential variable's.
        around = np.array(
            [np.median(power[max(0, i - half) : i + half + 1]) for i in range(0, len(power), half)]
        )
        places = np.arange(len(power))
        level = np.interp(places, places[::half], around) / math.log(2)
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


def _unexplained(joint: Joint, recording: Recording) -> tuple[Array, Array]:
    """Return the torque at the motor that a model lacks, and the states."""
    request = joint.request
    size = 0.1 * request.arm.reference_torque
    quick = DisturbanceTerm("gauss_markov", {"std": size, "time_constant": 0.05})
    known = request.torque_disturbance
    torques = TorqueDisturbance((*known.motor, quick), known.link)
    looking = replace(joint, request=replace(request, torque_disturbance=torques))
    states = innovations(looking, recording).states
    torque = states @ looking.request.flow.motor_torque
    return torque, request.arm.to_physical(states[:, :4])


def _torques(joint: Joint, recording: Recording) -> list[Lack]:
    """Return what a torque depends on that the model has not."""
    request = joint.request
    skip = min(recording.count // 10, round(1.0 / request.period))
    smooth = with_values(joint, dict.fromkeys(FRICTION, 0.0))
    torque, states = (each[skip:] for each in _unexplained(smooth, recording))
    link, link_speed, motor, motor_speed = states.T
    deflection = link - motor
    slow_speed = 0.02 * float(np.abs(motor_speed).max() or 1.0)
    slack = 0.1 * float(np.abs(deflection).max() or 1.0)
    causes = {
        "Coulomb friction of the motor": np.tanh(motor_speed / slow_speed),
        "friction that grows with the square of the motor's velocity": motor_speed
        * np.abs(motor_speed),
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
    share, text, amount = 0.0, "", 0.0
    for cause, shape in causes.items():
        part = shape - basis @ (basis.T @ shape)
        norm, along = float(part @ part), float(part @ rest)
        explained = norm >= 1e-9 * float(shape @ shape) and total > 0.0
        if explained and along**2 / norm / total > share:
            share, text = along**2 / norm / total, cause
            amount = abs(along / norm) * float(np.abs(part).max())
    if share < _EXPLAINED or amount < 0.003 * request.arm.reference_torque:
        return []
    term = f"{{kind: gauss_markov, std: {amount:.2g}, time_constant: 0.3}}"
    entry = f"torque_disturbance: {{motor: [{term}]}}"
    if request.torque_disturbance.motor:
        entry = "the torque disturbance of the motor takes it up"
    return [Lack(f"{text}, up to {amount:.2g} N m", entry)]
