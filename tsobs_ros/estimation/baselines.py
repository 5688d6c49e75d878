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

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.compiled import compiled, compiled_nogil
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.history import (
    DUPLICATE,
    EXTRA,
    FROM_FUTURE,
    GATED,
    NON_FINITE,
    TOO_OLD,
    USED,
    ZERO_STAMP,
)
from tsobs_ros.estimation.records import NANOSECONDS, Basis
from tsobs_ros.estimation.state import CONDITIONS, Shape, new_model
from tsobs_ros.estimation.tracker import TrackerOptions
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.fuzzy import Always, RuleBase
from tsobs_ros.model.linear_flow import cut_into_steps, flow_over
from tsobs_ros.model.matrices import congruence, has_finite, product
from tsobs_ros.model.prediction import fill_matrix
from tsobs_ros.model.stepping import INTEGRATED, Room
from tsobs_ros.model.trigonometry import cosine, sine
from tsobs_ros.model.uncertainty import EXTERNAL, SINE, TORQUE, Uncertainty

_POLE_RATIOS = (1.0, 1.1, 1.2, 1.3, 1.4)
"""Poles as multiples of −θ; distinct, so that a small change of a gain moves them little."""

_STEP_LIMIT = 0.1
"""Largest step times |pole|: Runge–Kutta's own error is then about 1e-6 of the estimate a step."""

GATE = 5.0
"""Sigmas of the innovation beyond which an EKF leaves a sample out."""

THETA_STD, THETA_WANDER = 0.2, 1e-6
"""1σ of each θ of an EKF before any measurement, and the growth of its variance [1/s]."""

_WINDOW, _MOST = 0.5, 0.6
"""An EKF starts its covariance again if it left out such a share of the samples of so long [s]."""

_ALONG_THE_ESTIMATE = float(Basis.STARTING.value)


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
    room = Room.fitting(n, p, shape.m, 0, rules, base.premise_count)
    model = new_model(room, shape, positive("period", period))
    one, flow = model[0], model[0]["flow"]
    sizes = {"n": n, "p": p, "m": shape.m, "plant": shape.plant, "rules": rules}
    for name, size in {**sizes, "kind": INTEGRATED, "premises": base.premise_count}.items():
        flow[name] = size
    flow["period"], flow["max_step"], flow["gravity_gain"] = period, max_step, gravity_gain
    shapes, parameters = base.coded
    for name, values in (
        ("F", F),
        ("Y", Y),
        ("U", U),
        ("shapes", shapes),
        ("parameters", parameters),
    ):
        fill_matrix(flow[name], values)
    direct = np.zeros((p, p)) if D is None else D
    for name, values in (("C", C), ("D", direct), ("R", measurement_covariance), ("scale", scale)):
        fill_matrix(one[name], values)
    if disturbance is not None:
        fill_matrix(one["disturbance_map"], disturbance[0])
        fill_matrix(one["disturbance_direct"], disturbance[1])
    return Estimator(shape, room, model, bounded=False, disturbed=disturbance is not None)


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


class EkfNumbers(NamedTuple):
    """The model of an EKF, as its compiled functions take it.

    Attributes:
        sizes: Of [x; w] and of θ, of the window of the gate, of its ring, terms of the series,
            and whether there are unknown torques.
        times: Longest lateness, the clock's tolerance and the longest gap [ns].
        numbers: Nominal step [s], reach of the series [s], mgl/J₁ [1/s²], the gate, and half width
            of the certificate's domain [rad].
        variances: Of the noise of a sample of each output, shape (p,).
        series: Of the linear flow.
        phi, gamma, noise: The linear flow over a nominal step.
        output, read: States to the outputs, and to their disturbances and the unknown torques,
            shapes (p, n + k) and (p + t, n + k).
        torques: States to the unknown torques of motor and link, shape (2, n + k).
        scale: Physical units of the arm's states, shape (4,).
        effects: Accelerations of link and motor by each θ, from [x, sin x₁, u, d], shape (k, 2, 7).
        initial: Covariance before any measurement.
    """

    sizes: NDArray[np.int64]
    times: NDArray[np.int64]
    numbers: Array
    variances: Array
    series: Array
    phi: Array
    gamma: Array
    noise: Array
    output: Array
    read: Array
    torques: Array
    scale: Array
    effects: Array
    initial: Array


