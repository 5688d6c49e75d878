# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Motions that a joint can be moved by: tones of its angle, the torque for them, and their limits.

The link angle is prescribed, q₁ = Σ w(t) aᵢ sin(ωᵢt + φᵢ) with a window w that begins and ends at
rest, and the torque follows from the nominal arm backwards (the link angle is its flat output):

    τ = J₁ q̈₁ + b₁ q̇₁ + mgl sin q₁,   q₂ = q₁ + τ/k,   u = J₂ q̈₂ + b₂ q̇₂ + τ

So the nominal arm starts and ends at rest, and one without gravity does not drift: the torque's
momentum and the way it goes have a mean of zero. Other arms do about the same; how far they go is
simulated.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.design.request import NO_LIMIT, ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.identification.joint import UNCERTAINTY
from tsobs_ros.identification.likelihood import WORKERS
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.integrator import ArmMotion, Friction
from tsobs_ros.simulation.plant import Scenario

_ANGLE_SHARE = 0.9
"""Largest angle by the request's domain."""

_BOUND = 0.3
"""Relative error of a number about which the request says nothing."""

_RUBBING = 0.04
"""Largest Coulomb friction of arms that are drawn, by the torque of reference."""

_SLOW_SHARE = 0.4
"""Share of the slow part in the duration."""

_SLOW_PERIODS = 2.0
"""Periods of the slowest tone in the slow part."""

_TONES, _KNOTS = (5, 20), (2, 5)
"""Tones of the slow and the fast part, and frequencies at which their amplitudes are chosen."""

_BEYOND = 2.5
"""Fastest tone by the joint's resonance."""

_EDGE = 0.2
"""Share of a part in which its window rises, and falls."""

_NEAR = 8
"""Arms that go farthest at first, by which motions are made larger or smaller."""

_TAIL = 2.0
"""Time after the end in which the limits must still hold [s]."""


class Limits(NamedTuple):
    """Largest torque [N m], angle [rad] and velocity [rad/s] of link and motor."""

    torque: float
    angle: float
    velocity: float


def limits_of(
    request: ArmRequest, torque: float | None, angle: float | None, velocity: float | None
) -> Limits:
    """Return limits, those that are None from a request.

    Raises:
        ModelError: A limit is out of range.
    """
    known = request.torque_limit
    largest = known if known and known < NO_LIMIT else math.inf
    if torque is None:
        torque = min(0.5 * largest, request.arm.reference_torque)
    if positive("max_torque", torque) > largest:
        raise ModelError(
            f"max_torque: expected at most the request's torque_limit = {largest:g} N m, got "
            f"{torque:g}"
        )
    angle = _ANGLE_SHARE * request.x_max if angle is None else positive("max_angle", angle)
    if angle > request.max_angle:
        raise ModelError(
            f"max_angle: expected at most the request's x_max = {request.x_max:g} rad, got "
            f"{angle:g}"
        )
    velocity = float(request.reach[1]) if velocity is None else velocity
    return Limits(torque, angle, positive("max_velocity", velocity))


class TrialArm(NamedTuple):
    """An arm that a request may mean, and its Coulomb friction at motor and link [N m]."""

    arm: ElasticJointArm
    friction: tuple[float, float] = (0.0, 0.0)


def trial_arms(request: ArmRequest, draws: int, seed: int) -> list[TrialArm]:
    """Return arms within a request's uncertainty: the nominal one, the corners and random ones.

    Args:
        request: Of the nominal arm; ±30 % where it names no uncertainty.
        draws: Number of random ones.
        seed: Of them.
    """
    arm, rng = request.arm, np.random.default_rng((seed, 1))
    names = [name for name in UNCERTAINTY if getattr(arm, name)]
    bounds = [min(request.uncertainty.get(UNCERTAINTY[name], _BOUND), 0.9) for name in names]
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * len(names)), -1).reshape(-1, len(names))
    dampings = {name: getattr(arm, name) for name in ("link_damping", "motor_damping")}
    spreads = {name: request.uncertainty.get(name, _BOUND * b) for name, b in dampings.items()}
    # The least damping lets resonances grow most.
    least = {name: max(0.0, own - spreads[name]) for name, own in dampings.items()}
    slack = replace(arm, **least)
    found = [TrialArm(arm), *(TrialArm(_changed(slack, names, row * bounds)) for row in signs)]
    for place in range(draws):
        drawn = _changed(slack, names, rng.uniform(-1.0, 1.0, len(names)) * bounds)
        friction = (0.0, 0.0)
        if place % 2:
            more = {
                name: each + float(rng.uniform(0.0, 2.0)) * spreads[name]
                for name, each in least.items()
            }
            drawn = replace(drawn, **more)
            rub = _RUBBING * arm.reference_torque * rng.uniform(size=2)
            friction = (float(rub[0]), float(rub[1]))
        found.append(TrialArm(drawn, friction))
    return found


