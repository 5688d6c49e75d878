# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The three examples of the method's paper as data, in one reading of its lost signs.

T. V. Dang, W.-J. Wang, L. Luoh, C.-H. Sun, "Adaptive observer design for the uncertain
Takagi–Sugeno fuzzy system with output disturbance", IET Control Theory & Applications (2011).

The available text has lost its minus signs and every π. What decides the signs here:

* Example 1's printed P and M satisfy P M = C̄ᵀ to rounding for exactly four patterns of signs,
  and these go into one another when coordinates change sign. One of the four is taken.
* A₂ has a stable reading only if the product of its three off-diagonal entries is negative, and
  A₁ needs opposite signs off its diagonal, to turn as the paper's figures do.
* Example 2's matrices are those of the fault-estimation paper it takes them from (Z. Gao, X. Shi,
  S. X. Ding, IEEE Trans. Systems, Man, and Cybernetics B 38, 2008).
* Example 3 is mechanics, so its signs are known; its printed P and H are not determined beyond a
  change of sign of coordinates, and the conclusions drawn here hold for every such choice.

ω₃ may have been .4 (sin² 2πt + cos 3πt): `third_frequency` is the factor of t.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.fuzzy import RuleBase, TSSystem
from tsobs_ros.paper.augmentation import require_partition

Signal = Callable[[Array], Array]
"""A signal of time: t of shape (...) to values of shape (..., channels)."""

_C = (
    [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]],
)
_B = ([[1.0], [0.0], [0.0]], [[0.0], [1.0], [0.0]])


@dataclass(frozen=True)
class PaperExample:
    """An example: the uncertain system, what disturbs it and what the observer is given.

    Attributes:
        name: "example_1" and so on.
        system: The T–S system without its uncertainty.
        delta_A: ΔAᵢ at λ = 1, shape (r, n, n).
        alpha: Bounds αᵢ ≥ ‖ΔAᵢ‖, shape (r,).
        xi: Bounds ξᵢ on ‖Ξᵢ‖, shape (r,).
        Gamma: Adaptation gains Γᵢ, shape (r, p, p).
        initial_state: x(0), shape (n,).
        torque: The input u(t).
        disturbance: ω(t) of the outputs; zero for Example 3, whose disturbance is noise.

    Raises:
        ModelError: A matrix has the wrong shape, or a bound is below ‖ΔAᵢ‖.
    """

    name: str
    system: TSSystem
    delta_A: Array
    alpha: Array
    xi: Array
    Gamma: Array
    initial_state: Array
    torque: Signal
    disturbance: Signal

    def __post_init__(self) -> None:
        r, n, p = len(self.system.A), self.system.state_count, self.system.C.shape[1]
        shapes = {"delta_A": (r, n, n), "alpha": (r,), "xi": (r,), "Gamma": (r, p, p)}
        shapes["initial_state"] = (n,)
        for field, shape in shapes.items():
            object.__setattr__(self, field, as_matrix(field, getattr(self, field), shape))
        for rule, (change, bound) in enumerate(zip(self.delta_A, self.alpha, strict=True), 1):
            if np.linalg.norm(change, 2) > bound * (1.0 + 1e-12):
                raise ModelError(
                    f"alpha: expected at least the norm {np.linalg.norm(change, 2):.6g} of ΔA of "
                    f"rule {rule}, got {bound:.6g}"
                )

    def derivative(self, x: Array, u: Array, z: Array, uncertainty: Array | float = 1.0) -> Array:
        """Return ẋ of the uncertain system.

        Args:
            x: State, shape (..., n).
            u: Input, shape (..., m).
            z: Premise variables, shape (..., q).
            uncertainty: λ, which scales ΔAᵢ, shape (..., 1) or a number.
        """
        change = self.system.blend(self.delta_A, z)
        drift = (change @ x[..., np.newaxis])[..., 0]
        return np.asarray(self.system.derivative(x, u, z) + uncertainty * drift)


def _weights_of_first_output() -> RuleBase:
    # h₂ = y₁² as printed, and 1 where |y₁| > 1, which the paper's y₁ never reaches.
    def second(y1: Array) -> Array:
        return np.minimum(y1**2, 1.0)

    rule_base = RuleBase(((lambda y1: 1.0 - second(y1),), (second,)))
    require_partition(rule_base, np.linspace(-2.0, 2.0, 41)[:, np.newaxis])
    return rule_base