class EkfMemory(NamedTuple):
    """All that an EKF remembers: a ring of states after the last samples.

    Attributes:
        counts: Place of the oldest state, number of states, late samples, failures.
        stamps: Of the samples [ns].
        samples: Outputs and torque.
        x, P: The states.
        left_out: Whether each of the last samples was left out.
        seen: Number of samples since the covariance was started.
    """

    counts: NDArray[np.int64]
    stamps: NDArray[np.int64]
    samples: Array
    x: Array
    P: Array
    left_out: NDArray[np.bool_]
    seen: NDArray[np.int64]


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
        numbers: Its model.
        memory: What it remembers.
        row_parts: Places of an estimate's fields in a row, as of an `Estimator`.
        row_width: Length of a row without what `history.estimate_at` adds.
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
        effects = np.zeros((0, 2, EXTERNAL + 1))
        if uncertainty is not None and uncertainty.count:
            effects = np.ascontiguousarray(uncertainty.directions[:, 0, [1, 3]])
        n, k, step, linear = flow.state_count, len(effects), flow.nominal, flow.linear
        p, t = len(flow.output_matrix), len(flow.torque_map)
        std = np.concatenate([initial_std, np.full(k, THETA_STD)])
        torques = np.stack([flow.motor_torque, flow.link_torque])

        def padded(rows: Array) -> Array:
            return np.pad(rows, ((0, 0), (0, k)))

        window = max(10, round(_WINDOW / flow.period))
        limits = (options.history, options.future_tolerance, options.restart_after)
        self.numbers = EkfNumbers(
            np.array([n, k, window, options.max_steps, linear.terms, int(torques.any())]),
            np.array([round(min(each, 1e9) * NANOSECONDS) for each in limits]),
            np.array([flow.period, linear.reach, flow.arm.gravity_gain, gate, options.x_max]),
            as_matrix("variances", variances, (p,)),
            linear.series,
            np.ascontiguousarray(step.phi),
            np.ascontiguousarray(step.gamma),
            np.ascontiguousarray(step.noise),
            padded(flow.output_matrix),
            padded(np.concatenate([flow.disturbance_map, flow.torque_map])),
            padded(torques),
            flow.arm.to_physical(np.ones(4)),
            effects,
            np.diag(std * std),
        )
        size, ring = n + k, options.max_steps
        self.memory = EkfMemory(
            np.zeros(4, np.int64),
            np.zeros(ring, np.int64),
            np.zeros((ring, p + 1)),
            np.zeros((ring, size)),
            np.zeros((ring, size, size)),
            np.zeros((ring, window), np.bool_),
            np.zeros(ring, np.int64),
        )
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
        return int(self.memory.counts[2])

    @property
    def failures(self) -> int:
        """Number of estimates that were not finite."""
        return int(self.memory.counts[3])

    def reset(self) -> None:
        """Forget everything."""
        self.memory.counts[:] = 0

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
        size = self.numbers.output.shape[1]
        vectors, matrices = np.zeros((5, size)), np.zeros((8, size, size))
        gammas = np.zeros((2, self.numbers.sizes[0], 1))
        _advance_ekf(
            self.numbers, self.memory, ticks, samples, results, newest, rows,
            vectors, matrices, gammas,
        )  # fmt: skip

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
        results = (np.zeros(count, np.int64), codes, *np.empty((2, count, self.shape.p)))
        newest, rows = np.zeros(count, np.int64), np.empty((count, self.row_width + EXTRA))
        self.advance(ticks, (times, outputs, torques), results, newest, rows)
        rows[newest == 0] = np.nan
        return rows, *results


