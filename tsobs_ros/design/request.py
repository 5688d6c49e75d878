# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Requests: the model, the disturbance, the noise, the domain and the rate a gain is wanted for.

What a certificate covers depends on the premise. The arm's gravity slopes cover it always. If a
T–S system's premise is known (made of scheduled signals), the error system is a blend of the rules
and their matrices are the vertices. If it is the estimate, the weights of truth and estimate
differ; then matrices whose hull holds the Jacobian of f on the domain, `slope_vertices`, cover the
error exactly. Without them only the blend of the rules is proved, and `TSRequest.claim` says so.
"""

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, finite, non_negative, positive, shown
from tsobs_ros.design.names import NO_LABELS, Labels, checked_names, checked_units, labelled
from tsobs_ros.design.problem import DesignProblem
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.options import TorqueLimits
from tsobs_ros.model import disturbance as disturbances
from tsobs_ros.model.arm import LINK_ANGLE, QUANTITIES, SIDES, ElasticJointArm
from tsobs_ros.model.disturbance import DisturbanceModel, per_channel
from tsobs_ros.model.flow import ArmFlow, ProcessNoise, slope_range
from tsobs_ros.model.ts_flow import PairVertex, TSFlow
from tsobs_ros.model.ts_model import TSModel
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

_MAX_MATRICES = 16
"""Vertex matrices; l of them make l² inequalities."""


class FrozenMapping(Mapping[str, Any]):
    """Names with values, equal to every mapping of the same ones, in the order given."""

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[str, Any]) -> None:
        self._items = dict(items)

    def __getitem__(self, name: str) -> Any:
        return self._items[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __hash__(self) -> int:
        return hash(frozenset(self._items.items()))

    def __repr__(self) -> str:
        return repr(self._items)


class DisturbanceTerm(FrozenMapping):
    """One term of the disturbance: its kind and its parameters, the rest filled with defaults.

    Raises:
        ModelError: The kind is unknown, or a parameter is not one of that kind or out of range.

    >>> DisturbanceTerm("bias", {"density": 1e-4})
    {'kind': 'bias', 'density': 0.0001, 'initial_std': 0.3}
    """

    __slots__ = ()

    def __init__(self, kind: str, parameters: Mapping[str, float] = FrozenMapping({})) -> None:
        if not isinstance(kind, str) or kind not in DISTURBANCE_KINDS:
            raise ModelError(
                f"kind: expected one of {', '.join(DISTURBANCE_KINDS)}, got {shown(kind)}"
            )
        known = dict(inspect.signature(DISTURBANCE_KINDS[kind]).parameters)
        known.pop("channels", None)
        for name in parameters:
            if name not in known:
                raise ModelError(
                    f"{name}: no parameter of {kind}, expected some of {', '.join(known) or 'none'}"
                )
        for name, parameter in known.items():
            if parameter.default is inspect.Parameter.empty and name not in parameters:
                raise ModelError(f"{name}: missing, {kind} has no default for it")
        filled = {
            name: finite(f"{kind} {name}", parameters.get(name, parameter.default))
            for name, parameter in known.items()
        }
        super().__init__({"kind": kind, **filled})
        self.model()

    @classmethod
    def from_mapping(cls, entries: Mapping[str, Any]) -> "DisturbanceTerm":
        """Return the term that a file gives by its kind and parameters."""
        parameters = dict(entries)
        return cls(parameters.pop("kind", None), parameters)

    @property
    def kind(self) -> str:
        """The name of the exosystem, one of `DISTURBANCE_KINDS`."""
        return str(self["kind"])

    def model(self) -> DisturbanceModel:
        """Return the exosystem of this term."""
        return DISTURBANCE_KINDS[self.kind](**{k: v for k, v in self.items() if k != "kind"})


NO_LIMIT = 1e9
"""A torque [N m], or rate of it [N m/s], from which on any is plausible."""


def _require_no_alias(terms: Iterable[DisturbanceTerm], rate: float) -> None:
    """Refuse tones that look slower in samples than they are, in the limit like a bias."""
    for term in terms:
        frequency = term.get("frequency", 0.0)
        if frequency >= math.pi * rate:
            raise ModelError(
                f"{term.kind} frequency: expected less than half the measurement rate, "
                f"π·rate = {math.pi * rate:.6g} rad/s, got {frequency!r}; faster tones "
                f"look like slower ones in the samples"
            )


def _require_squares(name: str, values: Iterable[float]) -> None:
    """Refuse what is not above zero, or leaves the range of numbers once squared, as filters do."""
    for value in values:
        if not 0.0 < positive(name, value) * value < math.inf:
            raise ModelError(f"{name}: expected a number with a finite square, got {value!r}")


@dataclass(frozen=True)
class Output:
    """One measured quantity of an arm.

    Attributes:
        measures: What it measures, one of `QUANTITIES` (rad, rad/s).
        measurement_std: 1σ of one sample's noise [rad, rad/s].
        disturbance: Terms whose sum disturbs it.

    Raises:
        ModelError: The quantity is unknown, or a value is out of range.
    """

    measures: str
    measurement_std: float
    disturbance: Sequence[DisturbanceTerm] = (DisturbanceTerm("clean"),)

    def __post_init__(self) -> None:
        if self.measures not in QUANTITIES:
            raise ModelError(
                f"measures: expected one of {', '.join(QUANTITIES)}, got {shown(self.measures)}"
            )
        std = positive("measurement_std", self.measurement_std)
        _require_squares("measurement_std", [std])
        object.__setattr__(self, "measurement_std", std)
        object.__setattr__(self, "disturbance", tuple(self.disturbance))
        if not self.disturbance:
            raise ModelError("disturbance: expected at least one term, e.g. kind: clean")

    @property
    def model(self) -> DisturbanceModel:
        """The sum of the disturbance's terms."""
        return _sum_of(self.disturbance)


