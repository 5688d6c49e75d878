# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixed-step integration of plants: the true motion that observers are judged by.

The classical fourth-order Runge–Kutta method at 1 ms keeps the undriven arm's energy to 1e-10
over a minute. Its error is far below any noise.
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
from tsobs_ros.simulation.delays import AngleDelay
from tsobs_ros.simulation.signals import recurs
from tsobs_ros.simulation.streams import RandomStream, Source

if TYPE_CHECKING:
    from tsobs_ros.simulation.plant import Scenario

CREEP = 0.01
"""Speed below which Coulomb friction is proportional to the speed [rad/s], as in simulate.c."""

_LONGEST_SUBSTEP = 1e-3
_ARM = record_type("simulated_arm")
_STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class Friction:
    """Friction of the true arm that the nominal one lacks.

    Coulomb friction is c·sign(q̇), and below `CREEP` it grows linearly from zero.

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
        """Move on over samples; see `Motion.move`."""
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
