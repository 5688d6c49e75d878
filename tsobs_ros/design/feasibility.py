# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Detectability: the modes that the outputs do not show.

A mode with eigenvalue λ is hidden if a vector v ≠ 0 satisfies (A − λI) v = 0 and C̄ v = 0
(Popov–Belevitch–Hautus). For an arm, A depends on the gravity slope c, and only 0 and the
eigenvalues of an exosystem can persist. The slope enters a single row. So the null space of the
other rows is found first, and that row then gives the slope.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.design.request import AnyRequest, ArmRequest
from tsobs_ros.errors import DetectabilityError
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY, MOTOR_ANGLE

_PERSISTENT = -1e-9
"""A mode whose real part is above this [1/s] counts as lasting: it would outlive the robot."""

_TOLERANCE = 1e-9
"""Relative size below which numbers count as zero, and by which a slope may leave the domain."""

Complex = NDArray[np.complex128]


class HiddenMode(NamedTuple):
    """A mode that the outputs do not show.

    Attributes:
        eigenvalue: λ [1/s].
        shape: The unit vector v with A v = λ v and C v = 0, shape (n,).
        slope: Gravity slope of an arm at which the mode is hidden; None if at every slope.
        text: The mode in words: its place, the motions that look alike, λ and shape.
    """

    eigenvalue: complex
    shape: Complex
    slope: float | None = None
    text: str = ""


def undetectable_modes(A: Array, C: Array) -> list[HiddenMode]:
    """Return the modes of A that C does not see and that do not decay: no observer converges.

    Equal eigenvalues count once: if several hidden directions share an eigenvalue, the best hidden
    one is returned.
    """
    modes, eigenvalues = list[HiddenMode](), np.linalg.eigvals(A)
    slowest = _PERSISTENT * float(np.abs(eigenvalues).max(initial=1.0))
    for eigenvalue in eigenvalues[eigenvalues.real >= slowest]:
        pencil = np.vstack([A - eigenvalue * np.eye(len(A)), C])
        _, singular, right = np.linalg.svd(pencil)
        already = any(abs(eigenvalue - mode.eigenvalue) < 1e-6 for mode in modes)
        if singular[-1] / singular[0] < _TOLERANCE and not already:
            modes.append(HiddenMode(complex(eigenvalue), right[-1].conj()))
    return modes


def format_mode(mode: HiddenMode, label: str = "[x; ω]") -> str:
    """Return a mode as text: eigenvalue, and shape scaled so that its largest entry is 1."""
    shape = mode.shape / mode.shape[int(np.argmax(np.abs(mode.shape)))]
    entries = ", ".join(_format_complex(part, ".3g") for part in shape)
    return f"{_format_complex(mode.eigenvalue, '.4g')} with {label} = [{entries}]"


def _format_complex(value: complex, style: str) -> str:
    real, imaginary = (0.0 if abs(part) < 1e-9 else part for part in (value.real, value.imag))
    return f"{real:{style}}" + (f"{imaginary:+{style}}j" if imaginary else "")


def find_obstacles(request: AnyRequest) -> list[HiddenMode]:
    """Return the undetectable modes, one of each conjugate pair.

    For an arm, these are the modes at slopes of its domain. For a T–S system, every vertex is
    tested by itself. All must pass, and only the synthesis shows whether their blends pass, too.
    """
    if isinstance(request, ArmRequest):
        return list(_of_arm(request))
    return [
        mode._replace(text=f"{corner.place['']}: {_mode_text(request, mode)}")
        for corner in request.corners()
        for mode in undetectable_modes(
            request.flow.drift + corner.matrix, request.flow.output_matrix
        )
        if mode.eigenvalue.imag >= 0.0
    ]


def require_detectable(request: AnyRequest) -> None:
    """Refuse a request that no observer can answer.

    Raises:
        DetectabilityError: A mode that does not decay is hidden, or a disturbance is arbitrary;
            the text names the place, the mode's eigenvalue and shape.
    """
    lines = [
        f"arbitrary disturbance of {each.name}: explains every value; nothing can be proved for a "
        "gain that uses it"
        for each in request.channels
        if each.model.arbitrary
    ] or [obstacle.text for obstacle in find_obstacles(request)]
    if lines:
        what = f"no observer exists: {request.headline.partition(';')[0]}"
        raise DetectabilityError("\n  - ".join([what, *lines]))


