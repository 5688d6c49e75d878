# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Detectability of a request: its hidden modes, their gravity slopes and the remedies."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.design.problem import DesignProblem
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import DetectabilityError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.detectability import (
    HiddenMode,
    format_mode,
    hidden_modes,
    undetectable_modes,
)

_PERSISTENT = -1e-9
"""Real parts above this [1/s] do not decay: the mode would outlive the robot."""

_SLOPE_TOLERANCE = 1e-9


class Obstacle(NamedTuple):
    """A mode that the sensor does not see, with the gravity slope, or None if it is any."""

    slope: float | None
    mode: HiddenMode


def find_obstacles(request: ArmRequest) -> list[Obstacle]:
    """Return the undetectable modes on the request's domain, one of each conjugate pair.

    The test is structural, with no rank to judge: the arm alone is observable at every slope, so
    a hidden mode is one of the disturbance. It is hidden among the disturbance's own terms, or at
    a slope at which the arm has a mode of the same eigenvalue. Gravity enters in a single place,
    so that slope has a closed form. An arbitrary disturbance hides the whole arm, decaying or not.
    """
    if request.disturbance_model.arbitrary:
        # ω = y − C x explains every output whatever x does: C̄ carries nothing about the state.
        return [
            Obstacle(slope, mode)
            for slope in request.slope_range
            for mode in hidden_modes(request.arm.slope_matrix(slope), np.zeros((1, 4)))
            if mode.eigenvalue.imag >= 0.0
        ]
    if request.outputs or request.torque_sides or not request.arm.gravity_torque:
        return [
            Obstacle(slope, mode)
            for slope in request.slope_range
            for mode in undetectable_modes(
                request.flow.slope_matrix(slope), request.flow.output_matrix
            )
            if mode.eigenvalue.imag >= 0.0
        ]
    return [*_indistinct_terms(request), *_resonances(request)]


def require_detectable(problem: DesignProblem) -> None:
    """Refuse a request that no observer can answer.

    For a T–S system every vertex is tested by itself (Popov–Belevitch–Hautus). That all of them
    pass is necessary; only the synthesis shows whether what lies between them passes too.

    Raises:
        DetectabilityError: A mode that does not decay is hidden, or a disturbance is arbitrary;
            the text names the place, the mode's eigenvalue and shape, and what would help.
    """
    if isinstance(problem, ArmRequest):
        obstacles = find_obstacles(problem)
        if obstacles:
            raise DetectabilityError(explain(problem, obstacles))
    elif isinstance(problem, TSRequest):
        _require_detectable_vertices(problem)


def explain(request: ArmRequest, obstacles: list[Obstacle]) -> str:
    """Return the report: what is hidden, at which slope and angle, its shape, what would help."""
    label = request.disturbance_model.label
    lines = [
        f"no observer can distinguish the arm from a disturbance of kind {label} on "
        f"|q1| <= {request.x_max:.6g} rad:"
    ]
    if request.disturbance_model.arbitrary:
        lines.append(
            "  - every mode of the arm is hidden, whether it decays or not: the estimate can only "
            "be an open-loop simulation"
        )
    lines += [f"  - {_describe(request, obstacle)}" for obstacle in obstacles]
    lines += ["what would help:"]
    lines += [f"  - {advice}" for advice in _advice(request, obstacles)]
    return "\n".join(lines)


def _indistinct_terms(request: ArmRequest) -> Iterator[Obstacle]:
    """Yield the persistent modes that cancel within the disturbance, whatever the arm does."""
    model = request.disturbance_model
    for mode in hidden_modes(model.S, model.H):
        if mode.eigenvalue.real >= _PERSISTENT and mode.eigenvalue.imag >= 0.0:
            yield Obstacle(None, mode._replace(shape=np.concatenate([np.zeros(4), mode.shape])))


def _resonances(request: ArmRequest) -> Iterator[Obstacle]:
    """Yield the persistent modes of the disturbance that the arm can copy, with the slope."""
    lowest, highest = request.slope_range
    found: list[complex] = []
    for eigenvalue in np.linalg.eigvals(request.disturbance_model.S).astype(complex):
        known = any(abs(eigenvalue - other) < 1e-6 for other in found)
        if known or eigenvalue.real < _PERSISTENT or eigenvalue.imag < 0.0:
            continue
        found.append(eigenvalue)
        slope, twist = _resonance(request.arm, eigenvalue)
        outside = max(lowest - slope.real, slope.real - highest)
        # Written so that an infinite slope, at the link's own node, is no obstacle.
        if abs(slope.imag) <= _SLOPE_TOLERANCE and outside <= _SLOPE_TOLERANCE:
            nearest = min(max(slope.real, lowest), highest)
            yield Obstacle(nearest, _shared_mode(request, complex(eigenvalue), twist, nearest))


def _resonance(arm: ElasticJointArm, eigenvalue: complex) -> tuple[complex, complex]:
    """Return the slope at which the arm has the eigenvalue λ, and q₂/q₁ of the mode.

    det(A(c) − λI) = (m₁ + k/J₁ + c mgl/J₁)(m₂ + k/J₂) − k²/(J₁J₂) with mᵢ = λ² + λ bᵢ/Jᵢ vanishes
    if c mgl/J₁ = −m₁ − (k/J₁) m₂/(m₂ + k/J₂), a form without cancellation at λ = 0.
    """
    link = eigenvalue * (eigenvalue + arm.link_damping / arm.link_inertia)
    motor = eigenvalue * (eigenvalue + arm.motor_damping / arm.motor_inertia)
    spring = arm.stiffness / arm.motor_inertia
    if motor + spring == 0.0:
        return complex(math.inf), complex(math.inf)
    reaction = arm.stiffness / arm.link_inertia * motor / (motor + spring)
    return -(link + reaction) / arm.gravity_gain, spring / (motor + spring)


