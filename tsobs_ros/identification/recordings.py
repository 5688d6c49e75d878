# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings for a fit, from logs, bags and arrays, with errors that are explained in one line.

Common mistakes are the torque's sign, a gear ratio, and units. They show in a likelihood that is
far better with another sign or scale, or in angles that leave the domain.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter1d, median_filter

from tsobs_ros.checks import Array, numbers
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import LogError, ModelError
from tsobs_ros.estimation.records import USED
from tsobs_ros.identification.joint import TORQUE_GAIN, Unknowns, with_values
from tsobs_ros.identification.likelihood import Likelihood, Recording
from tsobs_ros.replay.estimate import open_source
from tsobs_ros.series import NANOSECONDS

Samples = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Times [s], shape (n,), outputs [rad, rad/s], shape (n, p), and torques [N m], shape (n,)."""

LEAST_SAMPLES, LEAST_TIME = 300, 2.0
"""Shortest recording, in samples and [s]."""

_GAP, _JITTER = 3.5, 0.02
"""Periods between samples from which on there is a gap, in which the torque is not known, and the
share of a period within which times count as even."""

_FAR, _FARTHEST = 0.1, 50.0
"""Distance of two angles' zeros that no deflection of a spring explains, and an angle that no joint
reaches even without gravity [rad]."""

_LEAST_MOTION = 8.0
"""Least useful motion, relative to the noise of the sensor."""

_BETTER = 100.0
"""Gain in log-likelihood that another sign or scale of the torque must have to count [nat]."""

_BACK = 1.0
"""Step back in time from which on a clock has restarted, and no sample is just late [s]."""

_OTHER_UNIT = 50.0
"""Ratio of the rates of recording and request from which on times must have another unit."""

_SCALES = tuple(10.0 ** (step / 3.0) for step in range(-12, 13))

_SPIKE, _NEARBY, _ROUNDS = 5.0, 41, 8
"""Distance of an outlier from its neighbours, relative to the median second difference (8σ of white
noise), number of samples of that median, and number of passes, as outliers hide each other."""

DAMAGED = "damaged: "
"""Begin of a note on a recording that could not be read to its end."""

_Raw = tuple[str, Array, Array, Array]
"""Name, times, outputs and torques of a recording."""


def read(
    request: ArmRequest, logs: Sequence[str | Path | Samples], **options: Any
) -> tuple[ArmRequest, list[Recording], list[str]]:
    """Return the request with the recordings' rate, the checked recordings, and remarks.

    Options are those of `open_source`.

    Raises:
        LogError: A recording is unusable; the message names it and the reason, in one line.
        BagReadError: A bag cannot be read.
        ModelError: There is no recording, or arrays have the wrong shape.
    """
    if not logs:
        raise ModelError("logs: expected at least one recording")
    notes = list[str]()
    raw = [part for log in logs for part in _runs(*_samples(request, log, options, notes), notes)]
    period = float(np.median(np.concatenate([np.diff(time) for _, time, _, _ in raw])))
    if not 1.0 / _OTHER_UNIT < period * request.rate < _OTHER_UNIT:
        raise LogError(
            f"{raw[0][0]}: samples are {period:.4g} s apart, in the request "
            f"{request.period:.4g} s: if these are ms, say so: --units "
            "time=ms; else correct the request's rate"
        )
    if abs(period * request.rate - 1.0) > 0.02:
        notes.append(
            f"note: the recording has {1.0 / period:.4g} samples per second, the request "
            f"{request.rate:.4g}: the fitted request has the recording's rate"
        )
        request = replace(request, rate=float(f"{1.0 / period:.6g}"))
    zeros = _zeros(request, np.concatenate([y for _, _, y, _ in raw]))
    if zeros.any():
        shown = ", ".join(f"{zero:.4g} rad" for zero in zeros.tolist())
        names = ", ".join(request.output_names)
        notes.append(f"note: the zeros of the angles differ; subtracted from {names}: {shown}")
    found = []
    for name, time, y, u in raw:
        recording = Recording(time, _even(time, request.period), y - zeros, u)
        for values, output in zip(recording.y.T, request.output_names, strict=True):
            if lost := _leave_out_spikes(time, values):
                count = f"{lost:,} of {int(np.isfinite(values).sum()) + lost:,}"
                notes.append(f"note: {name}: {count} samples of {output} are outliers, left out")
        if lost := int((recording.durations < 0.0).sum()):
            notes.append(f"note: {name}: gaps left out: {lost}")
        try:
            _require_motion(request, recording)
        except LogError as error:
            raise LogError(f"{name}: {error}") from None
        found.append(recording)
    return request, found, notes


def _zeros(request: ArmRequest, y: Array) -> Array:
    """Return the numbers to subtract from outputs with a zero far from the first angle's, (p,)."""
    zeros = np.zeros(len(request.sensors))
    angles = [i for i, one in enumerate(request.sensors) if one.measures.endswith("_angle")]
    for place in angles:
        far = y[:, place] - y[:, angles[0]] + zeros[angles[0]]
        if place == angles[0]:
            # Without gravity an angle has no natural zero.
            far = np.zeros(1) if request.arm.gravity_torque else y[:, place]
        known = far[np.isfinite(far)]
        apart = float(np.median(known)) if len(known) else 0.0
        if abs(apart) > _FAR and not request.sensors[place].model.state_count:
            zeros[place] = float(f"{apart:.4g}")
    return zeros


