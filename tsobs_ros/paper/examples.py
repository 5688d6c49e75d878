# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The method's three examples and printed solutions as data, in one reading of the lost signs.

T. V. Dang, W.-J. Wang, L. Luoh, C.-H. Sun, "Adaptive observer design for the uncertain
Takagi–Sugeno fuzzy system with output disturbance", IET Control Theory & Applications (2011).
docs/method.md has the reasons for the signs, and the data that are not printed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.core.functions import evaluate
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.ts_model import TSModel

Signal = Callable[[Array], Array]
"""A signal of time: t of shape (...) to values of shape (..., channels)."""

_C = (
    [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]],
)
_B = ([[1.0], [0.0], [0.0]], [[0.0], [1.0], [0.0]])


@dataclass(frozen=True)
class PaperExample:
    """Example 1 or 2: the uncertain system, its disturbance and the data given to the observer.

    Attributes:
        system: The T–S system without its uncertainty.
        delta_A: ΔAᵢ at λ = 1, shape (r, n, n).
        alpha: Bounds αᵢ ≥ ‖ΔAᵢ‖, shape (r,).
        xi: Bounds ξᵢ on ‖Ξᵢ‖, shape (r,).
        Gamma: Adaptation gains Γᵢ, shape (r, p, p).
        initial_state: x(0), shape (n,).
        disturbance: ω(t) of the outputs.
    """

    system: TSModel
    delta_A: Array
    alpha: Array
    xi: Array
    Gamma: Array
    initial_state: Array
    disturbance: Signal


def _system(A1: list[list[float]], A2: list[list[float]]) -> TSModel:
    # h₂ = y₁² as printed, and 1 for |y₁| > 1, which the paper's y₁ never reaches.
    unit = {"half_width": 1.0}
    rules = RuleBase(((membership("square_rest", unit),), (membership("square", unit),)))
    A, C, measured = np.array([A1, A2]), np.array(_C), np.ones((1, 1))
    return TSModel(A, np.array(_B), C[0], rules, np.zeros((1, 3)), measured, C)


def arm_system(arm: ElasticJointArm, x_max: float = math.pi / 2) -> TSModel:
    """Return the two-rule T–S form of an arm, equal to it wherever |q₁| ≤ x_max.

    The default arm and angle give the system of Example 3, which has no ΔA.

    Sector nonlinearity: sin q₁ = (h₁·1 + h₂·b) q₁ with b = sin(x_max)/x_max, the paper's
    (48)–(49) at x_max = π/2.

    Raises:
        ModelError: x_max [rad] is not between 0 and π.
    """
    sector = {"half_width": x_max}
    rules = RuleBase(((membership("sine_upper", sector),), (membership("sine_lower", sector),)))
    slopes = 1.0, evaluate("sine", x_max).item() / x_max
    A = np.array([arm.slope_matrix(slope) for slope in slopes])
    return TSModel(A, arm.input_matrix, arm.output_matrix, rules, np.eye(4)[:1])


def torque(t: Array) -> Array:
    """Return the input u(t) of all examples, shape (..., 1)."""
    return np.sin(np.asarray(t))[..., np.newaxis]


def _after_2_and_3(first: Signal, second: Signal, third: Signal) -> Signal:
    """Return three channels: the first begins at 2 s, the second at 3 s, the third at once."""

    def channels(t: Array) -> Array:
        time = np.asarray(t)
        of_first = np.where(time >= 2.0, first(time - 2.0), 0.0)
        of_second = np.where(time >= 3.0, second(time - 3.0), 0.0)
        return np.stack([of_first, of_second, third(time)], axis=-1)

    return channels


def example_1() -> PaperExample:
    """Return Example 1: three states, three disturbed outputs, two rules with different C."""
    return PaperExample(
        system=_system(
            [[-1.25, 2.05, 0.0], [-2.025, -1.025, 0.0], [1.05, 0.05, -3.0]],
            [[-2.0, 1.05, 0.0], [0.0, -0.5, 1.025], [-1.05, 0.0, -1.0]],
        ),
        delta_A=np.stack([np.diag([0.0608, 0.06, 0.03]), np.diag([0.1216, 0.1, 0.03])]),
        alpha=np.array([0.0608, 0.1216]),
        xi=np.array([0.01, 0.02]),
        Gamma=np.stack([np.diag([5.0, 1.0, 1.0])] * 2),
        initial_state=np.array([0.5, 0.7, 0.5]),
        disturbance=_after_2_and_3(
            lambda t: 0.2 * np.sin(3.0 * t) ** 2,
            lambda t: 0.3 * np.cos(4.0 * t) ** 2,
            lambda t: 0.4 * (np.sin(2.0 * t) ** 2 + np.cos(3.0 * t)),
        ),
    )


def example_2() -> PaperExample:
    """Return Example 2: sensor faults on the system of Gao, Shi and Ding (D_s = I)."""
    return PaperExample(
        system=_system(
            [[-1.0, 2.0, 0.0], [-2.0, -1.0, 0.0], [1.0, 0.0, -3.0]],
            [[-2.0, 1.0, 0.0], [0.0, -0.5, 1.0], [-1.0, 0.0, -1.0]],
        ),
        delta_A=np.stack([np.diag([0.1199, 0.1, 0.009]), np.diag([0.2512, 0.135, 0.03])]),
        alpha=np.array([0.1199, 0.2512]),
        xi=np.array([0.01, 0.02]),
        Gamma=np.stack([2.0 * np.diag([10.0, 1.0, 1.0])] * 2),
        initial_state=np.array([0.2, 0.3, 0.5]),
        disturbance=_after_2_and_3(
            lambda t: 0.2 * np.sin(3.0 * t),
            lambda t: 0.2 * np.sin(4.0 * t),
            lambda t: 0.4 * (np.sin(2.0 * t) + np.cos(3.0 * t)),
        ),
    )


def _symmetric(upper: list[list[float]]) -> Array:
    matrix = np.zeros((len(upper), len(upper)))
    matrix[np.triu_indices(len(upper))] = np.concatenate(upper)
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
"""P of Example 1, shape (6, 6), in the reading of the signs of `example_1`."""

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
"""Hᵢ of Example 3, shape (2, 5, 1), up to the same changes of sign. Among all of these, with the
numbers taken as Hᵢ or as E_L⁻¹Hᵢ, this reading violates (37) least if P and H change together, and
it gives the best observer."""


def sign_changes(count: int) -> Array:
    """Return every change of sign of the `count` coordinates after the first.

    The first coordinate of Example 3 is the measured angle; its sign and that of its disturbance
    are fixed by C̄ = [1 0 0 0 1], so only relative signs of the others are open. Shape (2^count,
    1 + count), of ±1.
    """
    return np.array([[1.0, *signs] for signs in product((1.0, -1.0), repeat=count)])
