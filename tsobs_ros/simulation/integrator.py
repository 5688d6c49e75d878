# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixed-step integration of plants: the true motion that observers are judged by.

The classical fourth-order Runge–Kutta method at 1 ms keeps the undriven arm's energy to 1e-10
over a minute. Its error is far below any noise. Torques may reach an arm's motor late, and angles
may be measured late.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from tsobs_ros.checks import Array, check_each, non_negative
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import QUANTITIES
from tsobs_ros.model.torque_path import TorquePath
from tsobs_ros.simulation.signals import recurs
from tsobs_ros.simulation.streams import RandomStream, Source

if TYPE_CHECKING:
    from tsobs_ros.simulation.plant import Scenario

_LONGEST_SUBSTEP = 1e-3
_ARM = record_type("simulated_arm")
_STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class Friction:
    """Friction of the true arm that the nominal one lacks.

    Coulomb friction is c·sign(q̇), and below 0.01 rad/s it grows linearly from zero.

    Attributes:
        link_viscous: Of the link's bearing [N m s/rad].
        link_coulomb: [N m].
        motor_viscous: Of the motor with its gear [N m s/rad].
        motor_coulomb: [N m].

    Raises:
        ModelError: A number is negative or not finite.
    """

    link_viscous: float = 0.0
    link_coulomb: float = 0.0
    motor_viscous: float = 0.0
    motor_coulomb: float = 0.0

    def __post_init__(self) -> None:
        names = (item.name for item in fields(self))
        check_each(non_negative, self, *names, prefix="friction ")


@dataclass(frozen=True)
class Payload:
    """What the link carries for a time; its speed does not jump as it is put on.

    Attributes:
        link_inertia: Inertia that it adds to the link's [kg m²].
        gravity_torque: Torque that it adds to the one that holds the link horizontal [N m].
        start: From the first sample at this time or later [s].
        duration: How long it is carried [s]; infinite for ever.

    Raises:
        ModelError: A number is negative or not finite.
    """

    link_inertia: float = 0.0
    gravity_torque: float = 0.0
    start: float = 0.0
    duration: float = math.inf

    def __post_init__(self) -> None:
        names = ("link_inertia", "gravity_torque", "start")
        check_each(non_negative, self, *names, prefix="payload ")
        if not self.duration >= 0.0:
            raise ModelError(f"payload duration: expected at least 0 s, got {self.duration!r}")

    @classmethod
    def point(
        cls, mass: float, distance: float, start: float = 0.0, duration: float = math.inf
    ) -> "Payload":
        """Return a mass [kg] at a distance from a horizontal axis [m].

        >>> Payload.point(2.0, 0.5).link_inertia
        0.5
        """
        non_negative("payload mass", mass)
        non_negative("payload distance", distance)
        torque = mass * _STANDARD_GRAVITY * distance
        return cls(mass * distance * distance, torque, start, duration)


class TorqueDelay:
    """The path of a commanded torque to the motor, in every run of a batch.

    Args:
        path: Gain, offset and delay.
        rate: Samples per second [Hz].
    """

    def __init__(self, path: TorquePath, rate: float) -> None:
        self._path = path
        self._whole, self._share = _cut(path.delay, rate)
        self._past: Array | None = None

    def through(self, commands: Array) -> Array:
        """Return the mean torque at the motor from each sample to the next, shape (runs, samples).

        Each command is held for a period. The first one is taken to have been there always.

        Args:
            commands: Of the samples that follow those of the last call, shape (runs, samples).
        """
        samples = commands.shape[1]
        if self._past is None:
            self._past = np.repeat(commands[:, :1], self._whole + 1, axis=1)
        known = np.concatenate([self._past, commands], axis=1)
        self._past = known[:, samples:]
        older, newer = known[:, :samples], known[:, 1 : samples + 1]
        mean = newer + self._share * (older - newer)
        return np.asarray(self._path.gain * mean + self._path.offset)


class AngleDelay:
    """Angles as they were, in every run of a batch.

    Args:
        places: Places of the angles in a state, each followed by that of its velocity.
        delays: Of each [s]; a state of a delay of 0 is taken as it is, and need not be an angle.
        rate: Samples per second [Hz].
    """

    def __init__(self, places: Sequence[int], delays: Sequence[float], rate: float) -> None:
        self._places, self._period = list(places), 1.0 / rate
        self._cuts = [_cut(delay, rate) for delay in delays]
        self._longest = max((whole + 1 for whole, _ in self._cuts), default=0)
        self._is_late = any(delays)
        self._past: Array | None = None

    def measured(self, states: Array) -> Array:
        """Return what is measured at each sample, shape (runs, samples, p).

        Between samples the motion is a cubic polynomial of angles and velocities; before the first
        one the velocity is the first one's.

        Args:
            states: Of the samples that follow those of the last call, shape (runs, samples, n).
        """
        if not self._is_late:
            return np.asarray(states[..., self._places])
        samples, T = states.shape[1], self._period
        if self._past is None:
            ages = T * np.arange(self._longest, 0, -1)[:, np.newaxis]
            self._past = np.repeat(states[:, :1], self._longest, axis=1)
            self._past[..., 0::2] -= ages * self._past[..., 1::2]
        known = np.concatenate([self._past, states], axis=1)
        self._past = known[:, samples:]
        found = []
        for place, (whole, share) in zip(self._places, self._cuts, strict=True):
            now = self._longest - whole
            newer = known[:, now : now + samples]
            if share > 0.0:
                older = known[:, now - 1 : now - 1 + samples]
                found.append(_hermite(older, newer, place, T, 1.0 - share))
            else:
                found.append(newer[..., place])
        return np.stack(found, axis=-1)


