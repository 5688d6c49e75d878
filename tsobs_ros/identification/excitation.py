# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Excitation: a torque motion within limits that shows the wanted numbers of a joint.

The link angle is a multisine q₁ = w(t) Σ aᵢ sin(ωᵢt + φᵢ) with a window w that begins and ends at
rest. The torque follows from the inverse of the nominal arm (the link angle is its flat output):

    τ = J₁ q̈₁ + b₁ q̇₁ + mgl sin q₁,   q₂ = q₁ + τ/k,   u = J₂ q̈₂ + b₂ q̇₂ + τ

So the nominal arm starts and ends at rest, and an arm without gravity does not drift. The search
draws motions with random phases and amplitudes, and takes the one whose recording would give the
most information. Each motion is as large as the limits allow, in simulations of the nominal arm and
of others within the request's uncertainty.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.design.request import NO_LIMIT, ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.files import require_new, write_whole
from tsobs_ros.identification.joint import (
    UNCERTAINTY,
    Found,
    Unknowns,
    found_named,
    require_arm,
    table,
)
from tsobs_ros.identification.likelihood import WORKERS, Likelihood, Recording
from tsobs_ros.model.arm import QUANTITIES
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.plant import ArmMotion, Friction, Scenario

_MARGIN, _ANGLE_SHARE = 0.15, 0.9
"""Share of the limits of angle and velocity that the trial arms leave free, and default largest
angle relative to the request's domain."""

_DRAWS, _TRIED = 64, slice(0, 17, 2)
"""Number of random arms within the uncertainty, and the arms with which candidates are simulated:
the nominal one and every second corner."""

_BOUND, _RUBBING = 0.3, 0.04
"""Relative error of a number about which the request says nothing, and largest Coulomb friction of
random arms relative to the reference torque."""

_LONGEST = 600.0
"""Largest duration [s]."""

_TONES, _KNOTS, _PERIODS, _BEYOND = 24, 6, 3.0, 2.5
"""Number of tones, and of frequencies at which their amplitudes are drawn; periods of the slowest
tone in the motion; fastest tone relative to the joint's resonance."""

_FIRST, _ROUNDS, _SMALLEST = 0.3, 3, 1e-9
"""Initial largest link angle of a motion [rad], the number of times that the motion is made larger
or smaller, and an angle that no sensor shows [rad]."""

_EDGE, _TAIL = 0.1, 2.0
"""Share of the motion in which its window rises, or falls; time after it with limits [s]."""


class Limits(NamedTuple):
    """Largest torque [N m], angle [rad] and velocity [rad/s] of link and motor."""

    torque: float
    angle: float
    velocity: float

    def __str__(self) -> str:
        each = zip(self, ("N m", "rad", "rad/s"), strict=True)
        return ", ".join(f"{value:.4g} {unit}" for value, unit in each if value < math.inf)


