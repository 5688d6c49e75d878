# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Numbers of a joint that a recording can show, each with its prior, and the joint they make.

A number above zero is estimated by its logarithm, so that it stays there and its prior is a factor;
friction, which may be nothing, too. An offset and delays are estimated as they are. The torque's
gain is fixed unless it is asked for: it scales inertias, stiffness, gravity and friction alike, so
only a number among them that is known could show it.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, meant
from tsobs_ros.design.problem import DisturbanceTerm
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import SIDES
from tsobs_ros.model.torque_path import DIRECT, TorquePath

TORQUE_GAIN = "torque.gain"
OFFSET, DELAY = "torque.offset", "torque.delay"
FRICTION = tuple(f"{side}_friction" for side in SIDES)
"""Coulomb friction at motor and link [N m]."""

_UNITS = {
    "link_inertia": "kg m²",
    "motor_inertia": "kg m²",
    "stiffness": "N m/rad",
    "gravity_torque": "N m",
    "link_damping": "N m s/rad",
    "motor_damping": "N m s/rad",
    "gain": "",
    "offset": "N m",
    "delay": "s",
    "time_constant": "s",
    "frequency": "rad/s",
    "link_friction": "N m",
    "motor_friction": "N m",
    "link": "rad²/s³",
    "motor": "rad²/s³",
}
UNCERTAINTY = {
    "stiffness": "stiffness",
    "gravity_torque": "gravity",
    "link_inertia": "link_inverse_inertia",
    "motor_inertia": "motor_inverse_inertia",
}
"""Numbers of the arm, each with the entry of `uncertainty` that bounds its relative error."""

_UNKNOWN = 0.5
"""1σ of the logarithm of a number of the arm about which the request says nothing: a factor 1.6."""

_NOISE = 2.0
"""1σ of the logarithm of a noise: a factor 7."""

_OFFSET = 0.05
"""1σ of the zero of an angle's sensor [rad]."""

_BOUND_STD = 1.0 / math.sqrt(3.0)
"""1σ of a number that is anywhere within bounds of ±1."""

_SMALL = 0.02
"""A damping or friction that a request leaves out is looked for from this share on: of the torque
of reference at the speed of a swing."""


class Number(NamedTuple):
    """A number of a joint and its prior.

    Attributes:
        name: Its place in the request, e.g. "arm.stiffness" or "motor_angle.measurement_std".
        unit: Its unit, empty for none.
        start: The request's value, or what stands for nothing.
        prior_std: 1σ beforehand: of the logarithm if `positive`.
        positive: Whether its logarithm is estimated.
        from_nothing: Whether the request has 0, so that `start` is only where to look from.
    """

    name: str
    unit: str
    start: float
    prior_std: float
    positive: bool = True
    from_nothing: bool = False

    def value(self, coordinate: float) -> float:
        """Return the number at a distance from the start, in units of `prior_std`."""
        if self.positive:
            return self.start * math.exp(min(max(coordinate * self.prior_std, -60.0), 60.0))
        return self.start + coordinate * self.prior_std

    def deviation(self, coordinate: float, std: float) -> float:
        """Return 1σ of the number from that of the coordinate."""
        scale = self.value(coordinate) if self.positive else 1.0
        return std * self.prior_std * scale


@dataclass(frozen=True)
class Joint:
    """A request with what only a recording needs.

    Attributes:
        request: Of an arm; its torque path and its outputs' delays are those below.
        gain: Torque at the motor by that of the log.
        offset: Torque at the motor without one in the log [N m].
        delay: Of the torque [s]; below 0 it acts before its stamp.
        output_delays: Of the outputs [s].
        output_offsets: Of the outputs (rad, rad/s): what they show at 0.
        friction: Coulomb friction at motor and link [N m].
    """

    request: ArmRequest
    gain: float = 1.0
    offset: float = 0.0
    delay: float = 0.0
    output_delays: tuple[float, ...] = ()
    output_offsets: tuple[float, ...] = ()
    friction: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, request: ArmRequest) -> "Joint":
        """Return a request's joint, without friction."""
        path, sensors = request.torque, request.sensors
        direct = tuple(replace(output, delay=0.0) for output in request.outputs)
        return cls(
            replace(request, torque=DIRECT, outputs=direct),
            path.gain,
            path.offset,
            path.delay,
            tuple(output.delay for output in sensors),
            (0.0,) * len(sensors),
        )

    def with_path(self, shown: Collection[str]) -> ArmRequest:
        """Return the request with the torque's path and the outputs' delays.

        Args:
            shown: Names of the numbers that are surely not 0; others of the path are left out.
        """
        delays = [
            delay if f"{output.measures}.delay" in shown else 0.0
            for output, delay in zip(self.request.sensors, self.output_delays, strict=True)
        ]
        # What counts is when an output is measured after the torque was commanded.
        late = max(0.0, -min(delays))
        delay = self.delay if DELAY in shown else 0.0
        path = TorquePath(
            _rounded(self.gain),
            _rounded(self.offset) if OFFSET in shown else 0.0,
            _rounded(max(0.0, delay - late)),
        )
        outputs = tuple(
            replace(output, delay=_rounded(own + late))
            for output, own in zip(self.request.outputs, delays, strict=False)
        )
        return replace(self.request, torque=path, outputs=outputs)


