# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Prediction models for observers and designs: a step of the augmented state x̄.

x̄ is [x; w; w_d]: the states of the plant, of the outputs' disturbances and of torque disturbances.
The compiled core takes the steps; a model supplies the numbers for them.

The flow of the linear part is exact for a held input and white noise, over a step of any length:
Φ' = AΦ, Γ' = AΓ + B, Q' = AQ + QAᵀ + W, by their Taylor series with precomputed coefficients. A
step then costs one evaluation of polynomials, which matters because real stamps jitter. If a step
is long for the fastest mode, the series covers a fraction 2⁻ˢ of it and is doubled s times. The
doubling adds positive semidefinite terms, so the noise stays a covariance.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product as pairs_of
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, fixed, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import DIRECT, TorquePath
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.matrices import block_diagonal, product

Record = np.ndarray[Any, np.dtype[Any]]
"""An array of records."""

STRETCH = 1.25
"""Factor by which a step may be longer than nominal, because real stamps jitter."""

_LARGEST_TURN = 2.0**16
"""Largest turn or decay of a mode in one step [rad]; doubling loses a digit per factor of 10."""

_MAX_DIRECTIONS = 3
"""Largest number of uncertain directions other than gravity in a proof; k make 4·4^k vertices."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Bounded uncertain parameters θ of a model with n states and r rules.

    The state's derivative is ẋ(θ) = ẋ(0) + Σ_k θ_k Σᵢ hᵢ E_{k,i} s. Signals s enter it linearly:
    [x; u] for a T–S system, and [x; sin x₁; u; d] for the arm, with a torque d at the link. The arm
    has a single rule.

    Attributes:
        names: Names of the parameters, in the order of θ.
        limits: Bound of each |θ|, shape (k,).
        directions: E_{k,i}, shape (k, r, n, c) for c signals, the first n of which are the state.

    Raises:
        ModelError: A direction is not finite.
    """

    names: tuple[str, ...]
    limits: Array
    directions: Array

    def __post_init__(self) -> None:
        as_matrix("directions", self.directions, self.directions.shape)
        for array in (self.limits, self.directions):
            fixed(array)

    @property
    def count(self) -> int:
        """Number k of uncertain parameters."""
        return len(self.names)

    @property
    def linear(self) -> Array:
        """The part of the directions that multiplies the state, shape (k, r, n, n)."""
        return self.directions[..., : self.directions.shape[2]]

    @property
    def linear_places(self) -> list[int]:
        """Places of the directions that act on the state linearly: not gravity's and the command's.

        Raises `ModelError` if there are too many of them for a proof by vertices.
        """
        places = [k for k in range(self.count) if self.linear[k].any()]
        if len(places) > _MAX_DIRECTIONS:
            raise ModelError(
                f"certify_uncertainty: expected at most {_MAX_DIRECTIONS} uncertain parameters "
                f"beside gravity, got {', '.join(self.names[k] for k in places)}"
            )
        return places


class FlowSizes(NamedTuple):
    """Sizes of a model's numbers: augmented states, signals and the inputs among them, parameters,
    the plant's own states, rules and premise variables."""

    n: int
    m: int
    inputs: int
    k: int
    plant: int
    rules: int = 0
    premises: int = 0


class Corner(NamedTuple):
    """A corner of the set that a certificate covers: its values or names in words, by quantity, and
    its matrix in an error system, shape (n, n); see `Flow.error_map`."""

    place: Mapping[str, str]
    matrix: Any


class VertexSystem(NamedTuple):
    """The error system e⁺ = transition·e + noise at one vertex, which `where` names for reports.

    Attributes:
        transition: Shape (n, n).
        noise: Covariance of the noise, shape (n, n).
        where: The vertex in words.
    """

    transition: Array
    noise: Array
    where: str


class Transition(NamedTuple):
    """The linear flow over a step of an arm, or over half a step of a T–S system.

    Attributes:
        duration: Duration of the whole step [s].
        phi: State transition Φ, shape (n, n).
        gamma: Effect of held inputs Γ, shape (n, inputs).
        noise: Covariance the process noise adds, shape (n, n).
    """

    duration: float
    phi: Array
    gamma: Array
    noise: Array