@dataclass(frozen=True)
class Excitation:
    """A torque motion, and the numbers that it shows.

    Attributes:
        request: Request of the nominal arm.
        time: Since the start [s], shape (n,).
        torque: Commands, held from each sample to the next [N m], shape (n,).
        angles: Angles of link and motor of the nominal arm [rad], shape (n, 2).
        numbers: The wanted numbers, with the accuracy that a fit of a recording would have.
        limits: Allowed torque, angle and velocity of link and motor.
        worst: Largest values that the arms within the request's uncertainty reach.
        seed: Seed of the search.
    """

    request: ArmRequest
    time: Array
    torque: Array
    angles: Array
    numbers: tuple[Found, ...]
    limits: Limits
    worst: Limits
    seed: int

    def number(self, name: str) -> Found:
        """Return a wanted number with its expected accuracy; other names raise `KeyError`."""
        return found_named(self.numbers, name)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Names of the wanted numbers that the motion does not show."""
        return tuple(each.name for each in self.numbers if not each.seen)

    def summary(self) -> dict[str, Any]:
        """Return the expected result as plain data."""
        return {
            "duration": float(self.time[-1]),
            "samples": len(self.time),
            "seed": self.seed,
            "limits": self.limits._asdict(),
            "worst": self.worst._asdict(),
            "numbers": [each._asdict() | {"seen": each.seen} for each in self.numbers],
            "unseen": list(self.unseen),
        }

    def __str__(self) -> str:
        columns = {"value": "before", "before": "prior_std", "after": "std"}
        return "\n".join(
            [
                *table(self.numbers, columns),
                "before, after: expected 1 sigma before and after a recording of this motion",
                f"limits: {self.limits}; arms within the uncertainty reach {self.worst}, "
                "with friction less",
                f"{len(self.time):,} samples, {self.time[-1]:g} s",
            ]
        )

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the motion as CSV: time, torque, and the nominal arm's angles.

        Raises:
            OutputError: The file cannot be written, or exists and may not be replaced.
        """
        require_new([Path(path)], force=force)
        rows = np.column_stack([self.time, self.torque, self.angles]).tolist()
        lines = (f"{t:.9g},{u:.9g},{link:.6g},{motor:.6g}\n" for t, u, link, motor in rows)
        write_whole(path, _HEADER.format(self, self.time[-1]) + "".join(lines), force=force)


_HEADER = """\
# A motion of `tsobs excite`: {1:g} s at {0.request.rate:g} Hz, seed {0.seed}.
# torque: command, held from its time to the next line's; 0 after the last one.
# expected_link_angle, expected_motor_angle: of the request's arm, from rest at 0.
# Limits of link and motor: {0.limits}.
# Arms within the request's uncertainty reach {0.worst}.
time [s],torque [N m],expected_link_angle [rad],expected_motor_angle [rad]
"""