@dataclass(frozen=True)
class TorqueDisturbance:
    """Unknown torques of an arm besides the known one [N m].

    Attributes:
        motor: Terms of the torque at the motor: friction, offset, an error of the drive's gain.
        link: Terms of the torque at the link: contact, payload.

    Raises:
        ModelError: A term is arbitrary: such a torque has no model.
    """

    motor: Sequence[DisturbanceTerm] = ()
    link: Sequence[DisturbanceTerm] = ()

    def __post_init__(self) -> None:
        for side in SIDES:
            terms = tuple(getattr(self, side))
            object.__setattr__(self, side, terms)
            for place, term in enumerate(terms):
                if term.kind == "arbitrary":
                    raise ModelError(
                        f"{side}[{place}]: expected a torque with a model, e.g. gauss_markov, "
                        "got kind arbitrary"
                    )

    @cached_property
    def by_side(self) -> Mapping[str, DisturbanceModel]:
        """The exosystems with at least one state by their sides, the motor's first."""
        models = {side: _sum_of(getattr(self, side)) for side in SIDES}
        return {side: model for side, model in models.items() if model.state_count}

    @cached_property
    def model(self) -> DisturbanceModel | None:
        """The exosystem of both sides, None if neither has a model."""
        if not self.by_side:
            return None
        return per_channel([self.by_side.get(side, disturbances.clean()) for side in SIDES])


def _sum_of(terms: Sequence[DisturbanceTerm]) -> DisturbanceModel:
    models = [term.model() for term in terms] or [disturbances.clean()]
    return sum(models[1:], start=models[0])


