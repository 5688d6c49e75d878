# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings for a fit, from logs, bags and arrays, and what is wrong with them in one line.

What people get wrong is the torque's sign, a gear ratio, and units: each shows in a likelihood that
is far better with another sign or scale, or in angles that leave the domain.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import LogError, ModelError
from tsobs_ros.identification.joint import Unknowns, with_values
from tsobs_ros.identification.likelihood import Likelihood, Recording
from tsobs_ros.replay.estimate import open_source
from tsobs_ros.series import NANOSECONDS

Samples = tuple[ArrayLike, ArrayLike, ArrayLike]
"""Times [s], shape (n,), outputs [rad, rad/s], shape (n, p), and torques [N m], shape (n,)."""

LEAST_SAMPLES = 300
LEAST_TIME = 2.0
"""Shortest recording [s]."""

_GAP = 3.5
"""Periods between samples that begin a gap: the torque in it is not known."""

_JITTER = 0.02
"""Times within this share of a period from even ones are taken for even."""

_FAR = 0.1
"""Distance of two angles' zeros that no spring's deflection makes [rad]."""

_LEAST_MOTION = 8.0
"""Motion that says something, by the noise of the sensor."""

_SATURATED = 0.05
"""Share of samples at the same largest value from which on a sensor is at its stop."""

_BETTER = 100.0
"""Gain of likelihood by which another sign or scale of the torque must be likelier [nat]."""

_SCALES = tuple(10.0 ** (step / 3.0) for step in range(-12, 13))
_UNITS = {1e-3: "mN m", 1e-2: "N cm"}

_Raw = tuple[str, Array, Array, Array]
"""Name, times, outputs and torques of a recording."""


def read(
    request: ArmRequest, logs: Sequence[str | Path | Samples], **options: Any
) -> tuple[ArmRequest, list[Recording], list[str]]:
    """Return the request with the recordings' rate, the checked recordings, and remarks.

    Args:
        request: What its numbers are taken for.
        logs: Paths of CSV logs or bags, or arrays.
        **options: Of `open_source`.

    Raises:
        LogError: A recording is of no use; the text names it and says why, in one line.
        BagReadError: A bag cannot be read.
        ModelError: There is none, or arrays have the wrong shape.
    """
    if not logs:
        raise ModelError("logs: expected at least one recording")
    raw = []
    for log in logs:
        if isinstance(log, str | Path):
            raw.append(_complete(*_of_file(request, log, options)))
        else:
            raw.append(_complete(*_of_arrays(request, log)))
    period = float(np.median(np.concatenate([np.diff(time) for _, time, _, _ in raw])))
    if not period > 0.0:
        raise LogError(f"{raw[0][0]}: its samples have no time between them")
    notes = []
    if abs(period * request.rate - 1.0) > 0.02:
        notes.append(
            f"note: the recording has {1.0 / period:.4g} samples per second, the request "
            f"{request.rate:.4g}: the fitted request has the recording's rate"
        )
        request = replace(request, rate=float(f"{1.0 / period:.6g}"))
    zeros = _zeros(request, raw)
    if zeros.any():
        shown = ", ".join(
            f"{output.measures} {zero:.4g} rad"
            for output, zero in zip(request.sensors, zeros.tolist(), strict=True)
            if zero
        )
        notes.append(
            f"note: the zeros of the angles differ; subtracted from the recordings: {shown}"
        )
    found = []
    for name, time, y, u in raw:
        recording, remark = _even(name, time, y - zeros, u, request.period)
        found.append(recording)
        notes += [f"note: {name}: {remark}"] * bool(remark)
        notes += _checked(request, recording)
    return request, found, notes


def _zeros(request: ArmRequest, raw: Sequence[_Raw]) -> Array:
    """Return what to subtract from outputs whose zero is far from the others', shape (p,)."""
    zeros = np.zeros(len(request.sensors))
    angles = [i for i, one in enumerate(request.sensors) if one.measures.endswith("_angle")]
    if not angles:
        return zeros
    y = np.concatenate([each for _, _, each, _ in raw])
    first, *others = angles
    if not request.arm.gravity_torque and abs(np.nanmedian(y[:, first])) > _FAR:
        # Without gravity an angle has no zero.
        zeros[first] = float(f"{np.nanmedian(y[:, first]):.4g}")
    for place in others:
        apart = float(np.nanmedian(y[:, place] - y[:, first])) + zeros[first]
        if abs(apart) > _FAR and not request.sensors[place].model.state_count:
            zeros[place] = float(f"{apart:.4g}")
    return zeros


