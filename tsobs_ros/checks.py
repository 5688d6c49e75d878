# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checks of numbers and matrices: an error names the quantity, what was expected and what came."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.errors import ModelError

Array = NDArray[np.float64]


def as_matrix(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return `value` as a read-only float array of exactly `shape`.

    Raises:
        ModelError: The value is not numeric, not finite, or of another shape.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{name}: expected real numbers, got {value!r}") from error
    if array.shape != shape:
        raise ModelError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ModelError(f"{name}: every entry must be finite, got {array.tolist()}")
    array.setflags(write=False)
    return array


def positive(name: str, value: float) -> float:
    """Return `value` if it is a finite number above zero, else raise `ModelError`."""
    if not (math.isfinite(value) and value > 0.0):
        raise ModelError(f"{name}: expected a finite number above 0, got {value!r}")
    return float(value)


def non_negative(name: str, value: float) -> float:
    """Return `value` if it is a finite number of at least zero, else raise `ModelError`."""
    if not (math.isfinite(value) and value >= 0.0):
        raise ModelError(f"{name}: expected a finite number of at least 0, got {value!r}")
    return float(value)