class Flow(ABC):
    """One step of the augmented state and of its error covariance.

    Args:
        plant: A [1/s], B and C of the plant itself, for an arm without gravity.
        densities: White-noise densities on the derivatives of the plant's states, (plant_count,).
        disturbance: The exosystem of the outputs and then of an arm's torques, whose states follow
            the plant's in x̄.
        period: Nominal step [s]; longer steps are split into nominal ones and a remainder.
        torque_gain: These torques to derivatives of the plant's states, (plant_count, torques).

    Attributes:
        torque_path: How torques reach an arm's motor; a step uses the torque that acts there.
        plant_count: Number of the plant's own states, the first ones of x̄.
        disturbance_map: Augmented state to the disturbance of each output, shape (p, n).
        torques: Augmented state to the torques at an arm's motor and link [N m], (torques, n).
        output_matrix: Augmented state to measurement C̄ = [C H], shape (p, n).
        input_count: Number m of inputs and scheduled signals.
        scheduled_count: Number of scheduled signals, which are the last ones of the m.
        rule_counts: Numbers of rules and of premise variables.
        drift: Continuous matrix of x̄, without gravity or for the mean of the rules, shape (n, n).
        density: Density of the white noise on the derivative of x̄, shape (n, n).

    Raises:
        ModelError: The disturbance's channels do not match the outputs and torques, an entry is not
            finite, or a step is too long for the fastest mode.
    """

    kind: ClassVar[int]
    linear_share: ClassVar[float] = 1.0
    """Share of a step that the linear flow takes at once."""
    torque_path: TorquePath = DIRECT
    scheduled_count: int = 0
    rule_counts: tuple[int, int] = (0, 0)
    gravity_gain: float = 0.0

    def __init__(
        self,
        plant: tuple[Array, Array, Array],
        densities: Array,
        disturbance: DisturbanceModel,
        period: float,
        torque_gain: Array | None = None,
    ) -> None:
        A, B, C = plant
        n, m, p = len(A), B.shape[1], len(C)
        gain = np.zeros((n, 0)) if torque_gain is None else torque_gain
        if (channels := len(disturbance.H)) != p + gain.shape[1]:
            what = "one per output" + " and torque" * bool(gain.size)
            expected = f"{p + gain.shape[1]} channels, {what}"
            raise ModelError(f"disturbance: expected {expected}, got {channels}")
        self.disturbance, self.plant_count = disturbance, n
        self.period, self.input_count = positive("period", period), m + self.scheduled_count
        maps = np.hstack([np.zeros((len(disturbance.H), n)), disturbance.H])
        self.disturbance_map, self.torques = maps[:p], maps[p:]
        joined = self.disturbance_map.copy()
        joined[:, :n] = C
        self.output_matrix = as_matrix("C̄", joined, joined.shape)
        self.drift = block_diagonal(A, disturbance.S)
        self.drift[:n] += product(gain, self.torques)
        self.density = block_diagonal(np.diag(densities), product(disturbance.G, disturbance.G.T))
        inputs = np.zeros((self.state_count, m))
        inputs[:n] = B
        step = self.linear_share * self.period
        turn = _norm(self.drift) * step
        if not turn <= _LARGEST_TURN:
            raise ModelError(
                f"period: expected the fastest mode to turn or decay by at most "
                f"{_LARGEST_TURN:.0f} rad in a step of {step:.4g} s, got {turn:.4g} rad; a "
                f"higher rate or a softer, heavier or less damped arm is needed"
            )
        # The series converges fast for |A|t up to 1; the common step needs no doubling.
        self._reach = STRETCH * step / max(1.0, STRETCH * turn)
        self._series, self._terms = _taylor_series(self.drift, inputs, self.density, self._reach)
        if not all(np.isfinite(part).all() for part in self.nominal[1:4]):
            raise ModelError(
                f"flow: every entry over a step of {step:.4g} s must be finite; "
                f"the model's numbers are too large"
            )

    @property
    def state_count(self) -> int:
        """Length n of the augmented state."""
        return self.plant_count + self.disturbance.state_count

    @cached_property
    def nominal(self) -> Transition:
        """The linear flow of a nominal step."""
        return self.transition(self.period)

    @cached_property
    def rate_map(self) -> Array:
        """Augmented state to the modelled rate of each output's disturbance, shape (p, n)."""
        of_plant, of_disturbance = np.split(self.disturbance_map, [self.plant_count], axis=1)
        return np.hstack([of_plant, product(of_disturbance, self.disturbance.S)])

    @cached_property
    def torque_map(self) -> Array:
        """Augmented state to torque disturbances [N m], shape (t, n); sides with a model, motor's
        first."""
        return self.torques[self.torques.any(axis=1)]

    def to_physical(self, x: ArrayLike) -> Array:
        """Return the plant's states in physical units (for an arm rad and rad/s) from augmented
        states of shape (..., n)."""
        return np.asarray(x, dtype=np.float64)[..., : self.plant_count]

    def transition(self, duration: float) -> Transition:
        """Return the linear flow of a step of a duration [s]."""
        flow = self._record()
        step = np.zeros(1, record_type("flow_step", flow["sizes"][0]))
        native.flow_over(flow.view(np.float64), duration, step.view(np.float64))
        return Transition(duration, *(step[name][0] for name in Transition._fields[1:]))

    @abstractmethod
    def error_map(self, first: Array, second: Array) -> tuple[Array, Array]:
        """Return the transition of the error over a nominal step, and the covariance of its noise,
        from the matrices of the corners that hold in its two halves, shapes (..., n, n)."""

    def vertices(self, corners: Iterable[Corner]) -> list[VertexSystem]:
        """Return the vertex error systems of a nominal step: those of every pair of corners."""
        return [
            VertexSystem(*self.error_map(first.matrix, second.matrix), _between(first, second))
            for first, second in pairs_of(corners, repeat=2)
        ]

    @abstractmethod
    def numbers(self, uncertainty: Uncertainty | None) -> Mapping[str, Any]:
        """Return the fields of the record that only this kind of model has, by name."""

    def record(self, uncertainty: Uncertainty | None = None) -> Record:
        """Return the record for the compiled core, shape (1,); its step includes θ if given."""
        record = self._record(uncertainty)
        for name in Transition._fields[1:]:
            record[name] = getattr(self.nominal, name)
        return record

    def _record(self, uncertainty: Uncertainty | None = None) -> Record:
        """Return the record without the linear flow of a nominal step."""
        n, m = self.state_count, self.input_count
        k, inputs = 0 if uncertainty is None else uncertainty.count, m - self.scheduled_count
        sizes = FlowSizes(n, m, inputs, k, self.plant_count, *self.rule_counts)
        record = np.zeros(1, record_type("flow", sizes))
        for name, values in {
            "sizes": sizes,
            "kind": self.kind,
            "terms": self._terms,
            "reach": self._reach,
            "series": self._series,
            "torque_offset": self.torque_path.offset,
            **self.numbers(uncertainty),
        }.items():
            fill_matrix(record[name] if np.ndim(values) == 0 else record[name][0], values)
        return record