def _of_file(request: ArmRequest, log: str | Path, options: dict[str, Any]) -> _Raw:
    source = open_source(log, **options)
    if len(source.joints) != 1:
        raise LogError(f"{log}: joints {', '.join(source.joints)}: name one of them with --joint")
    source.observe([request])
    whole = source.samples
    keep = (whole.stamps > 0) & whole.complete[:, 0]
    stamps = whole.stamps[keep]
    # Stamps since the epoch have no digits left below a microsecond as one number.
    times = (stamps - stamps.min(initial=2**62)) / NANOSECONDS
    return str(log), times, whole.y[keep, 0], whole.u[keep, 0, 0]


def _of_arrays(request: ArmRequest, log: Samples) -> _Raw:
    times, y, u = (np.asarray(each, np.float64) for each in log)
    y = y.reshape(len(times), -1) if times.ndim == 1 and len(times) else y
    p = len(request.sensors)
    if times.ndim != 1 or y.shape != (len(times), p) or u.shape != times.shape:
        raise ModelError(
            f"logs: expected times (n,), outputs (n, {p}) and torques (n,), got "
            f"{times.shape}, {y.shape} and {u.shape}"
        )
    return "the arrays", times, y, u


def _complete(name: str, times: Array, y: Array, u: Array) -> _Raw:
    """Return the samples with a time, a torque and an output, in order of time."""
    keep = np.isfinite(times) & np.isfinite(u) & np.isfinite(y).any(axis=1)
    times, y, u = times[keep], y[keep], u[keep]
    times, first = np.unique(times, return_index=True)
    y, u = y[first], u[first]
    if len(times) < LEAST_SAMPLES or times[-1] - times[0] < LEAST_TIME:
        length = times[-1] - times[0] if len(times) else 0.0
        raise LogError(
            f"{name}: too short: {len(times)} samples with angle and torque in {length:.3g} s; "
            f"expected at least {LEAST_SAMPLES} in {LEAST_TIME:g} s"
        )
    return name, times - times[0], np.ascontiguousarray(y), np.ascontiguousarray(u)


def _even(name: str, time: Array, y: Array, u: Array, period: float) -> tuple[Recording, str]:
    """Return a recording whose nearly even times are even, and a remark about its gaps."""
    durations = np.diff(time, append=time[-1] + period)
    steps = np.round(durations / period)
    drift = np.cumsum(durations - np.maximum(steps, 1.0) * period)
    gaps = durations > _GAP * period
    jitter = np.abs(durations - period) < _JITTER * period
    if (jitter | gaps).all() and np.ptp(drift[~gaps]) < 0.5 * period:
        durations = np.where(gaps, durations, period)
    remark = ""
    if gaps.any():
        lost = float(durations[gaps].sum())
        remark = f"{int(gaps.sum())} gaps, {lost:.3g} s in all, are left out"
    return Recording(name, time, np.where(gaps, -1.0, durations), y, u), remark


def _checked(request: ArmRequest, recording: Recording) -> list[str]:
    """Return remarks; raise a `LogError` for what is of no use."""
    name, y, u, notes = recording.name, recording.y, recording.u, list[str]()
    if float(np.ptp(u)) == 0.0:
        raise LogError(
            f"{name}: the torque is {u[0] + 0.0:.4g} N m throughout: nothing moves the arm"
        )
    moves = False
    for place, output in enumerate(request.sensors):
        values = y[np.isfinite(y[:, place]), place]
        if len(values) < LEAST_SAMPLES:
            raise LogError(f"{name}: {output.measures}: only {len(values)} samples have it")
        noise = max(float(np.median(np.abs(np.diff(values, 2)))) / 1.65, 1e-12)
        swing = float(np.quantile(values, 0.98) - np.quantile(values, 0.02))
        moves |= (
            swing > _LEAST_MOTION * noise and swing > _LEAST_MOTION * 0.05 * output.measurement_std
        )
        if output.measures.endswith("_angle"):
            _require_domain(request, recording, place, values)
        for edge in (values.min(), values.max()):
            share = float((values == edge).mean())
            if share > _SATURATED and swing > 0.0:
                raise LogError(
                    f"{name}: {output.measures}: {100 * share:.0f} % of the samples are "
                    f"{edge:.4g}: the sensor or the arm is at a stop; leave that part out"
                )
    if not moves:
        raise LogError(f"{name}: at rest: no output moves by more than its noise")
    for edge in (u.min(), u.max()):
        share = float((u == edge).mean())
        if share > 0.3:
            notes.append(
                f"note: {name}: the torque is {edge:.4g} N m in {100 * share:.0f} % of the "
                "samples: if the drive is at its limit there, the true torque may be another one"
            )
    _require_no_gear(request, recording)
    return notes


