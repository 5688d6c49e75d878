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
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

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
_ARM = record_type("simulated_arm")
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


class ArmMotion:
    """Arms of a batch, in physical coordinates, which do not depend on the uncertain stiffness.

    Attributes:
        states: Present states, shape (runs, 4).
    """

    fed_back: tuple[tuple[int, int, Array], ...] = ()

    def __init__(self, scenario: "Scenario", seeds: Sequence[int]) -> None:
        noise, outputs, self._rate = scenario.process_noise, scenario.outputs, scenario.rate
        self._payload = scenario.payload
        bare, loaded = (_arm_record(scenario, *more) for more in ((0.0, 0.0), self._payload.total))
        self._arms = np.concatenate([bare, loaded])
        delays = {QUANTITIES.index(output.measures): output.delay for output in outputs}
        self._sensed = AngleDelay(delays, self._rate)
        spread = RandomStream(seeds, Source.INITIAL_STATE).take(4)
        start = np.array(scenario.initial_state) + spread * np.array(scenario.initial_spread)
        self.states = scenario.arm.to_physical(start)
        self._kicks = 2 * _substeps(self._rate)[0] if noise.link or noise.motor else 0
        self._noise = RandomStream(seeds, Source.PROCESS)

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        """Move on over samples from an index on; return states and true values of the outputs.

        Args:
            start: The index.
            inputs: Torques of the motor, shape (runs, samples, 1).
            torques: Disturbing torques, shape (runs, samples, 2); overwritten with those that an
                undisturbed arm would need to move so.
        """
        samples, payload = inputs.shape[1], self._payload
        since = np.arange(start, start + samples) / self._rate - payload.start
        is_loaded = recurs(since, payload.duration or math.inf, 0.0)
        states = np.empty((len(self.states), samples, 4))
        kicks = self._noise.take(samples, self._kicks)
        native.simulate_arms(
            self._arms, is_loaded.astype(np.int64), inputs, kicks, self.states, states, torques
        )
        return states, self._sensed.measured(states)


class SystemMotion:
    """T–S systems of a batch: ẋ = Σ hᵢ(z)((Aᵢ + ΔAᵢ)x + (Bᵢ + ΔBᵢ)u), y = Σ hᵢ(z) Cᵢx.

    Attributes:
        states: Present states, shape (runs, n).
        fed_back: Places of the inputs that are measurements, each with the number of its output and
            that one's row of C.
    """

    def __init__(self, scenario: "SystemScenario", seeds: Sequence[int]) -> None:
        model, (steps, step) = scenario.model, _substeps(scenario.rate)
        shapes, parameters = model.rule_base.coded
        n, m, outputs = model.state_count, model.input_count, model.rule_outputs
        sizes = [n, m, model.schedule.shape[1], model.C.shape[0], *shapes.shape]
        self._sizes = np.array(sizes, np.int64)
        record = np.zeros(1, record_type("simulated_system", self._sizes))
        for name, value in {
            "substeps": steps,
            "substep": step,
            "rates": scenario.true_rates.reshape(-1, n + m),
            "outputs": outputs.reshape(-1, n),
            "shapes": shapes.ravel(),
            "parameters": parameters.reshape(-1, 4),
            "premise": np.hstack(
                [model.premise, np.zeros((len(model.premise), m)), model.schedule]
            ),
            "strengths": np.sqrt(scenario.process_noise / scenario.rate / steps),
        }.items():
            record[name] = value
        self._numbers, self._output_count = record.view(np.float64), outputs.shape[1]
        self.states = np.repeat([np.asarray(scenario.initial_state)], len(seeds), axis=0)
        self._kicks = steps * n if scenario.process_noise.any() else 0
        self._noise = RandomStream(seeds, Source.PROCESS)
        self.fed_back = tuple(
            (m + place, number, outputs[0, number])
            for place, number in enumerate(scenario.fed_back)
            if number is not None
        )

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        """See `ArmMotion.move`; inputs have the shape (runs, samples, m + s)."""
        shape = inputs.shape[:2]
        states = np.empty((*shape, self.states.shape[1]))
        truths = np.empty((*shape, self._output_count))
        kicks = self._noise.take(shape[1], self._kicks)
        native.simulate_systems(
            self._sizes, self._numbers, inputs, kicks, self.states, states, truths
        )
        return states, truths


Motion: TypeAlias = ArmMotion | SystemMotion


def _substeps(rate: float) -> tuple[int, float]:
    """Return the number of equal steps in a sampling period of a rate [Hz], and their length."""
    # A period of exactly five steps must not become six because .005/.001 rounds upwards.
    steps = max(1, math.ceil(1.0 / rate / _LONGEST_SUBSTEP - 1e-9))
    return steps, 1.0 / rate / steps


def _arm_record(scenario: "Scenario", more_inertia: float, more_torque: float) -> Array:
    """Return the numbers of the true arm with a payload, as the compiled core has them."""
    true, friction, noise = scenario.true_arm, scenario.friction, scenario.process_noise
    j1, j2 = true.link_inertia + more_inertia, true.motor_inertia
    steps, step = _substeps(scenario.rate)
    record = np.zeros(1, _ARM)
    record[0] = (
        steps,
        step,
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
        math.sqrt(noise.link * step),
        math.sqrt(noise.motor * step),
        0.5 * scenario.backlash,
    )
    return record.view(np.float64)
