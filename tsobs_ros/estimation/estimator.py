# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The step-by-step estimator: pure functions of states that call the steps of the compiled core."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, check_names, non_negative, numbers
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.state import Shape, copy_records, new_model, numbers_of, types_of
from tsobs_ros.model.arm import LINK_ANGLE, MOTOR_ANGLE
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.matrices import congruent, inverse, joseph
from tsobs_ros.model.prediction import Flow, Record, Uncertainty, fill_matrix
from tsobs_ros.settings import check, live_setting

CONSTANTS = {name: place for place, (name, *_) in enumerate(native.BANK_CONSTANTS)}
"""Places of the constants of the bank in a model record."""

PERIOD_TOLERANCE = 0.1
"""Steps within this fraction of the design's period count as regular samples.

It allows for jitter about the period. If a sensor is always 10 % slow, bounds are 2 % too small.
"""

_TORQUE_RATE = 0.1
"""Default 1σ of the rate at which an arm's torque may move in a gap, per reference torque [1/s]."""

LEARNING = {
    "random_walk": 1e-6,  # growth of each θ's variance, which keeps the gain alive [1/s]
    "pass_time": 4.0,  # length of a pass [s]; the next one learns along better regressors
    "memory": 10.0,  # time constant of the measure of excitation [s]
    "excitation": 400.0,  # smallest eigenvalue of that measure from which θ counts as valid
}
"""Settings of the learning, by fields of a model record."""

_SELDOM = 2.5758
"""The quantile that a standard normal number exceeds once in 200 times."""

_FIRST_PASS = 1.0
"""Length of the first pass [s]: while the estimate settles, the regressors are at their worst."""

_LONGEST = 3600.0
"""Longest prediction [s]: it is made in steps of a period."""

_LASTING = 0.2
"""A disturbance with a mode slower than this [1/s] can stay at the value that it jumped to."""

_LINK_SHARE = 0.3
"""1σ of FORCE's torque at the link, relative to that at the motor: drives have more friction."""

_CONSTANTS_OF_SYSTEMS = {
    "COLOUR_TIME": 0.4,  # for an arm, noise so slow would explain wrong parameters
    "COLOUR_SIZE": 1.0,
    "IMPERFECTION": 10.0,  # rules interpolate: such a model is often slightly wrong, never hit
    "DRIFT_SIZE": 8.0,  # a smaller drift explains such errors better than their own hypotheses
}
"""Constants that differ for T–S systems."""

GAIN_MODES = ("certified", "riccati")
"""The gains that may correct the estimate once it has settled."""

Rows = Any
"""Rows of estimates, a record array of `Estimator.row_type`."""


class TorqueLimits(NamedTuple):
    """The limits of an arm's plausible torques.

    Attributes:
        limit: Largest torque [N m], infinite if any is plausible.
        rate_limit: Its largest rate [N m/s], likewise.
        spread: 1σ of an entirely unknown torque [N m].
    """

    limit: float
    rate_limit: float
    spread: float


@dataclass(frozen=True)
class SupervisionOptions:
    """The rules for leaving samples out.

    Each σ is multiplied by the noise scale. A disturbance beyond π looks as if arm and sensor had
    turned together. core/bank.c counts repetitions.
    """

    gate: float = live_setting(
        5.0,
        "Innovations as unlikely as this many sigma or more are outliers and not used",
        minimum=1.0,
        maximum=1e3,
    )
    stuck_samples: int = live_setting(
        20, "Signs of a stuck sensor from which samples are not used; 0: never", minimum=0
    )
    disturbance_limit: float = live_setting(
        math.pi,
        "Largest disturbance that a sensor is assumed to jump to",
        unit="rad",
        minimum=1e-3,
    )

    def __post_init__(self) -> None:
        check(self)


class Correction(NamedTuple):
    """A measurement's y − ŷ, and the variance expected of each output, shape (p,)."""

    innovation: Array
    innovation_variance: Array


