# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Requests: the model, disturbance, noise, domain and rate for which a gain is wanted.

The coverage of a certificate depends on the premise. For an arm, the gravity slopes always cover
it. If a T–S system's premise is known (made of scheduled signals), the error system is a blend of
the rules, whose matrices are the vertices. If it is the estimate, truth and estimate have different
weights. Then `slope_vertices`, matrices whose hull holds the Jacobian of f on the domain, cover the
error exactly. Without them only the blend of the rules is proved, which `TSRequest.claim` states.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, product
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import (
    Array,
    Fixed,
    as_matrix,
    expect,
    finite,
    fixed,
    non_negative,
    positive,
    shown,
)
from tsobs_ros.design.signals import (
    NO_LABELS,
    Field,
    Labels,
    Place,
    Signals,
    checked_labels,
    labelled,
    positions,
)
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.estimator import TorqueLimits
from tsobs_ros.model.arm import (
    ANGLES,
    DIRECT,
    LINK_ANGLE,
    QUANTITIES,
    SIDES,
    ElasticJointArm,
    TorquePath,
    require_delay,
)
from tsobs_ros.model.disturbance import (
    CLEAN,
    DisturbanceModel,
    DisturbanceTerm,
    per_channel,
    sum_of,
)
from tsobs_ros.model.flow import ArmFlow, ProcessNoise, arm_uncertainty
from tsobs_ros.model.prediction import Corner, Flow, Uncertainty, VertexSystem
from tsobs_ros.model.ts_model import Direction, TSFlow, TSModel, system_uncertainty

__all__ = [
    "AnyRequest",
    "ArmRequest",
    "DisturbanceTerm",
    "Output",
    "TSRequest",
    "TorqueDisturbance",
    "TorquePath",
]

NO_LIMIT = 1e9
"""A limit of a torque [N m] or of its rate [N m/s] counts as none if it is this large or larger."""

_MAX_MATRICES = 16
"""Largest number of vertex matrices; l matrices make l² inequalities."""

_MOTION: tuple[Field, Field] = ("position", "velocity")

Terms: TypeAlias = Sequence[DisturbanceTerm]


@dataclass(frozen=True)
class Channel:
    """A disturbance: the place where it acts, in words, and its terms."""

    name: str
    terms: Terms

    @cached_property
    def model(self) -> DisturbanceModel:
        """The sum of the terms."""
        return sum_of(self.terms)


def checked_terms(name: str, terms: Any) -> tuple[DisturbanceTerm, ...]:
    """Return the terms of a disturbance, or raise `ModelError` if they are none."""
    found = tuple(terms) if isinstance(terms, Iterable) else (terms,)
    if not all(isinstance(term, DisturbanceTerm) for term in found):
        raise ModelError(f"{name}: expected a list of DisturbanceTerm, got {shown(terms)}")
    return found


def require_squares(name: str, values: Iterable[float]) -> None:
    """Refuse values unless they are above zero and have squares above zero that do not overflow."""
    for value in values:
        if not 0.0 < positive(name, value) * value < math.inf:
            raise ModelError(f"{name}: expected a number with a finite square, got {value!r}")