@compiled_nogil
def _advance_ekf(
    model: EkfNumbers,
    memory: EkfMemory,
    ticks: Any,
    samples: Any,
    results: Any,
    newest: Any,
    rows: Array,
    vectors: Array,
    matrices: Array,
    gammas: Array,
) -> None:
    """Use samples and estimate; see `KalmanFilter.advance`. The last three are scratch."""
    stamps, now, ends, resets = ticks
    times, y, u = samples
    outcomes, codes, innovations, expected = results
    n, k, x_max = model.sizes[0], model.sizes[1], model.numbers[4]
    p, q = model.output.shape[0], model.read.shape[0]
    counts, size, ring = memory.counts, n + k, model.sizes[3]
    x, P = vectors[0], matrices[0]
    begin = 0
    for tick in range(len(stamps)):
        for sample in range(begin, ends[tick]):
            if sample == resets[tick]:
                counts[1] = 0
            if outcomes[sample] < 0:
                continue
            outcomes[sample] = _use(
                model, memory, times[sample], y[sample], u[sample], now[tick], codes, innovations,
                expected, sample, vectors, matrices, gammas,
            )  # fmt: skip
        if resets[tick] >= 0 and not begin <= resets[tick] < ends[tick]:
            counts[1] = 0
        begin = max(begin, ends[tick])
        newest[tick] = 0
        # The newest state that is not after the tick.
        place = counts[1] - 1
        while place >= 0 and memory.stamps[(counts[0] + place) % ring] > stamps[tick]:
            place -= 1
        slot = (counts[0] + place) % ring
        elapsed = stamps[tick] - memory.stamps[slot]
        if place < 0 or elapsed > model.times[2]:
            continue
        _copy_state(memory.x[slot], memory.P[slot], x, P)
        _predict(model, elapsed / 1e9, memory.samples[slot, p], vectors, matrices, gammas)
        row = rows[tick]
        for i in range(len(row)):
            row[i] = 0.0
        for i in range(4):
            row[i] = model.scale[i] * x[i]
            row[4 + i] = model.scale[i] * math.sqrt(P[i, i]) if P[i, i] >= 0.0 else math.nan
        for a in range(q):
            total, reader = 0.0, model.read[a]
            for i in range(size):
                row[8 + a] += reader[i] * x[i]
                for j in range(size):
                    total += reader[i] * P[i, j] * reader[j]
            row[8 + q + a] = math.sqrt(total) if total >= 0.0 else math.nan
        at = 8 + 2 * q
        for i in range(k):
            variance = P[n + i, n + i]
            row[at + i] = x[n + i]
            row[at + k + i] = math.sqrt(variance) if variance >= 0.0 else math.nan
        row[at + 2 * k] = _ALONG_THE_ESTIMATE
        # It takes its parameters for valid, and the noise for the design's.
        row[at + 1 + 2 * k], row[at + 2 + 2 * k] = 1.0 if k > 0 else 0.0, 1.0
        inside = abs(row[0]) <= x_max
        row[len(row) - 2], row[len(row) - 1] = 1.0 if inside else 0.0, elapsed / 1e9
        finite = True
        for i in range(at):
            finite = finite and math.isfinite(row[i])
        if not finite:
            # It diverged: what follows starts over.
            counts[1] = 0
            counts[3] += 1
        else:
            newest[tick] = memory.stamps[(counts[0] + counts[1] - 1) % ring]


@compiled
def _use(
    model: EkfNumbers,
    memory: EkfMemory,
    stamp: int,
    y: Array,
    u: float,
    now: int,
    codes: Any,
    innovations: Array,
    expected: Array,
    sample: int,
    vectors: Array,
    matrices: Array,
    gammas: Array,
) -> int:
    """Use a sample, in its place; return its outcome."""
    counts, ring, p = memory.counts, model.sizes[3], model.output.shape[0]
    later, length = 0, counts[1]
    newest = memory.stamps[(counts[0] + length - 1) % ring]
    while later < length and memory.stamps[(counts[0] + length - 1 - later) % ring] > stamp:
        later += 1
    refused = USED
    if not has_finite(y, p):
        refused = NON_FINITE
    elif stamp <= 0:
        refused = ZERO_STAMP
    elif stamp > now + model.times[1]:
        refused = FROM_FUTURE
    elif later < length and memory.stamps[(counts[0] + length - 1 - later) % ring] == stamp:
        refused = DUPLICATE
    elif later > 0 and ((later == length and counts[0] != 0) or newest - stamp > model.times[0]):
        # Before a ring that has turned there were others, which it does not remember.
        refused = TOO_OLD
    if refused != USED:
        for j in range(p):
            codes[sample, j] = refused
        return refused
    counts[2] += later > 0
    # The sample, and those after it again.
    stamps, samples = np.empty(later + 1, np.int64), np.empty((later + 1, p + 1))
    stamps[0], samples[0, p] = stamp, u
    for i in range(p):
        samples[0, i] = y[i]
    for i in range(later):
        slot = (counts[0] + length - later + i) % ring
        stamps[1 + i] = memory.stamps[slot]
        for j in range(p + 1):
            samples[1 + i, j] = memory.samples[slot, j]
    counts[1] = length - later
    outcome = USED
    for i in range(later + 1):
        code = _correct(model, memory, stamps[i], samples[i], vectors, matrices, gammas)
        if i == 0:
            outcome = code
            for j in range(p):
                innovations[sample, j], expected[sample, j] = vectors[2, j], vectors[3, j]
                codes[sample, j] = int(vectors[4, j])
    return outcome