@dataclass(frozen=True)
class ArmRequest(DesignProblem):
    """Everything a certified gain depends on; the defaults are the shipped design's.

    Attributes:
        arm: Nominal physical parameters.
        disturbance: Terms whose sum disturbs the measured link angle; with `outputs`, the first's.
        process_noise: Densities of the arm's acceleration noise.
        measurement_std: 1σ of one sample's noise of the link angle [rad]; with `outputs`, the
            first's.
        outputs: What is measured; () for the link angle alone, see `sensors`.
        torque_disturbance: Unknown torques at motor and link.
        rate: Measurement rate [Hz].
        x_max: Half width of the domain |q₁| ≤ x_max the certificate is for [rad], up to π.
        decay_rate: Certified rate ρ at which eᵀPe shrinks without noise, as e^{−2ρt} [1/s].
        initial_std: 1σ of [q₁, q̇₁, q₂, q̇₂] before any measurement (rad, rad/s), shape (4,).
        uncertainty: Bound on |θ| of each uncertain parameter, by its name in
            `model.uncertainty.ARM_DIRECTIONS`: relative, or N m s/rad for a damping. That of
            gravity is left out if there is none.
        certify_uncertainty: Whether the certificate covers every θ within the bounds.
        torque_limit: Largest plausible torque [N m]; None: see `torque_limits`; any is from
            `NO_LIMIT` on, or by 0, which a file that asks for a design may not have.
        torque_rate_limit: Its largest plausible rate [N m/s]; likewise.

    Raises:
        ModelError: A value is out of range or of the wrong shape.
    """

    arm: ElasticJointArm = field(default_factory=ElasticJointArm)
    disturbance: Sequence[DisturbanceTerm] = (DisturbanceTerm("bias"),)
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    measurement_std: float = 0.028
    outputs: Sequence[Output] = ()
    torque_disturbance: TorqueDisturbance = TorqueDisturbance()
    rate: float = 200.0
    x_max: float = 0.75
    decay_rate: float = 0.0
    initial_std: Sequence[float] = (0.3, 0.6, 0.3, 0.4)
    uncertainty: Mapping[str, float] = FrozenMapping({"stiffness": 0.4, "gravity": 0.4})
    certify_uncertainty: bool = False
    torque_limit: float | None = None
    torque_rate_limit: float | None = None

    def __post_init__(self) -> None:
        if self.outputs:
            self._take_outputs()
        checked: dict[str, Any] = {
            "measurement_std": positive("measurement_std", self.measurement_std),
            "outputs": tuple(self.outputs),
            # msgspec omits an attribute that is only a class's default.
            "torque_disturbance": self.torque_disturbance,
            "rate": positive("rate", self.rate),
            "decay_rate": non_negative("decay_rate", self.decay_rate),
            "x_max": finite("x_max", self.x_max),
            "disturbance": tuple(self.disturbance),
            "initial_std": tuple(as_matrix("initial_std", self.initial_std, (4,)).tolist()),
            "uncertainty": FrozenMapping(
                {
                    name: positive(f"uncertainty.{name}", bound)
                    for name, bound in self.uncertainty.items()
                    # A share of no gravity is none.
                    if name != "gravity" or self.arm.gravity_torque
                }
            ),
        }
        for name in ("torque_limit", "torque_rate_limit"):
            value = getattr(self, name)
            checked[name] = None if value is None else non_negative(name, value)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if not 0.0 < self.x_max <= math.pi:
            degrees = f" rad; as degrees it would be {math.radians(self.x_max):.4g} rad"
            hint = degrees if math.pi < self.x_max <= 180.0 else ""
            raise ModelError(f"x_max: expected 0 < x_max <= π, got {self.x_max!r}{hint}")
        _require_squares("measurement_std", [self.measurement_std])
        _require_squares("initial_std", self.initial_std)
        if not self.disturbance:
            raise ModelError("disturbance: expected at least one term, e.g. kind: clean")
        for output in self.sensors:
            _require_no_alias(output.disturbance, self.rate)
        for side in SIDES:
            _require_no_alias(getattr(self.torque_disturbance, side), self.rate)
        if self.certify_uncertainty:
            if not self.uncertainty:
                raise ModelError("certify_uncertainty: expected at least one uncertain parameter")
            linear_directions(self.uncertainty_model)
        _ = self.uncertainty_model

    def _take_outputs(self) -> None:
        """Let the first output's entries stand for those of the link angle alone."""
        first = self.outputs[0]
        for name in ("disturbance", "measurement_std"):
            given, own = getattr(self, name), getattr(first, name)
            if given not in (own, getattr(type(self), name)):
                raise ModelError(
                    f"{name}: expected in outputs, one an output, got {shown(given)} besides them"
                )
            object.__setattr__(self, name, own)
        self.arm.measured([output.measures for output in self.outputs])

    @cached_property
    def sensors(self) -> tuple[Output, ...]:
        """What is measured, one entry an output."""
        alone = Output(QUANTITIES[LINK_ANGLE], self.measurement_std, self.disturbance)
        return tuple(self.outputs) or (alone,)

    @property
    def output_names(self) -> tuple[str, ...]:
        """The measured quantities, names of `QUANTITIES`."""
        return tuple(output.measures for output in self.sensors)

    @property
    def output_units(self) -> tuple[str, ...]:
        """Those of an angle or a velocity."""
        return tuple("rad" if name.endswith("_angle") else "rad/s" for name in self.output_names)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The motor's torque alone."""
        return ("torque",)

    @property
    def torque_sides(self) -> tuple[str, ...]:
        """The sides with a torque disturbance, of "motor" and "link", in this order."""
        return tuple(self.torque_disturbance.by_side)

    @cached_property
    def disturbance_model(self) -> DisturbanceModel:
        """The exosystem of all outputs, one channel each."""
        return per_channel([output.model for output in self.sensors])

    @cached_property
    def flow(self) -> ArmFlow:
        """The prediction model of the arm with its disturbances."""
        return ArmFlow(
            self.arm,
            self.disturbance_model,
            self.process_noise,
            self.period,
            self.output_names,
            self.torque_disturbance.model,
        )

    @cached_property
    def uncertainty_model(self) -> Uncertainty:
        """The uncertain parameters of the arm."""
        return arm_uncertainty(self.arm, self.uncertainty)

    @cached_property
    def measurement_covariance(self) -> Array:
        """R, diagonal, shape (p, p)."""
        return np.diag([output.measurement_std * output.measurement_std for output in self.sensors])

    def torque_limits(self, limit: float = 0.0, rate_limit: float = 0.0) -> TorqueLimits:
        """Return which torques a drive of the arm can have.

        What the request leaves open is generous for any arm: ten times the gravity torque and what
        moves both inertias through the domain at the joint's fastest frequency; and from one end of
        this range to the other within 2 ms, so that no step of a command is refused at rates up to
        500 Hz. A step is judged by the time since the last torque in use, but at least by a period.

        Args:
            limit: Largest torque instead of the request's [N m]; 0 for that.
            rate_limit: Largest rate instead of the request's [N m/s]; 0 for that.
        """
        arm = self.arm
        inertia = arm.link_inertia + arm.motor_inertia
        angle, speed = self.reach[:2].tolist()
        largest = 10.0 * (arm.gravity_torque + inertia * speed * speed / angle)
        # What a torque may be while it is unknown stays of the arm's size.
        known, rate = (
            0.0 if each is not None and each >= NO_LIMIT else each
            for each in (limit or self.torque_limit, rate_limit or self.torque_rate_limit)
        )
        return TorqueLimits.of(known, rate, largest)

    @property
    def reach(self) -> Array:
        """Largest [q₁, q̇₁, q₂, q̇₂] that is likely (rad, rad/s), shape (4,).

        Velocities are those of a swing through the domain at the joint's fastest frequency.
        """
        arm = self.arm
        spring = arm.stiffness / arm.link_inertia + arm.stiffness / arm.motor_inertia
        speed = self.x_max * math.sqrt(spring + arm.gravity_gain)
        return np.array([self.x_max, speed, self.x_max, speed])

    @property
    def slope_range(self) -> tuple[float, float]:
        """Smallest and largest gravity slope (cosine) on the domain; (0, 0) without gravity."""
        return slope_range(self.x_max) if self.arm.gravity_torque else (0.0, 0.0)

    @property
    def max_angle(self) -> float:
        """Half width of the certificate's domain [rad]: without gravity it has all angles."""
        return self.x_max if self.arm.gravity_torque else math.inf

    @property
    def state_names(self) -> tuple[str, ...]:
        """The arm's four states."""
        return ("link_angle", "link_velocity", "motor_angle", "motor_velocity")

    @property
    def state_labels(self) -> tuple[str, ...]:
        """The arm's four states with their units."""
        return (
            "link angle [rad]",
            "link velocity [rad/s]",
            "motor angle [rad]",
            "motor velocity [rad/s]",
        )

    @property
    def disturbance_labels(self) -> Sequence[str]:
        """The states of the outputs' disturbances and of the torques in words."""
        if not self.outputs:
            labels = list(super().disturbance_labels)
        else:
            labels = [
                f"{output.measures} disturbance {i + 1}"
                for output in self.outputs
                for i in range(output.model.state_count)
            ]
        for side, model in self.torque_disturbance.by_side.items():
            labels += [f"{side} torque {i + 1} [N m]" for i in range(model.state_count)]
        return labels

    @property
    def headline(self) -> str:
        """Outputs, disturbances and the domain in words."""
        parts = [f"disturbance {self.disturbance_model.label}"]
        if self.outputs:
            parts = [f"{output.measures} ({output.model.label})" for output in self.outputs]
        for side, model in self.torque_disturbance.by_side.items():
            parts.append(f"torque at the {side} ({model.label})")
        gravity = f"|q1| <= {self.x_max:.4g} rad" if self.arm.gravity_torque else "no gravity"
        return ", ".join([*parts, gravity])

    @property
    def details(self) -> dict[str, Any]:
        """The domain, the outputs and the torques as plain data."""
        details: dict[str, Any] = {"x_max": self.x_max} if self.arm.gravity_torque else {}
        if self.outputs:
            details["outputs"] = self.output_names
        if models := self.torque_disturbance.by_side:
            details["torque_disturbance"] = {side: model.label for side, model in models.items()}
        return details

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
        if not self.arm.gravity_torque:
            slopes = "the arm without gravity"
        if not self.certify_uncertainty:
            return slopes
        bounds = " and ".join(f"{name} ± {bound:.4g}" for name, bound in self.uncertainty.items())
        return f"{slopes}, {bounds}"

    @cached_property
    def initial_covariance(self) -> Array:
        """Error covariance before any measurement in design coordinates, shape (n, n)."""
        std = [self.arm.from_physical(self.initial_std), self.disturbance_model.initial_std]
        if (torque := self.torque_disturbance.model) is not None:
            std.append(torque.initial_std)
        with np.errstate(over="ignore"):  # what is not finite is refused by the observer
            return np.diag(np.concatenate(std) ** 2)