def _samples(
    request: ArmRequest, log: str | Path | Samples, options: dict[str, Any], notes: list[str]
) -> _Raw:
    """Return the samples of a log, a bag or arrays; remarks on them become notes."""
    if not isinstance(log, str | Path):
        times, y, u = (numbers("logs", each) for each in log)
        y = y.reshape(len(times), -1) if times.ndim == 1 and len(times) else y
        p = len(request.sensors)
        if times.ndim != 1 or y.shape != (len(times), p) or u.shape != times.shape:
            raise ModelError(
                f"logs: expected times (n,), outputs (n, {p}) and torques (n,), got "
                f"{times.shape}, {y.shape} and {u.shape}"
            )
        return "the arrays", times, y, u
    source = open_source(log, **options)
    if len(source.joints) != 1:
        raise LogError(f"{log}: joints {', '.join(source.joints)}: name one of them with --joint")
    source.observe([request])
    notes += source.remarks
    if source.damage is not None:
        notes.append(f"{DAMAGED}{source.damage}; fitted up to there")
    whole = source.samples
    keep = (whole.stamps > 0) & (whole.codes[:, 0] == USED)
    stamps = whole.stamps[keep]
    # As one float, a stamp since the epoch has no digits left below a microsecond.
    times = (stamps - stamps.min(initial=2**62)) / NANOSECONDS
    return str(log), times, whole.y[keep, 0], whole.u[keep, 0, 0]


def _runs(name: str, times: Array, y: Array, u: Array, notes: list[str]) -> list[_Raw]:
    """Return a log's complete samples: as one recording, or as several if its clock restarts."""
    y = np.where(np.isfinite(y), y, np.nan)
    there = np.isfinite(times) & np.isfinite(y).any(axis=1)
    keep = there & np.isfinite(u)
    times, y, u = times[keep], y[keep], u[keep]
    cuts = [0, *(1 + np.flatnonzero(np.diff(times) < -_BACK)).tolist(), len(times)]
    parts = [slice(*ends) for ends in pairwise(cuts) if ends[1] - ends[0] >= LEAST_SAMPLES]
    if parts and (restarts := len(cuts) - 2):
        notes.append(
            f"note: {name}: its clock has restarted ({restarts}): fitted as {len(parts)} recordings"
        )
    lack = f"; {lost:,} others have no torque" if (lost := int((there & ~keep).sum())) else ""
    return [_in_order(name, lack, times[part], y[part], u[part]) for part in parts or [slice(None)]]


def _in_order(name: str, lack: str, times: Array, y: Array, u: Array) -> _Raw:
    """Return samples in order of time, from 0 on; refuse too few, and say what others lack."""
    times, first = np.unique(times, return_index=True)
    length = float(times[-1] - times[0]) if len(times) else 0.0
    if len(times) < LEAST_SAMPLES or length < LEAST_TIME:
        raise LogError(
            f"{name}: too short: {len(times)} samples with angle and torque in {length:.3g} s; "
            f"expected at least {LEAST_SAMPLES} in {LEAST_TIME:g} s{lack}"
        )
    return name, times - times[0], np.ascontiguousarray(y[first]), u[first]


def _leave_out_spikes(time: Array, values: Array) -> int:
    """Make outliers of an output NaN, and return their number.

    An outlier is far from the cubic through its four neighbours, relative to the second differences
    of the samples nearby. This needs no model, so it also holds before a fit.
    """
    known = int(np.isfinite(values).sum())
    for _ in range(_ROUNDS):
        places = np.flatnonzero(np.isfinite(values))
        t, y = time[places], values[places]
        bend = np.abs(np.diff(y, 2))[1:-1]
        if len(places) < LEAST_SAMPLES or not bend.any():
            break
        near = [slice(i, len(t) - 4 + i) for i in (0, 1, 3, 4)]
        far = y[2:-2].copy()
        for one in near:
            others = (t[each] for each in near if each != one)
            far -= y[one] * math.prod((t[2:-2] - each) / (t[one] - each) for each in others)
        far = np.abs(far)
        # Nearby and anywhere, as at rest there is neither noise nor motion.
        usual = np.maximum(median_filter(bend, _NEARBY), np.median(bend[bend > 0.0]))
        # An outlier also moves the cubics of its neighbours, but less.
        is_spike = (far > _SPIKE * usual) & (far == maximum_filter1d(far, 5))
        # The first and last ones to have four neighbours stand for those beyond them.
        values[np.concatenate([places[:1], places[3:-3], places[-1:]])[is_spike]] = np.nan
    return known - int(np.isfinite(values).sum())


