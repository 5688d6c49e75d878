# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a fitted model on recordings: how well it predicts, and what it lacks."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from tsobs_ros.checks import Array
from tsobs_ros.design.request import TorqueDisturbance
from tsobs_ros.identification.joint import (
    DELAY,
    FRICTION,
    OFFSET,
    Found,
    Joint,
    Unknowns,
)
from tsobs_ros.identification.likelihood import GATE, Recording, innovations
from tsobs_ros.identification.result import OutputFit, Traces
from tsobs_ros.model.disturbance import DisturbanceTerm

HORIZON = 1.0
"""Time for which a free run is compared [s]: longer ones of an arm without gravity drift away."""

_WARM_UP = 2.0
"""Time of filtering before a free run [s]."""

_MAX_RUNS = 20

_TONE = 20.0
"""Power of a tone by the mean of the spectrum around it: by chance e⁻²⁰ at a given frequency."""


def output_fits(
    joint: Joint, recording: Recording, begin: int
) -> tuple[tuple[OutputFit, ...], Traces]:
    """Return how well each output is predicted from a sample on, and the traces.

    The recording is whole, so that the filter has settled at `begin`.
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
        power = float(clean @ clean) or 1.0
        fits.append(
            OutputFit(
                output.measures,
                one_step=_fit(y[there], predicted[there, place]),
                free_run=_fit(y[run], made[run]) if run.any() else math.nan,
                horizon=HORIZON,
                innovation_std=float(np.sqrt((clean**2).mean())),
                correlation=float(clean[1:] @ clean[:-1]) / power,
            )
        )
    traces = Traces(
        recording.time[begin:],
        measured,
        predicted,
        simulated,
        residual[begin:],
        recording.u[begin:],
        request.arm.to_physical(found.states[begin:, :4]),
        _unexplained(joint, recording)[begin:],
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


def unseen(unknowns: Unknowns, information: Array) -> tuple[str, ...]:
    """Return the directions in which recordings, by their information (k, k), know less than the
    prior, in words.
    """
    values, vectors = np.linalg.eigh(information)
    found = []
    for vector in vectors.T[values <= 3.0]:
        order = [at for at in np.argsort(-np.abs(vector)) if abs(vector[at]) >= 0.3]
        names = [unknowns.numbers[at].name for at in order]
        motion = next((text for part, text in _MOTIONS.items() if part in names[0]), "")
        found.append(" and ".join(name.removeprefix("arm.") for name in names) + motion)
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


def news(numbers: Sequence[Found]) -> tuple[list[str], list[str]]:
    """Return what was found that the request did not have: what one can have, and the rest."""
    added, lacks = list[str](), list[str]()
    for each in numbers:
        name, _, last = each.name.rpartition(".")
        value = f"{each.value:.3g} {each.unit}"
        if not each.significant or each.before:
            continue
        if each.name in FRICTION:
            side = last.removesuffix("_friction")
            added.append(f"Coulomb friction of the {side}, {value}, as a torque disturbance")
        elif each.name == DELAY and each.value < 0.0:
            lacks.append(f"a torque that acts {-each.value:.3g} s before its stamp")
        elif each.name in (OFFSET, DELAY) or last.endswith("damping"):
            added.append(f"{last} of the {name.replace('arm', 'joint')}, {value}")
        elif last == "offset":
            lacks.append(f"offset of {name}, {value}; subtract it from what the driver publishes")
    return added, lacks


def tones(joint: Joint, recording: Recording) -> list[str]:
    """Return the tones in the outputs' innovations."""
    found, request = [], joint.request
    r = innovations(joint, recording).standardised
    for place, output in enumerate(request.sensors):
        clean = np.nan_to_num(np.clip(r[:, place], -GATE, GATE))
        power = np.abs(np.fft.rfft(clean * np.hanning(len(clean)))) ** 2
        frequencies = np.fft.rfftfreq(len(clean), request.period)
        # The median of a wide neighbourhood, by the mean of an exponential variable's.
        level = median_filter(power, 2 * max(10, len(power) // 100) + 1) / math.log(2)
        ratio = power / np.maximum(level, 1e-300)
        ratio[:4] = 0.0
        peak = int(ratio.argmax())
        if ratio[peak] > _TONE:
            hertz = float(frequencies[peak])
            std = float(np.sqrt(request.measurement_covariance[place, place]))
            # A window's gain of a tone's power by that of noise.
            size = std * math.sqrt(2.0 * float(ratio[peak]) / len(clean) * 3.0)
            found.append(
                f"a tone of {hertz:.3g} Hz in {output.measures}, about {size:.2g} in size; its "
                f"disturbance: {{kind: sinusoid, frequency: {2.0 * math.pi * hertz:.4g}}}"
            )
    return found


def _unexplained(joint: Joint, recording: Recording) -> Array:
    """Return the torque at the motor that a model without process noise there lacks [N m]."""
    request = joint.request
    size = 0.1 * request.arm.reference_torque
    quick = DisturbanceTerm("gauss_markov", {"std": size, "time_constant": 0.05})
    known = request.torque_disturbance
    looking = replace(
        request,
        # Else it would take most of the torque.
        process_noise=replace(request.process_noise, motor=0.0),
        torque_disturbance=TorqueDisturbance((*known.motor, quick), known.link),
    )
    states = innovations(replace(joint, request=looking), recording).states
    return np.asarray(states @ looking.flow.motor_torque)