def _require_domain(request: ArmRequest, recording: Recording, place: int, values: Array) -> None:
    """Refuse angles beyond the domain, with what they would be in degrees."""
    largest = float(np.quantile(np.abs(values), 0.999))
    domain = request.max_angle
    if largest <= domain * 1.0001 and (math.isfinite(domain) or largest < 50.0):
        return
    name, what = recording.name, request.sensors[place].measures
    limit, hints = min(domain, math.pi), []
    if largest > max(limit, 3.0) and math.radians(largest) <= limit:
        hints.append(
            f"if these are degrees, {math.radians(largest):.3g} rad, say so: --units angle=deg"
        )
    if largest > 4.0:
        hints.append("if it is the motor's side of a gear, divide by its ratio")
    if math.isfinite(domain):
        hints.append("widen x_max, or leave that motion out")
    if hints:
        raise LogError(
            f"{name}: {what}: up to {largest:.4g} rad, beyond {limit:.4g} rad: {'; '.join(hints)}"
        )


def _require_no_gear(request: ArmRequest, recording: Recording) -> None:
    """Refuse angles of motor and link with a gear between them."""
    names = [output.measures for output in request.sensors]
    if not {"motor_angle", "link_angle"} <= set(names):
        return
    motor, link = (recording.y[:, names.index(each)] for each in ("motor_angle", "link_angle"))
    both = np.isfinite(motor) & np.isfinite(link)
    motor, link = motor[both] - motor[both].mean(), link[both] - link[both].mean()
    slope = float(motor @ link) / float(link @ link) if link.any() else 0.0
    agreement = float(motor @ link) / (float(np.linalg.norm(motor) * np.linalg.norm(link)) + 1e-300)
    if abs(agreement) > 0.7 and not 0.5 < slope < 2.0:
        sign = " and has the opposite sign" if slope < 0.0 else ""
        raise LogError(
            f"{recording.name}: motor_angle moves {abs(slope):.4g} times as far as link_angle"
            f"{sign}: if a gear is between them, divide the motor's angle by its ratio, and "
            "multiply the torque by it"
        )


def require_torque(unknowns: Unknowns, recording: Recording) -> None:
    """Refuse a torque of the wrong sign, or whose unit or gear ratio is wrong.

    Raises:
        LogError: Another sign or scale is far likelier.
    """
    noises = unknowns.noises()
    # A filter that does not trust its model shows the sign and the scale, whatever else is wrong.
    at = np.array([2.0 if each.name.startswith("process") else 0.0 for each in noises.numbers])
    costs = {}
    for sign in (1.0, -1.0):
        for scale in _SCALES:
            joint = with_values(noises.joint, {"torque.gain": sign * scale})
            moved = Likelihood(replace(noises, joint=joint), [recording])
            costs[sign * scale] = moved.cost(at)
    likeliest = min(costs, key=costs.__getitem__)
    upright = min((each for each in costs if each > 0.0), key=costs.__getitem__)
    if likeliest < 0.0 and costs[likeliest] < costs[upright] - _BETTER:
        raise LogError(
            f"{recording.name}: torque: its sign is the opposite of the angle's: with the other "
            "sign the motion follows from it; change the sign of torque or angle"
        )
    if not 0.08 < upright < 12.0 and costs[upright] < costs[1.0] - _BETTER:
        unit = min(_UNITS, key=lambda each: abs(math.log(each / upright)))
        is_unit = upright < 1.0 and abs(math.log10(unit / upright)) < 0.4
        hint = f" (is its unit {_UNITS[unit]}?)" if is_unit else " (a gear ratio?)"
        raise LogError(
            f"{recording.name}: torque: the request's arm moves as if the torque were about "
            f"{upright:.2g} times as large: the torque's unit, or the side of the gear that it is "
            f"for, is not the request's{hint}"
        )