class _Motions:
    """The motions of a request's arm within limits, and the accuracy that recordings would give."""

    def __init__(
        self, request: ArmRequest, duration: float, limits: Limits, free: Sequence[str], seed: int
    ) -> None:
        self.request, self.limits, arm = request, limits, request.arm
        self.times = np.arange(math.floor(duration * request.rate + 1e-9) + 1) / request.rate
        slowest = math.tau * _PERIODS / duration
        # Link and motor swing against each other at `joint`, the whole arm at `swing`.
        joint = math.sqrt(arm.stiffness / arm.link_inertia + arm.stiffness / arm.motor_inertia)
        swing = math.sqrt(arm.gravity_torque / (arm.link_inertia + arm.motor_inertia))
        mode, fastest = min(swing or math.inf, 0.5 * joint), math.tau * request.rate / 8.0
        if slowest > mode:
            raise ModelError(
                f"duration: expected at least {math.tau * _PERIODS / mode:.3g} s for {_PERIODS:g} "
                f"periods of the slowest frequency, {mode:.3g} rad/s, got {duration:g}"
            )
        if fastest < joint:
            raise ModelError(
                f"rate: expected at least {math.ceil(8.0 * joint / math.tau)} Hz for the joint's "
                f"resonance of {joint:.4g} rad/s, got {request.rate:g}"
            )
        self.frequencies = np.geomspace(slowest, min(_BEYOND * joint, fastest), _TONES)
        # Some damping, so that no tone is lost at a resonance.
        s, k = 1j * self.frequencies, arm.stiffness
        rub_link = arm.link_damping + 0.1 * math.sqrt(arm.link_inertia * (k + arm.gravity_torque))
        rub_motor = arm.motor_damping + 0.1 * math.sqrt(arm.motor_inertia * k)
        spring = arm.link_inertia * s * s + rub_link * s + arm.gravity_torque
        torque = (arm.motor_inertia * s * s + rub_motor * s) * (1.0 + spring / k) + spring
        self._gains = 1.0 / np.abs(torque)
        at = self.times / max(self.times[-1], 1e-9)
        rise = np.clip(np.minimum(at, 1.0 - at) / _EDGE, 0.0, 1.0)
        # The first four derivatives are continuous.
        self._window = rise**5 * (126 + rise * (-420 + rise * (540 + rise * (-315 + rise * 70))))

        self.unknowns = unknowns = Unknowns.of(request, free)
        self._measured = [QUANTITIES.index(each.measures) for each in request.sensors]
        noise = np.random.default_rng((seed, 2)).standard_normal
        self._noise = noise((len(self.times), len(request.sensors))) * request.output_std
        prior = unknowns.at(np.zeros(unknowns.count))
        rubbing = _scenario(prior.request, prior.friction)
        self._recorded = replace(rubbing, process_noise=request.process_noise)
        # Any motion shows the noises.
        noises = unknowns.noises().numbers
        moved = [each not in noises for each in unknowns.numbers]
        self.wanted = np.array(moved) if any(moved) else np.full(unknowns.count, True)

    def drawn(self, rng: np.random.Generator) -> Array:
        """Return the link angle of a random motion, up to a scale, shape (n,)."""
        phases = rng.uniform(0.0, math.tau, _TONES)
        knots, levels = np.linspace(0.0, _TONES - 1.0, _KNOTS), rng.standard_normal(_KNOTS)
        amplitudes = self._gains * np.exp(np.interp(np.arange(_TONES), knots, levels))
        # A held torque acts half a period later.
        times = self.times + 0.5 * self.request.period
        waves = np.sin(np.outer(times, self.frequencies) + phases)
        angle = self._window * (waves @ amplitudes)
        return np.asarray(angle / np.abs(angle).max())

    def torque(self, angle: Array) -> Array:
        """Return the torque that gives the nominal arm this link angle, shape (n,) [N m]."""
        arm = self.request.arm
        rate = 1j * np.fft.rfftfreq(len(angle), self.request.period) * math.tau
        rate[np.abs(rate) > 4.0 * self.frequencies[-1]] = 0.0

        def moved(position: Array, inertia: float, damping: float) -> Array:
            spectrum = np.fft.rfft(position) * (inertia * rate * rate + damping * rate)
            return np.fft.irfft(spectrum, len(position))

        spring = moved(angle, arm.link_inertia, arm.link_damping)
        spring = spring + arm.gravity_torque * np.sin(angle)
        motor = angle + spring / arm.stiffness
        torque = moved(motor, arm.motor_inertia, arm.motor_damping) + spring
        torque[0] = torque[-1] = 0.0
        return np.asarray(torque)

    def reached(self, torque: Array, arms: Sequence[Scenario]) -> Array:
        """Return the largest torque, angle and velocity of some arms, shape (3,)."""
        whole = np.concatenate([torque, np.zeros(round(_TAIL * self.request.rate))])
        with ThreadPoolExecutor(WORKERS) as pool:
            states = pool.map(lambda arm: simulated(arm, whole), arms)
            largest = np.max([np.abs(each).max(axis=0) for each in states], axis=0)
        return np.append(np.abs(torque).max(), np.maximum(largest[:2], largest[2:]))

    def scaled(self, angle: Array, arms: Sequence[Scenario]) -> tuple[Array, Limits]:
        """Return the torque of a motion as large as the limits allow for all arms, and its reach.

        It is made larger or smaller for some rounds, then only smaller until the limits hold.
        """
        scale = _FIRST
        for place in count():
            torque = self.torque(scale * angle)
            reached = self.reached(torque, arms)
            if np.isnan(reached).any():
                raise ModelError(
                    f"arm: expected one whose simulated motion is finite, got {self.request.arm}"
                )
            ratio = max(float((reached / self.limits).max()), 1e-9)
            if place >= _ROUNDS and ratio <= 1.0:
                break
            scale *= min(max(0.99 / ratio, 0.1), 3.0 if place < _ROUNDS else 1.0)
            # A scale beyond the limit of the angle is never needed.
            scale = min(scale, self.limits.angle)
            if scale < _SMALLEST:
                raise ModelError(
                    f"limits: expected room for a motion of {_SMALLEST:g} rad, which --max-torque "
                    f"or another limit prevents, got {self.limits}"
                )
        return torque, Limits(*reached.tolist())

    def std(self, torque: Array) -> Array:
        """Return the 1σ of the numbers after a recording, relative to that before, shape (k,)."""
        y = simulated(self._recorded, torque)[:, self._measured] + self._noise
        durations, k = np.full(len(torque), self.request.period), self.unknowns.count
        recording = Recording(self.times, durations, y, torque)
        information = Likelihood(self.unknowns, recording).evaluate(np.zeros(k)).information
        return np.sqrt(np.diag(np.linalg.inv(information + np.eye(k))))