class Request(ABC):
    """Base of the requests of both kinds, for an arm and for a T–S system; see `AnyRequest`.

    Attributes:
        rate: Samples per second [Hz].
        decay_rate: Rate ρ at which eᵀPe has to shrink without noise, as e^{−2ρt} [1/s].
        certify_uncertainty: Whether the certificate covers every θ within the bounds.
        flow: The prediction model.
        channels: The disturbances of the outputs, then those of torques, with or without terms.
        disturbance_model: The exosystem of the outputs' disturbances.
        uncertainty_model: The uncertain parameters; their number is 0 if there are none.
        output_std: 1σ of the noise of one sample of each output, shape (p,).
        plant_std: 1σ of the plant's states before any measurement, in design coordinates.
        state_names: Names of the plant's states.
        state_units: Units of these, empty texts if they are not known; likewise the other units.
        output_names: Names of the p outputs.
        input_names: Names of the inputs and then of the scheduled signals.
        headline: The problem in words, for reports.
        claim: The part of the problem that a certificate covers, in words.
        domain: The domain in words, after "for", e.g. "gravity slopes [0.7317, 1]".
        max_angle: Half width of the domain of an arm's link angle [rad], infinite if there is none.
        reach: Largest likely states of an arm (rad, rad/s), shape (4,); None for a T–S system.
        torque_sides: The sides of an arm with a torque disturbance, "motor" before "link".
        starts: Shares of the domain at which Kalman filters give first guesses, the best first.
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

        Share 0 is the middle (for an arm, the nominal arm hanging down); 1 is the whole request.
        """

    @abstractmethod
    def signals(self, joint: str, alone: bool, both_sides: bool = False) -> Signals:
        """Return the places of a joint's signals in measurements and estimates.

        The entries of a T–S system begin with the joint's name if the joint is not alone in its
        node. An arm may have encoders on both sides although its design measures only one.
        """

    @abstractmethod
    def at_rate(self, rate: float) -> Self:
        """Return the request at another rate [Hz] and without delays, for its error systems."""

    @abstractmethod
    def with_terms(self, place: int, terms: Terms) -> Self:
        """Return the request with other terms at a place of `channels`."""

    @abstractmethod
    def on_share(self, share: float) -> tuple[str, Self] | None:
        """Return the request on a share of its domain, with a text; None without a domain."""

    def torque_limits(self, limit: float = 0.0, rate_limit: float = 0.0) -> TorqueLimits | None:
        """Return the limits of a plausible torque; None for a T–S system."""
        return None

    def vertices(self, share: float = 1) -> list[VertexSystem]:
        """Return the error systems that a certificate on a share of the domain covers."""
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
        """Names of the disturbances' states, in words."""
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
        with np.errstate(over="ignore"):  # the observer refuses a matrix that is not finite
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
        """Check rates and what is certified, and refuse tones that sampling would alias."""
        expect("certify_uncertainty", self.certify_uncertainty, bool, "True or False")
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


@dataclass(frozen=True)
class Output:
    """One measured quantity of an arm.

    Attributes:
        measures: The quantity, one of `QUANTITIES` (rad, rad/s).
        measurement_std: 1σ of one sample's noise [rad, rad/s].
        disturbance: Terms whose sum disturbs it.
        delay: How late an angle is measured, y(t) = q(t − delay) ≈ q − delay · q̇ [s].

    Raises:
        ModelError: A value is out of range.
    """

    OMIT_EMPTY: ClassVar[bool] = True
    """A delay of 0 is left out of files."""

    measures: str
    measurement_std: float
    disturbance: Terms = CLEAN
    delay: float = 0.0

    def __post_init__(self) -> None:
        std = positive("measurement_std", self.measurement_std)
        require_squares("measurement_std", [std])
        object.__setattr__(self, "measurement_std", std)
        object.__setattr__(self, "delay", non_negative("delay", self.delay))
        object.__setattr__(self, "disturbance", checked_terms("disturbance", self.disturbance))

    @property
    def model(self) -> DisturbanceModel:
        """The sum of the disturbance's terms."""
        return sum_of(self.disturbance)


_LINK_ANGLE = Output(QUANTITIES[LINK_ANGLE], 0.028, (DisturbanceTerm("bias"),))
"""The output of a request that names none."""


@dataclass(frozen=True)
class TorqueDisturbance:
    """Unknown torques on an arm, in addition to the known one [N m].

    Attributes:
        motor: Terms of the torque at the motor: friction, offset, an error of the drive's gain.
        link: Terms of the torque at the link: contact, payload.

    Raises:
        ModelError: A term is arbitrary: such a torque has no model.
    """

    OMIT_EMPTY: ClassVar[bool] = True
    """A side without terms is left out of files."""

    motor: Terms = ()
    link: Terms = ()

    def __post_init__(self) -> None:
        for side in SIDES:
            terms = checked_terms(side, getattr(self, side))
            object.__setattr__(self, side, terms)
            for place, term in enumerate(terms):
                if term.kind == "arbitrary":
                    raise ModelError(
                        f"{side}[{place}]: expected a torque with a model, e.g. gauss_markov, "
                        "got kind arbitrary"
                    )


