# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One-step prediction of any T–S system with its disturbance model, and of its error covariance.

The exponential midpoint rule: the mean A₀, B₀ of the rules is integrated exactly, what the rules
differ by, g(x, u) = Σ hᵢ(z)((Aᵢ − A₀)x + (Bᵢ − B₀)u), enters at the middle of the step:

    c = Φ x + Γ u + n₁,   m = c + (T/2) Φ g(x, u),   x⁺ = Φ (c + T g(m, u)) + Γ u + n₂

with Φ, Γ the linear flow over T/2 and n₁, n₂ the process noise of its halves. It is of second
order, and exact for one rule. What matters for a proof is that its error map is exactly

    e⁺ = Φ [Φ + T N₂ Φ (I + (T/2) N₁)] e + Φ (I + T N₂) n₁ + n₂

with N₁ and N₂ two matrices that g(x) − g(x̂) = N (x − x̂) holds for, and affine in each of them:

- if the premise is known, N = Σ hᵢ(Aᵢ − A₀), a convex combination over the rules;
- if it is the estimate, N is a mean of the Jacobian of g (mean value theorem): a convex
  combination of any matrices J − A₀ whose hull holds the Jacobian of f on the domain.

So the ordered pairs of such matrices are vertices of all error systems of a step, at any period.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.linear_flow import LinearFlow
from tsobs_ros.model.prediction import Flow, fill_common, fill_matrix, require_directions
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty


class TSStep(NamedTuple):
    """The linear flow over half a step.

    Attributes:
        duration: T of the whole step [s].
        phi: State transition Φ(T/2), shape (n, n).
        gamma: Effect of held inputs Γ(T/2), shape (n, m).
        noise: Covariance that the process noise adds over T/2, shape (n, n).
    """

    duration: float
    phi: Array
    gamma: Array
    noise: Array


class PairVertex(NamedTuple):
    """The error system e⁺ = transition·e + noise at one pair of vertex matrices.

    Attributes:
        transition: Shape (n, n).
        noise: Covariance of the noise, shape (n, n).
        where: The pair in words, for reports.
    """

    transition: Array
    noise: Array
    where: str


