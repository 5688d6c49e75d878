# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Detectability of a request: its hidden modes, their gravity slopes and what would help.

The test of an arm is structural, with no rank to judge. In a hidden mode of eigenvalue λ ≥ 0 the
angles are a and b, and

    (λ² J₁ + λ b₁ + k + c mgl) a − k b = d₁        (λ² J₂ + λ b₂ + k) b − k a = d₂

with d₁, d₂ the torques at link and motor. A torque is other than zero only if its exosystem has the
eigenvalue. An output that has it too is *copied*: its disturbance takes back what it would show.
Every other output shows a or b, a velocity only if λ is not zero. So λ is an eigenvalue of an
exosystem, or 0, and each of the few cases of what is shown and of what is free has a closed form.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.design.problem import DesignProblem
from tsobs_ros.design.remedies import Remedy, helpful, remedies_of_hidden_modes
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import DetectabilityError
from tsobs_ros.model.arm import QUANTITIES, SIDES
from tsobs_ros.model.detectability import (
    HiddenMode,
    format_mode,
    hidden_modes,
    undetectable_modes,
)
from tsobs_ros.model.disturbance import DisturbanceModel, clean

_PERSISTENT = -1e-9
"""Real parts above this [1/s] do not decay: the mode would outlive the robot."""

_SLOPE_TOLERANCE = 1e-9

Complex = NDArray[np.complex128]


class Obstacle(NamedTuple):
    """A mode that the outputs do not show.

    Attributes:
        slope: Gravity slope at which it is hidden, None if at any.
        mode: Eigenvalue and shape.
        parties: What cannot be told apart, in words.
    """

    slope: float | None
    mode: HiddenMode
    parties: tuple[str, ...]


class _Exosystem(NamedTuple):
    """The disturbance of an output, or of one side's torque, among the augmented states."""

    name: str
    place: int
    model: DisturbanceModel

    def copy(self, eigenvalue: complex) -> Complex | None:
        """Return the mode of an eigenvalue whose disturbance is 1; None if there is none."""
        q = self.model.state_count
        if not q:
            return None
        _, singular, right = np.linalg.svd(self.model.S - eigenvalue * np.eye(q))
        kernel = right[singular <= 1e-9 * max(1.0, float(singular[0]))].conj().T
        own = kernel @ (kernel.conj().T @ self.model.H[0])
        size = complex(self.model.H[0] @ own)
        return own / size if abs(size) > 1e-12 else None


def find_obstacles(request: ArmRequest) -> list[Obstacle]:
    """Return the undetectable modes on the request's domain, one of each conjugate pair.

    An output with an arbitrary disturbance shows nothing. If there is no other, every mode of the
    arm is hidden, decaying or not.
    """
    exosystems = _exosystems(request)
    if all(output.model.arbitrary for output in request.sensors):
        # ω = y − C x explains every output whatever x does: C̄ carries nothing about the state.
        return [
            Obstacle(slope, mode, ("the arm", "an arbitrary disturbance"))
            for slope in dict.fromkeys(request.slope_range)
            for mode in hidden_modes(request.arm.slope_matrix(slope), np.zeros((1, 4)))
            if mode.eigenvalue.imag >= 0.0
        ]
    eigenvalues = [0j]
    for exosystem in exosystems:
        for eigenvalue in np.linalg.eigvals(exosystem.model.S).astype(complex):
            known = any(abs(eigenvalue - other) < 1e-6 for other in eigenvalues)
            if not known and eigenvalue.real >= _PERSISTENT and eigenvalue.imag >= 0.0:
                eigenvalues.append(complex(eigenvalue))
    return [
        *_indistinct_terms(request, exosystems),
        *(each for value in eigenvalues for each in _shared_modes(request, exosystems, value)),
    ]


def is_detectable(request: DesignProblem) -> bool:
    """Return whether no mode that persists is hidden, and no disturbance is arbitrary."""
    if request.disturbance_model.arbitrary:
        return False
    if isinstance(request, ArmRequest):
        return not find_obstacles(request)
    return not (isinstance(request, TSRequest) and _hidden_at_vertices(request))