@dataclass(frozen=True, eq=False)
class TSRequest(DesignProblem):
    """What a design is for. Units are the model's.

    Attributes:
        model: The T–S system, r rules.
        disturbance: Terms of each channel's disturbance, whose sum acts on it.
        process_noise: Densities of white noise on each state's derivative, shape (n,).
        measurement_std: Noise of one sample of each output, shape (p,).
        rate: Samples a second [Hz].
        initial_std: 1σ of each state before any measurement, shape (n,).
        decay_rate: Required rate ρ at which eᵀPe shrinks without noise, as e^{−2ρt} [1/s].
        slope_vertices: Matrices whose convex hull holds the Jacobian of f on the domain,
            shape (l, n, n), for a premise that is the estimate.
        D_s: Channels to outputs, shape (p, channels); by default one channel an output.
        uncertainty: Uncertain directions of the rules' matrices and their bounds.
        certify_uncertainty: Whether the certificate covers every θ within the bounds.
        names: Names of the signals; x1, y1, u1, s1 and so on in groups without any.
        units: Their units, of all groups or of none.

    Raises:
        ModelError: A value is out of range or of the wrong shape.
    """

    model: TSModel
    disturbance: Sequence[Sequence[DisturbanceTerm]]
    process_noise: ArrayLike
    measurement_std: ArrayLike
    rate: float
    initial_std: ArrayLike
    decay_rate: float = 0.0
    slope_vertices: Sequence[ArrayLike] = ()
    D_s: ArrayLike | None = None
    uncertainty: Uncertainty | None = None
    certify_uncertainty: bool = False
    names: Labels = NO_LABELS
    units: Labels = NO_LABELS

    def __post_init__(self) -> None:
        n, p = self.model.state_count, self.model.C.shape[0]
        checked: dict[str, Any] = {
            "measurement_std": as_matrix("measurement_std", self.measurement_std, (p,)),
            "initial_std": as_matrix("initial_std", self.initial_std, (n,)),
            "rate": positive("rate", self.rate),
            "decay_rate": non_negative("decay_rate", self.decay_rate),
            "disturbance": tuple(tuple(terms) for terms in self.disturbance),
            "slope_vertices": tuple(
                as_matrix(f"slope_vertices[{i}]", matrix, (n, n))
                for i, matrix in enumerate(self.slope_vertices)
            ),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        for name in ("measurement_std", "initial_std"):
            _require_squares(name, checked[name].tolist())
        _require_no_alias(chain.from_iterable(self.disturbance), self.rate)
        _ = self.flow, self._names, self._units
        if self.slope_vertices and self.model.premise_known:
            raise ModelError(
                "slope_vertices: expected none, the premise is made of scheduled signals only "
                "and the rules' matrices are the vertices"
            )
        self._check_uncertainty()

    def _check_uncertainty(self) -> None:
        if self.certify_uncertainty and self.uncertainty is None:
            raise ModelError("certify_uncertainty: expected at least one uncertain direction")
        if self.certify_uncertainty and self.slope_vertices and not self.uncertainty_model.common:
            raise ModelError(
                "certify_uncertainty: with slope_vertices every direction must be one matrix for "
                "all rules, got one that differs"
            )
        count = len(self.vertex_matrices()[1])
        if count > _MAX_MATRICES:
            raise ModelError(
                f"vertices: expected at most {_MAX_MATRICES} matrices (rules or slope vertices, "
                f"times 2 a certified direction), got {count}"
            )

    @cached_property
    def flow(self) -> TSFlow:
        """The prediction model of the system with its disturbance."""
        return TSFlow(self.model, self.disturbance_model, self.process_noise, self.period)

    @cached_property
    def uncertainty_model(self) -> Uncertainty:
        """The uncertain directions of the rules' matrices."""
        if self.uncertainty is not None:
            return self.uncertainty
        return Uncertainty({}, np.zeros((0, *self.flow.deviations.shape)))

    @cached_property
    def disturbance_model(self) -> DisturbanceModel:
        """The exosystem of all channels, acting on the outputs."""
        for channel, terms in enumerate(self.disturbance):
            if not terms:
                raise ModelError(
                    f"disturbance[{channel}]: expected at least one term, e.g. kind: clean"
                )
        models = [[term.model() for term in terms] for terms in self.disturbance]
        joined = per_channel([sum(terms[1:], start=terms[0]) for terms in models])
        return joined if self.D_s is None else joined.through(self.D_s)

    @cached_property
    def measurement_covariance(self) -> Array:
        """R, shape (p, p)."""
        return np.diag(np.asarray(self.measurement_std) ** 2)

    @cached_property
    def initial_covariance(self) -> Array:
        """Error covariance before any measurement, shape (n, n)."""
        std = np.concatenate([self.initial_std, self.disturbance_model.initial_std])
        return np.diag(std**2)

    @property
    def covers_estimated_premise(self) -> bool:
        """Whether the certificate covers the premise as it is, known or estimated."""
        return self.model.premise_known or bool(self.slope_vertices)

    @property
    def claim(self) -> str:
        """The part of premise and outputs that a certificate covers, for reports."""
        if self.model.premise_known:
            text = "the premise is known; covers every weight of the rules"
        elif self.slope_vertices:
            text = (
                "the premise is the estimate; covers it if the Jacobian of f lies in the "
                "convex hull of the slope vertices"
            )
        else:
            text = (
                "the premise is the estimate, but no slope_vertices were given: covers every "
                "weight of the rules as if it were known, NOT the difference between the weights "
                "of truth and estimate"
            )
        if self.model.outputs is not None:
            text += (
                "; the rules' C differ: covers what they differ by from the common C only as far "
                "as the disturbance model does"
            )
        return text

    @cached_property
    def _names(self) -> Labels:
        return checked_names(self.names, self._signal_counts)

    @cached_property
    def _units(self) -> Labels:
        return checked_units(self.units, self._signal_counts)

    @property
    def _signal_counts(self) -> dict[str, int]:
        model = self.model
        return {
            "states": model.state_count,
            "outputs": len(model.C),
            "inputs": model.input_count,
            "scheduled": int(model.schedule.shape[1]),
        }

    @property
    def state_names(self) -> tuple[str, ...]:
        """The names of the states, x1 and so on if the request gives none."""
        return self._names.states

    @property
    def output_names(self) -> tuple[str, ...]:
        """The names of the outputs, y1 and so on if the request gives none."""
        return self._names.outputs

    @property
    def input_names(self) -> tuple[str, ...]:
        """The names of the inputs, then of the scheduled signals; u1 and s1 and so on if none."""
        return self._names.inputs + self._names.scheduled

    @property
    def state_units(self) -> tuple[str, ...]:
        """The units of the states, empty texts if the request gives none."""
        return self._units.states

    @property
    def output_units(self) -> tuple[str, ...]:
        """The units of the outputs, empty texts if the request gives none."""
        return self._units.outputs

    @property
    def input_units(self) -> tuple[str, ...]:
        """The units of `input_names`, empty texts if the request gives none."""
        return self._units.inputs + self._units.scheduled

    @property
    def state_labels(self) -> tuple[str, ...]:
        """The names of the states with their units."""
        return labelled(self.state_names, self.state_units)

    @property
    def disturbance_labels(self) -> tuple[str, ...]:
        """The disturbance's states by their channels, which have the outputs' names but for D_s."""
        labels: list[str] = []
        for channel, terms in enumerate(self.disturbance):
            name = f"channel {channel + 1}" if self.D_s is not None else self.output_names[channel]
            count = sum(term.model().state_count for term in terms)
            labels += [f"disturbance of {name}, state {i + 1}" for i in range(count)]
        return tuple(labels)

    @property
    def headline(self) -> str:
        """The system, its disturbance and the claim in words."""
        model = self.model
        outputs = ", ".join(labelled(self.output_names, self.output_units))
        inputs = ", ".join(labelled(self.input_names, self.input_units))
        return (
            f"T-S system: {model.rule_count} rules, {model.state_count} states, "
            f"{model.C.shape[0]} outputs ({outputs}), inputs {inputs}, "
            f"disturbance {self.disturbance_model.label}; {self.claim}"
        )

    @property
    def details(self) -> dict[str, Any]:
        """The signals' names and units, and the claim, as plain data."""
        return {
            "states": self.state_names,
            "outputs": self.output_names,
            "inputs": self.input_names,
            "units": {
                "states": self.state_units,
                "outputs": self.output_units,
                "inputs": self.input_units,
            },
            "claim": self.claim,
            "covers_estimated_premise": self.covers_estimated_premise,
        }

    def vertex_matrices(self, share: float = 1.0) -> tuple[Array, list[str]]:
        """Return the plant matrices whose pairs are the vertices, (l, n, n), and their names."""
        if self.slope_vertices:
            matrices = np.array(self.slope_vertices)
            names = [f"slope vertex {i + 1}" for i in range(len(matrices))]
        else:
            matrices = np.asarray(self.model.A)
            names = [f"rule {i + 1}" for i in range(len(matrices))]
        if self.certify_uncertainty:
            matrices, names = self._with_uncertainty(matrices, names)
        middle = matrices.mean(axis=0)
        return middle + share * (matrices - middle), names

    def vertices(self, share: float = 1.0) -> list[PairVertex]:
        """Return the error systems the certificate is about.

        Args:
            share: How much of the way from the mean matrix to the vertices.
        """
        return self.flow.vertices(*self.vertex_matrices(share))

    def starts(self) -> list[PairVertex]:
        """Return the mean system, and each vertex by itself."""
        matrices, names = self.vertex_matrices()
        singles = [("the mean of the vertices", matrices.mean(axis=0))]
        singles += zip(names, matrices, strict=True)
        return [self.flow.vertices(matrix[np.newaxis], [name])[0] for name, matrix in singles]

    @property
    def domain(self) -> str:
        """What the certificate covers, in words."""
        _, names = self.vertex_matrices()
        return f"the hull of {', '.join(names)}"

    def _with_uncertainty(self, matrices: Array, names: list[str]) -> tuple[Array, list[str]]:
        """Return every matrix at every corner of the box of θ."""
        uncertain = self.uncertainty_model
        changes = uncertain.linear[:, :1] if self.slope_vertices else uncertain.linear
        corners, labels = [], []
        for signs in product((-1.0, 1.0), repeat=uncertain.count):
            theta = signs * uncertain.limits
            corners.append(matrices + np.tensordot(theta, changes, 1))
            at = ", ".join(f"{k} {v:+.4g}" for k, v in zip(uncertain.names, theta, strict=True))
            labels += [f"{name} ({at})" for name in names]
        return np.concatenate(corners), labels