def _cut(delay: float, rate: float) -> tuple[int, float]:
    """Return a delay [s] in whole periods and the share of another one."""
    periods = delay * rate
    # A whole number of periods must stay one, whatever the product rounds to.
    whole = math.floor(periods + 1e-9)
    return whole, max(0.0, periods - whole)


def _hermite(older: Array, newer: Array, place: int, period: float, t: float) -> Array:
    """Return an angle within a period, at a share t of it, shape (runs, samples)."""
    rest = 1.0 - t
    angles = rest * rest * (1.0 + 2.0 * t) * older[..., place]
    angles = angles + t * t * (1.0 + 2.0 * rest) * newer[..., place]
    slopes = rest * older[..., place + 1] - t * newer[..., place + 1]
    return np.asarray(angles + period * t * rest * slopes)


class Motion(ABC):
    """The plants of a batch, which are moved from sample to sample.

    Attributes:
        states: Present states, shape (runs, n).
        fed_back: Places of the inputs that are measurements, each with the number of its output.
    """

    states: Array
    fed_back: tuple[tuple[int, int], ...] = ()

    @abstractmethod
    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        """Move on over samples.

        Args:
            start: Index of the first one.
            inputs: Inputs and scheduled signals, shape (runs, samples, m + s).
            torques: Disturbing torques, shape (runs, samples, t); overwritten with those that an
                undisturbed plant would need to move so.

        Returns:
            States and true values of the outputs, shapes (runs, samples, n) and (runs, samples, p).
        """

    def known_output(self, output: int) -> Array:
        """Return the present true value of an output that is fed back, shape (runs,)."""
        raise NotImplementedError


class ArmMotion(Motion):
    """Elastic-joint arms, in physical coordinates.

    These do not depend on the stiffness, in which the true arm may differ from the nominal one.
    """

    def __init__(self, scenario: "Scenario", seeds: Sequence[int]) -> None:
        self._scenario, noise = scenario, scenario.process_noise
        self._steps = substeps(scenario.rate)
        bare, loaded = (_arm_record(scenario, each) for each in (Payload(), scenario.payload))
        self._arms = np.concatenate([bare, loaded])
        outputs = scenario.signals.outputs
        self._sensed = AngleDelay(
            [QUANTITIES.index(output.measures) for output in outputs],
            [output.delay for output in outputs],
            scenario.rate,
        )
        spread = RandomStream(seeds, Source.INITIAL_STATE).take(4)
        start = np.array(scenario.initial_state) + spread * np.array(scenario.initial_spread)
        self.states = scenario.arm.to_physical(start)
        self._kicks = 2 * self._steps if noise.link or noise.motor else 0
        self._noise = RandomStream(seeds, Source.PROCESS)

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        samples, payload = inputs.shape[1], self._scenario.payload
        since = np.arange(start, start + samples) / self._scenario.rate - payload.start
        states = np.empty((len(self.states), samples, 4))
        native.simulate_arms(
            self._arms,
            recurs(since, payload.duration, 0.0).astype(np.int64),
            inputs,
            self._noise.take(samples, self._kicks),
            self.states,
            states,
            torques,
        )
        return states, self._sensed.measured(states)


def substeps(rate: float) -> int:
    """Return the number of equal steps that a sampling period is cut into, of a rate [Hz]."""
    # A period of exactly five steps must not become six because .005/.001 rounds upwards.
    return max(1, math.ceil(1.0 / rate / _LONGEST_SUBSTEP - 1e-9))


def _arm_record(scenario: "Scenario", payload: Payload) -> Array:
    """Return the numbers of the true arm with a payload, as the compiled core has them."""
    true, friction, noise = scenario.true_arm, scenario.friction, scenario.process_noise
    j1, j2 = true.link_inertia + payload.link_inertia, true.motor_inertia
    steps = substeps(scenario.rate)
    substep = 1.0 / scenario.rate / steps
    record = np.zeros(1, _ARM)
    record[0] = (
        steps,
        substep,
        (true.gravity_torque + payload.gravity_torque) / j1,
        j2,
        true.stiffness / j1,
        (true.link_damping + friction.link_viscous) / j1,
        true.stiffness / j2,
        (true.motor_damping + friction.motor_viscous) / j2,
        friction.link_coulomb / j1,
        friction.motor_coulomb / j2,
        j1,
        *(getattr(friction, each.name) for each in fields(friction)),
        payload.link_inertia,
        payload.gravity_torque,
        math.sqrt(noise.link * substep),
        math.sqrt(noise.motor * substep),
        0.5 * scenario.backlash,
    )
    return record.view(np.float64)
