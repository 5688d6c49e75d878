# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The numbers the method's paper prints as solutions of its conditions, signs restored.

Available are P and M of Example 1, with ε and ‖P⁻¹‖, and P and Hᵢ of Example 3. Q and H of
Example 1 and every solution of Example 2 are not available, so their conditions can only be
checked in the part that does not depend on them; see `tsobs_ros.paper.conditions`.
"""

import numpy as np

from tsobs_ros.checks import Array


def _symmetric(upper: list[list[float]]) -> Array:
    n = len(upper)
    matrix = np.zeros((n, n))
    for row, values in enumerate(upper):
        matrix[row, row:] = values
    return np.asarray(matrix + np.triu(matrix, 1).T)


EXAMPLE_1_P = _symmetric(
    [
        [1.0840, -0.0017, 0.1464, 0.2751, 0.2769, 0.0556],
        [1.2450, -0.2543, 0.0017, 0.1158, -0.2306],
        [0.6544, -0.1464, 0.1079, 0.5807],
        [1.0840, -0.2769, -0.0556],
        [0.9664, 0.1750],
        [0.9025],
    ]
)
"""P of Example 1, shape (6, 6), in the reading of the signs of `examples.example_1`."""

EXAMPLE_1_M = np.array(
    [
        [0.7358, 0.7358, -0.27],
        [0.0, 0.7358, 0.3812],
        [0.0, 0.0, 1.6248],
        [0.7358, 0.0, 0.27],
        [0.0, 0.7358, -0.1113],
        [0.0, 0.0, 0.2149],
    ]
)
"""M of Example 1, shape (6, 3)."""

EXAMPLE_1_EPSILON = 6.6990
"""The bound α₁ᵢ/(ξᵢ‖C̄‖) of Example 1 as printed."""

EXAMPLE_1_INVERSE_NORM = 6.6987
"""‖P⁻¹‖ of Example 1 as printed."""

EXAMPLE_3_P = _symmetric(
    [
        [2.2592, -0.2010, -0.5134, -0.0768, 2.7653],
        [1.0801, -0.0789, 0.1328, 0.2981],
        [0.1644, -0.0119, -0.1504],
        [0.0583, -0.0878],
        [16.3296],
    ]
)
"""P of Example 3, shape (5, 5), up to changes of sign of coordinates."""

EXAMPLE_3_H = np.array(
    [
        [[27.8133], [-8.7405], [89.7378], [65.7083], [22.5315]],
        [[29.2736], [-6.4259], [94.4479], [67.1429], [23.7811]],
    ]
)
"""Hᵢ of Example 3, shape (2, 5, 1), up to the same changes of sign. Of all of them, and of taking
the numbers for Hᵢ or for E_L⁻¹Hᵢ, this reading violates (37) least where P and H change together,
and makes the best observer."""


def sign_changes(count: int) -> Array:
    """Return every change of sign of the last `count` of the coordinates after the first.

    The first coordinate of Example 3 is the measured angle; its sign and that of its disturbance
    are fixed by C̄ = [1 0 0 0 1], so only relative signs of the others are open.

    Returns:
        Vectors of ±1, shape (2^count, 1 + count), each beginning with +1.
    """
    rows = [[1.0]]
    for _ in range(count):
        rows = [[*row, sign] for row in rows for sign in (1.0, -1.0)]
    return np.array(rows)
