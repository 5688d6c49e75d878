# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The step-by-step estimator: pure functions of states, over the steps of the compiled core."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative
from tsobs_ros.core import native
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.options import (
    AdaptationOptions,
    CertifiedGain,
    GainMode,
    SupervisionOptions,
    TorqueLimits,
)
from tsobs_ros.estimation.state import Shape, State, flow_of, new_model, numbers_of, types_of
from tsobs_ros.model.arm import LINK_ANGLE, MOTOR_ANGLE
from tsobs_ros.model.flow import ArmFlow
from tsobs_ros.model.matrices import congruent, inverse, joseph
from tsobs_ros.model.prediction import Flow, Record, as_rows, fill_matrix, flow_record
from tsobs_ros.model.uncertainty import Uncertainty

CONSTANTS = {name: place for place, (name, *_) in enumerate(native.bank_constants())}
"""Places of the constants of the bank in a model record."""

PERIOD_TOLERANCE = 0.1
"""Steps within this fraction of the design's period count as regular samples.

For jitter, whose mean is the period. A sensor that is steadily 10 % slow makes the bound 2 % small.
"""

Rows = Any
"""Rows of estimates, a record array of `Estimator.row_type`."""


class Correction(NamedTuple):
    """The effect of one measurement; a batch has its axis in front.

    Attributes:
        innovation: y − ŷ before the correction, shape (..., p).
        innovation_covariance: Expected covariance of the innovation, shape (..., p, p).
        gain: The gain for the estimate, times the weight, shape (..., n, p).
        weight: The share of each output's correction that was applied; 0 if it was not used,
            shape (..., p).
    """

    innovation: Array
    innovation_covariance: Array
    gain: Array
    weight: Array