@dataclass(frozen=True)
class ArmRequest(Request):
    """Everything a certified gain depends on; the defaults are the shipped design's.

    Attributes:
        arm: Nominal physical parameters.
        disturbance: Terms whose sum disturbs the measured link angle; None with `outputs`.
        process_noise: Densities of the arm's acceleration noise.
        measurement_std: 1σ of the noise of one sample of the link angle [rad]; None with `outputs`.
        outputs: The measured quantities; None for the link angle alone, see `sensors`.
        torque_disturbance: Unknown torques at motor and link.
        torque: How the known torque reaches the motor. The certificate does not depend on it, since
            a known input moves truth and estimate alike.
        rate: Measurement rate [Hz].
        x_max: Half width of the certificate's domain |q₁| ≤ x_max [rad], up to π.
        decay_rate: Certified rate ρ at which eᵀPe shrinks without noise, as e^{−2ρt} [1/s].
        initial_std: 1σ of [q₁, q̇₁, q₂, q̇₂] before any measurement (rad, rad/s), shape (4,).
        uncertainty: Bound on |θ| of each uncertain parameter, by its name in
            `model.flow.ARM_DIRECTIONS`: relative, below 1 for all but gravity, or N m s/rad
            for a damping. Without gravity the bound of gravity is dropped.
        certify_uncertainty: Whether the certificate covers every θ within the bounds.
        torque_limit: Largest plausible torque [N m]; None: see `torque_limits`; `NO_LIMIT` or more,
            or 0: no limit. A request file may not have 0.
        torque_rate_limit: Its largest plausible rate [N m/s]; likewise.

    Raises:
        ModelError: A value is out of range or of the wrong shape.
    """

    arm: ElasticJointArm = field(default_factory=ElasticJointArm)
    disturbance: Terms | None = None
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    measurement_std: float | None = None
    outputs: Sequence[Output] | None = None
    torque_disturbance: TorqueDisturbance = TorqueDisturbance()
    torque: TorquePath = DIRECT
    rate: float = 200.0
    x_max: float = 0.75
    decay_rate: float = 0.0
    initial_std: Sequence[float] = (0.3, 0.6, 0.3, 0.4)
    uncertainty: Mapping[str, float] = Fixed({"stiffness": 0.4, "gravity": 0.4})
    certify_uncertainty: bool = False
    torque_limit: float | None = None
    torque_rate_limit: float | None = None

    starts = (0.5, 0)
    sensors = tuple[Output, ...]()
    """The measured quantities, one entry per output."""

    def __post_init__(self) -> None:
        for name, kind in (
            ("arm", ElasticJointArm),
            ("process_noise", ProcessNoise),
            ("torque_disturbance", TorqueDisturbance),
            ("torque", TorquePath),
            ("uncertainty", Mapping),
        ):
            expect(name, getattr(self, name), kind)
        own: dict[str, Any] = {
            name: value
            for name in ("disturbance", "measurement_std")
            if (value := getattr(self, name)) is not None
        }
        if self.outputs is None:
            alone = replace(_LINK_ANGLE, **own)
            self._take(disturbance=alone.disturbance, measurement_std=alone.measurement_std)
        elif own:
            where = "expected in outputs, one per output, not beside them"
            raise ModelError(f"{next(iter(own))}: {where}")
        elif not self.outputs:
            raise ModelError("outputs: expected at least one")
        sensors = (alone,) if self.outputs is None else tuple(self.outputs)
        for place, output in enumerate(sensors):
            expect(f"outputs[{place}]", output, Output)
        measured = tuple(each.measures for each in sensors)
        self.arm.measured(measured, [each.delay for each in sensors])
        given = {each.measures: each.disturbance for each in sensors}
        sides = {side: getattr(self.torque_disturbance, side) for side in SIDES}
        given |= {f"the torque at the {side}": terms for side, terms in sides.items()}
        self._take(
            sensors=sensors,
            outputs=self.outputs and sensors,
            channels=tuple(Channel(*each) for each in given.items()),
            torque_sides=tuple(side for side in SIDES if sum_of(sides[side]).state_count),
            output_std=np.array([each.measurement_std for each in sensors]),
            x_max=finite("x_max", self.x_max),
            initial_std=tuple(as_matrix("initial_std", self.initial_std, (4,)).tolist()),
            uncertainty=Fixed(
                {
                    name: positive(f"uncertainty.{name}", bound)
                    for name, bound in self.uncertainty.items()
                    # Without gravity there is nothing to scale.
                    if name != "gravity" or self.arm.gravity_torque
                }
            ),
        )
        for name, bound in self.uncertainty.items():
            if bound >= 1.0 and not name.endswith(("gravity", "damping")):
                raise ModelError(
                    f"uncertainty.{name}: expected a relative error below 1, got {bound!r}; for "
                    "40 % write 0.4"
                )
        for name in ("torque_limit", "torque_rate_limit"):
            if (limit := getattr(self, name)) is not None:
                self._take(**{name: non_negative(name, limit)})
        unit = {name: "rad" if name in ANGLES else "rad/s" for name in QUANTITIES}
        units = Labels(tuple(unit.values()), tuple(unit[name] for name in measured), ("N m",))
        self._label(Labels(QUANTITIES, measured, ("torque",)), units)
        if not 0.0 < self.x_max <= math.pi:
            degrees = ": is it in degrees?" * (self.x_max > math.pi)
            raise ModelError(f"x_max: expected 0 < x_max <= π rad, got {self.x_max!r}{degrees}")
        require_squares("initial_std", self.initial_std)
        self._take(plant_std=self.arm.from_physical(self.initial_std))
        self._check_rates()
        require_delay("torque.delay", self.torque.delay, self.period)
        for place, output in enumerate(sensors):
            require_delay(f"outputs[{place}].delay", output.delay, self.period)
        if self.certify_uncertainty:
            if not self.uncertainty_model.count:
                raise ModelError("certify_uncertainty: expected at least one uncertain parameter")
            _ = self.covered.linear_places  # raises if there are too many

    @cached_property
    def disturbance_model(self) -> DisturbanceModel:
        return per_channel([channel.model for channel in self.channels[: len(self.sensors)]])

    @cached_property
    def flow(self) -> ArmFlow:
        return ArmFlow(
            self.arm,
            per_channel([channel.model for channel in self.channels]),
            self.process_noise,
            self.period,
            self.output_names,
            self.torque,
            [output.delay for output in self.sensors],
        )

    @cached_property
    def uncertainty_model(self) -> Uncertainty:
        return arm_uncertainty(self.arm, self.uncertainty)

    def torque_limits(self, limit: float = 0.0, rate_limit: float = 0.0) -> TorqueLimits:
        """Return the limits of a plausible torque.

        Limits that the request leaves open are generous for any arm. The torque may be ten times
        the sum of the gravity torque and the torque that swings both inertias through the domain at
        the joint's fastest frequency. It may cross this range within 2 ms, so no command step is
        refused up to 500 Hz. A step is from the last torque in use and lasts at least a period.

        Args:
            limit: Largest torque [N m]; 0: the request's.
            rate_limit: Largest rate [N m/s]; 0: the request's.
        """
        arm = self.arm
        inertia = arm.link_inertia + arm.motor_inertia
        angle, speed = self.reach[:2].tolist()
        largest = 10.0 * (arm.gravity_torque + inertia * speed * speed / angle)
        # Without a limit, the spread of an unknown torque still has the arm's scale.
        known, rate = (
            0.0 if each is not None and each >= NO_LIMIT else each
            for each in (limit or self.torque_limit, rate_limit or self.torque_rate_limit)
        )
        size = known or largest
        rate = size / 1e-3 if rate is None else rate or math.inf
        return TorqueLimits(math.inf if known == 0.0 else size, rate, size / 3.0)

    @property
    def reach(self) -> Array:
        # Velocities are those of a swing through the domain at the joint's fastest frequency.
        arm = self.arm
        spring = arm.stiffness / arm.link_inertia + arm.stiffness / arm.motor_inertia
        speed = self.x_max * math.sqrt(spring + arm.gravity_gain)
        return np.array([self.x_max, speed, self.x_max, speed])

    @property
    def slope_range(self) -> tuple[float, float]:
        """Smallest and largest gravity slope (cosine) on the domain; (0, 0) without gravity."""
        return (math.cos(self.x_max), 1.0) if self.arm.gravity_torque else (0.0, 0.0)

    @property
    def max_angle(self) -> float:
        return self.x_max if self.arm.gravity_torque else math.inf

    @property
    def headline(self) -> str:
        p = len(self.sensors)
        parts = [
            f"{channel.name.removeprefix('the ')} ({channel.model.label})"
            for place, channel in enumerate(self.channels)
            if place < p or channel.model.state_count
        ]
        if not self.outputs:
            parts[0] = f"disturbance {self.disturbance_model.label}"
        gravity = f"|q1| <= {self.x_max:.4g} rad" if self.arm.gravity_torque else "no gravity"
        return ", ".join([*parts, gravity])

    @property
    def domain(self) -> str:
        slopes = "the arm without gravity"
        if self.arm.gravity_torque:
            slopes = f"gravity slopes [{self.slope_range[0]:.4g}, 1] (|q1| <= {self.x_max:.4g} rad)"
        each = zip(self.covered.names, self.covered.limits, strict=True)
        bounds = [f"{name} ± {bound:.4g}" for name, bound in each]
        return ", ".join(filter(None, (slopes, " and ".join(bounds))))

    @property
    def claim(self) -> str:
        return f"covers {self.domain}"

    def corners(self, share: float = 1) -> Iterator[Corner]:
        lowest, highest = self.slope_range
        slopes = share * lowest + (1 - share) * highest, highest
        return self.flow.corners(slopes, self.covered, share, 0.5 * self.period)

    def signals(self, joint: str, alone: bool, both_sides: bool = False) -> Signals:
        link, motor, names = f"{joint}_link", f"{joint}_motor", self.output_names
        sides = [name.partition("_")[0] for name in names]
        both = both_sides or len(set(sides)) == 2
        own = [motor if side == "motor" else joint for side in sides]
        entries = own if both else [joint] * len(own)
        fields: list[Field] = ["position" if name in ANGLES else "velocity" for name in names]
        return Signals(
            tuple(map(Place, entries, fields)),
            (Place(joint, "effort"),),
            tuple(Place(link, f) for f in _MOTION) + tuple(Place(motor, f) for f in _MOTION),
            (joint,) if len(names) == 1 else tuple(f"{joint}/{name}" for name in names),
            tuple(Place(f"{joint}_{side}", "effort") for side in self.torque_sides),
            (Place(motor, "effort"),) if motor in own else (),
            self.output_units,
            () if own == entries else tuple(map(Place, own, fields)),
        )

    def at_rate(self, rate: float) -> Self:
        # A delay could be too many of the shorter periods; errors do not depend on delays.
        outputs = self.outputs and [replace(output, delay=0.0) for output in self.outputs]
        return replace(self, rate=rate, torque=DIRECT, outputs=outputs)

    def with_terms(self, place: int, terms: Terms) -> Self:
        if place >= len(self.sensors):
            side = SIDES[place - len(self.sensors)]
            torques = replace(self.torque_disturbance, **{side: terms})
            return replace(self, torque_disturbance=torques)
        if not self.outputs:
            return replace(self, disturbance=terms)
        outputs = list(self.outputs)
        outputs[place] = replace(outputs[place], disturbance=terms)
        return replace(self, outputs=outputs)

    def on_share(self, share: float) -> tuple[str, Self] | None:
        x_max = share * self.x_max
        smaller = f"a smaller x_max: {x_max:.3g} rad", replace(self, x_max=x_max)
        return smaller if self.arm.gravity_torque else None


