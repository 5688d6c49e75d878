# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A design problem: the error systems that one matrix P and one gain K are wanted for."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from tsobs_ros.checks import Array
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.prediction import Flow
from tsobs_ros.model.uncertainty import Uncertainty


class ErrorVertex(Protocol):
    """The error system e⁺ = transition·e + noise at one vertex."""

    @property
    def transition(self) -> Array:
        """Shape (n, n)."""
        ...

    @property
    def noise(self) -> Array:
        """Covariance of the noise, shape (n, n)."""
        ...

    @property
    def where(self) -> str:
        """The vertex in words, for reports."""
        ...


class DesignProblem(ABC):
    """What synthesis, certificate and observer need to know of a request, whatever its model.

    Attributes:
        rate: Samples a second [Hz].
        decay_rate: Rate ρ at which eᵀPe has to shrink without noise, as e^{−2ρt} [1/s].
        certify_uncertainty: Whether the certificate covers every θ within the bounds.
    """

    rate: float
    decay_rate: float
    certify_uncertainty: bool

    @property
    def period(self) -> float:
        """Sampling period T [s]."""
        return 1.0 / self.rate

    @property
    @abstractmethod
    def flow(self) -> Flow:
        """The prediction model."""

    @property
    @abstractmethod
    def disturbance_model(self) -> DisturbanceModel:
        """What disturbs the measurements besides white noise."""

    @property
    @abstractmethod
    def uncertainty_model(self) -> Uncertainty:
        """The uncertain parameters; their number is 0 if there are none."""

    @property
    @abstractmethod
    def measurement_covariance(self) -> Array:
        """R of one sample, shape (p, p)."""

    @property
    @abstractmethod
    def initial_covariance(self) -> Array:
        """Error covariance before any measurement, shape (n, n)."""

    @property
    @abstractmethod
    def state_names(self) -> tuple[str, ...]:
        """The names of the plant's states, alone."""

    @property
    @abstractmethod
    def output_names(self) -> tuple[str, ...]:
        """The names of the p outputs, alone."""

    @property
    @abstractmethod
    def output_units(self) -> tuple[str, ...]:
        """The units of the p outputs, empty texts if they are not known."""

    @property
    @abstractmethod
    def input_names(self) -> tuple[str, ...]:
        """The names of the inputs and then of the scheduled signals, alone."""

    @property
    @abstractmethod
    def state_labels(self) -> Sequence[str]:
        """The plant's states in words, with units if known."""

    @property
    def disturbance_labels(self) -> Sequence[str]:
        """The disturbance's states in words."""
        count = self.disturbance_model.state_count
        return [f"disturbance state {i + 1}" for i in range(count)]

    @property
    @abstractmethod
    def headline(self) -> str:
        """The problem in words, for reports."""

    @property
    @abstractmethod
    def details(self) -> Mapping[str, Any]:
        """What reports of this kind of problem have besides, as plain data."""

    @property
    @abstractmethod
    def domain(self) -> str:
        """The domain in words, after "for", e.g. "gravity slopes [0.7317, 1]"."""

    @abstractmethod
    def vertices(self, share: float = 1.0) -> Sequence[ErrorVertex]:
        """Return the error systems of a share of the domain, 0 for its middle, 1 for all of it."""

    @abstractmethod
    def starts(self) -> Sequence[ErrorVertex]:
        """Return systems whose Kalman filters are first guesses, the best first."""