def _of_arm(request: ArmRequest) -> Iterator[HiddenMode]:
    """Yield the modes in which disturbances cancel the arm's motion, or each other."""
    flow, (lowest, highest) = request.flow, request.slope_range
    persistent, pull = [0j], request.arm.gravity_gain
    for eigenvalue in np.linalg.eigvals(flow.disturbance.S).astype(complex).tolist():
        known = any(abs(eigenvalue - other) < 1e-6 for other in persistent)
        if not known and eigenvalue.real >= _PERSISTENT and eigenvalue.imag >= 0.0:
            persistent.append(eigenvalue)
    for eigenvalue in persistent:
        A = flow.drift - eigenvalue * np.eye(flow.state_count)
        others = np.delete(A, LINK_VELOCITY, axis=0)
        kernel = _kernel(np.vstack([others, flow.output_matrix]))
        force, height = A[LINK_VELOCITY] @ kernel, kernel[LINK_ANGLE]
        slope: float | None = None
        if not kernel.size:
            continue
        rounding = 1e-14 * np.abs(A[LINK_VELOCITY]).max() * np.abs(kernel).max()
        if kernel.shape[1] > 1:  # some combination of them is hidden at every slope
            balance = (force - highest * pull * height)[np.newaxis]
            kernel = kernel @ np.linalg.svd(balance)[2][-1:].conj().T
        elif pull and abs(height[0]) > _TOLERANCE * np.abs(kernel[:, 0]).max():
            at = force[0] / (pull * height[0])
            outside = max(lowest - at.real, at.real - highest)
            if not (abs(at.imag) <= _TOLERANCE and outside <= _TOLERANCE):
                continue
            slope = float(min(max(at.real, lowest), highest))
        elif abs(force[0]) > _TOLERANCE * np.abs(A[LINK_VELOCITY] * kernel[:, 0]).sum() + rounding:
            continue
        yield _obstacle(request, slope, eigenvalue, kernel[:, 0])


def _kernel(matrix: Complex) -> Complex:
    """Return the null space of a matrix with rows and columns of any units, shape (n, d)."""
    scale = np.ones(matrix.shape[1])
    matrix = matrix[np.abs(matrix).any(axis=1)]
    for _ in range(30):
        rows = np.sqrt(np.abs(matrix).max(axis=1, keepdims=True))
        columns = np.sqrt(np.abs(matrix).max(axis=0))
        columns[columns == 0.0] = 1.0
        matrix, scale = matrix / rows / columns, scale / columns
    _, singular, right = np.linalg.svd(matrix)
    rank = int((singular > _TOLERANCE * singular[0]).sum())
    return np.asarray(scale[:, np.newaxis] * right[rank:].conj().T)


def _obstacle(
    request: ArmRequest, slope: float | None, eigenvalue: complex, shape: Complex
) -> HiddenMode:
    """Return a mode, with its place and everything that moves in it described in words."""
    place = "at every gravity slope" if request.arm.gravity_torque else "without gravity"
    if slope is not None:
        # cos(π/2) is 6e-17 in floating point.
        tidy = 0.0 if abs(slope) < 1e-12 else slope
        place = f"gravity slope c = {tidy:.4g} (|q1| = {math.degrees(math.acos(tidy)):.1f} deg)"
    unit = shape / np.linalg.norm(shape)
    physical = unit.copy()
    physical[:4] *= request.arm.to_physical(np.ones(4))
    size, begin = np.abs(physical[[LINK_ANGLE, MOTOR_ANGLE]]).max(), 4
    moves = size > _TOLERANCE
    parties = [f"the arm's {'motion' if abs(eigenvalue) > 1e-6 else 'position'}"] * bool(moves)
    for channel in request.channels:
        model, end = channel.model, begin + channel.model.state_count
        # If the arm does not move, states of the disturbances cancel each other.
        share = model.H[0] @ unit[begin:end] / size if moves else np.abs(unit[begin:end]).sum()
        kinds = [model.label] if moves else model.label.split("+")
        parties += [f"the {kind} of {channel.name}" for kind in kinds if abs(share) > _TOLERANCE]
        begin = end
    fault = "cannot be distinguished" if len(parties) > 1 else "is not shown by velocities"
    mode = _mode_text(request, HiddenMode(eigenvalue, physical))
    named = " and ".join(filter(None, (", ".join(parties[:-1]), parties[-1])))
    return HiddenMode(eigenvalue, unit, slope, f"{place}: {named} {fault}: {mode}")


def _mode_text(request: AnyRequest, mode: HiddenMode) -> str:
    labels = [*request.state_names, *(f"w{i + 1}" for i in range(len(request.disturbance_labels)))]
    text = format_mode(mode, f"[{', '.join(labels)}]")
    return f"the mode {text} does not decay and is not seen"