@compiled
def _correct(
    model: EkfNumbers,
    memory: EkfMemory,
    stamp: int,
    sample: Array,
    vectors: Array,
    matrices: Array,
    gammas: Array,
) -> int:
    """Predict to a sample from the newest state, correct by what is near enough, and remember.

    Innovations, the 1σ expected of them and the outputs' codes are left in the vectors.
    """
    p, size = model.output.shape
    counts, window, ring = memory.counts, model.sizes[2], model.sizes[3]
    x, cross, P, u = vectors[0], vectors[1], matrices[0], float(sample[p])
    last = (counts[0] + counts[1] - 1) % ring
    elapsed = stamp - memory.stamps[last]
    left_out, seen, torque = memory.left_out, memory.seen[last], 0.0
    if counts[1] == 0 or elapsed > model.times[2]:
        counts[1], slot, seen = 0, counts[0], 0
        _start(model, x, P)
        for i in range(window):
            left_out[slot, i] = False
    else:
        slot, torque = (last + 1) % ring, float(memory.samples[last, p])
        _copy_state(memory.x[last], memory.P[last], x, P)
        for i in range(window):
            left_out[slot, i] = left_out[last, i]
        _predict(model, elapsed / 1e9, torque, vectors, matrices, gammas)
    if math.isfinite(u):
        torque = u
    are_out, codes = True, vectors[4]
    for j in range(p):
        vectors[2, j], vectors[3, j], codes[j] = math.nan, math.nan, NON_FINITE
        if math.isfinite(sample[j]):
            spread, innovation = _expected(model, x, P, cross, sample[j], j)
            vectors[2, j], vectors[3, j] = innovation, math.sqrt(spread)
            codes[j] = GATED if abs(innovation) > model.numbers[3] * math.sqrt(spread) else USED
            are_out = are_out and codes[j] != USED
    left_out[slot, seen % window] = are_out
    seen += 1
    gone = 0
    for i in range(window):
        gone += left_out[slot, i]
    if seen >= window and gone > _MOST * window:
        seen = 0
        _copy_state(x, model.initial, x, P)
        for i in range(window):
            left_out[slot, i] = False
    elif not are_out:
        for output in range(p):
            if codes[output] != USED:
                continue
            spread, innovation = _expected(model, x, P, cross, sample[output], output)
            for i in range(size):
                x[i] += cross[i] / spread * innovation
                for j in range(size):
                    P[i, j] -= cross[i] * cross[j] / spread
    memory.stamps[slot], memory.seen[slot] = stamp, seen
    for j in range(p):
        memory.samples[slot, j] = sample[j]
    memory.samples[slot, p] = torque
    _copy_state(x, P, memory.x[slot], memory.P[slot])
    counts[1] += 1
    if counts[1] == ring:
        counts[0] = (counts[0] + 1) % ring
        counts[1] -= 1
    return GATED if are_out else USED


@compiled
def _expected(
    model: EkfNumbers, x: Array, P: Array, cross: Array, y: float, output: int
) -> tuple[float, float]:
    """Return an innovation's variance and the innovation; write the state's covariance with it."""
    C, spread, innovation = model.output[output], model.variances[output], y
    for i in range(len(x)):
        cross[i] = 0.0
        for j in range(len(x)):
            cross[i] += P[i, j] * C[j]
        spread += C[i] * cross[i]
        innovation -= C[i] * x[i]
    return spread, innovation


@compiled
def _start(model: EkfNumbers, x: Array, P: Array) -> None:
    for i in range(len(x)):
        x[i] = 0.0
        for j in range(len(x)):
            P[i, j] = model.initial[i, j]