@dataclass(frozen=True)
class Unknowns:
    """The numbers that are estimated, and the joint that they change.

    Attributes:
        joint: At the start.
        numbers: Those that are estimated.
    """

    joint: Joint
    numbers: tuple[Number, ...]

    @classmethod
    def of(cls, request: ArmRequest, free: Sequence[str] = ()) -> "Unknowns":
        """Return the unknown numbers of a request.

        Args:
            request: Of an arm.
            free: Names of the numbers to estimate, or beginnings of them; all but the torque's gain
                if empty.

        Raises:
            ModelError: A name is unknown.
        """
        known = {number.name: number for number in numbers_of(request)}
        for name in free:
            if not any(_names(name, each) for each in known):
                raise ModelError(
                    f"free: expected some of {', '.join(known)}, got {name!r}{meant(name, known)}"
                )
        chosen = [
            number
            for name, number in known.items()
            if (any(_names(each, name) for each in free) if free else name != TORQUE_GAIN)
        ]
        return cls(Joint.of(request), tuple(chosen))

    @property
    def count(self) -> int:
        """How many they are."""
        return len(self.numbers)

    def without(self, name: str) -> "Unknowns":
        """Return all but one of them."""
        return replace(self, numbers=tuple(each for each in self.numbers if each.name != name))

    def noises(self) -> "Unknowns":
        """Return those of noises and disturbances, which are no properties of arm and drive."""
        own = ("arm.", "torque.", *FRICTION)
        chosen = [each for each in self.numbers if not each.name.startswith(own)]
        ends = (".delay", ".offset")
        return replace(self, numbers=tuple(n for n in chosen if not n.name.endswith(ends)))

    def values(self, coordinates: Array) -> dict[str, float]:
        """Return the numbers by their names, from distances in units of their priors."""
        each = zip(self.numbers, coordinates.tolist(), strict=True)
        return {number.name: number.value(at) for number, at in each}

    def at(self, coordinates: Array) -> Joint:
        """Return the joint with these numbers."""
        return with_values(self.joint, self.values(coordinates))


def with_values(joint: Joint, values: Mapping[str, float]) -> Joint:
    """Return a joint with some numbers changed, by their names."""
    groups: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        group, _, rest = name.partition(".")
        groups.setdefault(group, {})[rest] = value
    request = joint.request
    outputs, delays, offsets = [], [], []
    for output, delay, offset in zip(
        request.sensors, joint.output_delays, joint.output_offsets, strict=True
    ):
        own = groups.get(output.measures, {})
        delays.append(own.get("delay", delay))
        offsets.append(own.get("offset", offset))
        std = own.get("measurement_std", output.measurement_std)
        terms = _terms_with(output.disturbance, own, "disturbance.")
        outputs.append(replace(output, measurement_std=std, disturbance=terms))
    disturbed = {
        side: _terms_with(
            getattr(request.torque_disturbance, side),
            groups.get("torque_disturbance", {}),
            f"{side}.",
        )
        for side in SIDES
    }
    changed = replace(
        request,
        arm=replace(request.arm, **groups.get("arm", {})),
        process_noise=replace(request.process_noise, **groups.get("process_noise", {})),
        torque_disturbance=replace(request.torque_disturbance, **disturbed),
        measurement_std=outputs[0].measurement_std,
        disturbance=outputs[0].disturbance,
        outputs=tuple(outputs) if request.outputs else (),
    )
    motor, link = (
        groups.get(name, {}).get("", known)
        for name, known in zip(FRICTION, joint.friction, strict=True)
    )
    return replace(
        joint,
        request=changed,
        output_delays=tuple(delays),
        output_offsets=tuple(offsets),
        friction=(motor, link),
        **groups.get("torque", {}),
    )


