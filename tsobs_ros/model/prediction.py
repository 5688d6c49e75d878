# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction models as observers and designs use them: a step of the augmented state x̄.

It is [x; w]: the plant's states, then those of the disturbances.
"""

import math
from abc import ABC, abstractmethod
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.linear_flow import LinearFlow
from tsobs_ros.model.uncertainty import Uncertainty

Record = np.ndarray[Any, np.dtype[Any]]
"""An array of records."""


class FlowSizes(NamedTuple):
    """Sizes of a model's numbers.

    Attributes:
        n: Augmented states.
        m: Inputs and scheduled signals.
        inputs: Inputs, the first of them.
        p: Outputs.
        k: Parameters.
        plant: The plant's own states.
        rules: Rules.
        premises: Premise variables.
    """

    n: int
    m: int
    inputs: int
    p: int
    k: int
    plant: int
    rules: int = 0
    premises: int = 0


@cache
def flow_type(sizes: FlowSizes) -> "np.dtype[Any]":
    """Return the type of a model's numbers, those of the compiled core's `flow`."""
    kind: np.dtype[Any] = record_type("flow", sizes)
    return kind


@cache
def scratch_size(sizes: FlowSizes) -> int:
    """Return the numbers of scratch that a step of a model needs."""
    return int(record_type("flow_scratch", sizes).itemsize // 8)


class Flow(ABC):
    """One step of the augmented state and of its error covariance.

    Attributes:
        disturbance: The exosystem of the outputs, whose states w follow the plant's in x̄.
        torque_disturbance: The exosystem of torques at an arm's motor and link, two channels, whose
            states follow those; None if there is none.
        period: Nominal step [s]; longer ones are taken in nominal steps and a last one.
    """

    disturbance: DisturbanceModel
    torque_disturbance: DisturbanceModel | None = None
    period: float

    @property
    @abstractmethod
    def plant_count(self) -> int:
        """Number of the plant's own states, the first ones of x̄."""

    @property
    @abstractmethod
    def state_count(self) -> int:
        """Length n of the augmented state."""

    @property
    @abstractmethod
    def output_matrix(self) -> Array:
        """Augmented state to measurement C̄ = [C H], shape (p, n)."""

    @property
    @abstractmethod
    def input_count(self) -> int:
        """Number m of inputs and scheduled signals."""

    @cached_property
    def disturbance_map(self) -> Array:
        """Augmented state to the disturbance of each output, shape (p, n)."""
        return self._placed(self.disturbance.H, self.plant_count)

    @cached_property
    def rate_map(self) -> Array:
        """Augmented state to the modelled rate of each output's disturbance, shape (p, n)."""
        return self._placed(self.disturbance.rate_map, self.plant_count)

    @cached_property
    def torque_map(self) -> Array:
        """Augmented state to torque disturbances [N m], shape (t, n); sides with a model, motor's
        first."""
        if self.torque_disturbance is None:
            return np.zeros((0, self.state_count))
        H = self.torque_disturbance.H
        sides = [side for side, row in enumerate(H) if row.any()]
        return self._placed(H[sides], self.plant_count + self.disturbance.state_count)

    def _placed(self, rows: Array, place: int) -> Array:
        """Return rows of a matrix within those of all states, shape (rows, n)."""
        placed = np.zeros((len(rows), self.state_count))
        placed[:, place : place + rows.shape[1]] = rows
        return placed

    @abstractmethod
    def to_physical(self, x: ArrayLike) -> Array:
        """Return the plant's states in physical units for augmented states, shape (..., n)."""

    @property
    def rule_counts(self) -> tuple[int, int]:
        """Numbers of rules and of premise variables."""
        return 0, 0

    @property
    def scheduled_count(self) -> int:
        """Number of scheduled signals, the last of the m signals."""
        return 0

    def sizes(self, parameters: int = 0) -> FlowSizes:
        """Return the sizes of the model's record, with so many parameters θ."""
        m, p = self.input_count, self.output_matrix.shape[0]
        inputs = m - self.scheduled_count
        plant = self.plant_count
        return FlowSizes(self.state_count, m, inputs, p, parameters, plant, *self.rule_counts)

    @abstractmethod
    def fill(self, record: Any, uncertainty: Uncertainty | None = None) -> None:
        """Enter the model's numbers into one record of `flow_type`, zero before.

        Args:
            record: Of the model's sizes.
            uncertainty: Parameters θ that the step takes in.

        Raises:
            ModelError: The uncertainty is of another model.
        """

    def predict(self, x: Array, u: Array, duration: float) -> Array:
        """Return the augmented state a time `duration` later.

        Args:
            x: Augmented state, shape (..., n).
            u: Inputs held over the step, shape (..., m).
            duration: [s], at least 0.

        Raises:
            ModelError: The duration is negative or not finite.
        """
        return self._advanced(x, None, u, duration)[0]

    def predict_with_covariance(
        self, x: Array, covariance: Array, u: Array, duration: float
    ) -> tuple[Array, Array]:
        """Return the state and the error covariance a time `duration` later.

        The covariance follows the step's Jacobian along the estimate, noise included in the same
        order as in the step itself.

        Args:
            x: Augmented state, shape (..., n).
            covariance: Its error covariance Σ, shape (..., n, n), or (n, n) for all of a batch.
            u: Inputs held over the step, shape (..., m).
            duration: [s], at least 0.

        Returns:
            State and covariance, shapes (..., n) and (..., n, n).

        Raises:
            ModelError: The duration is negative or not finite.
        """
        return self._advanced(x, covariance, u, duration)

    def _advanced(
        self, x: Array, covariance: Array | None, u: Array, duration: float
    ) -> tuple[Array, Array]:
        if not 0.0 <= duration < math.inf:
            raise ModelError(
                f"duration: expected a finite number of at least 0, got {duration!r} s"
            )
        n, m, sizes = self.state_count, self.input_count, self.sizes()
        batch = np.broadcast_shapes(np.shape(x)[:-1], np.shape(u)[:-1])
        states, inputs = as_rows("x", x, batch, (n,)), as_rows("u", u, batch, (m,))
        sigma = np.zeros((n, n)) if covariance is None else covariance
        spread = as_rows("covariance", sigma, batch, (n, n))
        moved = np.empty(0) if covariance is None else spread
        none, scratch = np.empty(0), np.empty(scratch_size(sizes))
        record = flow_record(self).view(np.float64)
        native.advance_all(record, states, none, moved, none, none, inputs, duration, scratch)
        return states.reshape(*batch, n), spread.reshape(*batch, n, n)


