# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""T–S systems for an estimator: their model, its one-step prediction and its uncertainty.

    ẋ = Σ hᵢ(z)(Aᵢx + Bᵢu),   y = C x + disturbance + noise,   z = Z x + Z_s s

The system has one output matrix, and premises that are linear in x and s. Scheduled signals s are
known: an ambient temperature, a set point, or a measurement that is almost exact. They are held
over a step and are given with the input, as [u; s].

The exponential midpoint rule integrates the mean A₀, B₀ of the rules exactly. The deviation from
it, g(x, u) = Σ hᵢ(z)((Aᵢ − A₀)x + (Bᵢ − B₀)u), enters at the middle of the step:

    c = Φ x + Γ u + n₁,   m = c + (T/2) Φ g(x, u),   x⁺ = Φ (c + T g(m, u)) + Γ u + n₂

with Φ, Γ the linear flow over T/2 and n₁, n₂ the process noise of the two halves. It is of second
order, and exact for one rule. For a proof it matters that the error map is exactly

    e⁺ = Φ [Φ + T N₂ Φ (I + (T/2) N₁)] e + Φ (I + T N₂) n₁ + n₂

for two matrices N₁, N₂ with g(x) − g(x̂) = N (x − x̂). The map is affine in each of them:

- if the premise is known, N = Σ hᵢ(Aᵢ − A₀), a convex combination over the rules;
- if the premise is the estimate, N is a mean of the Jacobian of g (mean value theorem): a convex
  combination of any matrices J − A₀, if the hull of the J holds the Jacobian of f on the domain.

So the ordered pairs of such matrices are vertices of all error systems of a step, at any period.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.fuzzy import RuleBase
from tsobs_ros.model.prediction import Flow, Uncertainty

_LARGEST = 1e100
"""Largest number in a model; the product of two is still finite."""


@dataclass(frozen=True, eq=False)
class TSModel:
    """The rules of a T–S system with a common output matrix.

    Attributes:
        A: State matrices, shape (r, n, n).
        B: Input matrices, shape (r, n, m); a single (n, m) serves every rule.
        C: Output matrix, shape (p, n).
        rule_base: Memberships of the q premise variables.
        premise: State to premise variables Z, shape (q, n).
        schedule: Scheduled signals to premise variables Z_s, shape (q, s); none by default.
        outputs: Output matrices Cᵢ of the rules, if they differ, shape (r, p, n). Estimators use C
            for all rules and treat the difference Σ hᵢ(Cᵢ − C)x as a disturbance.

    Raises:
        ModelError: A matrix has the wrong shape; the text names it.
    """

    A: Array
    B: Array
    C: Array
    rule_base: RuleBase
    premise: Array
    schedule: Array = field(default_factory=lambda: np.zeros((0, 0)))
    outputs: Array | None = None

    def __post_init__(self) -> None:
        rules, q = self.rule_base.coded[0].shape
        n = _length("A", self.A, -1, 3)
        B = self.B if np.ndim(self.B) == 3 else np.repeat([self.B], rules, axis=0)
        schedule = self.schedule if np.size(self.schedule) else np.zeros((q, 0))
        checked = {
            "A": as_matrix("A", self.A, (rules, n, n)),
            "B": as_matrix("B", B, (rules, n, _length("B", B, -1, 3))),
            "C": as_matrix("C", self.C, (_length("C", self.C, 0, 2), n)),
            "premise": as_matrix("premise", self.premise, (q, n)),
            "schedule": as_matrix("schedule", schedule, (q, _length("schedule", schedule, -1, 2))),
        }
        if self.outputs is not None:
            checked["outputs"] = as_matrix("outputs", self.outputs, (rules, *checked["C"].shape))
        for name, matrix in checked.items():
            if np.abs(matrix).max(initial=0.0) > _LARGEST:
                raise ModelError(f"{name}: expected numbers up to {_LARGEST:g}, got a larger one")
            object.__setattr__(self, name, matrix)

    @property
    def rule_count(self) -> int:
        """Number of rules r."""
        return int(self.A.shape[0])

    @property
    def state_count(self) -> int:
        """Number of states n."""
        return int(self.A.shape[-1])

    @property
    def input_count(self) -> int:
        """Number of inputs m, without scheduled signals."""
        return int(self.B.shape[-1])

    @property
    def rule_outputs(self) -> Array:
        """Cᵢ of every rule, shape (r, p, n)."""
        same = np.repeat(self.C[np.newaxis], self.rule_count, axis=0)
        return same if self.outputs is None else self.outputs

    @cached_property
    def premise_known(self) -> bool:
        """Whether the premise is made of scheduled signals only, so that no estimate enters."""
        return not self.premise.any()

    @cached_property
    def rates(self) -> Array:
        """[Aᵢ Bᵢ] of every rule, shape (r, n, n + m)."""
        return np.concatenate([self.A, self.B], axis=-1)

    def weights(self, x: Array, held: Array) -> Array:
        """Return h(z), shape (..., r), for states (..., n) and held signals [u; s] (..., m + s)."""
        scheduled = held[..., self.input_count :]
        return self.rule_base.weights(x @ self.premise.T + scheduled @ self.schedule.T)

    def derivative(self, x: Array, held: Array) -> Array:
        """Return ẋ, shape (..., n), for states and held signals as in `weights`."""
        signals = np.concatenate([x, held[..., : self.input_count]], axis=-1)
        weights = self.weights(x, held)
        return np.asarray(np.einsum("...r,rnk,...k->...n", weights, self.rates, signals))


