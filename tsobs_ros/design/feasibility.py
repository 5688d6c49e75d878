# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Detectability of a request: its hidden modes, their gravity slopes and what would help.

Of an arm, a mode of eigenvalue λ is hidden at the gravity slope c if a vector v other than zero has
(A(c) − λI) v = 0 and C̄ v = 0. Only λ of an exosystem, or 0, can persist. The slope enters one row
alone, so the vectors that the other rows leave are found first, and that row then gives the slope.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.design.problem import Channel
from tsobs_ros.design.remedies import helpful, remedies_of_hidden_modes
from tsobs_ros.design.request import AnyRequest, ArmRequest
from tsobs_ros.errors import DetectabilityError
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY
from tsobs_ros.model.detectability import (
    HiddenMode,
    format_mode,
    hidden_modes,
    undetectable_modes,
)

_PERSISTENT = -1e-9
"""Real parts above this [1/s] do not decay: the mode would outlive the robot."""

_TOLERANCE = 1e-9
"""Relative size of numbers that count as zero, and by which a slope may leave the domain."""

Complex = NDArray[np.complex128]


class Obstacle(NamedTuple):
    """A persistent mode that the outputs do not show.

    Attributes:
        slope: Gravity slope of an arm at which it is hidden, None if at any.
        eigenvalue: λ [1/s].
        shape: Unit vector, shape (n,).
        text: The mode in words: its place, what cannot be distinguished, λ and shape.
    """

    slope: float | None
    eigenvalue: complex
    shape: Complex
    text: str


def find_obstacles(request: AnyRequest) -> list[Obstacle]:
    """Return the undetectable modes, one of each conjugate pair.

    An arm's are those on its domain; an output with an arbitrary disturbance shows nothing. Of a
    T–S system every vertex is tested by itself (Popov–Belevitch–Hautus). That all of them pass is
    necessary; only the synthesis shows whether what lies between them passes too.
    """
    if isinstance(request, ArmRequest):
        return list(_of_arm(request))
    flow, pairs = request.flow, zip(*request.vertex_matrices(), strict=True)
    return [
        Obstacle(None, mode.eigenvalue, mode.shape, f"{name}: {_mode_text(request, mode)}")
        for matrix, name in pairs
        for mode in undetectable_modes(flow.augmented(matrix), flow.output_matrix)
        if mode.eigenvalue.imag >= 0.0
    ]


def is_detectable(request: AnyRequest) -> bool:
    """Return whether no mode that persists is hidden, and no disturbance is arbitrary."""
    return not (request.disturbance_model.arbitrary or find_obstacles(request))


def require_detectable(
    request: AnyRequest, has_design: Callable[[AnyRequest], bool] = is_detectable
) -> None:
    """Refuse a request that no observer can answer.

    Args:
        request: The request.
        has_design: What a changed request must pass to be suggested.

    Raises:
        DetectabilityError: A mode that does not decay is hidden, or a disturbance is arbitrary;
            the text names the place, the mode's eigenvalue and shape, and what would help.
    """
    if is_detectable(request):
        return
    lines, hidden = [f"no observer exists: {request.headline.partition(';')[0]}"], []
    if request.disturbance_model.arbitrary:
        unknown = [each.name for each in request.channels if each.model.arbitrary]
        nothing = "nothing can be proved for a gain that uses it"
        if len(unknown) == len(request.output_names):
            nothing = "the estimate can only be an open-loop simulation"
        names = ", ".join(unknown)
        lines.append(f"  - arbitrary disturbance of {names}: explains every value; {nothing}")
    else:
        hidden = find_obstacles(request)
        lines += [f"  - {obstacle.text}" for obstacle in hidden]
    oscillates = any(each.eigenvalue.imag > 1e-3 for each in hidden)
    families = remedies_of_hidden_modes(request, [each.slope for each in hidden], oscillates)
    found = helpful(families, has_design)
    advice = [f"  - {remedy.text}" for remedy in found] or [
        "  - none of the changes that were tried"
    ]
    raise DetectabilityError("\n".join([*lines, "what would help:", *advice]), found)


def _of_arm(request: ArmRequest) -> Iterator[Obstacle]:
    eigenvalues, pure = [0j], []
    for channel, place in _places(request):
        model = channel.model
        for eigenvalue in np.linalg.eigvals(model.S).astype(complex).tolist():
            known = any(abs(eigenvalue - other) < 1e-6 for other in eigenvalues)
            if not known and eigenvalue.real >= _PERSISTENT and eigenvalue.imag >= 0.0:
                eigenvalues.append(eigenvalue)
        for mode in hidden_modes(model.S, model.H):
            if mode.eigenvalue.real >= _PERSISTENT and mode.eigenvalue.imag >= 0.0:
                shape = np.zeros(request.flow.state_count, dtype=complex)
                shape[place] = mode.shape
                pure.append(shape)
                parties = [f"the {kind} of {channel.name}" for kind in model.label.split("+")]
                yield _obstacle(request, None, mode.eigenvalue, shape, parties)
    for eigenvalue in eigenvalues:
        yield from _shared_mode(request, eigenvalue, pure)