def _between(first: Corner, second: Corner) -> str:
    """Return the name of the vertex of two corners."""
    words = []
    for name, one in first.place.items():
        both = ", ".join(filter(None, (one, second.place[name])))
        words.append(f"{name} ({both})" if name and both else name or both)
    return ", ".join(words)


@np.errstate(all="ignore")
def _taylor_series(A: Array, B: Array, W: Array, reach: float) -> tuple[Array, int]:
    """Return Taylor coefficients of Φ, Γ and Q, and the number of rows that matter up to `reach`.

    The coefficients are side by side, shape (SERIES_TERMS, n (2n + m)); further rows are zero.
    """
    n, m = B.shape
    series = np.zeros((native.SERIES_TERMS, n * (2 * n + m)))
    row = np.concatenate([np.eye(n), np.zeros((n, n + m))], axis=1)
    largest, power = np.zeros_like(row), 1.0
    for order in range(1, native.SERIES_TERMS):
        size = np.abs(row) * power
        largest = np.where((size > largest) | np.isnan(size), size, largest)
        series[order - 1] = np.concatenate(
            [part.ravel() for part in np.split(row, (n, n + m), axis=1)]
        )
        # Judged entry by entry: entries differ by ten orders of magnitude.
        if order > 2 * n and (size <= 1e-3 * np.finfo(float).eps * largest).all():
            return series, order
        power *= reach
        row = product(A, row)
        row[:, n + m :] += row[:, n + m :].T.copy()
        if order == 1:
            row[:, n:] += np.concatenate([B, W], axis=1)
        row /= order
    return series, native.SERIES_TERMS - 1


def _norm(A: Array) -> float:
    """Return a norm of A [1/s] in coordinates where it is close to its fastest eigenvalue.

    The states' units differ, so rows and columns are balanced by powers of two, which changes no
    flow.
    """
    if not np.isfinite(A).all():
        raise ModelError(f"state matrix: every entry must be finite, got {A.tolist()}")
    balanced = np.abs(A)
    for _ in range(100):
        settled = True
        for i in range(len(balanced)):
            column, row = (sum(line.tolist()) - line[i] for line in (balanced[:, i], balanced[i]))
            if not (0.0 < column < math.inf and 0.0 < row < math.inf):
                continue
            shift = round((math.log2(row) - math.log2(column)) / 2.0)
            if shift:
                balanced[:, i] = np.ldexp(balanced[:, i], shift)
                balanced[i] = np.ldexp(balanced[i], -shift)
                settled = False
        if settled:
            break
    return float(max((sum(column.tolist()) for column in balanced.T), default=0.0))


def fill_matrix(target: Array, matrix: ArrayLike) -> None:
    """Write a matrix into the first rows and columns of a larger array, or reshape it into one."""
    values = np.asarray(matrix)
    if values.ndim != target.ndim:
        target[...] = values.reshape(target.shape)
        return
    target[tuple(slice(length) for length in values.shape)] = values
