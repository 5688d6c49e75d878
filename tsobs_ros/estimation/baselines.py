# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Baseline observers of the arm, for comparison: two with high gain, and extended Kalman filters.

The proportional high-gain observer (PO),

    x̂' = f(x̂, u) + K (y − x̂₁) ,     poles of A(c = 1) − K C at −θ (1, 1.1, 1.2, 1.3)

trades speed of convergence against noise by its θ. The proportional-integral one (PIO), after
K. Busawon, P. Kaboré, "Disturbance attenuation using proportional integral observers",
International Journal of Control 74 (2001), uses the integral x₀' = y as measurement in place of y,

    x̂₀' = C x̂ + K₀ (x₀ − x̂₀) ,     x̂' = f(x̂, u) + K (x₀ − x̂₀)

with the poles of the error at −θ (1, 1.1, 1.2, 1.3, 1.4). Its state is x̂ and then the error
e₀ = ∫y − x̂₀ [rad s], because x₀ itself grows without bound if y has a mean. Both observers take a
disturbance of y for motion. Between samples the last one is held, as an input of the model.

The extended Kalman filter (EKF) has the states [x; w], the noise and the start of a design, or the
states [x; w; θ] with its uncertain parameters. A careful engineer would write this filter: it
leaves out an output that is off by more than `GATE` sigmas. If it left out most outputs of the last
half second, its covariance starts again. It is a single hypothesis of the bank, always with Riccati
gains. θ is learnt from the first sample on, without limits; with Υ = ∂x/∂θ and θ's covariance Γ

    P_xx = P + Υ Γ Υ' ,     P_xθ = Υ Γ ,     P_θθ = Γ

are the covariances of θ as states, except for its random walk. No observer here has a certificate.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.core import native
from tsobs_ros.estimation.estimator import CONSTANTS, Estimator, TorqueLimits, riccati_estimator
from tsobs_ros.estimation.state import Shape, new_model
from tsobs_ros.model.arm import DIRECT, ElasticJointArm, TorquePath
from tsobs_ros.model.disturbance import CLEAN, per_channel
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.matrices import product
from tsobs_ros.model.prediction import Flow, Uncertainty, fill_matrix
from tsobs_ros.model.ts_model import TSFlow, TSModel

_POLE_RATIOS = (1.0, 1.1, 1.2, 1.3, 1.4)
"""Poles as multiples of −θ; distinct, so that a small change of a gain moves them little."""

GATE = 5.0
"""Sigmas of the innovation beyond which an EKF leaves a sample out."""

THETA_STD, THETA_WANDER = 0.2, 1e-6
"""1σ of each θ of an EKF before any measurement, and the growth of its variance [1/s]."""


def high_gain(
    arm: ElasticJointArm,
    theta: float,
    period: float,
    measurement_std: float,
    torque: TorquePath = DIRECT,
    *,
    integral: bool = False,
) -> Estimator:
    """Return the proportional high-gain observer (PO) or, with `integral`, the PIO.

    θ is in rad/s, the period in s. The 1σ of a sample [rad] also serves as that of an innovation.

    Raises:
        ModelError: A number is not finite and above zero.
    """
    K, C, U = high_gain_matrix(arm, theta, integral=integral), arm.output_matrix, arm.input_matrix
    F, Y = arm.spring_matrix - product(K[:4], C), K
    if integral:
        F = np.block([[arm.spring_matrix, K[1:]], [-C, -K[:1]]])
        Y, U = np.eye(5)[:, 4:], np.vstack([U, [[0.0]]])
    std = positive("measurement_std", measurement_std)
    return open_estimator(
        F[np.newaxis],
        Y[np.newaxis],
        U[np.newaxis],
        period=period,
        gravity_gain=arm.gravity_gain,
        torque=torque,
        scale=arm.to_physical(np.ones(4)),
        C=np.eye(1, len(F)),
        R=np.array([[std * std]]),
    )


proportional_integral = partial(high_gain, integral=True)
"""The proportional-integral observer (PIO)."""