def _changed(arm: ElasticJointArm, names: Sequence[str], errors: Array) -> ElasticJointArm:
    """Return an arm with relative errors; those of inertias are of their inverses."""
    changes = {}
    for name, error in zip(names, errors.tolist(), strict=True):
        inverse = UNCERTAINTY[name].endswith("inverse_inertia")
        changes[name] = getattr(arm, name) * ((1.0 + error) ** (-1.0 if inverse else 1.0))
    return replace(arm, **changes)


def simulated(
    request: ArmRequest,
    trial: TrialArm,
    torque: Array,
    noise: ProcessNoise = ProcessNoise(0.0, 0.0),  # noqa: B008 (it is frozen)
) -> Array:
    """Return the true [q₁, q̇₁, q₂, q̇₂] of an arm from rest under a torque, shape (n, 4)."""
    scenario = Scenario(
        arm=trial.arm,
        friction=Friction(motor_coulomb=trial.friction[0], link_coulomb=trial.friction[1]),
        rate=request.rate,
        process_noise=noise,
        initial_state=(0.0,) * 4,
        initial_spread=(0.0,) * 4,
    )
    inputs, torques = torque.reshape(1, -1, 1).copy(), np.zeros((1, len(torque), 2))
    return np.asarray(ArmMotion(scenario, [0]).move(0, inputs, torques)[0][0])


class _Part(NamedTuple):
    """Consecutive samples, their tones [rad/s], and the angle by the torque of each tone."""

    within: slice
    frequencies: Array
    gains: Array