def _system(A1: list[list[float]], A2: list[list[float]]) -> TSSystem:
    # The first row of both C is the first state, which is therefore y₁ without disturbance.
    return TSSystem.from_rules(
        [A1, A2], list(_B), list(_C), _weights_of_first_output(), lambda x: x[..., :1]
    )


def _sine(t: Array) -> Array:
    return np.sin(np.asarray(t))[..., np.newaxis]


def example_1(third_frequency: float = 1.0) -> PaperExample:
    """Return Example 1: three states, three disturbed outputs, two rules with different C.

    Args:
        third_frequency: Factor of t in ω₃; π in the other reading of the text.
    """

    def disturbance(t: Array) -> Array:
        time = np.asarray(t)
        third = third_frequency * time
        return np.stack(
            [
                np.where(time >= 2.0, 0.2 * np.sin(3.0 * (time - 2.0)) ** 2, 0.0),
                np.where(time >= 3.0, 0.3 * np.cos(4.0 * (time - 3.0)) ** 2, 0.0),
                0.4 * (np.sin(2.0 * third) ** 2 + np.cos(3.0 * third)),
            ],
            axis=-1,
        )

    return PaperExample(
        name="example_1",
        system=_system(
            [[-1.25, 2.05, 0.0], [-2.025, -1.025, 0.0], [1.05, 0.05, -3.0]],
            [[-2.0, 1.05, 0.0], [0.0, -0.5, 1.025], [-1.05, 0.0, -1.0]],
        ),
        delta_A=np.stack([np.diag([0.0608, 0.06, 0.03]), np.diag([0.1216, 0.1, 0.03])]),
        alpha=np.array([0.0608, 0.1216]),
        xi=np.array([0.01, 0.02]),
        Gamma=np.stack([np.diag([5.0, 1.0, 1.0])] * 2),
        initial_state=np.array([0.5, 0.7, 0.5]),
        torque=_sine,
        disturbance=disturbance,
    )


def example_2(third_frequency: float = 1.0) -> PaperExample:
    """Return Example 2: sensor faults on the system of Gao, Shi and Ding (D_s = I).

    Args:
        third_frequency: Factor of t in the third fault; π in the other reading of the text.
    """

    def faults(t: Array) -> Array:
        time = np.asarray(t)
        third = third_frequency * time
        return np.stack(
            [
                np.where(time >= 2.0, 0.2 * np.sin(3.0 * (time - 2.0)), 0.0),
                np.where(time >= 3.0, 0.2 * np.sin(4.0 * (time - 3.0)), 0.0),
                0.4 * (np.sin(2.0 * third) + np.cos(3.0 * third)),
            ],
            axis=-1,
        )

    return PaperExample(
        name="example_2",
        system=_system(
            [[-1.0, 2.0, 0.0], [-2.0, -1.0, 0.0], [1.0, 0.0, -3.0]],
            [[-2.0, 1.0, 0.0], [0.0, -0.5, 1.0], [-1.0, 0.0, -1.0]],
        ),
        delta_A=np.stack([np.diag([0.1199, 0.1, 0.009]), np.diag([0.2512, 0.135, 0.03])]),
        alpha=np.array([0.1199, 0.2512]),
        xi=np.array([0.01, 0.02]),
        Gamma=np.stack([2.0 * np.diag([10.0, 1.0, 1.0])] * 2),
        initial_state=np.array([0.2, 0.3, 0.5]),
        torque=_sine,
        disturbance=faults,
    )


def example_3() -> PaperExample:
    """Return Example 3: the arm with an elastic joint, its T–S form on |q₁| ≤ π/2, no ΔA."""
    arm = ElasticJointArm()
    return PaperExample(
        name="example_3",
        system=arm.ts_system(),
        delta_A=np.zeros((2, 4, 4)),
        alpha=np.zeros(2),
        xi=np.zeros(2),
        Gamma=np.ones((2, 1, 1)),
        initial_state=np.array([0.3, 0.0, 2.0, 0.0]),
        torque=_sine,
        disturbance=lambda t: np.zeros((*np.shape(t), 1)),
    )
