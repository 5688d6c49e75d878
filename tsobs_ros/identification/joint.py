# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Numbers of a joint that a recording can show, each with its prior, and the joint they make.

A number above zero is estimated by its logarithm, so that it stays above zero and its prior is a
factor. This includes friction, although it may be zero. Offsets and delays are estimated directly.
The torque's gain is fixed unless it is asked for: it scales inertias, stiffness, gravity and
friction alike, so a recording shows it only if one of these is known.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, expect
from tsobs_ros.design.file import arm_entries
from tsobs_ros.design.request import ArmRequest, TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import SIDES, TorquePath
from tsobs_ros.model.disturbance import DisturbanceTerm
from tsobs_ros.schema import decode

TORQUE_GAIN, OFFSET, DELAY = "torque.gain", "torque.offset", "torque.delay"
FRICTION = tuple(f"{side}_friction" for side in SIDES)
"""Coulomb friction at motor and link [N m]."""

_UNITS = {
    "link_inertia": "kg m²", "motor_inertia": "kg m²", "stiffness": "N m/rad",
    "gravity_torque": "N m", "link_damping": "N m s/rad", "motor_damping": "N m s/rad",
    "link_friction": "N m", "motor_friction": "N m", "offset": "N m", "delay": "s",
    "time_constant": "s", "frequency": "rad/s", "link": "rad²/s³", "motor": "rad²/s³",
}  # fmt: skip
"""Units by the last part of a number's name."""

UNCERTAINTY = {
    "stiffness": "stiffness",
    "gravity_torque": "gravity",
    "link_inertia": "link_inverse_inertia",
    "motor_inertia": "motor_inverse_inertia",
}
"""Numbers of the arm, each with the entry of `uncertainty` that bounds its relative error."""

_UNKNOWN, _NOISE, _ZERO = 0.5, 2.0, 0.05
"""1σ of the logarithm of an arm's number about which the request says nothing (a factor of 1.6),
and of a noise (a factor of 7); 1σ of the zero of an angle's sensor [rad]."""

_BOUND_STD = 1.0 / math.sqrt(3.0)
"""1σ of a number that is uniformly distributed within ±1."""

_SMALL = 0.02
"""Start value of a damping or friction that a request omits, as a share of the reference torque;
for a damping, at the speed of a swing."""


class Found(NamedTuple):
    """A number that recordings show, or would show.

    Attributes:
        name: Its place in the request, e.g. "arm.stiffness" or "motor_angle.measurement_std".
        unit: Its unit, empty for none.
        before: The request's value.
        value: The likeliest value.
        std: Its 1σ.
        prior_std: 1σ of the value without the recordings.
    """

    name: str
    unit: str
    before: float
    value: float
    std: float
    prior_std: float

    @property
    def seen(self) -> bool:
        """Whether the recordings show it: its 1σ is at most half of the prior's."""
        return self.std <= 0.5 * self.prior_std

    @property
    def significant(self) -> bool:
        """Whether it differs from 0 by more than 3σ."""
        return abs(self.value) > 3.0 * self.std


class Number(NamedTuple):
    """A number of a joint and its prior.

    Attributes:
        name, unit, before: As in `Found`.
        prior_std: 1σ of the prior, of the logarithm if `positive`.
        start: Start of the search: the request's value, or a small one in place of zero.
        positive: Whether its logarithm is estimated.
    """

    name: str
    unit: str
    before: float
    prior_std: float
    start: float
    positive: bool = True

    def value(self, coordinate: float) -> float:
        """Return the number at a distance from the start, in units of `prior_std`."""
        if self.positive:
            return self.start * math.exp(min(max(coordinate * self.prior_std, -60.0), 60.0))
        return self.start + coordinate * self.prior_std

    def found(self, coordinate: float, std: float) -> Found:
        """Return the number as found at a coordinate with its 1σ."""
        value = self.value(coordinate)
        unit = self.prior_std * (value if self.positive else 1.0)
        return Found(self.name, self.unit, self.before, value, std * unit, unit)


def found_named(numbers: Sequence[Found], name: str) -> Found:
    """Return the number of a name, which may omit `arm.`; unknown names raise `KeyError`."""
    by_name = {each.name: each for each in numbers}
    return by_name.get(name) or by_name[f"arm.{name}"]