def _even(time: Array, period: float) -> Array:
    """Return the durations between samples: nearly even ones as even, -1 at the start of a gap."""
    durations = np.diff(time, append=time[-1] + period)
    steps = np.round(durations / period)
    drift = np.cumsum(durations - np.maximum(steps, 1.0) * period)
    gaps = durations > _GAP * period
    jitter = np.abs(durations - period) < _JITTER * period
    if (jitter | gaps).all() and np.ptp(drift[~gaps]) < 0.5 * period:
        durations[~gaps] = period
    return np.where(gaps, -1.0, durations)


def _require_motion(request: ArmRequest, recording: Recording) -> None:
    """Refuse a recording at rest or beyond the domain, one that lacks torque or an output, and
    angles of motor and link with a gear between them.
    """
    y, u, names, moves = recording.y, recording.u, request.output_names, False
    if float(np.ptp(u)) == 0.0:
        raise LogError(f"the torque is {u[0] + 0.0:.4g} N m throughout: nothing moves the arm")
    for place, output in enumerate(request.sensors):
        values = y[np.isfinite(y[:, place]), place]
        if len(values) < LEAST_SAMPLES:
            raise LogError(f"{output.measures}: only {len(values)} samples have it")
        noise = max(float(np.median(np.abs(np.diff(values, 2)))) / 1.65, 1e-12)
        swing = float(np.quantile(values, 0.98) - np.quantile(values, 0.02))
        moves |= swing > _LEAST_MOTION * max(noise, 0.05 * output.measurement_std)
        largest, domain = float(np.quantile(np.abs(values), 0.999)), request.max_angle
        if output.measures.endswith("_angle") and largest > min(1.0001 * domain, _FARTHEST):
            raise LogError(
                f"{output.measures}: up to {largest:.4g} rad, beyond {min(domain, math.pi):.4g} "
                f"rad: if these are degrees, {math.radians(largest):.3g} rad, say so: --units "
                "angle=deg; if it is the motor's side of a gear, divide by its ratio; if it is not "
                "0 where the link hangs down, subtract that angle; else widen x_max, or leave that "
                "motion out"
            )
    if not moves:
        raise LogError("at rest: no output moves by more than its noise")
    if {"motor_angle", "link_angle"} <= set(names):
        both = y[:, [names.index("motor_angle"), names.index("link_angle")]]
        (motor, cross), (_, link) = np.cov(both[np.isfinite(both).all(axis=1)].T)
        if cross * cross > 0.5 * motor * link and -2.0 < cross / link < -0.5:
            raise LogError("motor_angle and link_angle have opposite signs: change that of one")
        if cross * cross > 0.5 * motor * link and not 0.5 < cross / link < 2.0:
            sign = " and has the opposite sign" if cross < 0.0 else ""
            raise LogError(
                f"motor_angle moves {abs(cross / link):.4g} times as far as link_angle{sign}: if a "
                "gear is between them, divide the motor's angle by its ratio, and multiply the "
                "torque by it"
            )


def wary(unknowns: Unknowns, noise: float) -> Array:
    """Return the coordinates of a filter that trusts its model little, otherwise the request's."""
    return np.array(
        [noise if each.name.startswith("process") else 0.0 for each in unknowns.numbers]
    )


def require_torque(unknowns: Unknowns, recording: Recording) -> None:
    """Refuse a torque that has the wrong sign, unit or gear ratio.

    Raises:
        LogError: Another sign or scale is far likelier.
    """
    noises = unknowns.noises()
    # A filter with little trust in its model shows sign and scale even if other numbers are wrong.
    at = wary(noises, 2.0)
    costs = {}
    for gain in (sign * scale for sign in (1.0, -1.0) for scale in _SCALES):
        joint = with_values(noises.joint, {TORQUE_GAIN: gain})
        costs[gain] = Likelihood(replace(noises, joint=joint), recording).cost(at)
    likeliest = min(costs, key=costs.__getitem__)
    upright = min((each for each in costs if each > 0.0), key=costs.__getitem__)
    if likeliest < 0.0 and costs[likeliest] < costs[upright] - _BETTER:
        bar = costs[likeliest] - _BETTER
        swapped = replace(recording, y=np.ascontiguousarray(recording.y[:, ::-1]))
        if recording.y.shape[1] == 2 and Likelihood(noises, swapped).cost(at) < bar:
            first, second = noises.joint.request.output_names
            raise LogError(f"{first} and {second}: each seems to be the other: exchange them")
        raise LogError(
            "torque: its sign is the opposite of the angle's: with the other sign the motion "
            "follows from it; change the sign of torque or angle"
        )
    if not 0.08 < upright < 12.0 and costs[upright] < costs[1.0] - _BETTER:
        raise LogError(
            f"torque: the request's arm moves as if the torque were about {upright:.2g} times as "
            "large: is its unit mN m (--units torque=mNm), or is it for the other side of a gear?"
        )
