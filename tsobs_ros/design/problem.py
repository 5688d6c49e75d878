# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The interface of requests of both kinds."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np

from tsobs_ros.checks import Array, fixed, non_negative, positive
from tsobs_ros.design.signals import Labels, Signals
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import TorqueLimits
from tsobs_ros.model.disturbance import DisturbanceModel, DisturbanceTerm, sum_of
from tsobs_ros.model.prediction import Corner, Flow, Uncertainty, VertexSystem

Terms: TypeAlias = tuple[DisturbanceTerm, ...]


class Channel(NamedTuple):
    """A disturbance: where it acts, in words, its terms, and the model of their sum."""

    name: str
    terms: Terms
    model: DisturbanceModel

    @classmethod
    def of(cls, name: str, terms: Iterable[DisturbanceTerm]) -> "Channel":
        """Return the disturbance by some terms."""
        each = tuple(terms)
        return cls(name, each, sum_of(each))


def require_squares(name: str, values: Iterable[float]) -> None:
    """Refuse what is not above zero, or leaves the range of numbers once squared, as filters do."""
    for value in values:
        if not 0.0 < positive(name, value) * value < math.inf:
            raise ModelError(f"{name}: expected a number with a finite square, got {value!r}")


class Request(ABC):
    """What requests of both kinds have, for an arm and for a T–S system; see `AnyRequest`.

    Attributes:
        rate: Samples per second [Hz].
        decay_rate: Rate ρ at which eᵀPe has to shrink without noise, as e^{−2ρt} [1/s].
        certify_uncertainty: Whether the certificate covers every θ within the bounds.
        flow: The prediction model.
        channels: The disturbances of the outputs, then those of torques, with or without terms.
        disturbance_model: The exosystem of the outputs' disturbances.
        uncertainty_model: The uncertain parameters; their number is 0 if there are none.
        output_std: 1σ of one sample's noise of each output, shape (p,).
        plant_std: 1σ of the plant's states before any measurement, in design coordinates.
        state_names: Names of the plant's states.
        state_units: Their units, empty texts if they are not known; likewise those below.
        output_names: Names of the p outputs.
        input_names: Names of the inputs and then of the scheduled signals.
        headline: The problem in words, for reports.
        claim: What of it a certificate covers, in words.
        domain: The domain in words, after "for", e.g. "gravity slopes [0.7317, 1]".
        max_angle: Half width of the domain of an arm's link angle [rad], infinite if there is none.
        reach: Largest states of an arm that are likely (rad, rad/s), shape (4,); None of a system.
        torque_sides: The sides of an arm with a torque disturbance, "motor" before "link".
        starts: Shares of the domain whose Kalman filters are first guesses, the best first.
    """

    rate: float
    decay_rate: float
    certify_uncertainty: bool
    channels: tuple[Channel, ...]
    output_std: Array
    plant_std: Array
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    torque_sides: tuple[str, ...] = ()
    starts: tuple[float, ...]

    @property
    @abstractmethod
    def flow(self) -> Flow: ...

    @property
    @abstractmethod
    def uncertainty_model(self) -> Uncertainty: ...

    @abstractmethod
    def corners(self, share: float = 1) -> Iterable[Corner]:
        """Return the corners of a share of the domain and of the certified uncertainty.

        Share 0 is the middle, of an arm the nominal one hanging down; 1 is all that was asked for.
        """

    @abstractmethod
    def signals(self, joint: str, alone: bool, both_sides: bool = False) -> Signals:
        """Return the places of a joint's signals in measurements and estimates.

        The joint's name is before those of a T–S system's entries if it is not alone in its node.
        An arm may have encoders on both sides although its design measures one.
        """

    @abstractmethod
    def at_rate(self, rate: float) -> Self:
        """Return the request for the error systems of another rate [Hz], without delays."""

    @abstractmethod
    def with_terms(self, place: int, terms: Terms) -> Self:
        """Return the request with other terms at a place of `channels`."""

    @abstractmethod
    def on_share(self, share: float) -> tuple[str, Self] | None:
        """Return the request on a share of its domain, in words too; None if it has none."""

    def torque_limits(self, limit: float = 0.0, rate_limit: float = 0.0) -> TorqueLimits | None:
        """Return which torques a drive of the arm can have; None for a T–S system."""
        return None

    def vertices(self, share: float = 1) -> list[VertexSystem]:
        """Return the error systems that the certificate of a share of the domain is about."""
        return self.flow.vertices(self.corners(share))

    @property
    def period(self) -> float:
        """Sampling period T [s]."""
        return 1.0 / self.rate

    @cached_property
    def covered(self) -> Uncertainty:
        """The uncertain parameters that the certificate covers up to their bounds."""
        known = self.uncertainty_model
        nothing = Uncertainty((), known.limits[:0], known.directions[:0])
        return known if self.certify_uncertainty else nothing

    @property
    def disturbance_labels(self) -> list[str]:
        """The disturbances' states in words."""
        return [
            f"disturbance of {channel.name}, state {i + 1}"
            for channel in self.channels
            for i in range(channel.model.state_count)
        ]

    @cached_property
    def measurement_covariance(self) -> Array:
        """R of one sample, diagonal, shape (p, p)."""
        return fixed(np.diag(self.output_std**2))

    @cached_property
    def initial_covariance(self) -> Array:
        """Error covariance before any measurement in design coordinates, shape (n, n)."""
        std = self.plant_std, self.flow.disturbance.initial_std
        with np.errstate(over="ignore"):  # what is not finite is refused by the observer
            return fixed(np.diag(np.concatenate(std) ** 2))

    def _take(self, **values: Any) -> None:
        """Set attributes of the frozen request."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _label(self, names: Labels, units: Labels) -> None:
        """Take names and units of all signals."""
        self._take(
            state_names=names.states,
            state_units=units.states,
            output_names=names.outputs,
            output_units=units.outputs,
            input_names=names.inputs + names.scheduled,
            input_units=units.inputs + units.scheduled,
        )

    def _check_rates(self) -> None:
        """Check rates, and refuse tones that look slower in samples than they are."""
        self._take(
            rate=positive("rate", self.rate), decay_rate=non_negative("decay_rate", self.decay_rate)
        )
        for term in chain.from_iterable(channel.terms for channel in self.channels):
            if (frequency := term.get("frequency", 0.0)) >= math.pi * self.rate:
                raise ModelError(
                    f"{term.kind} frequency: expected less than half the measurement rate, "
                    f"π·rate = {math.pi * self.rate:.6g} rad/s, got {frequency!r}; faster tones "
                    f"look like slower ones in the samples"
                )