def _shared_mode(
    request: ArmRequest, eigenvalue: complex, twist: complex, slope: float
) -> HiddenMode:
    """Return the mode in which the disturbance takes back the arm's motion."""
    model, arm = request.disturbance_model, request.arm
    motor = twist * arm.stiffness / arm.link_inertia
    _, singular, right = np.linalg.svd(model.S - eigenvalue * np.eye(model.state_count))
    kernel = right[singular <= 1e-9 * max(1.0, float(singular[0]))].conj().T
    own = kernel @ (kernel.conj().T @ model.H[0])
    shape = np.concatenate(
        [[1.0, eigenvalue, motor, motor * eigenvalue], -own / (model.H[0] @ own)]
    )
    shape /= np.linalg.norm(shape)
    pencil = request.flow.slope_matrix(slope) - eigenvalue * np.eye(shape.size)
    visibility = np.linalg.norm(pencil @ shape) / np.linalg.norm(pencil)
    return HiddenMode(eigenvalue, shape, float(visibility))


def _describe(request: ArmRequest, obstacle: Obstacle) -> str:
    eigenvalue = obstacle.mode.eigenvalue
    # A persistent mode's tiny real part, or a defective zero's spread, is rounding.
    clean = complex(*(0.0 if abs(part) < 1e-6 else part for part in _parts(eigenvalue)))
    rate = f"{clean.real:.4g} ± {clean.imag:.4g}j" if clean.imag else f"{clean.real:.4g}"
    names = ["q1", "q1'", "q2", "q2'"]
    names += [f"w{index + 1}" for index in range(obstacle.mode.shape.size - 4)]
    fate = "decays by itself but" if clean.real < 0.0 else "does not decay and"
    return (
        f"{_place(obstacle.slope)}: the mode with eigenvalue {rate} 1/s {fate} is not seen; shape "
        f"{_shape(request, obstacle.mode.shape, names)}"
    )


def _place(slope: float | None) -> str:
    if slope is None:
        return "at every gravity slope"
    angle = math.degrees(math.acos(max(-1.0, min(1.0, slope))))
    return f"gravity slope c = {_tidy(slope):.4g} (|q1| = {angle:.1f} deg)"


def _shape(
    request: ArmRequest,
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


def _advice(request: ArmRequest, obstacles: list[Obstacle]) -> Iterator[str]:
    if request.disturbance_model.arbitrary:
        yield "a model of the disturbance: bias, gauss_markov, sinusoid, ramp, or a sum of them"
        yield "a second sensor known to be clean (a motor encoder, say)"
        return
    slopes = [obstacle.slope for obstacle in obstacles if obstacle.slope is not None]
    if len(slopes) < len(obstacles):
        terms = " and ".join(term.kind for term in request.disturbance)
        yield (
            f"fewer terms: two of {terms} move alike and cannot be distinguished, not even "
            f"without the arm"
        )
    if slopes and max(slopes) < 1.0 - _SLOPE_TOLERANCE:
        worst = _tidy(max(slopes))
        yield (
            f"a smaller domain: x_max below {math.acos(worst):.4g} rad keeps the slope above "
            f"{worst:.4g}"
        )
    if any(abs(obstacle.mode.eigenvalue.imag) > 1e-3 for obstacle in obstacles if obstacle.slope):
        yield "a disturbance frequency away from the arm's own frequencies on the domain"
    yield "kind gauss_markov, whose decaying state need not be seen, in place of one that persists"
    yield "kind clean, if the sensor carries noise only"


def _require_detectable_vertices(request: TSRequest) -> None:
    if request.disturbance_model.arbitrary:
        raise DetectabilityError(
            "an arbitrary disturbance explains every value of the outputs it acts on, which "
            "then carry nothing about the state. What would help: a model of it (bias, "
            "gauss_markov, sinusoid, ramp), or leaving these outputs out of C and reading "
            "their disturbance as y − C x̂ from the others"
        )
    matrices, names = request.vertex_matrices()
    hidden = [
        (name, mode)
        for name, matrix in zip(names, matrices, strict=True)
        for mode in undetectable_modes(request.flow.augmented(matrix), request.flow.output_matrix)
        if mode.eigenvalue.imag >= 0.0
    ]
    if hidden:
        raise DetectabilityError(_explain_hidden(request, hidden))


def _explain_hidden(request: TSRequest, hidden: Sequence[tuple[str, HiddenMode]]) -> str:
    n, q = request.model.state_count, request.disturbance_model.state_count
    names = [*request.state_names, *(f"w{i + 1}" for i in range(q))]
    label = f"[{', '.join(names)}]"
    lines = [
        f"no observer exists for outputs disturbed by {request.disturbance_model.label}:",
        *(f"  - {name}: the mode {format_mode(mode, label)} is not seen" for name, mode in hidden),
        "what would help:",
    ]
    if any(np.abs(mode.shape[n:]).max(initial=0.0) > 1e-6 for _, mode in hidden):
        lines.append(
            "  - a disturbance that cannot copy the mode: gauss_markov, another frequency, or "
            "kind clean on an output that shows it"
        )
    lines.append("  - an output that shows the mode, or damping that makes it decay")
    return "\n".join(lines)