@compiled
def _copy_state(x: Array, P: Array, to_x: Array, to_P: Array) -> None:
    for i in range(len(x)):
        to_x[i] = x[i]
        for j in range(len(x)):
            to_P[i, j] = P[i, j]


@compiled
def _predict(
    model: EkfNumbers,
    duration: float,
    u: float,
    vectors: Array,
    matrices: Array,
    gammas: Array,
) -> None:
    """Move the state and the covariance, the first of the vectors and matrices, over a time [s]."""
    n, k, terms = model.sizes[0], model.sizes[1], model.sizes[4]
    period, reach, gravity = model.numbers[0], model.numbers[1], model.numbers[2]
    size = n + k
    x, moved, P, jacobian, scratch = vectors[0], vectors[1], matrices[0], matrices[1], matrices[2]
    nothing = matrices[3]
    whole, rest = cut_into_steps(duration, period)
    for step in range(whole + 1):
        length = period if step < whole else rest
        if not length > 0.0:
            return
        phi, gamma, noise = model.phi, model.gamma, model.noise
        if step == whole:
            phi, gamma, noise = matrices[4], gammas[0], matrices[5]
            flow_over(
                model.series, terms, reach, length, phi, gamma, noise, matrices[6:8], gammas[1],
                np.empty(model.series.shape[1]), n, 1, True,
            )  # fmt: skip
        half = 0.5 * length
        for part in range(2):
            if part == 1:
                # The parameters wander.
                for i in range(size):
                    for j in range(size):
                        jacobian[i, j] = 1.0 if i == j else 0.0
                        scratch[i, j] = 0.0
                        if i < n and j < n:
                            jacobian[i, j] = phi[i, j]
                _drift(phi, gamma, u, x, moved)
                congruence(jacobian, P, nothing, scratch, P, size, size)
                _add_noise(noise, length, P)
            _kick(model, half, half * gravity, u, x, jacobian)
            congruence(jacobian, P, nothing, scratch, P, size, size)


@compiled
def _drift(phi: Array, gamma: Array, u: float, x: Array, moved: Array) -> None:
    """Move a state by the linear flow; the last is scratch."""
    n = len(gamma)
    for i in range(n):
        moved[i] = gamma[i, 0] * u
        for j in range(n):
            moved[i] += phi[i, j] * x[j]
    for i in range(n):
        x[i] = moved[i]


@compiled
def _add_noise(noise: Array, length: float, P: Array) -> None:
    n = len(noise)
    for i in range(len(P)):
        for j in range(len(P)):
            if i < n and j < n:
                P[i, j] += noise[i, j]
            elif i == j:
                P[i, i] += THETA_WANDER * length


@compiled
def _kick(
    model: EkfNumbers, half: float, half_kick: float, u: float, x: Array, jacobian: Array
) -> None:
    """Give half a kick by gravity and by the parameters; write its Jacobian if there is room."""
    effects, torques = model.effects, model.torques
    size, k, linear = x.shape[0], effects.shape[0], jacobian.shape[0] > 0
    angle = sine(x[0])
    slope = cosine(x[0]) if linear else 0.0
    if linear:
        for i in range(size):
            for j in range(size):
                jacobian[i, j] = 1.0 if i == j else 0.0
        jacobian[1, 0] -= half_kick * slope
    link, motor = -half_kick * angle, 0.0
    drive, external = u, 0.0
    if model.sizes[5] != 0:
        for j in range(size):
            drive += torques[0, j] * x[j]
            external += torques[1, j] * x[j]
    for row in range(2):
        place = 1 + 2 * row
        for i in range(k):
            theta, effect = x[size - k + i], effects[i, row]
            push = effect[SINE] * angle + effect[TORQUE] * drive + effect[EXTERNAL] * external
            for j in range(4):
                push += effect[j] * x[j]
            if linear:
                for j in range(4):
                    jacobian[place, j] += half * theta * effect[j]
                jacobian[place, 0] += half * theta * effect[SINE] * slope
                if model.sizes[5] != 0:
                    for j in range(4, size - k):
                        share = effect[TORQUE] * torques[0, j] + effect[EXTERNAL] * torques[1, j]
                        jacobian[place, j] += half * theta * share
                jacobian[place, size - k + i] = half * push
            if row == 0:
                link += half * theta * push
            else:
                motor += half * theta * push
    x[1] += link
    x[3] += motor
