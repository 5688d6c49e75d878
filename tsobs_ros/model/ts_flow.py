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

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.prediction import Flow
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.model.uncertainty import Uncertainty


class TSFlow(Flow):
    """Predicts the augmented state x̄ = [x; w] of a T–S system (or of a batch of equal ones).

    Args:
        model: The T–S system.
        disturbance: The exosystem of the outputs' disturbances, one channel per output.
        process_noise: Densities of white noise on each state's derivative [unit²/s], shape (n,).
        period: Nominal step [s].

    Raises:
        ModelError: As `Flow`; a density is negative or of the wrong shape.
    """

    kind, linear_share = native.KIND_SYSTEM, 0.5

    def __init__(
        self,
        model: TSModel,
        disturbance: DisturbanceModel,
        process_noise: ArrayLike,
        period: float,
    ) -> None:
        self.model, n = model, model.state_count
        densities = as_matrix("process_noise", process_noise, (n,))
        if (densities < 0.0).any():
            raise ModelError(f"process_noise: expected densities of at least 0, got {[*densities]}")
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