class Mover:
    """The motions of a request's arm, and the torques for them.

    A motion has a slow part, with many reversals, and a fast one. Its genes are the phases of their
    tones [rad], the logarithms of torques at their knots, and those of the parts' sizes.

    Args:
        request: Of the arm.
        duration: Of a motion [s].
        limits: Of the motions, with a margin.

    Attributes:
        times: Of the samples [s], shape (n,).
        slowest: The slowest tone [rad/s].
        fastest: The fastest one [rad/s].
        steps: Steps of a search in each gene, by those of a phase, shape (genes,).

    Raises:
        ModelError: The duration is too short, or the rate too low.
    """

    def __init__(self, request: ArmRequest, duration: float, limits: Limits) -> None:
        self.request, self.limits, arm = request, limits, request.arm
        count = math.floor(duration * request.rate + 1e-9) + 1
        self.times = np.arange(count) / request.rate
        slow_time = _SLOW_SHARE * duration
        self.slowest = math.tau * _SLOW_PERIODS / slow_time
        # The frequencies at which link and motor swing against each other, and at which the arm
        # swings.
        joint = math.sqrt(arm.stiffness / arm.link_inertia + arm.stiffness / arm.motor_inertia)
        swing = math.sqrt(arm.gravity_torque / (arm.link_inertia + arm.motor_inertia))
        mode = min(swing or math.inf, 0.5 * joint)
        if self.slowest > mode:
            least = math.tau * _SLOW_PERIODS / mode / _SLOW_SHARE
            raise ModelError(
                f"duration: expected at least {math.ceil(10.0 * least) / 10.0:g} s for "
                f"{_SLOW_PERIODS:g} periods of the slowest frequency, {mode:.3g} rad/s, got "
                f"{duration:g}"
            )
        self.fastest = min(_BEYOND * joint, math.tau * request.rate / 8.0)
        if self.fastest < joint:
            raise ModelError(
                f"rate: expected at least {math.ceil(8.0 * joint / math.tau)} Hz for the joint's "
                f"resonance of {joint:.4g} rad/s, got {request.rate:g}"
            )
        middle = round(slow_time * request.rate)
        slow = np.geomspace(self.slowest, 3.0 * self.slowest, _TONES[0])
        fast = np.geomspace(max(self.slowest, 0.5 * mode), self.fastest, _TONES[1])
        self._parts = [
            _Part(slice(0, middle), slow, self._angle_gain(slow)),
            _Part(slice(middle, count), fast, self._angle_gain(fast)),
        ]
        self.steps = np.repeat([1.0, 2.0, 1.0], [sum(_TONES), sum(_KNOTS), len(self._parts)])

    def _angle_gain(self, frequencies: Array) -> Array:
        """Return the link angle by the torque of some damping, shape (tones,) [rad/(N m)]."""
        arm, s = self.request.arm, 1j * frequencies
        link, motor = arm.link_inertia, arm.motor_inertia
        rub_link = arm.link_damping + 0.1 * math.sqrt(link * (arm.stiffness + arm.gravity_torque))
        rub_motor = arm.motor_damping + 0.1 * math.sqrt(motor * arm.stiffness)
        spring = link * s * s + rub_link * s + arm.gravity_torque
        torque = (motor * s * s + rub_motor * s) * (1.0 + spring / arm.stiffness) + spring
        return np.asarray(1.0 / np.abs(torque))

    def random(self, rng: np.random.Generator) -> Array:
        """Return the genes of random phases and equal torques."""
        genes = np.zeros(len(self.steps))
        genes[: sum(_TONES)] = rng.uniform(0.0, math.tau, sum(_TONES))
        return genes

    def angle(self, genes: Array) -> Array:
        """Return the link angle up to a scale; with shares of 0 each part alone is at its limits.

        Args:
            genes: Shape (genes,).
        """
        # A held torque acts half a period later.
        times = self.times + 0.5 / self.request.rate
        total, limits = np.zeros(len(times)), self.limits
        *tones, sizes = np.split(genes, np.cumsum([*_TONES, *_KNOTS]))
        shares = np.exp(sizes - sizes.max()).tolist()
        each = zip(self._parts, tones[:2], tones[2:], shares, strict=True)
        for (within, frequencies, gains), phases, levels, share in each:
            logs = np.log(frequencies)
            knots = np.linspace(logs[0], logs[-1], len(levels))
            amplitudes = gains * np.exp(np.interp(logs, knots, levels))
            waves = np.sin(np.outer(times[within], frequencies) + phases)
            angle = np.zeros(len(times))
            angle[within] = _window(len(waves)) * (waves @ amplitudes)
            angle *= limits.angle / max(float(np.abs(angle).max()), 1e-300)
            velocity = float(np.abs(np.diff(angle)).max()) * self.request.rate
            torque = float(np.abs(self.torque(angle)).max())
            total += angle * share * min(1.0, limits.velocity / velocity, limits.torque / torque)
        return total

    def sine(self, frequency: float) -> Array:
        """Return the link angle of one tone over all the time, up to a scale."""
        wave = np.sin(frequency * (self.times + 0.5 / self.request.rate))
        return np.asarray(_window(len(wave)) * wave)

    def torque(self, angle: Array) -> Array:
        """Return the torque under which the nominal arm moves so, shape (n,) [N m]."""
        arm = self.request.arm
        rate = 1j * np.fft.rfftfreq(len(angle), self.request.period) * math.tau
        rate[np.abs(rate) > 4.0 * self.fastest] = 0.0

        def moved(position: Array, inertia: float, damping: float) -> Array:
            spectrum = np.fft.rfft(position) * (inertia * rate * rate + damping * rate)
            return np.fft.irfft(spectrum, len(position))

        spring = moved(angle, arm.link_inertia, arm.link_damping)
        spring = spring + arm.gravity_torque * np.sin(angle)
        motor = angle + spring / arm.stiffness
        torque = moved(motor, arm.motor_inertia, arm.motor_damping) + spring
        torque[0] = torque[-1] = 0.0
        return np.asarray(torque)

    def reached(self, torque: Array, arms: Sequence[TrialArm]) -> Array:
        """Return torque, angle and velocity that each arm reaches, shape (arms, 3).

        Args:
            torque: Shape (n,) [N m]; the time after its end counts too.
            arms: The arms.
        """
        whole = np.concatenate([torque, np.zeros(round(_TAIL * self.request.rate))])
        with ThreadPoolExecutor(WORKERS) as pool:
            states = pool.map(lambda arm: simulated(self.request, arm, whole), arms)
            largest = np.array([np.abs(each).max(axis=0) for each in states])
        reached = np.maximum(largest[:, :2], largest[:, 2:])
        return np.column_stack([np.full(len(arms), np.abs(torque).max()), reached])

    def scaled(
        self, angle: Array, arms: Sequence[TrialArm], *, scale: float = 1.0, rounds: int = 2
    ) -> tuple[Array, float, Limits]:
        """Return torque, scale and what is reached by a motion as large as the limits allow.

        Args:
            angle: Of the link, up to a scale, shape (n,).
            arms: That must stay within the limits.
            scale: To start from.
            rounds: Number of corrections upwards; it is then made smaller until the limits hold.
        """
        count, near, limits = 0, list(arms), np.array(self.limits)
        while True:
            torque = self.torque(scale * angle)
            each = self.reached(torque, near if count < rounds else arms)
            if count == 0:
                order = np.argsort(-(each / limits).max(axis=1), kind="stable")
                near = [arms[at] for at in order[:_NEAR].tolist()]
            reached = each.max(axis=0)
            ratio = max(float((reached / limits).max()), 1e-9)
            if count >= rounds and ratio <= 1.0:
                return torque, scale, Limits(*reached.tolist())
            scale *= min(max(0.99 / ratio, 0.1), 3.0 if count < rounds else 1.0)
            # Beyond its limit of angle nothing is gained.
            scale = min(scale, self.limits.angle / float(np.abs(angle).max()))
            count += 1


def _window(count: int) -> Array:
    """Return a window that rises from rest and falls to rest, with four smooth derivatives."""
    at = np.arange(count) / max(count - 1, 1)
    rise = np.clip(np.minimum(at, 1.0 - at) / _EDGE, 0.0, 1.0)
    return np.asarray(
        rise**5 * (126.0 + rise * (-420.0 + rise * (540.0 + rise * (-315.0 + rise * 70.0))))
    )