def high_gain_matrix(arm: ElasticJointArm, theta: float, *, integral: bool = False) -> Array:
    """Return the gain K of a PO, shape (4, 1), or the gains K₀, K of a PIO, shape (5, 1).

    Ackermann's formula is K = Π (A − pᵢ I) O⁻¹ eₙ for the poles pᵢ. Each state is the derivative of
    the one before, plus earlier states, so the last column of the observability matrix O is eₙ.
    """
    A = arm.slope_matrix(1.0)
    if integral:
        A = np.block([[np.zeros((1, 1)), arm.output_matrix], [np.zeros((4, 1)), A]])
    polynomial = np.eye(len(A))
    for ratio in _POLE_RATIOS[: len(A)]:
        polynomial = product(polynomial, A + positive("theta", theta) * ratio * np.eye(len(A)))
    return polynomial[:, -1:]


def extended_kalman(
    flow: Flow,
    measurement_covariance: Array,
    initial_covariance: Array,
    uncertainty: Uncertainty | None = None,
    *,
    gate: float = GATE,
) -> Estimator:
    """Return the extended Kalman filter (EKF) of a model; see `riccati_estimator`.

    Uncertain parameters become states of the filter. The gate is in sigmas; if it is infinite, the
    filter leaves no output out.
    """
    covariances = (measurement_covariance, initial_covariance)
    estimator = riccati_estimator(flow, *covariances, uncertainty)
    estimator.model["gate"] = gate
    if uncertainty is not None and uncertainty.count:
        # θ, always valid, is learnt in one pass without curvature or limits.
        estimator.learn(
            uncertainty, initial_std=THETA_STD, random_walk=THETA_WANDER, significance=0.0,
            pass_time=np.inf, excitation=-1.0,
        )  # fmt: skip
        estimator.model["limits"] = np.inf
        estimator.model["constants"][0, CONSTANTS["CURVED"]] = 0.0
    if isinstance(flow, ArmFlow):  # for a torque that is NaN the last one is held; others are used
        estimator.limit_torque(TorqueLimits(np.inf, np.inf, 0.0))
    return estimator


class _WithGravity(TSFlow):
    """A system of one rule with −g sin x₁ in the row of x₂, for the steps of an arm."""

    kind, linear_share = native.KIND_ARM, 1.0

    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        return {**super().numbers(uncertainty), "gravity_gain": self.gravity_gain}


_ALWAYS = RuleBase(((membership("always"),),))


def open_estimator(
    F: Array,
    Y: Array,
    U: Array,
    *,
    period: float,
    rule_base: RuleBase | None = None,
    gravity_gain: float = 0.0,
    torque: TorquePath = DIRECT,
    **matrices: Array,
) -> Estimator:
    """Return the estimator x̂' = Σ hᵢ(y)(Fᵢ x̂ + Yᵢ y + Uᵢ u) − g sin x̂₁ in the row of x̂₂.

    Args:
        F: One matrix per rule, shape (r, n, n).
        Y: Those of the sample, which is held until the next one, shape (r, n, p).
        U: Those of the inputs, shape (r, n, m).
        period: Nominal sampling period [s].
        rule_base: Memberships of the first measurements; one rule that always fires if None.
        gravity_gain: g of an arm [1/s²].
        torque: How the first input reaches an arm's motor.
        **matrices: Matrices of a model record: `scale`, `C`, `R` and, unless they are zero, `D`,
            `disturbance_map` and `disturbance_direct`.
    """
    _, n, p = Y.shape
    shape = Shape(n, len(matrices["scale"]), p, U.shape[2])
    rules = rule_base or _ALWAYS
    q = rules.coded[0].shape[1]
    # The sample is an input and a scheduled signal; its first entries are the premises.
    inputs, premise = np.concatenate([U, Y], axis=2), (np.zeros((q, n)), np.eye(q, p))
    system = TSModel(F, inputs, matrices["C"], rules, *premise)
    undisturbed = per_channel(p * [CLEAN[0].model])
    make = _WithGravity if rule_base is None else TSFlow
    flow = make(system, undisturbed, np.zeros(n), period)
    flow.gravity_gain, flow.torque_path = gravity_gain, torque
    model = new_model(shape, flow)
    model["gain_mode"] = native.GAIN_OPEN
    for name, values in matrices.items():
        fill_matrix(model[0][name], values)
    lacking = ("state_bound", "disturbance_bound", "disturbance_rate")
    unknown = () if "disturbance_map" in matrices else ("disturbance",)
    return Estimator(shape, model, (*lacking, *unknown))