def table(numbers: Sequence[Found], columns: Mapping[str, str]) -> list[str]:
    """Return lines of a table of numbers; its three columns are fields of `Found` by title."""
    width = max(len(each.name) for each in numbers)
    line = f"{{:{width}}}  {{:>10}}  {{:>10}}  {{:>9}}  {{}}".format
    lines = [line("number", *columns, "unit")]
    for each in numbers:
        values = [(getattr(each, field), field.endswith("std")) for field in columns.values()]
        cells = [f"{value:{'.2g' if is_std else '.4g'}}" for value, is_std in values]
        lines.append(line(each.name, *cells, each.unit) + "   not shown" * (not each.seen))
    return lines


@dataclass(frozen=True)
class Joint:
    """A request with the numbers that only a recording needs.

    Attributes:
        request: Request of an arm, without the path of the torque and the outputs' delays.
        extras: The other numbers, by name: the torque's gain, offset [N m] and delay [s], below 0
            if it acts before its stamp; Coulomb friction [N m]; of each output its delay [s] and
            its offset, which is its value at 0 (rad, rad/s).
    """

    request: ArmRequest
    extras: Mapping[str, float]

    @classmethod
    def of(cls, request: ArmRequest) -> "Joint":
        """Return a request's joint, without friction."""
        path, extras = request.torque, dict.fromkeys(FRICTION, 0.0)
        extras |= {TORQUE_GAIN: path.gain, OFFSET: path.offset, DELAY: path.delay}
        for output in request.sensors:
            extras |= {f"{output.measures}.delay": output.delay, f"{output.measures}.offset": 0.0}
        return cls(request.at_rate(request.rate), extras)

    @property
    def friction(self) -> list[float]:
        """Coulomb friction at motor and link [N m]."""
        return [self.extras[name] for name in FRICTION]

    def of_outputs(self, key: str) -> list[float]:
        """Return the "delay" or "offset" of each output."""
        return [self.extras[f"{name}.{key}"] for name in self.request.output_names]

    def with_path(self, shown: Collection[str]) -> ArmRequest:
        """Return the request with the torque's path and the outputs' delays, if they are shown."""
        kept = {name: value if name in shown else 0.0 for name, value in self.extras.items()}
        delays = [kept[f"{name}.delay"] for name in self.request.output_names]
        # Only the time from the command of a torque to the measurement of an output counts.
        late = max(0.0, -min(delays))
        path = self.extras[TORQUE_GAIN], kept[OFFSET], max(0.0, kept[DELAY] - late)
        outputs = self.request.outputs and [
            replace(output, delay=_rounded(own + late))
            for output, own in zip(self.request.outputs, delays, strict=True)
        ]
        return replace(self.request, torque=TorquePath(*map(_rounded, path)), outputs=outputs)


@dataclass(frozen=True)
class Unknowns:
    """The numbers that are estimated, and the joint at their start."""

    joint: Joint
    numbers: tuple[Number, ...]

    @classmethod
    def of(cls, request: ArmRequest, free: Sequence[str] = ()) -> "Unknowns":
        """Return the unknown numbers of a request: all but the torque's gain, or those with names
        or beginnings of names in `free`.

        Raises:
            ModelError: A name is unknown.
        """
        known = {number.name: number for number in numbers_of(request)}
        chosen = set() if free else known.keys() - {TORQUE_GAIN}
        for name in free:
            named = {n for n in known if n in (name, f"arm.{name}") or n.startswith(f"{name}.")}
            if not named:
                raise ModelError(f"free: expected some of {', '.join(known)}, got {name!r}")
            chosen |= named
        return cls(Joint.of(request), tuple(known[name] for name in known if name in chosen))

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return len(self.numbers)

    def without(self, *names: str) -> "Unknowns":
        """Return all unknowns except those with some names."""
        return replace(self, numbers=tuple(one for one in self.numbers if one.name not in names))

    def noises(self) -> "Unknowns":
        """Return the unknowns of noises and disturbances, without those of arm and drive."""
        own, ends = ("arm.", "torque.", *FRICTION), (".delay", ".offset")
        names = [each.name for each in self.numbers]
        return self.without(*(n for n in names if n.startswith(own) or n.endswith(ends)))

    def at(self, coordinates: Array) -> Joint:
        """Return the joint with the numbers at distances in units of their priors, shape (k,)."""
        each = zip(self.numbers, coordinates.tolist(), strict=True)
        return with_values(self.joint, {number.name: number.value(at) for number, at in each})