class TSFlow(Flow):
    """Predicts the augmented state x̄ = [x; w] of a T–S system (or of a batch of equal ones).

    Process noise: densities of white noise on each state's derivative [unit²/s], shape (n,).

    Raises:
        ModelError: As `Flow`; a density is negative or of the wrong shape.
    """

    kind, linear_share = native.KIND_SYSTEM, 0.5

    def __init__(
        self, model: TSModel, disturbance: DisturbanceModel, process_noise: ArrayLike, period: float
    ) -> None:
        self.model, n = model, model.state_count
        densities = as_matrix("process_noise", process_noise, (n,))
        if (densities < 0.0).any():
            raise ModelError(
                f"process_noise: expected densities of at least 0, got {densities.tolist()}"
            )
        self.scheduled_count = int(model.schedule.shape[1])
        self.rule_counts = model.rule_count, len(model.premise)
        mean = sum(model.rates[1:], start=model.rates[0]) / model.rule_count
        self.deviations = model.rates - mean
        super().__init__((mean[:, :n], mean[:, n:], model.C), densities, disturbance, period)

    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        shapes, parameters = self.model.rule_base.coded
        return {
            "deviations": self.deviations,
            "premise": self.model.premise,
            "schedule": self.model.schedule,
            "shapes": shapes,
            "parameters": parameters,
            **({} if uncertainty is None else {"directions": uncertainty.directions}),
        }

    def error_map(self, first: Array, second: Array) -> tuple[Array, Array]:
        step, one = self.nominal, np.eye(self.state_count)
        T, phi = step.duration, step.phi
        transition = phi @ (phi + T * second @ (phi @ (one + 0.5 * T * first)))
        spread = phi @ (one + T * second)
        noise = spread @ step.noise @ np.swapaxes(spread, -1, -2) + step.noise
        return transition, 0.5 * (noise + np.swapaxes(noise, -1, -2))


@dataclass(frozen=True, eq=False)
class Direction:
    """An uncertain direction of a T–S system's state matrices, Aᵢ + θ Eᵢ with |θ| ≤ bound.

    Attributes:
        E: Eᵢ, shape (r, n, n); one (n, n) serves every rule.
        bound: Bound of |θ|.
    """

    E: Array
    bound: float


def system_uncertainty(model: TSModel, directions: Mapping[str, Direction]) -> Uncertainty:
    """Return the uncertainty of a T–S system's state matrices, uncertain directions by name.

    Raises:
        ModelError: A direction is zero or of the wrong shape, or a bound is not above zero.
    """
    rules, n = model.rule_count, model.state_count
    stack = np.zeros((len(directions), rules, n, n + model.input_count))
    for (name, each), placed in zip(directions.items(), stack, strict=True):
        shape = (n, n) if np.ndim(each.E) == 2 else (rules, n, n)
        positive(f"uncertainty.{name}.bound", each.bound)
        matrix = as_matrix(f"uncertainty.{name}.E", each.E, shape)
        if not matrix.any():
            raise ModelError(f"uncertainty.{name}.E: expected a matrix other than zero")
        placed[..., :n] = matrix
    limits = np.array([each.bound for each in directions.values()], np.float64)
    return Uncertainty(tuple(directions), limits, stack)


def _length(name: str, matrix: ArrayLike, axis: int, axes: int) -> int:
    """Return the length of an axis of a matrix that must have `axes` axes."""
    shape = np.shape(matrix)
    if len(shape) != axes:
        kind = "one matrix per rule, shape (r, ·, ·)" if axes == 3 else "a matrix"
        raise ModelError(f"{name}: expected {kind}, got shape {shape}")
    return int(shape[axis])
