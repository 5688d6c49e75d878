# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixed-step integration of plants: the true motion that observers are judged by.

The classical fourth-order Runge–Kutta method at 1 ms keeps the undriven arm's energy to 1e-10
over a minute. Its error is far below any noise.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.model.arm import QUANTITIES
from tsobs_ros.settings import check, setting
from tsobs_ros.simulation.delays import AngleDelay
from tsobs_ros.simulation.signals import recurs
from tsobs_ros.simulation.streams import RandomStream, Source

if TYPE_CHECKING:
    from tsobs_ros.simulation.plant import Scenario

_LONGEST_SUBSTEP = 1e-3
_ARM = record_type("simulated_arm")
_STANDARD_GRAVITY = 9.80665


def _friction(description: str, unit: str) -> float:
    return setting(0.0, f"{description} friction", unit=unit, minimum=0.0)


@dataclass(frozen=True)
class Friction:
    """Friction of the true arm that the nominal one lacks.

    Coulomb friction is c·sign(q̇), and below 0.01 rad/s it grows linearly from zero.

    Raises:
        ModelError: A number is negative or not finite.
    """

    link_viscous: float = _friction("The link's viscous", "N m s/rad")
    link_coulomb: float = _friction("The link's Coulomb", "N m")
    motor_viscous: float = _friction("The motor's viscous", "N m s/rad")
    motor_coulomb: float = _friction("The motor's Coulomb", "N m")

    def __post_init__(self) -> None:
        check(self, "friction")


@dataclass(frozen=True)
class Payload:
    """What the link carries for a time; its speed does not jump as it is put on.

    Raises:
        ModelError: A number is negative or not finite.
    """

    link_inertia: float = setting(
        0.0, "Inertia that it adds to the link's", unit="kg m^2", minimum=0.0
    )
    gravity_torque: float = setting(
        0.0, "Torque that it adds to what holds the link horizontal", unit="N m", minimum=0.0
    )
    start: float = setting(0.0, "When it is put on", unit="s", minimum=0.0)
    duration: float = setting(0.0, "How long it is carried; 0: for ever", unit="s", minimum=0.0)
    mass: float = setting(0.0, "Mass at the distance, added to the above", unit="kg", minimum=0.0)
    distance: float = setting(0.0, "Its distance from the axis", unit="m", minimum=0.0)

    def __post_init__(self) -> None:
        check(self, "payload")

    @property
    def total(self) -> tuple[float, float]:
        """All inertia [kg m²] and torque [N m] that it adds.

        >>> Payload(mass=2.0, distance=0.5).total[0]
        0.5
        """
        moment = self.mass * _STANDARD_GRAVITY * self.distance
        inertia = self.mass * self.distance * self.distance
        return inertia + self.link_inertia, moment + self.gravity_torque


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
        """Move on over samples from an index on; return states and true values of the outputs.

        Args:
            start: The index.
            inputs: Inputs and scheduled signals, shape (runs, samples, m + s).
            torques: Disturbing torques, shape (runs, samples, t); overwritten with those that an
                undisturbed plant would need to move so.
        """

    def known_output(self, output: int) -> Array:
        """Return the present true value of an output that is fed back, shape (runs,)."""
        raise NotImplementedError


class ArmMotion(Motion):
    """Elastic-joint arms, in physical coordinates.

    These do not depend on the stiffness, in which the true arm may differ from the nominal one.
    """

    def __init__(self, scenario: "Scenario", seeds: Sequence[int]) -> None:
        noise, outputs, self._rate = scenario.process_noise, scenario.measured, scenario.rate
        self._payload, steps = scenario.payload, substeps(scenario.rate)
        bare, loaded = (_arm_record(scenario, *more) for more in ((0.0, 0.0), self._payload.total))
        self._arms = np.concatenate([bare, loaded])
        places = [QUANTITIES.index(output.measures) for output in outputs]
        self._sensed = AngleDelay(places, [output.delay for output in outputs], self._rate)
        spread = RandomStream(seeds, Source.INITIAL_STATE).take(4)
        start = np.array(scenario.initial_state) + spread * np.array(scenario.initial_spread)
        self.states = scenario.arm.to_physical(start)
        self._kicks = 2 * steps if noise.link or noise.motor else 0
        self._noise = RandomStream(seeds, Source.PROCESS)

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        samples, payload = inputs.shape[1], self._payload
        since = np.arange(start, start + samples) / self._rate - payload.start
        is_loaded = recurs(since, payload.duration or math.inf, 0.0)
        states = np.empty((len(self.states), samples, 4))
        native.simulate_arms(
            self._arms,
            is_loaded.astype(np.int64),
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


def _arm_record(scenario: "Scenario", more_inertia: float, more_torque: float) -> Array:
    """Return the numbers of the true arm with a payload, as the compiled core has them."""
    true, friction, noise = scenario.true_arm, scenario.friction, scenario.process_noise
    j1, j2 = true.link_inertia + more_inertia, true.motor_inertia
    steps = substeps(scenario.rate)
    substep = 1.0 / scenario.rate / steps
    record = np.zeros(1, _ARM)
    record[0] = (
        steps,
        substep,
        (true.gravity_torque + more_torque) / j1,
        j2,
        true.stiffness / j1,
        (true.link_damping + friction.link_viscous) / j1,
        true.stiffness / j2,
        (true.motor_damping + friction.motor_viscous) / j2,
        friction.link_coulomb / j1,
        friction.motor_coulomb / j2,
        j1,
        *astuple(friction),
        more_inertia,
        more_torque,
        math.sqrt(noise.link * substep),
        math.sqrt(noise.motor * substep),
        0.5 * scenario.backlash,
    )
    return record.view(np.float64)
