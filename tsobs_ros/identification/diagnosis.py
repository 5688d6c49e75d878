# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a fitted model on recordings: the quality of its predictions, and its gaps."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.request import TorqueDisturbance
from tsobs_ros.identification.joint import DELAY, FRICTION, OFFSET, Found, Joint, Unknowns
from tsobs_ros.identification.likelihood import GATE, Recording, innovations
from tsobs_ros.model.disturbance import DisturbanceTerm

HORIZON = 1.0
"""Length of a compared free run [s]; longer runs of an arm without gravity drift away."""

_WARM_UP, _MAX_RUNS = 2.0, 20
"""Time of filtering before a free run [s], and number of free runs."""


class OutputFit(NamedTuple):
    """The quality of an output's prediction on the held-out part.

    Attributes:
        name: The output's name.
        one_step: 100 (1 − |y − ŷ|/|y − mean y|) with ŷ one sample ahead [%].
        free_run: The same with ŷ simulated from the torque alone for `HORIZON` [%].
        innovation_std: 1σ of the innovations relative to the expected one; 1 for a right model.
        correlation: Correlation of neighbouring innovations; 0 if they are white.
        outliers: Number of innovations beyond `GATE`, whose samples are not in the first two.
    """

    name: str
    one_step: float
    free_run: float
    innovation_std: float
    correlation: float
    outliers: int


class Traces(NamedTuple):
    """The held-out part or, if there is none, the end of the recording, for figures.

    Attributes:
        time: [s], shape (n,).
        measured: Outputs, shape (n, p).
        predicted: One sample ahead, shape (n, p).
        simulated: From the torque alone, piece by piece, shape (n, p).
        residual: Innovations divided by their expected 1σ, shape (n, p).
        torque: Torque of the log [N m], shape (n,).
        velocity: Estimated velocity of the motor [rad/s], shape (n,).
        unexplained: Torque at the motor that model and log lack [N m], shape (n,).
    """

    time: Array
    measured: Array
    predicted: Array
    simulated: Array
    residual: Array
    torque: Array
    velocity: Array
    unexplained: Array


def output_fits(
    joint: Joint, recording: Recording, begin: int
) -> tuple[tuple[OutputFit, ...], Traces]:
    """Return the quality of each output's prediction from sample `begin` on, and the traces.

    The recording includes the samples before, so that the filter has settled at `begin`.
    """
    found, late = innovations(joint, recording), slice(begin, None)
    measured, simulated = recording.y[late], _simulated(joint, recording, begin)
    predicted, residual = measured - found.errors[late], found.standardised[late]
    fits = []
    columns = zip(measured.T, predicted.T, simulated.T, residual.T, strict=True)
    for name, (y, ahead, made, r) in zip(joint.request.output_names, columns, strict=True):
        there, clean = np.abs(r) <= GATE, np.clip(r[np.isfinite(r)], -GATE, GATE)
        run = np.isfinite(made) & there
        fits.append(
            OutputFit(
                name,
                one_step=_fit(y[there], ahead[there]),
                free_run=_fit(y[run], made[run]),
                innovation_std=float(np.sqrt((clean**2).mean())),
                correlation=float(clean[1:] @ clean[:-1]) / (float(clean @ clean) or 1.0),
                outliers=len(clean) - int(there.sum()),
            )
        )
    time, torque = recording.time[late], recording.u[late]
    velocity = joint.request.arm.to_physical(found.states[late, :4])[:, 3]
    unexplained = _unexplained(joint, recording)[late]
    traces = Traces(time, measured, predicted, simulated, residual, torque, velocity, unexplained)
    return tuple(fits), traces


def _simulated(joint: Joint, recording: Recording, begin: int) -> Array:
    """Return the outputs simulated from the torque alone, for a horizon from several starts."""
    period = joint.request.period
    span, warm = round(HORIZON / period), round(_WARM_UP / period)
    made = np.full_like(recording.y, np.nan)
    starts = list(range(max(begin, 1), recording.count - 1, span))
    for start in starts[:: max(1, len(starts) // _MAX_RUNS)]:
        first, end = max(0, start - warm), min(start + span, recording.count)
        part = recording.part(first, end)
        if (part.durations[:-1] >= 0.0).all():
            found = innovations(joint, part, corrected_until=start - first)
            made[start:end] = (part.y - found.errors)[start - first :]
    return made[begin:]


def _fit(measured: Array, made: Array) -> float:
    """Return 100 (1 − |y − ŷ|/|y − mean y|) [%], NaN for an output that does not move."""
    spread = float(np.linalg.norm(measured - measured.mean())) if len(measured) else 0.0
    return 100.0 * (1.0 - float(np.linalg.norm(measured - made)) / spread) if spread else math.nan


def unseen(unknowns: Unknowns, information: Array) -> tuple[str, ...]:
    """Return in words the directions in which recordings, by their information (k, k), do not halve
    the prior's 1σ.
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
"""The motion that would show a number, by a part of the number's name."""


def news(numbers: Sequence[Found]) -> tuple[list[str], list[str]]:
    """Return findings that the request did not have: those that a request can have, and others."""
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


def _unexplained(joint: Joint, recording: Recording) -> Array:
    """Return the torque at the motor that a model without process noise there lacks [N m]."""
    request = joint.request
    size = 0.1 * request.arm.reference_torque
    quick = DisturbanceTerm("gauss_markov", {"std": size, "time_constant": 0.05})
    known = request.torque_disturbance
    looking = replace(
        request,
        # Otherwise the process noise would explain most of the torque.
        process_noise=replace(request.process_noise, motor=0.0),
        torque_disturbance=TorqueDisturbance((*known.motor, quick), known.link),
    )
    states = innovations(replace(joint, request=looking), recording).states
    return np.asarray(states @ looking.flow.torques[0])