def flow_record(flow: Flow, uncertainty: Uncertainty | None = None) -> Record:
    """Return the record of a model for the compiled core, shape (1,).

    Args:
        flow: The model.
        uncertainty: Parameters θ that the step takes in.

    Raises:
        ModelError: The uncertainty is of another model.
    """
    count = 0 if uncertainty is None else uncertainty.count
    record = np.zeros(1, flow_type(flow.sizes(count)))
    flow.fill(record[0], uncertainty)
    return record


def as_rows(name: str, values: ArrayLike, batch: tuple[int, ...], shape: tuple[int, ...]) -> Array:
    """Return a batch's numbers one after the other as a new array, by rows whatever came.

    Args:
        name: Name of the numbers, for errors.
        values: Shape (*batch, *shape), or what can be repeated to it.
        batch: Shape of the batch.
        shape: Shape of each of it.

    Raises:
        ModelError: The values are of another shape.
    """
    array = np.asarray(values, np.float64)
    try:
        whole = np.broadcast_to(array, (*batch, *shape))
    except ValueError:
        raise ModelError(f"{name}: expected shape {(*batch, *shape)}, got {array.shape}") from None
    return np.array(whole, order="C").reshape(math.prod(batch), *shape)


def fill_common(
    record: Any, model: Flow, linear: LinearFlow, nominal: float, uncertainty: Uncertainty | None
) -> None:
    """Enter sizes and the linear flow into a model's record.

    Args:
        record: One record of `flow_type`.
        model: The model.
        linear: Its linear flow.
        nominal: Time of the linear flow within a nominal step [s].
        uncertainty: Parameters θ that the step takes in.
    """
    record["n"], record["p"] = model.state_count, model.output_matrix.shape[0]
    record["m"], record["k"] = model.input_count, 0 if uncertainty is None else uncertainty.count
    record["rules"], record["premises"] = model.rule_counts
    record["period"], record["terms"], record["reach"] = model.period, linear.terms, linear.reach
    record["series"] = linear.series
    phi, gamma, noise = linear.over(nominal)
    record["inputs"] = gamma.shape[1]
    for name, matrix in (("phi", phi), ("turned", phi.T), ("gamma", gamma), ("noise", noise)):
        fill_matrix(record[name], matrix)


def fill_matrix(target: Array, matrix: ArrayLike) -> None:
    """Enter a matrix into the first rows and columns of a larger array, or as rows of numbers."""
    values = np.asarray(matrix)
    if values.ndim != target.ndim:
        target[...] = values.reshape(target.shape)
        return
    target[tuple(slice(length) for length in values.shape)] = values


def require_directions(uncertainty: Uncertainty, shape: tuple[int, ...], model: str) -> None:
    """Raise `ModelError` unless the uncertainty is of a model with directions of a shape."""
    if uncertainty.directions.shape[1:] != shape:
        raise ModelError(
            f"uncertainty: expected directions of shape {shape} for {model}, "
            f"got {uncertainty.directions.shape[1:]}"
        )
