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
further off than so many sigmas is left out, and if all were in most of the last half second, the
covariance starts again. Late samples are put in their place. No observer here
has a certificate.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.history import EXTRA, USED
from tsobs_ros.estimation.records import NANOSECONDS, Basis
from tsobs_ros.estimation.state import CONDITIONS, Shape, new_model
from tsobs_ros.estimation.tracker import TrackerOptions
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.fuzzy import Always, RuleBase
from tsobs_ros.model.matrices import product
from tsobs_ros.model.prediction import FlowSizes, fill_matrix, flow_record, flow_type
from tsobs_ros.model.uncertainty import Uncertainty

_POLE_RATIOS = (1.0, 1.1, 1.2, 1.3, 1.4)
"""Poles as multiples of −θ; distinct, so that a small change of a gain moves them little."""

_STEP_LIMIT = 0.1
"""Largest step times |pole|: Runge–Kutta's own error is then about 1e-6 of the estimate a step."""

GATE = 5.0
"""Sigmas of the innovation beyond which an EKF leaves a sample out."""

THETA_STD, THETA_WANDER = 0.2, 1e-6
"""1σ of each θ of an EKF before any measurement, and the growth of its variance [1/s]."""

_WINDOW = 0.5
"""An EKF starts its covariance again if it left out most of the samples of so long [s]."""


def high_gain(
    arm: ElasticJointArm, theta: float, period: float, measurement_std: float
) -> Estimator:
    """Return the proportional high-gain observer (PO).

    Args:
        arm: The physical model.
        theta: θ [rad/s].
        period: Nominal sampling period [s].
        measurement_std: 1σ of a sample [rad], the only known part of an innovation's size.

    Raises:
        ModelError: A number is not finite and above zero.
    """
    K = high_gain_matrix(arm, theta)
    C = arm.output_matrix
    return _of_arm(
        arm, arm.spring_matrix - product(K, C), K, arm.input_matrix, theta, period, measurement_std
    )


