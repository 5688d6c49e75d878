# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction models as observers and designs use them: a step of the augmented state x̄.

It is [x; w; w_d]: the plant's states, those of the outputs' disturbances, those of torques.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache, cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.linear_flow import LinearFlow
from tsobs_ros.model.torque_path import DIRECT, TorquePath
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


class Transition(NamedTuple):
    """The linear flow over a step of an arm, or over half a step of a T–S system.

    Attributes:
        duration: Of the whole step [s].
        phi: State transition Φ, shape (n, n).
        gamma: Effect of held inputs Γ, shape (n, inputs).
        noise: Covariance the process noise adds, shape (n, n).
        half_kick: Half the duration times mgl/J₁ of an arm [1/s].
    """

    duration: float
    phi: Array
    gamma: Array
    noise: Array
    half_kick: float = 0.0


class Flow(ABC):
    """One step of the augmented state and of its error covariance.

    Attributes:
        disturbance: The exosystem of the outputs, whose states w follow the plant's in x̄.
        torque_disturbance: The exosystem of torques at an arm's motor and link, two channels, whose
            states follow those; None if there is none.
        torque_path: How torques reach an arm's motor; a step is by the torque that acts there.
        period: Nominal step [s]; longer ones are taken in nominal steps and a last one.
        plant_count: Number of the plant's own states, the first ones of x̄.
        output_matrix: Augmented state to measurement C̄ = [C H], shape (p, n).
        input_count: Number m of inputs and scheduled signals.
        scheduled_count: Number of scheduled signals, the last of them.
        rule_counts: Numbers of rules and of premise variables.
        directions: Shape of each of the uncertain directions that a step can take in.
        linear: The linear flow.
    """

    kind: ClassVar[int]
    disturbance: DisturbanceModel
    torque_disturbance: DisturbanceModel | None = None
    torque_path: TorquePath = DIRECT
    period: float
    plant_count: int
    output_matrix: Array
    input_count: int
    scheduled_count: int = 0
    rule_counts: tuple[int, int] = (0, 0)
    directions: tuple[int, ...]
    linear: LinearFlow

    @property
    def state_count(self) -> int:
        """Length n of the augmented state."""
        torque = self.torque_disturbance
        own = self.plant_count + self.disturbance.state_count
        return own + (torque.state_count if torque else 0)

    @cached_property
    def nominal(self) -> Transition:
        """The linear flow of a nominal step."""
        return self.transition(self.period)

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
        torque = self.torque_disturbance
        rows = np.zeros((0, 0)) if torque is None else torque.H[torque.H.any(axis=1)]
        return self._placed(rows, self.plant_count + self.disturbance.state_count)

    def _placed(self, rows: Array, place: int) -> Array:
        """Return rows of a matrix within those of all states, shape (rows, n)."""
        placed = np.zeros((len(rows), self.state_count))
        placed[:, place : place + rows.shape[1]] = rows
        return placed

    def to_physical(self, x: ArrayLike) -> Array:
        """Return the plant's states in physical units for augmented states, shape (..., n)."""
        return np.asarray(x, dtype=np.float64)[..., : self.plant_count]

    @abstractmethod
    def transition(self, duration: float) -> Transition:
        """Return the linear flow of a step of a duration [s]."""

    @abstractmethod
    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        """Return what only this kind of model has in its record, by name; see `flow_record`."""

    def sizes(self, parameters: int = 0) -> FlowSizes:
        """Return the sizes of the model's record, with so many parameters θ."""
        n, m, p = self.state_count, self.input_count, len(self.output_matrix)
        inputs = m - self.scheduled_count
        return FlowSizes(n, m, inputs, p, parameters, self.plant_count, *self.rule_counts)

    def predict(self, x: Array, u: Array, duration: float) -> Array:
        """Return the augmented state a time `duration` later; see `predict_with_covariance`."""
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
        n, m = self.state_count, self.input_count
        batch = np.broadcast_shapes(np.shape(x)[:-1], np.shape(u)[:-1])
        states, inputs = as_rows("x", x, batch, (n,)), as_rows("u", u, batch, (m,))
        sigma = np.zeros((n, n)) if covariance is None else covariance
        spread = as_rows("covariance", sigma, batch, (n, n))
        moved = np.empty(0) if covariance is None else spread
        none, scratch = np.empty(0), np.empty(scratch_size(self.sizes()))
        record = flow_record(self).view(np.float64)
        native.advance_all(record, states, none, moved, none, none, inputs, duration, scratch)
        return states.reshape(*batch, n), spread.reshape(*batch, n, n)


@cache
def flow_type(sizes: FlowSizes) -> "np.dtype[Any]":
    """Return the type of a model's numbers, those of the compiled core's `flow`."""
    kind: np.dtype[Any] = record_type("flow", sizes)
    return kind


@cache
def scratch_size(sizes: FlowSizes) -> int:
    """Return the numbers of scratch that a step of a model needs."""
    return int(record_type("flow_scratch", sizes).itemsize // 8)


def flow_record(flow: Flow, uncertainty: Uncertainty | None = None) -> Record:
    """Return the record of a model for the compiled core, shape (1,).

    Args:
        flow: The model.
        uncertainty: Parameters θ that the step takes in.

    Raises:
        ModelError: The uncertainty is of another model.
    """
    if uncertainty is not None and uncertainty.directions.shape[1:] != flow.directions:
        raise ModelError(
            f"uncertainty: expected directions of shape {flow.directions} for "
            f"{type(flow).__name__}, got {uncertainty.directions.shape[1:]}"
        )
    sizes, linear = flow.sizes(0 if uncertainty is None else uncertainty.count), flow.linear
    phi, gamma, noise = flow.nominal[1:4]
    record = np.zeros(1, flow_type(sizes))
    for name, values in {
        **sizes._asdict(),
        "kind": flow.kind,
        "period": flow.period,
        "terms": linear.terms,
        "reach": linear.reach,
        "series": linear.series,
        "phi": phi,
        "turned": phi.T,
        "gamma": gamma,
        "noise": noise,
        **flow.numbers(uncertainty),
    }.items():
        fill_matrix(record[name] if np.ndim(values) == 0 else record[name][0], values)
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


def fill_matrix(target: Array, matrix: ArrayLike) -> None:
    """Enter a matrix into the first rows and columns of a larger array, or as rows of numbers."""
    values = np.asarray(matrix)
    if values.ndim != target.ndim:
        target[...] = values.reshape(target.shape)
        return
    target[tuple(slice(length) for length in values.shape)] = values