class Estimator:
    """The estimator of one system; its states are records, which no step changes.

    `Design.observer` and `methods.make_estimator` make it for a design; `estimation.baselines`
    makes the baselines.

    Attributes:
        shape: Sizes.
        model: Model record, shape (1,).
        lacking: Fields of an estimate that the estimator cannot fill.
        row_type: Type of the estimates' rows: the fields of `Estimate` as numbers, without the
            stamp; fields that the estimator cannot fill have length 0.
    """

    def __init__(self, shape: Shape, model: Record, lacking: tuple[str, ...] = ()) -> None:
        self.shape, self.model, self.lacking = shape, model, lacking
        self._types = types_of(tuple(model["sizes"][0].tolist()))
        self._work = self.new_record("work")
        full = self._types["estimate"]
        nothing, fields = (np.float64, (0,)), [(name, *full.fields[name]) for name in full.names]
        rows: Any = {
            "names": full.names,
            "formats": [nothing if name in lacking else of for name, of, _ in fields],
            "offsets": [place for _, _, place in fields],
            "itemsize": full.itemsize,
        }
        self.row_type: Any = np.dtype((np.record, np.dtype(rows)))

    @property
    def period(self) -> float:
        """Nominal sampling period [s]."""
        return float(self.model["period"][0])

    @property
    def supervised(self) -> bool:
        """Whether outliers, jumps and losses are looked for."""
        return bool(self.model["supervised"][0])

    def supervise(self, options: SupervisionOptions) -> None:
        """Supervise from now on, or change the options of the supervision."""
        model = self.model[0]
        for name, value in vars(options).items():
            model[name] = value
        model["supervised"] = 1
        # The limit is for an arm's angles; other outputs have other units.
        angles = model["C"][:, [LINK_ANGLE, MOTOR_ANGLE]].any(axis=1)
        is_arm = model["flow_record"].view(np.int64)[0] == native.KIND_ARM
        model["disturbance_limit"][~(angles & is_arm)] = math.inf

    def limit_torque(self, limits: TorqueLimits | None) -> None:
        """Use only plausible torques from now on, if there are limits."""
        for name, value in limits._asdict().items() if limits else ():
            self.model[f"torque_{name}"] = value

    def learn(
        self,
        uncertainty: Uncertainty,
        *,
        covered: bool = False,
        initial_std: ArrayLike | None = None,
        **options: float,
    ) -> None:
        """Learn the parameters that the estimator was made for.

        Args:
            uncertainty: The parameters; their bounds limit the learnt values.
            covered: Whether the certificate holds for every θ within the bounds; if not, no bound
                that depends on θ is called certified.
            initial_std: 1σ of each θ before any measurement; if None, the 1σ of a uniform draw
                from its range. It caps the gain ever after.
            **options: Values that replace the significance, or some of `LEARNING`.
        """
        one = self.model[0]
        one["limits"], one["covered"] = uncertainty.limits, covered
        std = uncertainty.limits / math.sqrt(3.0) if initial_std is None else initial_std
        one["theta_deviation"] = std
        # A change of θ is used from 3σ on, and if noise makes one so large in at most one of 200
        # times, so that a nominal arm stays nominal: a quantile of χ² (Wilson and Hilferty).
        width = 2.0 / (9.0 * uncertainty.count)
        quantile = uncertainty.count * (1.0 - width + _SELDOM * math.sqrt(width)) ** 3
        for name, value in ({"significance": max(9.0, quantile)} | LEARNING | options).items():
            one[name] = value
        first = one["initial"]["hypotheses"][0]
        first["gamma"] = np.diag(one["theta_deviation"] ** 2)
        first["pass_age"] = max(0.0, one["pass_time"] - _FIRST_PASS)

    def new_record(self, name: str) -> Record:
        """Return a record of zeros: "work" (scratch for one thread), "correction" or "estimate"."""
        return np.zeros(1, self._types[name])

    def rows_of(self, numbers: Array) -> Rows:
        """Return numbers as rows of `row_type`, without copying them."""
        shape = (numbers.nbytes // self.row_type.itemsize,)
        # The constructor of `recarray` takes three times as long.
        return np.ndarray.__new__(np.recarray, shape, self.row_type, numbers.data)

    def initial(self) -> Record:
        """Return the state before any measurement, shape (1,): zero estimate, wide covariance."""
        return copy_records(self.model["initial"])

    def correct(self, state: Record, y: ArrayLike) -> tuple[Record, Correction]:
        """Return the state corrected by a measurement at its stamp, and the innovation.

        The measurement has the shape (p,), with NaN for a missing output.

        Raises:
            ModelError: The measurement has another shape.
        """
        after, effect = copy_records(state), self.new_record("correction")
        given = numbers_of(self.model), numbers_of(after), _vector("y", y, self.shape.p)
        native.estimator_correct(*given, numbers_of(effect))
        return after, Correction(*(effect[name][0] for name in Correction._fields))

    def predict(
        self, state: Record, u: ArrayLike, duration: float, *, between_samples: bool = False
    ) -> Record:
        """Predict over a duration [s] with inputs u held, shape (m,).

        With `between_samples` the result is only read, not stepped on, and its certified bound
        holds on the whole interval to the next regular sample.

        Raises:
            ModelError: The duration is negative or not finite, or longer than an hour and a
                thousand periods, or the inputs are not finite or have another shape.
        """
        longest, seconds = max(_LONGEST, 1000.0 * self.period), non_negative("duration", duration)
        if seconds > longest:
            raise ModelError(f"duration: expected at most {longest:g} s, got {seconds:g}")
        given = as_matrix("u", u, (self.shape.m,)), seconds, between_samples
        model, after, work = self.model, copy_records(state), self._work
        native.estimator_predict(numbers_of(model), numbers_of(after), *given, numbers_of(work))
        return after

    def readout(self, state: Record) -> Any:
        """Return the estimate and its bounds in physical units, a row of `row_type`."""
        row, work = numbers_of(self.new_record("estimate")), numbers_of(self._work)
        native.estimator_read(numbers_of(self.model), numbers_of(state), row, work)
        return self.rows_of(row)[0]


def _vector(name: str, values: ArrayLike, length: int) -> Array:
    array = numbers(name, values)
    if array.shape != (length,):
        raise ModelError(f"{name}: expected shape {(length,)}, got {array.shape}")
    return array


def riccati_estimator(
    flow: Flow,
    measurement_covariance: Array,
    initial_covariance: Array,
    uncertainty: Uncertainty | None = None,
    *,
    auxiliary: bool = False,
) -> Estimator:
    """Return the estimator with Riccati gains, a Kalman filter along the estimate.

    Args:
        flow: Prediction model.
        measurement_covariance: R of one sample, diagonal, shape (p, p).
        initial_covariance: Error covariance of the zero estimate before any sample, shape (n, n).
        uncertainty: Parameters to learn, see `Estimator.learn`; none if None.
        auxiliary: As for `new_model`.

    Raises:
        ModelError: A matrix has the wrong shape.
    """
    n, p = flow.state_count, flow.output_matrix.shape[0]
    k = 0 if uncertainty is None else uncertainty.count
    R = as_matrix("R", measurement_covariance, (p, p))
    initial = as_matrix("initial covariance", initial_covariance, (n, n))
    scale = flow.to_physical(np.ones(n))
    shape = Shape(n, len(scale), p, flow.input_count, k, len(flow.torque_map))
    model = new_model(shape, flow, uncertainty, auxiliary=auxiliary)
    one = model[0]
    one["gain_mode"] = native.GAIN_RICCATI
    one["shortest"] = (1.0 - PERIOD_TOLERANCE) * flow.period
    one["longest"] = (1.0 + PERIOD_TOLERANCE) * flow.period
    for name, values in (
        ("R", R),
        ("C", flow.output_matrix),
        ("scale", scale),
        ("disturbed", _can_jump(flow)),
        ("disturbance_map", flow.disturbance_map),
        ("rate_map", flow.rate_map),
        ("torque_map", flow.torque_map),
    ):
        fill_matrix(one[name], values)
    one["is_clean"] = not one["disturbed"].all()
    fill_matrix(one["initial"]["hypotheses"][0]["covariance"], initial)
    estimator = Estimator(shape, model)
    if uncertainty is not None and k:
        estimator.learn(uncertainty)
    return estimator


def _unknown_input(flow: Flow, std: Array) -> float:
    """Return the 1σ of an unknown part of the first input, from the plant's initial 1σ.

    Within a second it moves the state that it moves most by 0.3 of that state's 1σ.
    """
    gain = np.abs(flow.nominal.gamma[: len(std), 0]) / (flow.linear_share * flow.period)
    moved = gain > 0.0
    return 0.3 * float((std[moved] / gain[moved]).min()) if moved.any() else 0.0


def _can_jump(flow: Flow) -> Array:
    """Return for each output whether its disturbance can stay after a jump, like a bias."""
    model, first = flow.disturbance, flow.plant_count
    if not model.state_count:
        return np.zeros(len(flow.disturbance_map), bool)
    rates, modes = np.linalg.eig(model.S)
    lasting = flow.disturbance_map[:, first:] @ modes[:, np.abs(rates) < _LASTING]
    return np.asarray(np.abs(lasting).max(axis=1, initial=0.0) > 1e-9 * np.abs(model.H).max())


def certified_estimator(
    flow: Flow,
    measurement_covariance: Array,
    initial_covariance: Array,
    K: Array,
    X: Array,
    *,
    late_factor: float = math.nan,
    settle_time: float = 5.0,
    gain_mode: str = "certified",
    torque_rate: float | None = 0.0,
    uncertainty: Uncertainty | None = None,
    domain: Array | None = None,
) -> Estimator:
    """Return the estimator with a certified gain; other arguments are as for `riccati_estimator`.

    Args:
        K: Filter gain, shape (n, p).
        X: Bound on the error covariance before each sample, proved for K, shape (n, n).
        late_factor: Factor on the 1σ bound for up to a period after the next sample is due; NaN
            if none is known.
        settle_time: Least duration of the Riccati phase [s].
        gain_mode: "certified" if the certified gain may take over, else "riccati".
        torque_rate: 1σ of the rate at which an arm's torque, or a system's first input, may move
            in a gap [N m/s]; 0: it is held; None: a tenth of the arm's reference torque per second,
            or a system's unknown input per second.
        domain: 1σ of the plant's states if nothing is known of them, in physical units, shape
            (plant,); raised to the initial 1σ if smaller.

    Raises:
        ModelError: As `riccati_estimator`, a number is negative, or there is no such `gain_mode`.
    """
    covariances = (measurement_covariance, initial_covariance)
    estimator = riccati_estimator(flow, *covariances, uncertainty, auxiliary=True)
    one, (n, plant, p, *_) = estimator.model[0], estimator.shape
    one["late_factor"] = late_factor
    if isinstance(flow, ArmFlow):
        share = one["constants"][CONSTANTS["FORCE_SHARE"]]
        usual, one["modes"] = flow.arm.reference_torque, flow.arm.modes
        force, rate = share * usual, _TORQUE_RATE * usual
        # Sensors that have a disturbance do not show on which side a force acts.
        at_motor, at_link = force, one["is_clean"] * _LINK_SHARE * force
        explains_motor, explains_link = (bool(each.any()) for each in flow.torques)
        if explains_motor and not explains_link:
            known = math.sqrt(congruent(flow.torques[:1], initial_covariance)[0, 0])
            at_motor, at_link, one["explains_motor"] = 0.0, max(2.0 * known, force), 1
        one["force"] = at_motor, at_link / flow.arm.link_inertia
        if explains_motor:  # a torque at the motor explains a wrong stiffness, too
            measured = flow.output_matrix[:, :plant].reshape(p, 2, 2).any(axis=(0, 2))
            one["hidden"] = np.repeat(~measured & (estimator.shape.k == 0), 2)
    else:
        for name, value in _CONSTANTS_OF_SYSTEMS.items():
            one["constants"][CONSTANTS[name]] = value
        if flow.input_count > flow.scheduled_count:
            initial_std = np.sqrt(np.diag(initial_covariance)[:plant])
            one["force"][0] = _unknown_input(flow, initial_std)
        rate = one["force"][0]
    one["torque_rate"] = rate if torque_rate is None else non_negative("torque_rate", torque_rate)
    one["initial"]["hypotheses"][0]["settling"] = non_negative("settle_time", settle_time)
    one["domain"] = np.sqrt(np.diag(initial_covariance)[:plant])
    if domain is not None:
        one["domain"] = np.maximum(one["domain"], domain / np.abs(one["scale"]))
    check_names("gain_mode", [gain_mode], GAIN_MODES)
    if gain_mode == "certified":
        one["gain_mode"] = native.GAIN_CERTIFIED
    K, X, R = as_matrix("K", K, (n, p)), as_matrix("X", X, (n, n)), one["R"]
    C, H, T = (one[name][:, :n] for name in ("C", "disturbance_map", "torque_map"))
    for name, matrix in (
        ("X", X),
        ("K", K),
        ("P", inverse(X)),
        ("posterior", joseph(C, R, X, K)),
        ("innovation_variance", congruent(C, X, R).diagonal()),
        ("disturbance_std", np.sqrt(np.maximum(congruent(H, X).diagonal(), 0.0))),
        ("torque_std", np.sqrt(np.maximum(congruent(T, X).diagonal(), 0.0))),
    ):
        fill_matrix(one[name], matrix)
    return estimator