def _terms_with(
    terms: Sequence[DisturbanceTerm], values: Mapping[str, float], prefix: str
) -> tuple[DisturbanceTerm, ...]:
    """Return terms with the parameters that `values` names as "prefix + place.parameter"."""
    changed = []
    for place, term in enumerate(terms):
        entries: dict[str, Any] = dict(term)
        for key in entries:
            entries[key] = values.get(f"{prefix}{place}.{key}", entries[key])
        changed.append(DisturbanceTerm.from_mapping(entries))
    return tuple(changed)


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _names(prefix: str, name: str) -> bool:
    """Return whether a name is meant: whole, a group, or an entry of the arm."""
    return name == prefix or name.startswith(f"{prefix}.") or name == f"arm.{prefix}"


def numbers_of(request: ArmRequest) -> list[Number]:
    """Return all numbers of a request that can be estimated."""
    arm, found = request.arm, list[Number]()
    speed = float(request.reach[1])
    for name, entry in UNCERTAINTY.items():
        if start := getattr(arm, name):
            std = request.uncertainty.get(entry, _UNKNOWN / _BOUND_STD) * _BOUND_STD
            found.append(Number(f"arm.{name}", _UNITS[name], start, std))
    torque = arm.reference_torque
    for name in ("link_damping", "motor_damping"):
        own = getattr(arm, name)
        start = own or _SMALL * torque / speed
        bound = request.uncertainty.get(name)
        std = math.log1p(bound * _BOUND_STD / start) if bound else 2.0 * _UNKNOWN
        found.append(
            Number(f"arm.{name}", _UNITS[name], start, std if own else _NOISE, True, own == 0.0)
        )
    for name in FRICTION:
        found.append(Number(name, _UNITS[name], _SMALL * torque, _NOISE, True, True))
    path = request.torque
    found.append(Number(TORQUE_GAIN, "", path.gain, _UNKNOWN))
    found.append(Number(OFFSET, "N m", path.offset, 0.1 * torque, False))
    found.append(Number(DELAY, "s", path.delay, 2.0 * request.period, False))
    for side in ("link", "motor"):
        density = getattr(request.process_noise, side)
        size = density or 1e-8 * (torque / arm.link_inertia) ** 2 * request.period
        name = f"process_noise.{side}"
        found.append(Number(name, _UNITS[side], size, _NOISE, True, density == 0.0))
    for place, output in enumerate(request.sensors):
        prefix = output.measures
        unit = "rad" if output.measures.endswith("_angle") else "rad/s"
        found.append(Number(f"{prefix}.measurement_std", unit, output.measurement_std, _NOISE))
        if place and unit == "rad":
            found.append(Number(f"{prefix}.delay", "s", output.delay, 2.0 * request.period, False))
        if unit == "rad" and not output.model.state_count and (place or arm.gravity_torque):
            found.append(Number(f"{prefix}.offset", unit, 0.0, _OFFSET, False))
        found += _of_terms(f"{prefix}.disturbance", output.disturbance, unit)
    for side in SIDES:
        terms = getattr(request.torque_disturbance, side)
        found += _of_terms(f"torque_disturbance.{side}", terms, "N m")
    return found


def _of_terms(prefix: str, terms: Sequence[DisturbanceTerm], unit: str) -> list[Number]:
    """Return the numbers of terms that a recording shows, but for those of its start."""
    found = []
    for place, term in enumerate(terms):
        for key, value in term.items():
            if key == "kind" or key.startswith("initial_") or not value:
                continue
            units = {"density": f"({unit})²/s", "rate_density": f"({unit})²/s³", "std": unit}
            std = 0.1 if key == "frequency" else _NOISE
            name = f"{prefix}.{place}.{key}"
            found.append(Number(name, units.get(key, _UNITS.get(key, "")), float(value), std))
    return found


def delayed(torque: Array, durations: Array, delay: float) -> Array:
    """Return the mean over each step of a held torque that acts later.

    Args:
        torque: Held from each sample to the next [N m], shape (n,).
        durations: From each sample to the next [s], shape (n,).
        delay: By so much it acts later [s]; it may be below 0.
    """
    if delay == 0.0:
        return torque
    times = np.concatenate([[0.0], np.cumsum(durations)])
    sums = np.concatenate([[0.0], np.cumsum(torque * durations)])
    at = times - delay
    integral = np.interp(at, times, sums)
    # Before the first sample and behind the last one the torque is what it is there.
    integral += np.minimum(at - times[0], 0.0) * torque[0]
    integral += np.maximum(at - times[-1], 0.0) * torque[-1]
    return np.asarray(np.diff(integral) / durations)
