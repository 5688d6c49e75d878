# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a user asks of a design: the arm, the disturbance, the noise, the domain and the rate."""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, as_matrix, finite, non_negative, positive
from tsobs_ros.design.frozen import FrozenMapping
from tsobs_ros.errors import ModelError
from tsobs_ros.model import disturbance as disturbances
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.disturbance import DisturbanceModel
from tsobs_ros.model.flow import ArmFlow, ProcessNoise, slope_range
from tsobs_ros.model.uncertainty import Uncertainty, arm_uncertainty
from tsobs_ros.model.vertices import VertexSystem, linear_directions

DISTURBANCE_KINDS: Mapping[str, Callable[..., DisturbanceModel]] = {
    "clean": disturbances.clean,
    "arbitrary": disturbances.arbitrary,
    "bias": disturbances.bias,
    "gauss_markov": disturbances.gauss_markov,
    "sinusoid": disturbances.sinusoid,
    "ramp": disturbances.ramp,
}


@dataclass(frozen=True)
class DisturbanceTerm:
    """One term of the disturbance: its kind and its parameters, the rest filled with defaults.

    Raises:
        ModelError: The kind is unknown, or a parameter is not one of that kind.
    """

    kind: str
    parameters: Mapping[str, float] = FrozenMapping({})

    def __post_init__(self) -> None:
        if self.kind not in DISTURBANCE_KINDS:
            raise ModelError(
                f"disturbance kind: expected one of {', '.join(DISTURBANCE_KINDS)}, "
                f"got {self.kind!r}"
            )
        known = inspect.signature(DISTURBANCE_KINDS[self.kind]).parameters
        for name in self.parameters:
            if name not in known or name == "channels":
                raise ModelError(
                    f"disturbance {self.kind}: unknown parameter {name!r}, "
                    f"expected some of {', '.join(n for n in known if n != 'channels') or 'none'}"
                )
        missing = [
            name
            for name, parameter in known.items()
            if parameter.default is inspect.Parameter.empty and name not in self.parameters
        ]
        if missing:
            raise ModelError(f"disturbance {self.kind}: parameter {missing[0]!r} is missing")
        filled = {
            name: finite(f"{self.kind} {name}", self.parameters.get(name, parameter.default))
            for name, parameter in known.items()
            if name != "channels"
        }
        object.__setattr__(self, "parameters", FrozenMapping(filled))

    def model(self) -> DisturbanceModel:
        """Return the exosystem of this term."""
        return DISTURBANCE_KINDS[self.kind](**self.parameters)

    def as_mapping(self) -> dict[str, Any]:
        """Return the term as a plain mapping with every parameter spelled out."""
        return {"kind": self.kind, **self.parameters}


def require_no_alias(term: DisturbanceTerm, rate: float) -> None:
    """Refuse tones that look slower in samples than they are, in the limit like a bias.

    Raises:
        ModelError: The tone has at least half the rate [Hz] of the samples.
    """
    frequency = term.parameters.get("frequency", 0.0)
    if frequency >= math.pi * rate:
        raise ModelError(
            f"{term.kind} frequency: expected less than half the measurement rate, "
            f"π·rate = {math.pi * rate:.6g} rad/s, got {frequency!r}; faster tones "
            f"cannot be told from slower ones in the samples"
        )