def require_detectable(
    problem: DesignProblem, has_design: Callable[[DesignProblem], bool] = is_detectable
) -> None:
    """Refuse a request that no observer can answer.

    For a T–S system every vertex is tested by itself (Popov–Belevitch–Hautus). That all of them
    pass is necessary; only the synthesis shows whether what lies between them passes too.

    Args:
        problem: The request.
        has_design: What a changed request must pass to be suggested.

    Raises:
        DetectabilityError: A mode that does not decay is hidden, or a disturbance is arbitrary;
            the text names the place, the mode's eigenvalue and shape, and what would help.
    """
    if is_detectable(problem):
        return
    if isinstance(problem, ArmRequest):
        obstacles = find_obstacles(problem)
        slopes = [obstacle.slope for obstacle in obstacles]
        oscillates = any(abs(obstacle.mode.eigenvalue.imag) > 1e-3 for obstacle in obstacles)
        found = helpful(remedies_of_hidden_modes(problem, slopes, oscillates), has_design)
        raise DetectabilityError(explain(problem, obstacles, found), found)
    if isinstance(problem, TSRequest):
        oscillates = any(mode.eigenvalue.imag > 1e-3 for _, mode in _hidden_at_vertices(problem))
        found = helpful(remedies_of_hidden_modes(problem, (), oscillates), has_design)
        raise DetectabilityError(_explain_hidden(problem, found), found)


def explain(
    request: ArmRequest, obstacles: Sequence[Obstacle], remedies: Sequence[Remedy] = ()
) -> str:
    """Return the report: what is hidden, at which slope and angle, its shape, what would help."""
    outputs = [
        f"{output.model.label}" + (f" ({output.measures})" if request.outputs else "")
        for output in request.sensors
        if output.model.state_count or output.model.arbitrary
    ]
    parts = [f"a disturbance of kind {' and '.join(outputs)}"] if outputs else []
    parts += [
        f"a torque of kind {model.label} at the {side}"
        for side, model in request.torque_disturbance.by_side.items()
    ]
    domain = f" on |q1| <= {request.x_max:.6g} rad" if request.arm.gravity_torque else ""
    if parts:
        lines = [f"no observer can distinguish the arm from {' and '.join(parts)}{domain}:"]
    else:
        lines = [
            f"no observer finds the arm's angles from {_joined(request.output_names)}{domain}:"
        ]
    if request.disturbance_model.arbitrary:
        hidden = [output.measures for output in request.sensors if output.model.arbitrary]
        if len(hidden) < len(request.sensors):
            lines.append(
                f"  - an arbitrary disturbance of {', '.join(hidden)} explains every value of it: "
                "nothing can be proved for a gain that uses it"
            )
        else:
            lines.append(
                "  - every mode of the arm is hidden, whether it decays or not: the estimate can "
                "only be an open-loop simulation"
            )
    lines += [f"  - {_describe(request, obstacle)}" for obstacle in obstacles]
    return "\n".join([*lines, *_advice(remedies)])


def _advice(remedies: Sequence[Remedy]) -> list[str]:
    if not remedies:
        return ["what would help: none of the changes that were tried"]
    return ["what would help:", *(f"  - {remedy.text}" for remedy in remedies)]


def _exosystems(request: ArmRequest) -> list[_Exosystem]:
    """Return the disturbance of every output, then of the torques at motor and link."""
    found, place = [], 4
    sides = request.torque_disturbance.by_side
    pairs = [(output.measures, output.model) for output in request.sensors]
    for name, model in [*pairs, *((side, sides.get(side, clean())) for side in SIDES)]:
        found.append(_Exosystem(name, place, model))
        place += model.state_count
    return found


def _indistinct_terms(request: ArmRequest, exosystems: Sequence[_Exosystem]) -> Iterator[Obstacle]:
    """Yield the persistent modes that cancel within one disturbance, whatever the arm does."""
    for name, place, model in exosystems:
        for mode in hidden_modes(model.S, model.H):
            if mode.eigenvalue.real >= _PERSISTENT and mode.eigenvalue.imag >= 0.0:
                shape = np.zeros(request.flow.state_count, dtype=complex)
                shape[place : place + model.state_count] = mode.shape
                of = f"of the torque at the {name}" if name in SIDES else f"of the {name}"
                parties = tuple(f"the {kind} {of}" for kind in model.label.split("+"))
                yield Obstacle(None, mode._replace(shape=shape), parties)