@dataclass(frozen=True, eq=False)
class TSRequest(Request):
    """Everything a certified gain for a T–S system depends on. Units are the model's.

    Attributes:
        model: The T–S system, r rules.
        disturbance: Terms of each channel's disturbance, whose sum acts on it; () for none.
        process_noise: Densities of white noise on each state's derivative, shape (n,).
        measurement_std: 1σ of the noise of one sample of each output, shape (p,).
        rate: Samples per second [Hz].
        initial_std: 1σ of each state before any measurement, shape (n,).
        decay_rate: Required rate ρ at which eᵀPe shrinks without noise, as e^{−2ρt} [1/s].
        slope_vertices: Matrices whose convex hull holds the Jacobian of f on the domain,
            shape (l, n, n), for a premise that is the estimate.
        D_s: Channels to outputs, shape (p, channels); by default one channel per output.
        uncertainty: Uncertain directions of the rules' matrices by name.
        certify_uncertainty: Whether the certificate covers every θ within the bounds.
        names: Names of the signals; groups without names get x1, y1, u1, s1 and so on.
        units: Units of the signals, for all groups or for none.

    Raises:
        ModelError: A value is out of range or of the wrong shape.
    """

    model: TSModel
    process_noise: Sequence[float] | Array
    measurement_std: Sequence[float] | Array
    rate: float
    initial_std: Sequence[float] | Array
    disturbance: Sequence[Terms] = ()
    decay_rate: float = 0.0
    slope_vertices: Sequence[ArrayLike] = ()
    D_s: Sequence[Sequence[float]] | Array | None = None
    uncertainty: Mapping[str, Direction] = Fixed({})
    certify_uncertainty: bool = False
    names: Labels = NO_LABELS
    units: Labels = NO_LABELS

    max_angle, reach, starts = math.inf, None, (0, 1)

    def __post_init__(self) -> None:
        model, (n, p) = self.model, (self.model.state_count, len(self.model.C))
        shapes: dict[str, tuple[int, ...]]
        shapes = {"process_noise": (n,), "measurement_std": (p,), "initial_std": (n,)}
        if self.D_s is not None:
            shapes["D_s"] = p, len(self.disturbance or p * [CLEAN])
        for name, shape in shapes.items():
            self._take(**{name: as_matrix(name, getattr(self, name), shape)})
        for name in ("measurement_std", "initial_std"):
            require_squares(name, getattr(self, name).tolist())
        self._take(
            disturbance=tuple(
                checked_terms(f"disturbance[{i}]", terms)
                for i, terms in enumerate(self.disturbance or p * [CLEAN])
            ),
            slope_vertices=tuple(
                as_matrix(f"slope_vertices[{i}]", matrix, (n, n))
                for i, matrix in enumerate(self.slope_vertices)
            ),
            output_std=self.measurement_std,
            plant_std=self.initial_std,
        )
        known = self.uncertainty_model
        each = zip(known.names, known.linear, known.limits.tolist(), strict=True)
        self._take(uncertainty=Fixed({name: Direction(E, bound) for name, E, bound in each}))
        counts = n, p, model.input_count, int(model.schedule.shape[1])
        self._label(*checked_labels(self.names, self.units, counts))
        numbered = [f"channel {i + 1}" for i in range(len(self.disturbance))]
        names = numbered if self.D_s is not None else self.output_names
        pairs = zip(names, self.disturbance, strict=False)  # a wrong number is refused by `flow`
        self._take(channels=tuple(Channel(*each) for each in pairs))
        self._check_rates()
        _ = self.flow
        if self.slope_vertices and self.model.premise_known:
            raise ModelError(
                "slope_vertices: expected none, the premise is made of scheduled signals only "
                "and the rules' matrices are the vertices"
            )
        if self.certify_uncertainty and not self.uncertainty:
            raise ModelError("certify_uncertainty: expected at least one uncertain direction")
        is_common = (known.directions == known.directions[:, :1]).all()
        if self.certify_uncertainty and self.slope_vertices and not is_common:
            raise ModelError(
                "certify_uncertainty: with slope_vertices every direction must be one matrix for "
                "all rules, got one that differs"
            )
        if (count := len(list(self.corners()))) > _MAX_MATRICES:
            raise ModelError(
                f"vertices: expected at most {_MAX_MATRICES} matrices (rules or slope vertices, "
                f"times 2 per certified direction), got {count}"
            )

    @cached_property
    def flow(self) -> TSFlow:
        return TSFlow(self.model, self.disturbance_model, self.process_noise, self.period)

    @cached_property
    def uncertainty_model(self) -> Uncertainty:
        return system_uncertainty(self.model, self.uncertainty)

    @cached_property
    def disturbance_model(self) -> DisturbanceModel:
        joined = per_channel([sum_of(terms) for terms in self.disturbance])
        return joined if self.D_s is None else joined.through(self.D_s)

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
        if gaps := self.model.rule_base.gaps:
            places = " or ".join(f"between {low:.4g} and {high:.4g}" for low, high in gaps)
            text += f"; no rule fires for a premise {places}, so there is no model"
        return text

    @property
    def headline(self) -> str:
        model = self.model
        outputs = ", ".join(labelled(self.output_names, self.output_units))
        inputs = ", ".join(labelled(self.input_names, self.input_units))
        return (
            f"T-S system: {model.rule_count} rules, {model.state_count} states, "
            f"{model.C.shape[0]} outputs ({outputs}), inputs {inputs}, "
            f"disturbance {self.disturbance_model.label}; {self.claim}"
        )

    @property
    def domain(self) -> str:
        return f"the hull of {', '.join(corner.place[''] for corner in self.corners())}"

    def corners(
        self, share: float = 1, number: Callable[[Any], Any] = np.asarray
    ) -> Iterator[Corner]:
        known, n, size = self.covered, self.model.state_count, self.flow.state_count
        vertices, limits = number(self.slope_vertices or self.model.A), number(known.limits)
        changes = number(known.linear[:, :1] if self.slope_vertices else known.linear)
        matrices, names = [], list[str]()
        for signs in product((-1, 1), repeat=known.count):
            pairs = zip(known.names, signs * known.limits, strict=True)
            at = ", ".join(f"{name} {theta:+.4g}" for name, theta in pairs)
            what = "slope vertex" if self.slope_vertices else "rule"
            names += [f"{what} {i + 1}{at and f' ({at})'}" for i in range(len(vertices))]
            matrices.append(vertices + (np.tensordot(signs * limits, changes, 1) if at else 0))
        mean = number(self.flow.drift[:n, :n])
        for matrix, name in zip(_closer(np.concatenate(matrices), share), names, strict=True):
            deviation = number(np.zeros((size, size)))
            deviation[:n, :n] = matrix - mean
            yield Corner({"": name}, deviation)

    def signals(self, joint: str, alone: bool, both_sides: bool = False) -> Signals:
        outputs, inputs, states = (
            tuple(name if alone else f"{joint}/{name}" for name in names)
            for names in (self.output_names, self.input_names, self.state_names)
        )
        places = positions(outputs), positions(inputs), positions(states)
        return Signals(*places, outputs, (), (), self.output_units)

    def at_rate(self, rate: float) -> Self:
        return replace(self, rate=rate)

    def with_terms(self, place: int, terms: Terms) -> Self:
        each = [channel.terms for channel in self.channels]
        each[place] = terms
        return replace(self, disturbance=each)

    def on_share(self, share: float) -> tuple[str, Self] | None:
        what = "slope vertices" if self.slope_vertices else "rules"
        matrices = np.array(self.slope_vertices or self.model.A)
        if len(matrices) < 2:
            return None
        closer = _closer(matrices, share)
        text = f"a smaller domain: {what} {100 * share:.0f} % as far from their mean"
        if self.slope_vertices:
            return text, replace(self, slope_vertices=tuple(closer))
        return text, replace(self, model=replace(self.model, A=closer))


def _closer(matrices: Array, share: float) -> Array:
    """Return matrices at a share of their distances from their mean."""
    middle = matrices.mean(axis=0)
    return np.asarray(middle + share * (matrices - middle))


AnyRequest: TypeAlias = ArmRequest | TSRequest
"""The requests that designs answer."""
