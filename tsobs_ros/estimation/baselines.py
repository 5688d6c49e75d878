# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observers of the arm to compare with: two of high gain, and extended Kalman filters.

The proportional high-gain observer (PO),

    x̂' = f(x̂, u) + K (y − x̂₁) ,     poles of A(c = 1) − K C at −θ (1, 1.1, 1.2, 1.3)

trades by θ the speed of convergence against noise. The proportional-integral one (PIO), after
K. Busawon, P. Kaboré, "Disturbance attenuation using proportional integral observers",
International Journal of Control 74 (2001), measures the integral x₀' = y in place of y,

    x̂₀' = C x̂ + K₀ (x₀ − x̂₀) ,     x̂' = f(x̂, u) + K (x₀ − x̂₀)

with the poles of the error at −θ (1, 1.1, 1.2, 1.3, 1.4). Its state is x̂ and then the error
e₀ = ∫y − x̂₀ [rad s], as x₀ itself grows without bound if y has a mean. Both take a disturbance of y
for motion. Between two samples the last one is held, and the observer is integrated.

The extended Kalman filter (EKF) has the states [x; w] of a design, its noise and its start, or
[x; w; θ] with its uncertain parameters. It is what a careful engineer writes: an output that is
further off than so many sigmas is left out, and if most were in the last half second, the
covariance starts again. It is one hypothesis of the bank by itself, with Riccati gains for ever. θ
is learnt from the first sample on, without limits; with Υ = ∂x/∂θ and the covariance Γ of θ

    P_xx = P + Υ Γ Υ' ,     P_xθ = Υ Γ ,     P_θθ = Γ

are those of θ as states, but for what it wanders. No observer here has a certificate.
"""

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import CONSTANTS, Estimator, enter_adaptation, model_of
from tsobs_ros.estimation.options import AdaptationOptions, TorqueLimits
from tsobs_ros.estimation.state import Shape, new_model
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.model.matrices import product
from tsobs_ros.model.prediction import Flow, FlowSizes, fill_matrix, flow_type
from tsobs_ros.model.torque_path import DIRECT, TorquePath
from tsobs_ros.model.uncertainty import Uncertainty

_POLE_RATIOS = (1.0, 1.1, 1.2, 1.3, 1.4)
"""Poles as multiples of −θ; distinct, so that a small change of a gain moves them little."""

_STEP_LIMIT = 0.1
"""Largest step times |pole|: Runge–Kutta's own error is then about 1e-6 of the estimate a step."""

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
) -> Estimator:
    """Return the proportional high-gain observer (PO).

    Args:
        arm: The physical model.
        theta: θ [rad/s].
        period: Nominal sampling period [s].
        measurement_std: 1σ of a sample [rad], the only known part of an innovation's size.
        torque: How torques reach the motor.

    Raises:
        ModelError: A number is not finite and above zero.
    """
    K = high_gain_matrix(arm, theta)
    F = arm.spring_matrix - product(K, arm.output_matrix)
    return _of_arm(arm, F, K, arm.input_matrix, theta, period, measurement_std, torque)


def proportional_integral(
    arm: ElasticJointArm,
    theta: float,
    period: float,
    measurement_std: float,
    torque: TorquePath = DIRECT,
) -> Estimator:
    """Return the proportional-integral observer (PIO); see `high_gain`."""
    K = proportional_integral_matrix(arm, theta)
    F, Y = np.zeros((5, 5)), np.zeros((5, 1))
    F[:4, :4], F[:4, 4:] = arm.spring_matrix, K[1:]
    F[4:, :4], F[4:, 4:], Y[4] = -arm.output_matrix, -K[:1], 1.0
    U = np.vstack([arm.input_matrix, [[0.0]]])
    return _of_arm(arm, F, Y, U, theta, period, measurement_std, torque)


def extended_kalman(
    flow: Flow,
    measurement_covariance: Array,
    initial_covariance: Array,
    uncertainty: Uncertainty | None = None,
    *,
    gate: float = GATE,
) -> Estimator:
    """Return the extended Kalman filter (EKF) of a model.

    Args:
        flow: Prediction model.
        measurement_covariance: R of one sample, diagonal, shape (p, p).
        initial_covariance: Error covariance of the zero estimate before any sample, shape (n, n).
        uncertainty: Parameters to have as states; none if None.
        gate: Sigmas beyond which an output is left out, infinite for a filter that leaves none out.

    Raises:
        ModelError: A matrix has the wrong shape, or the uncertainty is of another model.
    """
    covariances = (measurement_covariance, initial_covariance)
    shape, model = model_of(flow, *covariances, uncertainty, auxiliary=False)
    one = model[0]
    one["gain_mode"], one["gate"] = native.GAIN_RICCATI, gate
    if uncertainty is not None and shape.k:
        at_once = AdaptationOptions(THETA_STD, THETA_WANDER, start=0.0, significance=0.0)
        enter_adaptation(one, np.full(shape.k, np.inf), at_once, covered=False)
        # θ, always valid, is learnt in one pass without curvature.
        one["pass_time"], one["excitation"] = np.inf, -1.0
        one["constants"][CONSTANTS["CURVED"]] = 0.0
    estimator = Estimator(shape, model)
    if isinstance(flow, ArmFlow):  # a torque that is no number is held, any other one taken
        estimator.limit_torque(TorqueLimits(np.inf, np.inf, 0.0))
    return estimator


def high_gain_matrix(arm: ElasticJointArm, theta: float) -> Array:
    """Return the gain K of a PO, shape (4, 1)."""
    poles = -positive("theta", theta) * np.array(_POLE_RATIOS[:4])
    return place_single_output(arm.slope_matrix(1.0), arm.output_matrix, poles)[:, np.newaxis]