def _places(request: ArmRequest) -> Iterator[tuple[Channel, slice]]:
    """Yield the disturbances and the places of their states."""
    begin = 4
    for channel in request.channels:
        end = begin + channel.model.state_count
        yield channel, slice(begin, end)
        begin = end


def _shared_mode(
    request: ArmRequest, eigenvalue: complex, pure: Sequence[Complex]
) -> Iterator[Obstacle]:
    """Yield the mode of an eigenvalue in which disturbances take back the arm's motion."""
    flow, (lowest, highest) = request.flow, request.slope_range
    n, shows = flow.state_count, [not output.model.arbitrary for output in request.sensors]
    A = flow.augmented(request.arm.slope_matrix(0.0)) - eigenvalue * np.eye(n)
    pull = A[LINK_VELOCITY, LINK_ANGLE] - request.arm.slope_matrix(1.0)[LINK_VELOCITY, LINK_ANGLE]
    others = np.delete(A, LINK_VELOCITY, axis=0)
    kernel = _kernel(np.vstack([others, flow.output_matrix[shows], *np.conj(pure)]))
    force, height = A[LINK_VELOCITY] @ kernel, kernel[LINK_ANGLE]
    size = np.abs(A[LINK_VELOCITY]) @ np.abs(kernel)
    slope: float | None = None
    if kernel.shape[1] > 1:  # one combination of them at every slope
        balance = (force - highest * pull * height)[np.newaxis]
        kernel = kernel @ np.linalg.svd(balance)[2][-1:].conj().T
    elif not kernel.size:
        return
    elif pull and abs(height[0]) > _TOLERANCE * np.abs(kernel[:, 0]).max():
        at = force[0] / (pull * height[0])
        outside = max(lowest - at.real, at.real - highest)
        if not (abs(at.imag) <= _TOLERANCE and outside <= _TOLERANCE):
            return
        slope = float(min(max(at.real, lowest), highest))
    elif abs(force[0]) > _TOLERANCE * size[0]:
        return
    shape = kernel[:, 0]
    parties = list(_parties(request, eigenvalue, shape))
    yield _obstacle(request, slope, eigenvalue, shape, parties)


def _kernel(matrix: Complex) -> Complex:
    """Return the null space of a matrix whose rows and columns have any units, shape (n, d)."""
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


def _parties(request: ArmRequest, eigenvalue: complex, shape: Complex) -> Iterator[str]:
    """Yield what moves in a mode, in words."""
    yield "the arm's motion" if abs(eigenvalue) > 1e-6 else "the arm's position"
    angles = request.arm.to_physical(np.ones(4)) * shape[:4]
    moving = shape / np.abs(angles[[0, 2]]).max()
    for channel, place in _places(request):
        model = channel.model
        if abs(model.H[0] @ moving[place]) > _TOLERANCE:
            yield f"the {model.label} of {channel.name}"


def _obstacle(
    request: ArmRequest,
    slope: float | None,
    eigenvalue: complex,
    shape: Complex,
    parties: Sequence[str],
) -> Obstacle:
    place = "at every gravity slope" if request.arm.gravity_torque else "without gravity"
    if slope is not None:
        # cos(π/2) is 6e-17 in floating point.
        tidy = 0.0 if abs(slope) < 1e-12 else slope
        place = f"gravity slope c = {tidy:.4g} (|q1| = {math.degrees(math.acos(tidy)):.1f} deg)"
    fault = "cannot be distinguished" if len(parties) > 1 else "is not shown by velocities"
    unit = shape / np.linalg.norm(shape)
    physical = unit.copy()
    physical[:4] *= request.arm.to_physical(np.ones(4))
    mode = _mode_text(request, HiddenMode(eigenvalue, physical))
    text = f"{place}: {', '.join(parties[:-1])}{' and ' * (len(parties) > 1)}{parties[-1]} {fault}"
    return Obstacle(slope, eigenvalue, unit, f"{text}: {mode}")


def _mode_text(request: AnyRequest, mode: HiddenMode) -> str:
    labels = [*request.state_names, *(f"w{i + 1}" for i in range(len(request.disturbance_labels)))]
    text = format_mode(mode, f"[{', '.join(labels)}]")
    return f"the mode {text} does not decay and is not seen"
