# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why a design cannot exist: the mode, the slope at which it hides, and what would help."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tsobs_ros.design.request import DesignRequest
from tsobs_ros.errors import DetectabilityError
from tsobs_ros.model.detectability import HiddenMode, undetectable_modes


class Obstacle(NamedTuple):
    """A gravity slope of the domain at which the sensor does not see a mode that persists."""

    slope: float
    mode: HiddenMode


def find_obstacles(request: DesignRequest) -> list[Obstacle]:
    """Return the undetectable modes on the request's domain, one of each conjugate pair.

    The slopes tried are the ends of the domain and every slope at which a mode of the
    disturbance can hide in the arm: det(A(c) − λI) is affine in c, because gravity enters A(c)
    in a single place, so these slopes are solved for and not searched.
    """
    lowest, highest = request.slope_range
    flow, model = request.flow, request.disturbance_model
    if model.arbitrary:
        # ω = y − C x explains every output whatever x does: C̄ carries nothing about the state.
        return [
            Obstacle(slope, mode)
            for slope in (lowest, highest)
            for mode in undetectable_modes(request.arm.slope_matrix(slope), np.zeros((1, 4)))
            if mode.eigenvalue.imag >= 0.0
        ]
    slopes = [lowest, highest, *_resonant_slopes(request, lowest, highest)]
    return [
        Obstacle(slope, mode)
        for slope in dict.fromkeys(slopes)
        for mode in undetectable_modes(flow.slope_matrix(slope), flow.output_matrix)
        if mode.eigenvalue.imag >= 0.0
    ]


def require_detectable(request: DesignRequest) -> None:
    """Raise `DetectabilityError` with the whole explanation if the design cannot exist."""
    obstacles = find_obstacles(request)
    if obstacles:
        raise DetectabilityError(explain(request, obstacles))


def explain(request: DesignRequest, obstacles: list[Obstacle]) -> str:
    """Return the report: what is hidden, at which slope and angle, its shape, what would help."""
    label = request.disturbance_model.label
    lines = [
        f"no observer can tell the arm from a disturbance of kind {label} on "
        f"|q1| <= {request.x_max:.6g} rad:"
    ]
    lines += [f"  - {_describe(request, obstacle)}" for obstacle in obstacles]
    lines += ["what would help:"]
    lines += [f"  - {advice}" for advice in _advice(request, obstacles)]
    return "\n".join(lines)


def _describe(request: DesignRequest, obstacle: Obstacle) -> str:
    eigenvalue = obstacle.mode.eigenvalue
    # A persistent mode's tiny real part, or a defective zero's spread, is rounding.
    clean = complex(*(0.0 if abs(part) < 1e-6 else part for part in _parts(eigenvalue)))
    rate = f"{clean.real:.4g} ± {clean.imag:.4g}j" if clean.imag else f"{clean.real:.4g}"
    slope = _tidy(obstacle.slope)
    angle = math.degrees(math.acos(max(-1.0, min(1.0, slope))))
    names = ["q1", "q1'", "q2", "q2'"]
    names += [f"w{index + 1}" for index in range(obstacle.mode.shape.size - 4)]
    return (
        f"gravity slope c = {slope:.4g} (|q1| = {angle:.1f} deg): the mode with "
        f"eigenvalue {rate} 1/s does not decay and is not seen; shape "
        f"{_shape(request, obstacle.mode.shape, names)}"
    )


def _shape(
    request: DesignRequest,
    mode: "np.ndarray[tuple[int, ...], np.dtype[np.complex128]]",
    names: list[str],
) -> str:
    physical = mode.copy()
    scale = request.arm.to_physical(np.ones(4))
    physical[:4] *= scale
    # Turn and scale the mode so that its largest part is exactly 1.
    physical /= physical[int(np.argmax(np.abs(physical)))]
    parts = []
    for name, value in zip(names, physical, strict=True):
        real, imaginary = (0.0 if abs(part) < 1e-6 else part for part in _parts(value))
        text = f"{real:.3g}{imaginary:+.3g}j" if imaginary else f"{real:.3g}"
        parts.append(f"{name} {text}")
    return "[" + ", ".join(parts) + "]"


def _tidy(slope: float) -> float:
    # cos(π/2) is 6e-17 in floating point.
    return 0.0 if abs(slope) < 1e-12 else slope


def _parts(value: complex) -> tuple[float, float]:
    return float(value.real), float(value.imag)


def _advice(request: DesignRequest, obstacles: list[Obstacle]) -> Iterator[str]:
    if request.disturbance_model.arbitrary:
        yield "a model of the disturbance: bias, gauss_markov, sinusoid, ramp, or a sum of them"
        yield "a second sensor known to be clean (a motor encoder, say)"
        if not (request.arm.link_damping and request.arm.motor_damping):
            yield (
                "damping of link and motor makes every hidden mode decay; the estimate is then "
                "an open-loop simulation that forgets its start at that rate"
            )
        return
    worst = max(_tidy(obstacle.slope) for obstacle in obstacles)
    if 0.0 <= worst < 1.0 - 1e-9:
        yield (
            f"a smaller domain: x_max below {math.acos(worst):.4g} rad keeps the slope above "
            f"{worst:.4g}"
        )
    if any(abs(obstacle.mode.eigenvalue.imag) > 1e-3 for obstacle in obstacles):
        yield "a disturbance frequency away from the arm's own frequencies on the domain"
    yield "kind gauss_markov, whose decaying state need not be seen, in place of one that persists"
    yield "kind clean, if the sensor carries noise only"


def _resonant_slopes(request: DesignRequest, lowest: float, highest: float) -> Iterator[float]:
    """Yield the slopes in range at which an eigenvalue of the exosystem is one of the arm's."""
    identity = np.eye(4)
    for eigenvalue in np.linalg.eigvals(request.disturbance_model.S):
        if eigenvalue.real < -1e-9:
            continue
        at_zero, at_one = (
            np.linalg.det(request.arm.slope_matrix(slope) - eigenvalue * identity)
            for slope in (0.0, 1.0)
        )
        if at_zero == at_one:
            continue
        slope = at_zero / (at_zero - at_one)
        if abs(slope.imag) < 1e-9 and lowest <= slope.real <= highest:
            yield float(slope.real)
