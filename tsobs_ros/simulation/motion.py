# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The true motion of simulated plants, that observers are judged by.

The classical fourth-order Runge–Kutta method in steps of at most 1 ms, with inputs held from a
sample to the next, keeps the undriven arm's energy to 1e-10 over a minute. Its error is far below
any noise.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.model.arm import QUANTITIES
from tsobs_ros.settings import setting
from tsobs_ros.simulation.signals import Numbers, recurs
from tsobs_ros.simulation.streams import AngleDelay, RandomStream, Source

if TYPE_CHECKING:
    from tsobs_ros.simulation.plant import Scenario, SystemScenario

_LONGEST_SUBSTEP = 1e-3
_STANDARD_GRAVITY = 9.80665


def _friction(description: str, unit: str) -> float:
    return setting(0.0, f"{description} friction", unit=unit, minimum=0.0)


@dataclass(frozen=True)
class Friction(Numbers, kind="friction"):
    """Friction of the true arm that the nominal one lacks.

    Coulomb friction is c·sign(q̇), and below 0.01 rad/s it grows linearly from zero.
    """

    link_viscous: float = _friction("The link's viscous", "N m s/rad")
    link_coulomb: float = _friction("The link's Coulomb", "N m")
    motor_viscous: float = _friction("The motor's viscous", "N m s/rad")
    motor_coulomb: float = _friction("The motor's Coulomb", "N m")


@dataclass(frozen=True)
class Payload(Numbers, kind="payload"):
    """What the link carries for a time; its speed does not jump as it is put on."""

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

    @property
    def total(self) -> tuple[float, float]:
        """All inertia [kg m²] and torque [N m] that it adds.

        >>> Payload(mass=2.0, distance=0.5).total[0]
        0.5
        """
        moment = self.mass * _STANDARD_GRAVITY * self.distance
        inertia = self.mass * self.distance * self.distance
        return inertia + self.link_inertia, moment + self.gravity_torque


class Motion:
    """The plants of a batch, which differ in their states and random numbers.

    Args:
        seeds: One for each plant.
        rate: Samples per second [Hz].
        states: At the first sample, shape (runs, n).
        densities: Of the white noise on derivatives of states.
        sizes: Of the plant's record, but for n, as core/simulate.h has them.
        **numbers: Of the record.

    Attributes:
        states: Present states, shape (runs, n).
        fed_back: Places of the inputs that are measurements, each with the number of its output and
            that one's row of C.
    """

    fed_back: tuple[tuple[int, int, Array], ...] = ()

    def __init__(
        self,
        seeds: Sequence[int],
        rate: float,
        states: Array,
        densities: Array,
        sizes: Sequence[int],
        **numbers: ArrayLike,
    ) -> None:
        # A period of exactly five steps must not become six because .005/.001 rounds upwards.
        steps = max(1, math.ceil(1.0 / rate / _LONGEST_SUBSTEP - 1e-9))
        step = 1.0 / rate / steps
        self.states, self._rate = states, rate
        self._sizes = np.array([states.shape[1], *sizes], np.int64)
        self._record = np.zeros(1, record_type("simulated_plant", self._sizes))
        own = {"substeps": steps, "substep": step, "noise": np.sqrt(densities * step)}
        for name, value in (own | numbers).items():
            self._record[name] = value
        self._kicks = steps * len(densities) if densities.any() else 0
        self._noise = RandomStream(seeds, Source.PROCESS)

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        """Move on over samples from an index on; return states and true values of the outputs.

        Args:
            start: The index.
            inputs: Torques of the motor, shape (runs, samples, 1); inputs and scheduled signals of
                a T–S system.
            torques: Disturbing torques, shape (runs, samples, 2); overwritten with those that an
                undisturbed arm would need to move so.
        """
        shape = inputs.shape[:2]
        states = np.empty((*shape, self._sizes[0]))
        outputs = np.empty((*shape, self._sizes[3]))
        kicks = self._noise.take(shape[1], self._kicks)
        numbers = self._record.view(np.float64)
        native.simulate(self._sizes, numbers, inputs, kicks, self.states, states, outputs)
        return states, outputs


class ArmMotion(Motion):
    """Arms, in physical coordinates, which do not depend on the uncertain stiffness."""

    def __init__(self, scenario: "Scenario", seeds: Sequence[int]) -> None:
        self._payload, noise = scenario.payload, scenario.process_noise
        delays = {QUANTITIES.index(output.measures): output.delay for output in scenario.outputs}
        self._sensed = AngleDelay(delays, scenario.rate)
        spread = RandomStream(seeds, Source.INITIAL_STATE).take(4)
        start = np.array(scenario.initial_state) + spread * np.array(scenario.initial_spread)
        states, densities = scenario.arm.to_physical(start), np.array([noise.link, noise.motor])
        arms = [_arm_numbers(scenario, *more) for more in ((0.0, 0.0), self._payload.total)]
        super().__init__(seeds, scenario.rate, states, densities, (4, 0, 2, 0, 0), arms=arms)

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        since = np.arange(start, start + inputs.shape[1]) / self._rate - self._payload.start
        is_loaded = np.zeros(inputs.shape)
        is_loaded[..., 0] = recurs(since, self._payload.duration or math.inf, 0.0)
        held = np.concatenate([inputs, torques, is_loaded], axis=2)
        states, torques[:] = super().move(start, held, torques)
        return states, self._sensed.measured(states)


class SystemMotion(Motion):
    """T–S systems: ẋ = Σ hᵢ(z)((Aᵢ + ΔAᵢ)x + (Bᵢ + ΔBᵢ)u), y = Σ hᵢ(z) Cᵢx."""

    def __init__(self, scenario: "SystemScenario", seeds: Sequence[int]) -> None:
        model, start = scenario.model, np.asarray(scenario.initial_state)
        shapes, parameters = model.rule_base.coded
        n, m, outputs = model.state_count, model.input_count, model.rule_outputs
        super().__init__(
            seeds,
            scenario.rate,
            np.repeat([start], len(seeds), axis=0),
            scenario.process_noise,
            (m, model.schedule.shape[1], outputs.shape[1], *shapes.shape),
            rates=scenario.true_rates.reshape(-1, n + m),
            outputs=outputs.reshape(-1, n),
            shapes=shapes.ravel(),
            parameters=parameters.reshape(-1, 4),
            premise=np.hstack([model.premise, np.zeros((len(model.premise), m)), model.schedule]),
        )
        self.fed_back = tuple(
            (m + place, number, outputs[0, number])
            for place, number in enumerate(scenario.fed_back)
            if number is not None
        )


def _arm_numbers(scenario: "Scenario", more_inertia: float, more_torque: float) -> list[float]:
    """Return the numbers of the true arm with a payload, as the compiled core has them."""
    true, friction = scenario.true_arm, scenario.friction
    j1, j2 = true.link_inertia + more_inertia, true.motor_inertia
    return [
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
        0.5 * scenario.backlash,
    ]
