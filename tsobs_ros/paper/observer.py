# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The adaptive observer of the method's Theorems 1 and 2, realised without ẏ.

Its (9), (30) and (17), (32), divided by E_L, with e_y = y − C̄x̂̄:

    x̂̄' = Σ hᵢ(z) [ A₁ᵢ x̂̄ + E_L⁻¹B̄ᵢ u + H₁ᵢ e_y + M Ξ̂ᵢ x̂̄ ] + E_L⁻¹N y + E_L⁻¹L ẏ
    Ξ̂ᵢ' = hᵢ(z) Γᵢ e_y x̂̄ᵀ ,   projected on ‖Ξ̂ᵢ‖ ≤ ξᵢ

The observer's own state is ξ = x̂̄ − E_L⁻¹L y, whose derivative has no ẏ.

docs/method.md discusses the limits of this observer, which is here only for comparison.
"""

from dataclasses import dataclass

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.design.request import TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.baselines import open_estimator
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.model.arm import DIRECT, ElasticJointArm, TorquePath
from tsobs_ros.model.matrices import product
from tsobs_ros.paper.augmentation import Augmentation, blend
from tsobs_ros.paper.examples import EXAMPLE_3_H, arm_system

PAPER_WARNING = (
    "method paper: on this undamped arm the method's conditions are infeasible (modes ±4.776j and "
    "±1.481j are hidden by an arbitrary disturbance). Running the printed gains of its Example 3: "
    "the estimate is an open-loop simulation whose error does not decay; no bound is published"
)
"""Warning for users of the paper's observer of an arm, given once."""

SYSTEM_WARNING = (
    "method paper: the estimate is an open-loop simulation of the T-S system, which gets the "
    "measurements only by its premise; an error decays as the system itself does, and no bound is "
    "published"
)
"""Warning for users of the paper's observer of a T–S system, given once."""

_MIDPOINT = 1.0421906109874948
"""2 sinh(1/2): the inverse of the share of a difference between rules that a step takes in."""

_EDGE = 1e-9


@dataclass(frozen=True)
class AdaptiveObserver:
    """The adaptive T–S observer of one system or a batch of runs of it, in continuous time.

    The axes of a batch come first, in the gains too if each run has its own.

    Attributes:
        augmentation: The system in augmented form.
        H1: Gains H₁ᵢ = E_L⁻¹Hᵢ, shape (..., r, n + p, p).
        M: P⁻¹C̄ᵀ, shape (..., n + p, p).
        Gamma: Adaptation gains Γᵢ, shape (..., r, p, p); zero for no adaptation.
        limits: Bounds ξᵢ on ‖Ξ̂ᵢ‖, shape (r,); infinite for no projection.
    """

    augmentation: Augmentation
    H1: Array
    M: Array
    Gamma: Array
    limits: Array

    def estimates(self, xi: Array, y: Array, h: Array) -> tuple[Array, Array, Array]:
        """Return x̂̄, the disturbance's estimate by (29), and e_y, from ξ, y and the weights.

        The results have the shapes (..., n + p), (..., p) and (..., p), the arguments have
        (..., n + p), (..., p) and (..., r).
        """
        aug = self.augmentation
        x_bar = xi + y @ aug.L1.T
        x, omega_0 = np.split(x_bar, [aug.system.state_count], axis=-1)
        omega = omega_0 - blend(aug.system.rule_outputs - aug.C, h, x)
        return x_bar, omega, y - x_bar @ aug.C_bar.T

    def rates(self, xi: Array, Xi: Array, y: Array, u: Array, h: Array) -> tuple[Array, Array]:
        """Return the derivatives of ξ and of Ξ̂, shape (..., r, p, n + p)."""
        aug = self.augmentation
        x_bar, _, e = self.estimates(xi, y, h)
        learnt = blend(Xi, h, x_bar)
        own = blend(aug.A1, h, x_bar) + blend(self.H1, h, e) + blend(aug.B1, h, u) + y @ aug.N1.T
        grown = np.einsum("...r,...rpq,...q,...a->...rpa", h, self.Gamma, e, x_bar)
        adapted = np.einsum("...ap,...p->...a", self.M, learnt)
        return own + adapted, project(Xi, grown, self.Gamma, self.limits)


def project(value: Array, rate: Array, Gamma: Array, limits: Array) -> Array:
    """Return rates Γ Y without the part that leads out of ‖Ξ‖ ≤ ξ if Ξ is on that bound.

    It is Γ Y − Γ g ⟨g, ΓY⟩/⟨g, Γg⟩, with the subgradient g = u₁v₁ᵀ of the spectral norm. Because
    the ball is convex, ⟨g, Ξ̂ − Ξ⟩ ≥ 0 for every Ξ in it, so this adds a term ≤ 0 to V'.

    Ξ and Γ Y have the shape (..., p, q); Γ has the shape (..., p, p), and is positive definite if Ξ
    is not 0; ξ > 0 broadcasts to the axes before these.
    """
    edge = limits * (1.0 - _EDGE)
    # ‖Ξ‖² is at most Σ Ξᵢⱼ², which rarely reaches the bound.
    if not (np.einsum("...ab,...ab->...", value, value) >= edge * edge).any():
        return rate
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    u, v = left[..., :1], right[..., :1, :]
    outward = u.swapaxes(-2, -1) @ rate @ v.swapaxes(-2, -1)
    leaves = (singular[..., 0] >= edge)[..., np.newaxis, np.newaxis] & (outward > 0.0)
    steepness = u.swapaxes(-2, -1) @ Gamma @ u
    share = np.divide(outward, steepness, out=np.zeros_like(outward), where=leaves)
    return np.asarray(rate - share * (Gamma @ u) * v)