def excite(
    request: ArmRequest,
    *,
    duration: float = 30.0,
    max_torque: float | None = None,
    max_angle: float | None = None,
    max_velocity: float | None = None,
    free: Sequence[str] = (),
    seed: int = 0,
    candidates: int | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> Excitation:
    """Return a torque motion within limits that shows a joint's numbers to `fit`.

    The limits hold in simulation, with a margin, for the request's arm and for others within its
    `uncertainty` (±30 % for numbers that it does not name), from rest at 0.

    Args:
        request: An arm's request, e.g. with the numbers of data sheets.
        duration: Duration of the motion [s].
        max_torque: Largest commanded torque [N m]; half of the request's `torque_limit`, at most
            the gravity torque, or 10 rad/s² of both inertias without gravity.
        max_angle: Largest angle of link and motor [rad]; 0.9 of the request's `x_max`.
        max_velocity: Largest velocity of both [rad/s]; none.
        free: Names of the wanted numbers, as in `fit`; all but the torque's gain if empty.
        seed: Seed of the search; the same seed gives the same motion.
        candidates: Number of motions that the search tries; if None, 120, fewer for long ones.
        advance: Called with the number of motions that were tried, for progress.

    Raises:
        ModelError: The request is not for an arm, a name is unknown, a limit is beyond the
            request's, or the duration is too short for the slowest frequency.

    >>> import tsobs_ros as ts
    >>> motion = ts.excite(ts.ArmRequest(rate=50.0), duration=20.0, candidates=1)
    >>> motion.number("stiffness").std < motion.number("stiffness").prior_std
    True
    >>> motion.time.shape, bool(abs(motion.torque).max() <= motion.limits.torque)
    ((1001,), True)
    """
    require_arm(request)
    if positive("duration", duration) > _LONGEST:
        raise ModelError(f"duration: expected at most {_LONGEST:g} s, got {duration:g}")
    limits, path = _limits(request, max_torque, max_angle, max_velocity), request.torque
    at_motor = path.gain * limits.torque - abs(path.offset)
    if at_motor <= 0.0:
        raise ModelError(
            f"max_torque: expected more than the offset of the request's torque takes, "
            f"{abs(path.offset) / path.gain:g} N m, got {limits.torque:g}"
        )
    if candidates is None:
        candidates = round(min(120.0, max(20.0, 3600.0 / duration)))
    elif candidates < 1:
        raise ModelError(f"candidates: expected at least 1, got {candidates}")
    # The accuracy of a fit does not depend on the values of delays, gain and offset.
    known, request = request, request.at_rate(request.rate)
    inner = Limits(at_motor, *((1.0 - _MARGIN) * each for each in limits[1:]))
    motions = _Motions(request, duration, inner, free, seed)
    arms = trial_arms(request, _DRAWS, seed)
    rng = np.random.default_rng((seed, 0))

    def unknown(angle: Array) -> float:
        torque, _ = motions.scaled(angle, arms[_TRIED])
        advance(1)
        return float(np.log(motions.std(torque)[motions.wanted]).mean())

    angle = min((motions.drawn(rng) for _ in range(candidates)), key=unknown)
    torque, worst = motions.scaled(angle, arms)
    commands = (torque - path.offset) / path.gain
    pairs = zip(motions.unknowns.numbers, motions.std(torque).tolist(), strict=True)
    return Excitation(
        request=known,
        time=motions.times,
        torque=commands,
        angles=simulated(arms[0], torque)[:, ::2],
        numbers=tuple(number.found(0.0, std) for number, std in pairs),
        limits=limits,
        worst=worst._replace(torque=float(np.abs(commands).max())),
        seed=seed,
    )


def _limits(
    request: ArmRequest, torque: float | None, angle: float | None, velocity: float | None
) -> Limits:
    """Return limits, with the request's in place of those that are None."""
    known = request.torque_limit
    largest = known if known and known < NO_LIMIT else math.inf
    found = Limits(
        min(0.5 * largest, request.arm.reference_torque) if torque is None else torque,
        _ANGLE_SHARE * request.x_max if angle is None else angle,
        math.inf if velocity is None else positive("max_velocity", velocity),
    )
    positive("max_torque", found.torque)
    positive("max_angle", found.angle)
    for name, value, source, limit in (
        ("max_torque", found.torque, "torque_limit", largest),
        ("max_angle", found.angle, "x_max", request.max_angle),
    ):
        if value > limit:
            raise ModelError(
                f"{name}: expected at most the request's {source} = {limit:g}, got {value:g}"
            )
    return found


def _scenario(request: ArmRequest, friction: Sequence[float] = (0.0, 0.0)) -> Scenario:
    """Return a simulation from rest, with Coulomb friction at motor and link [N m]."""
    return Scenario(
        arm=request.arm,
        friction=Friction(motor_coulomb=friction[0], link_coulomb=friction[1]),
        rate=request.rate,
        process_noise=ProcessNoise(0.0, 0.0),
        initial_state=(0.0,) * 4,
        initial_spread=(0.0,) * 4,
    )


def simulated(scenario: Scenario, torque: Array) -> Array:
    """Return the true [q₁, q̇₁, q₂, q̇₂] of an arm under a torque, shape (n, 4)."""
    inputs, torques = torque.reshape(1, -1, 1).copy(), np.zeros((1, len(torque), 2))
    return np.asarray(ArmMotion(scenario, [0]).move(0, inputs, torques)[0][0])


def trial_arms(request: ArmRequest, draws: int, seed: int) -> list[Scenario]:
    """Return arms within a request's uncertainty: the nominal one, the corners and random ones.

    Corners have the least damping, with which resonances grow most; random ones also have friction.
    """
    arm, rng = request.arm, np.random.default_rng((seed, 1))
    bounds = {
        name: min(request.uncertainty.get(entry, _BOUND), 0.9)
        for name, entry in UNCERTAINTY.items()
        if getattr(arm, name)
    }
    corners = [(*signs, -1.0, -1.0, 0.0, 0.0) for signs in product((-1.0, 1.0), repeat=len(bounds))]
    drawn = rng.uniform(size=(draws, len(bounds) + 4))
    drawn[:, :-2] = 2.0 * drawn[:, :-2] - 1.0
    found = [_scenario(request)]
    for *errors, link, motor, motor_rub, link_rub in [*corners, *drawn.tolist()]:
        changes = {}
        for (name, bound), error in zip(bounds.items(), errors, strict=True):
            # The errors of inertias are errors of their inverses.
            power = -1.0 if UNCERTAINTY[name].endswith("inverse_inertia") else 1.0
            changes[name] = getattr(arm, name) * (1.0 + error * bound) ** power
        for name, error in (("link_damping", link), ("motor_damping", motor)):
            own = getattr(arm, name)
            changes[name] = max(0.0, own + error * request.uncertainty.get(name, _BOUND * own))
        friction = [_RUBBING * arm.reference_torque * each for each in (motor_rub, link_rub)]
        found.append(_scenario(replace(request, arm=replace(arm, **changes)), friction))
    return found