def proportional_integral(
    arm: ElasticJointArm, theta: float, period: float, measurement_std: float
) -> Estimator:
    """Return the proportional-integral observer (PIO); see `high_gain`."""
    K = proportional_integral_matrix(arm, theta)
    F, Y = np.zeros((5, 5)), np.zeros((5, 1))
    F[:4, :4], F[:4, 4:] = arm.spring_matrix, K[1:]
    F[4:, :4], F[4:, 4:], Y[4] = -arm.output_matrix, -K[:1], 1.0
    U = np.vstack([arm.input_matrix, [[0.0]]])
    return _of_arm(arm, F, Y, U, theta, period, measurement_std)


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
    """
    rules, n, p = Y.shape
    shape = Shape(n, len(scale), p, U.shape[2])
    base = rule_base or RuleBase(((Always(),),))
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
    model = new_model(shape, period, flow)
    one = model[0]
    direct = np.zeros((p, p)) if D is None else D
    for name, values in (("C", C), ("D", direct), ("R", measurement_covariance), ("scale", scale)):
        fill_matrix(one[name], values)
    if disturbance is not None:
        fill_matrix(one["disturbance_map"], disturbance[0])
        fill_matrix(one["disturbance_direct"], disturbance[1])
    return Estimator(shape, model, bounded=False, disturbed=disturbance is not None)


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
    )


class KalmanFilter:
    """An EKF of an arm, over stamped samples in any order.

    Args:
        flow: Prediction model of [x; w].
        variances: Of the noise of a sample of each output, shape (p,).
        initial_std: 1σ of [x; w] before any measurement, shape (n,).
        uncertainty: Parameters to have as states; none if None.
        gate: Sigmas, infinite for a filter that leaves nothing out.
        options: Limits.

    Attributes:
        flow: Prediction model of [x; w].
        options: Limits.
        model: Record of its numbers, as kalman.h lays it out, shape (1,).
        memory: Record of what it remembers, shape (1,).
        row_parts: Places of an estimate's fields in a row, as of an `Estimator`.
        row_width: Length of a row without what `History.estimate_at` adds.
        shape: Its sizes.
        lacking: The fields of a row that it has nothing for.
    """

    lacking = ("disturbance_rate",)

    def __init__(
        self,
        flow: ArmFlow,
        variances: Array,
        initial_std: Array,
        uncertainty: Uncertainty | None = None,
        *,
        gate: float = GATE,
        options: TrackerOptions,
    ) -> None:
        self.flow, self.options = flow, options
        n, p, t = flow.state_count, len(flow.output_matrix), len(flow.torque_map)
        k = 0 if uncertainty is None else uncertainty.count
        sizes = (n, k, p, p + t, max(10, round(_WINDOW / flow.period)), options.max_steps)
        std = np.concatenate([initial_std, np.full(k, THETA_STD)])
        layouts = native.kalman_layouts(*sizes)
        self.model, self.memory, self._scratch = (
            np.zeros(1, record_type(layout)) for layout in layouts
        )
        record = self.model[0]
        for name, size in zip(("n", "k", "p", "reads", "window", "ring"), sizes, strict=True):
            record[name] = size
        for name in ("history", "future_tolerance", "restart_after"):
            record[name] = round(min(getattr(options, name), 1e9) * NANOSECONDS)
        record["gate"], record["x_max"], record["wander"] = gate, options.x_max, THETA_WANDER
        record["variances"] = as_matrix("variances", variances, (p,))
        record["output"][:, :n] = flow.output_matrix
        record["read"][:, :n] = np.concatenate([flow.disturbance_map, flow.torque_map])
        record["scale"] = flow.arm.to_physical(np.ones(4))
        record["initial"] = np.diag(std * std)
        # It takes its parameters for valid, and the noise for the design's.
        record["conditions"][:4] = Basis.COVARIANCE.value, True, k > 0, 1.0
        self._flow = flow_record(flow, uncertainty)
        self.shape = Shape(n, 4, p, 1, k, t=t)
        widths = {"state": 4, "state_bound": 4, "disturbance": p, "torque_disturbance": t}
        widths |= {"disturbance_rate": 0, "disturbance_bound": p, "torque_disturbance_bound": t}
        widths |= {"parameters": k, "parameter_bound": k}
        self.row_parts: dict[str, slice] = {}
        at = 0
        for name, width in widths.items():
            self.row_parts[name] = slice(at, at + width)
            at += width
        self.row_width = at + len(CONDITIONS)

    @property
    def estimator(self) -> "KalmanFilter":
        """The filter itself, whose rows are laid out as those of an `Estimator`."""
        return self

    @property
    def events(self) -> dict[str, int]:
        """What a supervision counts: nothing."""
        return {}

    @property
    def rewinds(self) -> int:
        """Number of late samples put in their place."""
        return int(self.memory["rewinds"][0])

    @property
    def failures(self) -> int:
        """Number of estimates that were not finite."""
        return int(self.memory["failures"][0])

    def reset(self) -> None:
        """Forget everything."""
        for name in ("first", "length", "rewinds", "failures"):
            self.memory[name] = 0

    def advance(
        self,
        ticks: tuple[NDArray[np.int64], ...],
        samples: tuple[NDArray[np.int64], Array, Array],
        results: tuple[NDArray[np.int64], NDArray[np.int64], Array, Array],
        newest: NDArray[np.int64],
        rows: Array,
    ) -> None:
        """Use samples and estimate, tick by tick.

        Args:
            ticks: Stamps, times on the clock [ns], ends of the samples that each includes, and
                the sample before which it forgets everything or -1, shape (m,) each.
            samples: Stamps [ns], outputs, NaN of one that is missing, and torques [N m] in the
                order of arrival, shapes (i,), (i, p) and (i,).
            results: Outcomes, codes of `history.REASONS`, of which those below 0 are of samples
                that are skipped, shape (i,); the codes of each output, innovations y − ŷ and 1σ
                expected of them, NaN of an output that is missing, shape (i, p); written.
            newest: Stamp of the newest sample in use [ns], 0 without an estimate; written.
            rows: The estimates, written where there are any, shape (m, row_width + EXTRA).
        """
        records = (self.model, self._flow, self.memory, self._scratch)
        arrays: list[NDArray[Any]] = [record.view(np.float64) for record in records]
        arrays += map(np.ascontiguousarray, (*ticks, *samples))
        arrays += (*results, newest, rows)
        native.kalman_advance(*arrays)

    def follow(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike) -> Array:
        """Use samples one after the other, and return the estimates at their stamps.

        Args:
            stamps: Ascending [ns], shape (m,).
            y: Outputs, NaN of one that is missing; a sample without any is lost with its torque,
                shape (m, p).
            u: Torques [N m], shape (m, 1).

        Returns:
            Rows, NaN without an estimate, shape (m, row_width + EXTRA).
        """
        return self._follow(stamps, y, u)[0]

    def misfits(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike) -> Array:
        """Use samples as `follow` does, and return |innovation| / 1σ of those used, shape (i,)."""
        _, outcomes, _, innovations, expected = self._follow(stamps, y, u)
        used = (outcomes == USED)[:, np.newaxis] & np.isfinite(innovations)
        return np.asarray(np.abs(innovations[used]) / expected[used])

    def _follow(
        self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike
    ) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], Array, Array]:
        times, outputs = np.array(stamps, np.int64), np.array(y, np.float64, order="C")
        torques, count = np.array(u, np.float64)[:, 0], len(times)
        ticks = (times, times, np.arange(1, count + 1), np.full(count, -1))
        codes = np.zeros((count, self.shape.p), np.int64)
        results = (np.zeros(count, np.int64), codes, *np.full((2, count, self.shape.p), np.nan))
        newest, rows = np.zeros(count, np.int64), np.empty((count, self.row_width + EXTRA))
        self.advance(ticks, (times, outputs, torques), results, newest, rows)
        rows[newest == 0] = np.nan
        return rows, *results