class TSFlow(Flow):
    """Predicts the augmented state x̄ = [x; w] of a T–S system (or of a batch of equal ones).

    Attributes:
        model: The T–S system.
        disturbance: The exosystem of the measurements' disturbances, one channel an output.
        process_noise: Densities of white noise on each state's derivative [unit²/s], shape (n,).
        period: Nominal step [s]; longer steps are taken in nominal ones and a remainder.
        deviations: [Aᵢ − A₀, Bᵢ − B₀] of every rule, shape (r, n, n + m).

    Raises:
        ModelError: The disturbance has another number of channels than the system outputs, or a
            density is negative or of the wrong shape.
    """

    def __init__(
        self,
        model: TSModel,
        disturbance: DisturbanceModel,
        process_noise: ArrayLike,
        period: float,
    ) -> None:
        n = model.state_count
        self.model = model
        self.disturbance = disturbance
        self.process_noise = as_matrix("process_noise", process_noise, (n,))
        self.period = positive("period", period)
        outputs = model.C.shape[0]
        if disturbance.channel_count != outputs:
            raise ModelError(
                f"disturbance: expected {outputs} channels, one an output, "
                f"got {disturbance.channel_count}"
            )
        if (self.process_noise < 0.0).any():
            raise ModelError(
                f"process_noise: expected densities of at least 0, got {[*self.process_noise]}"
            )
        mean = sum(model.rates[1:], start=model.rates[0]) / model.rule_count
        self._mean = mean[:, :n]
        self.deviations = model.rates - mean
        density = block_diag(np.diag(self.process_noise), disturbance.noise_density)
        inputs = np.vstack([mean[:, n:], np.zeros((disturbance.state_count, model.input_count))])
        self._linear = LinearFlow(
            self.augmented(self._mean), inputs, np.asarray(density), 0.5 * self.period
        )
        self._identity = np.eye(self.state_count)
        self.nominal = self.step(self.period)

    @property
    def plant_count(self) -> int:
        """Number of the system's own states."""
        return self.model.state_count

    @property
    def state_count(self) -> int:
        """Length n of the augmented state."""
        return self.model.state_count + self.disturbance.state_count

    @cached_property
    def output_matrix(self) -> Array:
        """Augmented state to measurement C̄ = [C H], shape (p, n)."""
        joined = np.hstack([self.model.C, self.disturbance.H])
        return as_matrix("C̄", joined, (self.model.C.shape[0], self.state_count))

    @property
    def input_count(self) -> int:
        """Number of inputs and scheduled signals."""
        return self.model.input_count + int(self.model.schedule.shape[1])

    @property
    def scheduled_count(self) -> int:
        """Number of scheduled signals, the last of the m signals."""
        return int(self.model.schedule.shape[1])

    def augmented(self, A: Array) -> Array:
        """Return diag(A, S), shape (n, n), for a state matrix of the plant."""
        return np.asarray(block_diag(A, self.disturbance.S))

    def step(self, duration: float) -> TSStep:
        """Return the linear flow over half of `duration` [s]."""
        return TSStep(duration, *self._linear.over(0.5 * duration))

    @property
    def rule_counts(self) -> tuple[int, int]:
        """Numbers of rules and of premise variables."""
        return self.model.rule_count, self.model.premise.shape[0]

    def fill(self, record: Any, uncertainty: Uncertainty | None = None) -> None:
        """Enter the model's numbers into one record; see `Flow`."""
        model = self.model
        fill_common(record, self, self._linear, 0.5 * self.period, uncertainty)
        record["kind"], record["plant"] = native.KIND_SYSTEM, model.state_count
        shapes, parameters = model.rule_base.coded
        for name, values in (
            ("deviations", self.deviations),
            ("premise", model.premise),
            ("schedule", model.schedule),
            ("shapes", shapes),
            ("parameters", parameters),
        ):
            fill_matrix(record[name], values)
        if uncertainty is not None:
            require_directions(uncertainty, self.deviations.shape, type(self).__name__)
            fill_matrix(record["directions"], uncertainty.directions)

    def error_map(self, first: Array, second: Array, step: TSStep) -> tuple[Array, Array]:
        """Return the transition of the error and the covariance of its noise over a step.

        Args:
            first: N₁ at the start of the step, shape (..., n, n).
            second: N₂ at its middle, shape (..., n, n).
            step: From `step` or `steps`.
        """
        T, phi = step.duration, step.phi
        kick = phi @ (self._identity + 0.5 * T * first)
        transition = phi @ (phi + T * second @ kick)
        spread = phi @ (self._identity + T * second)
        noise = spread @ step.noise @ np.swapaxes(spread, -1, -2) + step.noise
        return transition, 0.5 * (noise + np.swapaxes(noise, -1, -2))

    def vertices(self, matrices: ArrayLike, names: Sequence[str]) -> list[PairVertex]:
        """Return the vertex error systems of a nominal step: every ordered pair of matrices.

        Args:
            matrices: Plant matrices whose convex hull covers the error systems, shape (l, n, n).
            names: Their names, for reports.
        """
        n = self.model.state_count
        stack = as_matrix("vertex matrices", matrices, (len(names), n, n))
        padded = np.zeros((len(names), self.state_count, self.state_count))
        padded[:, :n, :n] = stack - self._mean
        return [
            PairVertex(*self.error_map(padded[i], padded[j], self.nominal), f"{one}, {other}")
            for i, one in enumerate(names)
            for j, other in enumerate(names)
        ]

    def to_physical(self, x: ArrayLike) -> Array:
        """Return the plant's part of augmented states of shape (..., n), in the model's units."""
        return np.asarray(x, dtype=np.float64)[..., : self.model.state_count]