def with_values(joint: Joint, values: Mapping[str, float]) -> Joint:
    """Return a joint with some numbers changed, by their places in the request's file."""
    request, entries = joint.request, arm_entries(joint.request)
    places = dict(zip(request.output_names, entries.get("outputs", [entries]), strict=True))
    for name in values.keys() - joint.extras.keys():
        *groups, last = name.split(".")
        place: Any = {**entries, **places}
        for group in groups:
            place = place[int(group) if isinstance(place, list) else group]
        place[last] = values[name]
    extras = {name: values.get(name, own) for name, own in joint.extras.items()}
    return Joint(decode(entries, ArmRequest), extras)


def require_arm(request: object) -> None:
    """Refuse a request that is not for an arm."""
    if isinstance(request, TSRequest):
        raise ModelError("request: expected one for an arm; a T-S system has no numbers to fit")
    expect("request", request, ArmRequest, "an ArmRequest, as of load_request")


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def numbers_of(request: ArmRequest) -> list[Number]:
    """Return all numbers of a request that can be estimated."""
    arm, period, found = request.arm, request.period, list[Number]()
    torque, speed = arm.reference_torque, float(request.reach[1])

    def add(
        name: str, value: float, std: float, nothing: float = 0.0, unit: str = "", **kind: bool
    ) -> None:
        unit = unit or _UNITS.get(name.rpartition(".")[2], "")
        found.append(Number(name, unit, value, std, value or nothing, **kind))

    def add_terms(prefix: str, terms: Sequence[DisturbanceTerm], unit: str) -> None:
        units = {"density": f"({unit})²/s", "rate_density": f"({unit})²/s³", "std": unit}
        for place, term in enumerate(terms):
            for key, value in term.items():
                # A recording does not show initial values.
                if key != "kind" and not key.startswith("initial_") and value:
                    std = 0.1 if key == "frequency" else _NOISE
                    add(f"{prefix}.{place}.{key}", float(value), std, unit=units.get(key, ""))

    def relative_std(entry: str) -> float:
        return request.uncertainty.get(entry, _UNKNOWN / _BOUND_STD) * _BOUND_STD

    for name, entry in UNCERTAINTY.items():
        if start := getattr(arm, name):
            add(f"arm.{name}", start, relative_std(entry))
    for name in ("link_damping", "motor_damping"):
        own, bound = getattr(arm, name), request.uncertainty.get(name)
        std = math.log1p(bound * _BOUND_STD / own) if bound and own else 2.0 * _UNKNOWN
        add(f"arm.{name}", own, std if own else _NOISE, _SMALL * torque / speed)
    for name in FRICTION:
        add(name, 0.0, _NOISE, _SMALL * torque)
    add(TORQUE_GAIN, request.torque.gain, relative_std("torque_gain"))
    add(OFFSET, request.torque.offset, 0.1 * torque, positive=False)
    add(DELAY, request.torque.delay, 2.0 * period, positive=False)
    for side in ("link", "motor"):
        small = 1e-8 * (torque / arm.link_inertia) ** 2 * period
        add(f"process_noise.{side}", getattr(request.process_noise, side), _NOISE, small)
    for place, output in enumerate(request.sensors):
        name, unit = output.measures, "rad" if output.measures.endswith("_angle") else "rad/s"
        add(f"{name}.measurement_std", output.measurement_std, _NOISE, unit=unit)
        if place and unit == "rad":
            add(f"{name}.delay", output.delay, 2.0 * period, positive=False)
        if unit == "rad" and not output.model.state_count and (place or arm.gravity_torque):
            add(f"{name}.offset", 0.0, _ZERO, unit=unit, positive=False)
        add_terms(f"{name}.disturbance", output.disturbance, unit)
    for side in SIDES:
        add_terms(f"torque_disturbance.{side}", getattr(request.torque_disturbance, side), "N m")
    return found


def delayed(torque: Array, durations: Array, delay: float) -> Array:
    """Return the mean over each step of a held torque that acts later (or earlier) by a delay."""
    if delay == 0.0:
        return torque
    # Before the first sample and after the last one the torque is constant.
    steps, u = np.pad(durations, 1, constant_values=abs(delay)), np.pad(torque, 1, mode="edge")
    times = np.concatenate([[0.0], np.cumsum(steps)])
    sums = np.concatenate([[0.0], np.cumsum(u * steps)])
    return np.asarray(np.diff(np.interp(times[1:-1] - delay, times, sums)) / durations)
