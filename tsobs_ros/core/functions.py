# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sine, cosine, exponential and logarithm of the compiled core, with the same bits on every CPU."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.core import native


def evaluate(function: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return "sine" or "cosine" of angles [rad], "exponential" of numbers up to 0, or "logarithm".

    >>> evaluate("sine", 0.5).item()
    0.479425538604203
    """
    result = np.array(values, np.float64, order="C")
    native.elementary(function, result)
    return result
