# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Modes that a sensor cannot see: the Popov–Belevitch–Hautus test with mode shapes."""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array


class HiddenMode(NamedTuple):
    """A mode of (A, C) that the output does not show.

    Attributes:
        eigenvalue: λ [1/s] (continuous time).
        shape: Unit vector v with A v = λ v and C v = 0, shape (n,), complex.
    """

    eigenvalue: complex
    shape: "np.ndarray[tuple[int, ...], np.dtype[np.complex128]]"


def hidden_modes(A: Array, C: Array, tolerance: float = 1e-9) -> list[HiddenMode]:
    """Return a mode of A that C does not see for each eigenvalue with one, by the PBH rank test.

    Equal eigenvalues count once: of several hidden directions that share one, the best hidden
    is returned. `tolerance` is the relative singular value below which [A − λI; C] has lost rank.
    """
    modes: list[HiddenMode] = []
    for eigenvalue in np.linalg.eigvals(A):
        pencil = np.vstack([A - eigenvalue * np.eye(len(A)), C])
        _, singular, right = np.linalg.svd(pencil)
        already = any(abs(eigenvalue - mode.eigenvalue) < 1e-6 for mode in modes)
        if singular[-1] / singular[0] < tolerance and not already:
            modes.append(HiddenMode(complex(eigenvalue), right[-1].conj()))
    return modes


def undetectable_modes(A: Array, C: Array) -> list[HiddenMode]:
    """Return the hidden modes that do not decay: with one of them no observer converges."""
    spectral_radius = float(np.abs(np.linalg.eigvals(A)).max(initial=1.0))
    slowest = -1e-9 * spectral_radius
    return [mode for mode in hidden_modes(A, C) if mode.eigenvalue.real >= slowest]


def format_mode(mode: HiddenMode, label: str = "[x; ω]") -> str:
    """Return a mode as text: eigenvalue, and shape scaled so that its largest entry is 1."""
    shape = mode.shape / mode.shape[int(np.argmax(np.abs(mode.shape)))]
    entries = ", ".join(_format_complex(part, ".3g") for part in shape)
    return f"{_format_complex(mode.eigenvalue, '.4g')} with {label} = [{entries}]"


def _format_complex(value: complex, style: str) -> str:
    real, imaginary = (0.0 if abs(part) < 1e-9 else part for part in (value.real, value.imag))
    return f"{real:{style}}" + (f"{imaginary:+{style}}j" if imaginary else "")