def _shared_modes(
    request: ArmRequest, exosystems: Sequence[_Exosystem], eigenvalue: complex
) -> Iterator[Obstacle]:
    """Yield the mode of an eigenvalue in which the disturbances take back the arm's motion."""
    arm, (lowest, highest) = request.arm, request.slope_range
    copies = [exosystem.copy(eigenvalue) for exosystem in exosystems]
    shown = {
        output.measures.split("_")[0]
        for output, copy in zip(request.sensors, copies, strict=False)
        if copy is None
        and not output.model.arbitrary
        and (output.measures.endswith("angle") or abs(eigenvalue) > 1e-6)
    }
    free = {side for side, copy in zip(SIDES, copies[-2:], strict=True) if copy is not None}
    k, mgl = arm.stiffness, arm.gravity_torque
    link = eigenvalue * (eigenvalue * arm.link_inertia + arm.link_damping)
    motor = eigenvalue * (eigenvalue * arm.motor_inertia + arm.motor_damping)
    motor_locked = abs(motor + k) <= 1e-9 * (abs(motor) + k)  # its resonance if the link is held

    # Angles, and the gravity slope at which they are a mode; None for any.
    a, b, slope = 1.0 + 0j, 1.0 + 0j, None
    if shown == {"link", "motor"}:
        return
    if "link" in shown:
        if "link" not in free or not ("motor" in free or motor_locked):
            return
        a = 0j
    elif "motor" in shown:
        if "motor" not in free:
            return
        b = 0j
        if "link" not in free:
            slope = _slope_at(-(link + k), abs(link) + k, mgl)
    elif "motor" in free:
        if "link" not in free:
            b = (link + k + highest * mgl) / k
    elif motor_locked:
        if "link" not in free:
            return
        a = 0j
    else:
        b = k / (motor + k)
        if "link" not in free:
            # Without cancellation at λ = 0.
            slope = _slope_at(-(link + k * motor / (motor + k)), abs(link) + k, mgl)
    if slope is not None:
        outside = max(lowest - slope.real, slope.real - highest)
        # Written so that an infinite slope is no obstacle.
        if not (abs(slope.imag) <= _SLOPE_TOLERANCE and outside <= _SLOPE_TOLERANCE):
            return
    at = highest if slope is None else min(max(slope.real, lowest), highest)
    torques = (motor + k) * b - k * a, (link + k + at * mgl) * a - k * b
    place = None if slope is None or not mgl else at
    yield _obstacle(request, exosystems, copies, eigenvalue, (a, b), torques, place)


def _slope_at(torque: complex, scale: float, mgl: float) -> complex:
    """Return c with c mgl = torque; without gravity 0 if the torque is none, else infinity."""
    if mgl:
        return torque / mgl
    return 0j if abs(torque) <= 1e-9 * scale else complex(math.inf)


def _obstacle(
    request: ArmRequest,
    exosystems: Sequence[_Exosystem],
    copies: Sequence[Complex | None],
    eigenvalue: complex,
    angles: tuple[complex, complex],
    torques: tuple[complex, complex],
    slope: float | None,
) -> Obstacle:
    """Return the mode in which the disturbances take back the arm's motion."""
    a, b = angles
    moved = {
        "link_angle": a, "link_velocity": eigenvalue * a,
        "motor_angle": b, "motor_velocity": eigenvalue * b,
    }  # fmt: skip
    shape = np.zeros(request.flow.state_count, dtype=complex)
    shape[:4] = [moved[name] for name in QUANTITIES]
    shape[2:4] *= request.arm.stiffness / request.arm.link_inertia
    parties = ["the arm's motion" if abs(eigenvalue) > 1e-6 else "where the arm is"]
    sizes = [-moved[output.measures] for output in request.sensors] + list(torques)
    for (name, place, model), copy, size in zip(exosystems, copies, sizes, strict=True):
        if copy is not None and abs(size) > 1e-9:
            shape[place : place + copy.size] = size * copy
            where = f"torque at the {name}" if name in SIDES else name
            parties.append(f"the {model.label} of the {where}")
    shape /= np.linalg.norm(shape)
    at = request.slope_range[1] if slope is None else slope
    pencil = request.flow.slope_matrix(at) - eigenvalue * np.eye(shape.size)
    visibility = np.linalg.norm(pencil @ shape) / np.linalg.norm(pencil)
    return Obstacle(slope, HiddenMode(eigenvalue, shape, float(visibility)), tuple(parties))