class Estimator:
    """The estimator of one system, or of a batch of equal ones.

    `Design.observer` and `Design.supervised` make it for a design; `estimation.baselines` makes
    those to compare with.

    Args:
        shape: Sizes.
        model: Model record, shape (1,).
        lacking: Fields of an estimate that it has nothing for.

    Attributes:
        shape: Sizes.
        model: Model record, shape (1,).
        lacking: Fields of an estimate that it has nothing for.
        row_type: Type of the estimates' rows: the fields of `Estimate` but the stamp, as numbers;
            of length 0 if the estimator has nothing for one.
    """

    def __init__(self, shape: Shape, model: Record, lacking: tuple[str, ...] = ()) -> None:
        self.shape, self.model, self.lacking = shape, model, lacking
        self._types = types_of(tuple(model["sizes"][0].tolist()))
        self._work = self.new_work()
        full: Any = self._types.estimate
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
        """Supervise from now on, or by other options than before."""
        model = self.model[0]
        is_arm = flow_of(model)["kind"] == native.KIND_ARM
        for name, value in vars(options).items():
            model[name] = value
        model["supervised"] = 1
        for i, row in enumerate(model["C"]):
            if not (is_arm and (row[LINK_ANGLE] or row[MOTOR_ANGLE])):
                # The limit is for angles; another output has a unit of its own.
                model["disturbance_limit"][i] = math.inf

    def limit_torque(self, limits: TorqueLimits) -> None:
        """Use only plausible torques from now on."""
        for name, value in limits._asdict().items():
            self.model[f"torque_{name}"] = value

    def new_work(self) -> Record:
        """Return a scratch record, for a thread of its own."""
        return np.zeros(1, self._types.work)

    def new_corrections(self, count: int = 1) -> Record:
        """Return records for the effects of samples."""
        return np.zeros(count, self._types.correction)

    def new_rows(self, *shape: int) -> Array:
        """Return NaN for estimates, whose numbers are the last axis; see `as_rows`."""
        return np.full((*shape, self.row_type.itemsize // 8), np.nan)

    def as_rows(self, numbers: Array) -> Rows:
        """Return numbers of `new_rows` as rows of `row_type`, the same memory."""
        return numbers.view(self.row_type)[..., 0].view(np.recarray)

    def new_states(self, count: int) -> Record:
        """Return records of states before any measurement."""
        numbers = np.tile(self.model["initial"].reshape(1).view(np.float64), count)
        return numbers.view(self._types.state)

    def initial(self, batch: tuple[int, ...] = ()) -> State:
        """Return the state before any measurement: zero estimate, wide covariance."""
        return State(self.new_states(int(np.prod(batch, dtype=int))), self.shape, batch)

    def correct(self, state: State, y: ArrayLike) -> tuple[State, Correction]:
        """Use one measurement.

        Args:
            state: The state predicted to the measurement's stamp.
            y: Measurement, NaN of an output that is missing, shape (..., p).

        Returns:
            The corrected state, and the innovation with its gain.

        Raises:
            ModelError: The measurement has another shape.
        """
        after, samples = state.copy(), as_rows("y", y, state.batch, (self.shape.p,))
        corrections = self.new_corrections(len(after.records))
        native.estimator_correct(
            numbers_of(self.model), numbers_of(after.records), samples, numbers_of(corrections)
        )
        fields = (self.shape.trim(name, corrections[name]) for name in Correction._fields)
        return after, Correction(*(each.reshape(*state.batch, *each.shape[1:]) for each in fields))

    def predict(self, state: State, u: ArrayLike, duration: float) -> State:
        """Predict to the next stamp.

        Args:
            state: Corrected, or not if the measurement is missing.
            u: Inputs held over the step, shape (..., m).
            duration: Time to the next stamp [s], at least 0.

        Raises:
            ModelError: The duration is negative or not finite, or the inputs have another shape.
        """
        return self._predicted(state, u, duration, between_samples=False)

    def extrapolate(self, state: State, u: ArrayLike, duration: float) -> State:
        """Predict to a time between samples; the result is read and not stepped on.

        As `predict`, except that the certified bound serves the whole interval to the next
        regular sample.
        """
        return self._predicted(state, u, duration, between_samples=True)

    def _predicted(
        self, state: State, u: ArrayLike, duration: float, *, between_samples: bool
    ) -> State:
        non_negative("duration", duration)
        after, inputs = state.copy(), as_rows("u", u, state.batch, (self.shape.m,))
        native.estimator_predict(
            numbers_of(self.model),
            numbers_of(after.records),
            inputs,
            duration,
            between_samples,
            numbers_of(self._work),
        )
        return after

    def readout(self, state: State) -> Any:
        """Return the estimate and its bounds in physical units, of a batch as rows."""
        numbers = self.new_rows(len(state.records))
        native.estimator_read(
            numbers_of(self.model), numbers_of(state.records), numbers, numbers_of(self._work)
        )
        return self.as_rows(numbers).reshape(state.batch)[()]

    def observe(
        self,
        y: ArrayLike,
        u: ArrayLike,
        period: float | None = None,
        start: State | None = None,
    ) -> Rows:
        """Return the estimates after each sample of some runs, without holding Python's lock.

        Args:
            y: Measurements, an output of them NaN if it is missing, shape (runs, samples, p).
            u: Inputs from each sample to the next, shape (runs, samples, m).
            period: Time between samples [s]; the nominal one if None.
            start: States at the first sample, a batch of shape (runs,); the initial one if None.

        Raises:
            ModelError: The arrays have other shapes, or the period is negative.
        """
        samples = np.array(y, np.float64, order="C")
        if samples.ndim != 3 or samples.shape[2] != self.shape.p:
            raise ModelError(
                f"y: expected shape (runs, samples, {self.shape.p}), got {samples.shape}"
            )
        inputs = as_rows("u", u, samples.shape[:1], (samples.shape[1], self.shape.m))
        rows = self.new_rows(*samples.shape[:2])
        length = self.period if period is None else non_negative("period", period)
        states = self.initial((len(samples),)) if start is None else start.copy()
        if states.batch != (len(samples),):
            raise ModelError(f"start: expected a batch of {(len(samples),)}, got {states.batch}")
        native.estimator_observe(
            numbers_of(self.model),
            numbers_of(states.records),
            samples,
            inputs,
            length,
            samples.shape[1],
            numbers_of(self.new_corrections()),
            numbers_of(self.new_work()),
            rows,
        )
        return self.as_rows(rows)

    def events(self, state: State) -> dict[str, int]:
        """Return how often what was found so far."""
        if not self.supervised:
            return {}
        return {
            "outliers left out": int(state.outliers),
            "sensor jumps": int(state.jumps),
            "hits": int(state.hits),
            "losses of track": int(state.losses),
        }


def certified_estimator(
    flow: Flow,
    measurement_covariance: Array,
    initial_covariance: Array,
    certified: CertifiedGain,
    *,
    settle_time: float = 5.0,
    gain_mode: GainMode = GainMode.CERTIFIED,
    torque_rate: float = 0.0,
    uncertainty: Uncertainty | None = None,
    adaptation: AdaptationOptions | None = None,
    covered: bool = False,
    domain: Array | None = None,
) -> Estimator:
    """Return the estimator with a certified gain.

    Args:
        flow: Prediction model.
        measurement_covariance: R of one sample, shape (p, p).
        initial_covariance: Error covariance of the zero estimate before any sample, shape (n, n).
        certified: The constant gain and its bound.
        settle_time: Least duration of the Riccati phase [s].
        gain_mode: Whether the certified gain ever takes over.
        torque_rate: 1σ of the rate at which the torque may move in a gap, which is a step longer
            than a regular one [N m/s]; 0: it is held.
        uncertainty: Parameters to learn; none if None.
        adaptation: How fast.
        covered: Whether the certificate holds for every θ within the bounds; if not, no bound
            that depends on θ is called certified.
        domain: 1σ of the plant's states where nothing is known of them, in physical units, shape
            (plant,); at least the initial one.

    Raises:
        ModelError: A matrix has the wrong shape, a number is negative, there is a torque rate for
            a system that is no arm, or the uncertainty is of another model.
    """
    is_arm = isinstance(flow, ArmFlow)
    if non_negative("torque_rate", torque_rate) and not is_arm:
        raise ModelError(f"torque_rate: expected 0 for any system but an arm, got {torque_rate!r}")
    covariances = (measurement_covariance, initial_covariance)
    shape, model = model_of(flow, *covariances, uncertainty, auxiliary=True)
    one, n, p = model[0], shape.n, shape.p
    one["torque_rate"] = torque_rate
    if isinstance(flow, ArmFlow):
        share = one["constants"][CONSTANTS["FORCE_SHARE"]]
        one["force"] = share * flow.arm.reference_torque
    designed = one["initial"]["hypotheses"][0]
    designed["settling"] = non_negative("settle_time", settle_time)
    one["domain"] = np.sqrt(np.diag(initial_covariance)[: shape.plant])
    if domain is not None:
        one["domain"] = np.maximum(one["domain"], domain / np.abs(one["scale"]))
    gain = certified._replace(
        K=as_matrix("K", certified.K, (n, p)), X=as_matrix("X", certified.X, (n, n))
    )
    C, H, T = (one[name][:, :n] for name in ("C", "disturbance_map", "torque_map"))
    X, K, R = gain.X, gain.K, one["R"]
    one["late_factor"], one["gain_mode"] = gain.late, native.GAIN_RICCATI
    if gain_mode is GainMode.CERTIFIED:
        one["gain_mode"] = native.GAIN_CERTIFIED
    for name, matrix in (
        ("X", X),
        ("K", K),
        ("P", inverse(X)),
        ("posterior", joseph(C, R, X, K)),
        ("innovation_covariance", congruent(C, X, R)),
        ("state_std", np.sqrt(X.diagonal())),
        ("disturbance_std", np.sqrt(np.maximum(congruent(H, X).diagonal(), 0.0))),
        ("torque_std", np.sqrt(np.maximum(congruent(T, X).diagonal(), 0.0))),
    ):
        fill_matrix(one[name], matrix)
    if uncertainty is not None and shape.k:
        enter_adaptation(one, uncertainty.limits, adaptation or AdaptationOptions(), covered)
    return Estimator(shape, model)


def model_of(
    flow: Flow,
    measurement_covariance: Array,
    initial_covariance: Array,
    uncertainty: Uncertainty | None,
    *,
    auxiliary: bool,
) -> tuple[Shape, Record]:
    """Return the sizes and the model record of a filter without its gain.

    The arguments are those of `certified_estimator` and of `state.new_model`.

    Raises:
        ModelError: A matrix has the wrong shape, or the uncertainty is of another model.
    """
    n, p = flow.state_count, flow.output_matrix.shape[0]
    k = 0 if uncertainty is None else uncertainty.count
    R = as_matrix("R", measurement_covariance, (p, p))
    initial = as_matrix("initial covariance", initial_covariance, (n, n))
    scale = flow.to_physical(np.ones(n))
    shape = Shape(n, len(scale), p, flow.input_count, k, len(flow.torque_map))
    record = flow_record(flow, uncertainty)
    model = new_model(shape, flow.period, record, auxiliary=auxiliary, torque=flow.torque_path)
    one = model[0]
    one["shortest"] = (1.0 - PERIOD_TOLERANCE) * flow.period
    one["longest"] = (1.0 + PERIOD_TOLERANCE) * flow.period
    for name, values in (
        ("R", R),
        ("C", flow.output_matrix),
        ("scale", scale),
        ("disturbed", flow.disturbance.H.any(axis=1)),
        ("disturbance_map", flow.disturbance_map),
        ("rate_map", flow.rate_map),
        ("torque_map", flow.torque_map),
    ):
        fill_matrix(one[name], values)
    fill_matrix(one["initial"]["hypotheses"][0]["covariance"], initial)
    return shape, model


def enter_adaptation(model: Any, limits: Array, options: AdaptationOptions, covered: bool) -> None:
    """Enter what is learnt, and how fast, into one model record."""
    fill_matrix(model["limits"], limits)
    model["covered"] = covered
    std = limits / math.sqrt(3.0) if options.initial_std is None else options.initial_std
    model["theta_deviation"] = std
    model["significance"], model["pass_time"] = options.significance, options.pass_time
    model["random_walk"] = options.random_walk_density
    model["adaptation_start"], model["memory"] = options.start, options.memory
    model["excitation"] = options.excitation
    designed = model["initial"]["hypotheses"][0]
    fill_matrix(designed["gamma"], np.diag(model["theta_deviation"] ** 2))