def proportional_integral_matrix(arm: ElasticJointArm, theta: float) -> Array:
    """Return the gains of a PIO, K₀ and then K, shape (5, 1)."""
    A = np.zeros((5, 5))
    A[:1, 1:], A[1:, 1:] = arm.output_matrix, arm.slope_matrix(1.0)
    poles = -positive("theta", theta) * np.array(_POLE_RATIOS)
    return place_single_output(A, np.eye(1, 5), poles)[:, np.newaxis]


def integrated_estimator(
    F: Array,
    Y: Array,
    U: Array,
    C: Array,
    *,
    period: float,
    max_step: float,
    scale: Array,
    measurement_covariance: Array,
    rule_base: RuleBase | None = None,
    gravity_gain: float = 0.0,
    D: Array | None = None,
    disturbance: tuple[Array, Array] | None = None,
    torque: TorquePath = DIRECT,
) -> Estimator:
    """Return the estimator x̂' = Σ hᵢ(y)(Fᵢ x̂ + Yᵢ y + Uᵢ u) − g sin x̂₁ in the row of x̂₂.

    Args:
        F: One matrix a rule, shape (r, n, n).
        Y: Of the sample, which is held until the next one, shape (r, n, p).
        U: Of the inputs, shape (r, n, m).
        C: State to expected measurement, shape (p, n).
        period: Nominal sampling period [s].
        max_step: Upper limit of a Runge–Kutta step [s].
        scale: Physical units of the plant's states, the first of x̂, shape (plant,).
        measurement_covariance: Of one sample, shape (p, p).
        rule_base: Memberships of the first measurements; one rule that always fires if None.
        gravity_gain: g [1/s²].
        D: Sample to expected measurement, shape (p, p); zero if None.
        disturbance: State and sample to estimated disturbance, shapes (p, n) and (p, p); None if
            it is not estimated.
        torque: How the first input reaches an arm's motor.
    """
    rules, n, p = Y.shape
    shape = Shape(n, len(scale), p, U.shape[2])
    base = rule_base or RuleBase(((membership("always"),),))
    sizes = FlowSizes(n, shape.m, shape.m, p, 0, shape.plant, rules, base.premise_count)
    flow = np.zeros(1, flow_type(sizes))
    for name, number in {
        **sizes._asdict(),
        "kind": native.KIND_INTEGRATED,
        "period": positive("period", period),
        "max_step": max_step,
        "gravity_gain": gravity_gain,
    }.items():
        flow[name] = number
    shapes, parameters = base.coded
    for name, values in (
        ("F", F),
        ("Y", Y),
        ("U", U),
        ("shapes", shapes),
        ("parameters", parameters),
    ):
        fill_matrix(flow[0][name], values)
    model = new_model(shape, period, flow, torque=torque)
    one = model[0]
    direct = np.zeros((p, p)) if D is None else D
    for name, values in (("C", C), ("D", direct), ("R", measurement_covariance), ("scale", scale)):
        fill_matrix(one[name], values)
    if disturbance is not None:
        fill_matrix(one["disturbance_map"], disturbance[0])
        fill_matrix(one["disturbance_direct"], disturbance[1])
    lacking = ("state_bound", "disturbance_bound", "disturbance_rate")
    return Estimator(shape, model, lacking if disturbance else (*lacking, "disturbance"))


def place_single_output(A: Array, C: Array, poles: ArrayLike) -> Array:
    """Return K, shape (n,), such that A − K C has the given poles (Ackermann's formula).

    Args:
        A: State matrix, shape (n, n).
        C: Output matrix of one output, shape (1, n).
        poles: n real poles [1/s].

    Raises:
        ModelError: The output does not see every mode of A.
    """
    n = A.shape[0]
    rows = [np.array(C, np.float64)]
    for _ in range(n - 1):
        rows.append(product(rows[-1], A))
    observability = np.vstack(rows)
    if np.linalg.matrix_rank(observability) < n:
        raise ModelError(f"C: expected an output that sees all {n} modes of A, got {C.tolist()}")
    polynomial = np.eye(n)
    for pole in np.asarray(poles).tolist():
        polynomial = product(polynomial, A - pole * np.eye(n))
    return np.asarray(product(polynomial, _solution(observability))[:, 0])


def _solution(matrix: Array) -> Array:
    """Return the last column of a matrix's inverse, by Gauss elimination in fixed order."""
    n = len(matrix)
    rows = [[*row, 1.0 if i == n - 1 else 0.0] for i, row in enumerate(matrix.tolist())]
    for column in range(n):
        best = max(range(column, n), key=lambda row: abs(rows[row][column]))
        rows[column], rows[best] = rows[best], rows[column]
        pivot = rows[column][column]
        for row in range(n):
            if row != column:
                share = rows[row][column] / pivot
                rows[row] = [a - share * b for a, b in zip(rows[row], rows[column], strict=True)]
    return np.array([[rows[i][n] / rows[i][i]] for i in range(n)])


def _of_arm(
    arm: ElasticJointArm,
    F: Array,
    Y: Array,
    U: Array,
    theta: float,
    period: float,
    measurement_std: float,
    torque: TorquePath,
) -> Estimator:
    n, fastest = len(F), theta * _POLE_RATIOS[len(F) - 1]
    std = positive("measurement_std", measurement_std)
    return integrated_estimator(
        F[np.newaxis],
        Y[np.newaxis],
        U[np.newaxis],
        np.eye(1, n),
        period=period,
        max_step=_STEP_LIMIT / fastest,
        scale=arm.to_physical(np.ones(4)),
        measurement_covariance=as_matrix("R", [[std * std]], (1, 1)),
        gravity_gain=arm.gravity_gain,
        torque=torque,
    )