def clip(value: Array, limits: Array) -> Array:
    """Return the nearest matrices with ‖Ξ‖ ≤ ξ, as a step may overshoot; see `project`."""
    left, singular, right = np.linalg.svd(value, full_matrices=False)
    excess = np.maximum(singular - limits[..., np.newaxis], 0.0)
    return np.asarray(value - left * excess[..., np.newaxis, :] @ right)


def paper_observer(
    arm: ElasticJointArm, period: float, measurement_std: float, torque: TorquePath = DIRECT
) -> Estimator:
    """Return the method's observer for the arm of its Example 3, with the gains that it prints.

    `period` is in s. `measurement_std` [rad] is the only known part of an innovation's size.

    Raises:
        ModelError: The arm is not that of Example 3, the only one for which gains are printed.
    """
    if arm != ElasticJointArm():
        raise ModelError(
            "method paper: expected the arm of the method's Example 3, for which it prints gains, "
            f"got {arm}"
        )
    aug = Augmentation(arm_system(arm))
    H1 = aug.E_L_inverse @ EXAMPLE_3_H
    F = np.array([A - product(H, aug.C_bar) for A, H in zip(aug.A1, H1, strict=True)])
    n, (_, size, p) = aug.system.state_count, H1.shape
    return open_estimator(
        F,
        np.zeros_like(H1),
        aug.B1,
        period=positive("period", period),
        rule_base=aug.system.rule_base,
        torque=torque,
        scale=arm.to_physical(np.ones(n)),
        C=aug.C_bar,
        R=np.array([[positive("measurement_std", measurement_std) ** 2]]),
        D=product(aug.C_bar, aug.L1),
        disturbance_map=np.eye(p, size, n),
        disturbance_direct=aug.L1[n:],
    )


def paper_system_observer(request: TSRequest) -> Estimator:
    """Return the method's observer for a T–S system, started at ω̂₀(0) = y(0) − C x̂(0).

    From this start e_y and Ξ̂ᵢ stay zero (Proposition 1 of docs/method.md), so neither gains nor the
    adaptive law enter the estimate: x̂ is the model's state, and ω̂ = y − Σ hᵢCᵢx̂ by (29).

    Disturbance model, process noise and vertices of the request are not used.

    Raises:
        ModelError: The premises are not the first outputs, which the method measures.
    """
    _require_measured_premise(request)
    model, rate = request.model, 1.0 / request.period
    (r, n, _), p, scheduled = model.A.shape, len(model.C), model.schedule.shape[1]
    # p further states follow Σ hᵢ(Cᵢ − C)x̂ within a period, as weights enter only derivatives.
    mismatch = model.rule_outputs - model.rule_outputs[0]
    mean = sum(mismatch[1:], start=mismatch[0]) / r
    F = np.pad(model.A, ((0, 0), (0, p), (0, p)))
    F[:, n:, :n] = rate * (mean + _MIDPOINT * (mismatch - mean))
    F[:, n:, n:] = -rate * np.eye(p)
    return open_estimator(
        F,
        np.zeros((r, n + p, p)),
        np.pad(model.B, ((0, 0), (0, p), (0, scheduled))),
        period=request.period,
        rule_base=model.rule_base,
        scale=np.ones(n),
        C=np.zeros((p, n + p)),
        R=request.measurement_covariance,
        D=np.eye(p),
        disturbance_map=np.hstack([-model.rule_outputs[0], -np.eye(p)]),
        disturbance_direct=np.eye(p),
    )


def _require_measured_premise(request: TSRequest) -> None:
    """Refuse premises other than the first outputs, measured or scheduled under their names."""
    model, names = request.model, request.output_names
    scheduled = request.input_names[model.input_count :]
    for j, (of_state, of_signals) in enumerate(zip(model.premise, model.schedule, strict=True)):
        output = names[j] if j < len(names) else None
        measured = not of_signals.any() and output is not None and (of_state == model.C[j]).all()
        signals = {name: share for name, share in zip(scheduled, of_signals, strict=True) if share}
        if not measured and (of_state.any() or signals != {output: 1.0}):
            expected = "one an output" if output is None else f"the output {output}"
            raise ModelError(
                f"method paper: expected premise {j + 1} to be {expected}, or a scheduled signal "
                "of its name, as the method measures its premises; got another one"
            )