@dataclass(frozen=True)
class DesignRequest:
    """Everything a certified gain depends on; the defaults are the shipped design's.

    Attributes:
        arm: Nominal physical parameters.
        disturbance: Terms whose sum disturbs the measured angle.
        process_noise: Densities of the arm's acceleration noise.
        measurement_std: 1σ of one sample's noise [rad].
        rate: Measurement rate [Hz].
        x_max: Half width of the domain |q₁| ≤ x_max the certificate is for [rad], up to π.
        decay_rate: Certified rate ρ at which eᵀPe shrinks without noise, as e^{−2ρt} [1/s].
        initial_std: 1σ of [q₁, q̇₁, q₂, q̇₂] before any measurement (rad, rad/s), shape (4,).
        uncertainty: Bound on |θ| of each uncertain parameter, by its name in
            `model.uncertainty.ARM_DIRECTIONS`: relative, or N m s/rad for a damping.
        certify_uncertainty: Whether the certificate covers every θ within the bounds.

    Raises:
        ModelError: A value is out of range or of the wrong shape.
    """

    arm: ElasticJointArm = field(default_factory=ElasticJointArm)
    disturbance: Sequence[DisturbanceTerm] = (DisturbanceTerm("bias"),)
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    measurement_std: float = 0.028
    rate: float = 200.0
    x_max: float = 0.75
    decay_rate: float = 0.0
    initial_std: Sequence[float] = (0.3, 0.6, 0.3, 0.4)
    uncertainty: Mapping[str, float] = FrozenMapping({})
    certify_uncertainty: bool = False

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {
            "measurement_std": positive("measurement_std", self.measurement_std),
            "rate": positive("rate", self.rate),
            "decay_rate": non_negative("decay_rate", self.decay_rate),
            "x_max": finite("x_max", self.x_max),
            "disturbance": tuple(self.disturbance),
            "initial_std": tuple(as_matrix("initial_std", self.initial_std, (4,)).tolist()),
            "uncertainty": FrozenMapping(
                {
                    name: positive(f"uncertainty {name}", bound)
                    for name, bound in self.uncertainty.items()
                }
            ),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if not 0.0 < self.x_max <= math.pi:
            raise ModelError(f"x_max: expected 0 < x_max <= π, got {self.x_max!r}")
        if min(self.initial_std) <= 0.0:
            raise ModelError(f"initial_std: expected values above 0, got {[*self.initial_std]}")
        # Filters work with squares, which leave the range of numbers earlier.
        for name, std in (("measurement", [self.measurement_std]), ("initial", self.initial_std)):
            for one in std:
                positive(f"square of {name}_std", one * one)
        if not self.disturbance:
            raise ModelError("disturbance: expected at least one term, e.g. kind: clean")
        for term in self.disturbance:
            require_no_alias(term, self.rate)
        if self.certify_uncertainty:
            if not self.uncertainty:
                raise ModelError("certify_uncertainty: expected at least one uncertain parameter")
            linear_directions(self.uncertainty_model)
        _ = self.uncertainty_model

    @cached_property
    def disturbance_model(self) -> DisturbanceModel:
        """The sum of the disturbance's terms."""
        models = [term.model() for term in self.disturbance]
        return sum(models[1:], start=models[0])

    @cached_property
    def flow(self) -> ArmFlow:
        """The prediction model of the arm with its disturbance."""
        return ArmFlow(self.arm, self.disturbance_model, self.process_noise, 1.0 / self.rate)

    @cached_property
    def uncertainty_model(self) -> Uncertainty:
        """The uncertain parameters of the arm."""
        return arm_uncertainty(self.arm, self.uncertainty)

    @property
    def period(self) -> float:
        """Sampling period T [s]."""
        return 1.0 / self.rate

    @property
    def measurement_covariance(self) -> Array:
        """R, shape (1, 1) [rad²]."""
        return np.array([[self.measurement_std * self.measurement_std]])

    @property
    def slope_range(self) -> tuple[float, float]:
        """Smallest and largest gravity slope (cosine) on the domain."""
        return slope_range(self.x_max)

    def vertices(self, share: float = 1.0) -> list[VertexSystem]:
        """Return the error systems the certificate is about.

        Args:
            share: How much of the domain and of the certified uncertainty: 0 is the nominal arm
                hanging down, 1 is all that was asked for.
        """
        lowest, highest = self.slope_range
        if share != 1.0:
            lowest = highest - share * (highest - lowest)
        covered = self.uncertainty_model if self.certify_uncertainty else None
        return self.flow.vertices(lowest, highest, covered, share)

    def starts(self) -> list[VertexSystem]:
        """Return the nominal arm in the middle of the slopes and hanging down."""
        middle = sum(self.slope_range) / 2
        return [self.flow.vertices(slope, slope)[0] for slope in (middle, 1.0)]

    @property
    def domain(self) -> str:
        """The slopes and the uncertainty that the certificate covers, in words."""
        slopes = f"gravity slopes [{self.slope_range[0]:.4g}, 1] (|q1| <= {self.x_max:.4g} rad)"
        if not self.certify_uncertainty:
            return slopes
        bounds = " and ".join(f"{name} ± {bound:.4g}" for name, bound in self.uncertainty.items())
        return f"{slopes}, {bounds}"

    @property
    def remedies(self) -> list[str]:
        """What would help where no common matrix is found."""
        smaller = ["smaller bounds of uncertainty"] if self.certify_uncertainty else []
        return [
            *smaller,
            "a smaller x_max",
            "a smaller decay_rate",
            "a disturbance model that decays",
        ]

    @cached_property
    def initial_covariance(self) -> Array:
        """Error covariance before any measurement in design coordinates, shape (n, n)."""
        arm = self.arm.from_physical(self.initial_std)
        with np.errstate(over="ignore"):  # what is not finite is refused by the observer
            return np.diag(np.concatenate([arm, self.disturbance_model.initial_std]) ** 2)
