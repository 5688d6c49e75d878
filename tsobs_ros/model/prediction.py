# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction models as observers and designs use them: a step of the augmented state x̄.

It is [x; w; w_d]: the plant's states, those of the outputs' disturbances, those of torques. The
compiled core takes the steps; a model gives it their numbers.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache, cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, positive
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.disturbance import DisturbanceModel, clean
from tsobs_ros.model.linear_flow import LinearFlow
from tsobs_ros.model.matrices import block_diagonal
from tsobs_ros.model.torque_path import DIRECT, TorquePath
from tsobs_ros.model.uncertainty import Uncertainty

Record = np.ndarray[Any, np.dtype[Any]]
"""An array of records."""

NO_TORQUES = clean(2)
"""The torque disturbance of a plant without: no states."""


class FlowSizes(NamedTuple):
    """Sizes of a model's numbers.

    Attributes:
        n: Augmented states.
        m: Inputs and scheduled signals.
        inputs: Inputs, the first of those.
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


class VertexSystem(NamedTuple):
    """The error system e⁺ = transition·e + noise at one vertex.

    Attributes:
        transition: Shape (n, n).
        noise: Covariance of the noise, shape (n, n).
        where: The vertex in words, for reports.
        slopes: Gravity slopes of an arm's first and second half kick.
    """

    transition: Array
    noise: Array
    where: str
    slopes: tuple[float, float] = (0.0, 0.0)


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

    Args:
        plant: A [1/s], B and C of the plant itself.
        densities: Of white noise on the derivatives of the plant's states, shape (plant_count,).
        disturbance: The exosystem of the outputs, whose states w follow the plant's in x̄.
        period: Nominal step [s]; longer ones are taken in nominal steps and a last one.
        torque_disturbance: The exosystem of torques at an arm's motor and link, two channels, whose
            states follow those.
        torque_effect: The torques' states to derivatives of the plant's, None if there are none.

    Attributes:
        torque_path: How torques reach an arm's motor; a step is by the torque that acts there.
        plant_count: Number of the plant's own states, the first ones of x̄.
        output_matrix: Augmented state to measurement C̄ = [C H], shape (p, n).
        input_count: Number m of inputs and scheduled signals.
        scheduled_count: Number of scheduled signals, the last of them.
        rule_counts: Numbers of rules and of premise variables.
        directions: Shape of each of the uncertain directions that a step can take in.
        linear: The linear flow, of an arm without gravity.

    Raises:
        ModelError: The disturbance has another number of channels than the plant outputs.
    """

    kind: ClassVar[int]
    linear_share: ClassVar[float] = 1.0
    """Share of a step that the linear flow takes at once."""
    torque_path: TorquePath = DIRECT
    scheduled_count: int = 0
    rule_counts: tuple[int, int] = (0, 0)
    directions: tuple[int, ...]
    gravity_gain: float = 0.0

    def __init__(
        self,
        plant: tuple[Array, Array, Array],
        densities: Array,
        disturbance: DisturbanceModel,
        period: float,
        torque_disturbance: DisturbanceModel = NO_TORQUES,
        torque_effect: Array | None = None,
    ) -> None:
        A, B, C = plant
        n, m = len(A), B.shape[1]
        if disturbance.channel_count != len(C):
            raise ModelError(
                f"disturbance: expected {len(C)} channels, one per output, "
                f"got {disturbance.channel_count}"
            )
        self.disturbance, self.torque_disturbance = disturbance, torque_disturbance
        self.period, self.plant_count = positive("period", period), n
        self.input_count = m + self.scheduled_count
        joined = self._placed(C, 0) + self.disturbance_map
        self.output_matrix = as_matrix("C̄", joined, joined.shape)
        models = disturbance, torque_disturbance
        self._drift = block_diagonal(A, *(model.S for model in models))
        if torque_effect is not None:
            self._drift[:n, n + disturbance.state_count :] = torque_effect
        density = block_diagonal(np.diag(densities), *(model.noise_density for model in models))
        inputs = np.zeros((self.state_count, m))
        inputs[:n] = B
        self.linear = LinearFlow(self._drift, inputs, density, self.linear_share * self.period)

    @property
    def state_count(self) -> int:
        """Length n of the augmented state."""
        models = self.disturbance, self.torque_disturbance
        return self.plant_count + sum(model.state_count for model in models)

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
        H = self.torque_disturbance.H
        return self._placed(H[H.any(axis=1)], self.plant_count + self.disturbance.state_count)

    def _placed(self, rows: Array, place: int) -> Array:
        """Return rows of a matrix within those of all states, shape (rows, n)."""
        placed = np.zeros((len(rows), self.state_count))
        placed[:, place : place + rows.shape[1]] = rows
        return placed

    def augmented(self, A: Array) -> Array:
        """Return the continuous matrix of x̄, shape (n, n), for a state matrix of the plant."""
        matrix = self._drift.copy()
        matrix[: self.plant_count, : self.plant_count] = A
        return matrix

    def to_physical(self, x: ArrayLike) -> Array:
        """Return the plant's states in physical units, of an arm rad and rad/s, for augmented ones
        of shape (..., n)."""
        return np.asarray(x, dtype=np.float64)[..., : self.plant_count]

    def transition(self, duration: float) -> Transition:
        """Return the linear flow of a step of a duration [s]."""
        flow = self.linear.over(self.linear_share * duration)
        return Transition(duration, *flow, 0.5 * duration * self.gravity_gain)

    @abstractmethod
    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        """Return what only this kind of model has in its record, by name; see `flow_record`."""


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
    n, m, p = flow.state_count, flow.input_count, len(flow.output_matrix)
    k, inputs = 0 if uncertainty is None else uncertainty.count, m - flow.scheduled_count
    sizes, linear = FlowSizes(n, m, inputs, p, k, flow.plant_count, *flow.rule_counts), flow.linear
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