def _describe(request: ArmRequest, obstacle: Obstacle) -> str:
    eigenvalue = obstacle.mode.eigenvalue
    # A persistent mode's tiny real part, or a defective zero's spread, is rounding.
    clean = complex(*(0.0 if abs(part) < 1e-6 else part for part in _parts(eigenvalue)))
    rate = f"{clean.real:.4g} ± {clean.imag:.4g}j" if clean.imag else f"{clean.real:.4g}"
    fate = "decays by itself but" if clean.real < 0.0 else "does not decay and"
    fault = "cannot be told apart" if len(obstacle.parties) > 1 else "is not shown by velocities"
    at = " at c = 1" if obstacle.slope is None and request.arm.gravity_torque else ""
    return (
        f"{_place(request, obstacle.slope)}: {_joined(obstacle.parties)} {fault}: the mode with "
        f"eigenvalue {rate} 1/s {fate} is not seen; shape{at} "
        f"{_shape(request, obstacle.mode.shape)}"
    )


def _joined(parts: Sequence[str]) -> str:
    *others, last = parts
    return f"{', '.join(others)} and {last}" if others else last


def _place(request: ArmRequest, slope: float | None) -> str:
    if not request.arm.gravity_torque:
        return "without gravity"
    if slope is None:
        return "at every gravity slope"
    angle = math.degrees(math.acos(max(-1.0, min(1.0, slope))))
    # cos(π/2) is 6e-17 in floating point.
    tidy = 0.0 if abs(slope) < 1e-12 else slope
    return f"gravity slope c = {tidy:.4g} (|q1| = {angle:.1f} deg)"


def _shape(request: ArmRequest, mode: Complex) -> str:
    """Return a mode in rad, rad/s and N m, its largest part 1."""
    physical = mode.copy()
    physical[:4] *= request.arm.to_physical(np.ones(4))
    physical /= physical[int(np.argmax(np.abs(physical)))]
    names = ["q1", "q1'", "q2", "q2'"]
    outputs, torques = request.disturbance_model.state_count, request.flow.state_count - 4
    names += [f"w{i + 1}" for i in range(outputs)]
    names += [f"d{i + 1}" for i in range(torques - outputs)]
    parts = []
    for name, value in zip(names, physical, strict=False):
        real, imaginary = (0.0 if abs(part) < 1e-6 else part for part in _parts(value))
        text = f"{real:.3g}{imaginary:+.3g}j" if imaginary else f"{real:.3g}"
        parts.append(f"{name} {text}")
    units = " (rad, rad/s, N m)" if request.torque_sides else ""
    return "[" + ", ".join(parts) + "]" + units


def _parts(value: complex) -> tuple[float, float]:
    return float(value.real), float(value.imag)


def _hidden_at_vertices(request: TSRequest) -> list[tuple[str, HiddenMode]]:
    matrices, names = request.vertex_matrices()
    return [
        (name, mode)
        for name, matrix in zip(names, matrices, strict=True)
        for mode in undetectable_modes(request.flow.augmented(matrix), request.flow.output_matrix)
        if mode.eigenvalue.imag >= 0.0
    ]


def _explain_hidden(request: TSRequest, remedies: Sequence[Remedy]) -> str:
    if request.disturbance_model.arbitrary:
        lines = [
            "an arbitrary disturbance explains every value of the outputs it acts on, which "
            "then carry nothing about the state"
        ]
        return "\n".join([*lines, *_advice(remedies)])
    q = request.disturbance_model.state_count
    names = [*request.state_names, *(f"w{i + 1}" for i in range(q))]
    label = f"[{', '.join(names)}]"
    lines = [
        f"no observer exists for outputs disturbed by {request.disturbance_model.label}:",
        *(
            f"  - {name}: the mode {format_mode(mode, label)} is not seen"
            for name, mode in _hidden_at_vertices(request)
        ),
    ]
    return "\n".join([*lines, *_advice(remedies)])
