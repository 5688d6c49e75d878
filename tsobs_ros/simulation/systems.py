# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated T–S systems: ẋ = Σ hᵢ(z)((Aᵢ + ΔAᵢ)x + (Bᵢ + ΔBᵢ)u), y = Σ hᵢ(z) Cᵢx.

They are integrated by the classical fourth-order Runge–Kutta method, in steps of at most a
millisecond, with inputs and scheduled signals held from a sample to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.simulation.integrator import Motion, substeps
from tsobs_ros.simulation.plant import PlantScenario
from tsobs_ros.simulation.sensor import SimulatedOutput
from tsobs_ros.simulation.signals import Signal
from tsobs_ros.simulation.streams import RandomStream, Source


@dataclass(frozen=True, eq=False)
class SystemScenario(PlantScenario):
    """How a T–S system is built, moved, disturbed and measured. Units are the model's.

    Attributes:
        model: The nominal system, the one an estimator knows.
        true_rates: [Aᵢ Bᵢ] of the true system's rules, shape (r, n, n + m).
        outputs: What measures each output, p of them.
        inputs: Signals of the inputs, then of the scheduled signals, m + s of them.
        fed_back: Of each scheduled signal the number of the output whose last finite measurement
            it is, None of a signal of its own.
        process_noise: Densities of white noise on each state's derivative, shape (n,).
        rate: Samples per second [Hz].
        duration: How long a run is [s].
        initial_state: x(0), shape (n,); zero if None.

    Raises:
        ModelError: A number is not finite, of the wrong sign or shape, or an output that is fed
            back would depend on itself.
    """

    model: TSModel
    true_rates: Array
    outputs: tuple[SimulatedOutput, ...]
    inputs: tuple[Signal, ...]
    fed_back: tuple[int | None, ...]
    process_noise: Array
    rate: float
    duration: float = 60.0
    initial_state: ArrayLike | None = None

    def __post_init__(self) -> None:
        model = self.model
        positive("rate", self.rate)
        non_negative("duration", self.duration)
        start = np.zeros(model.state_count) if self.initial_state is None else self.initial_state
        state = as_matrix("initial_state", start, (model.state_count,))
        object.__setattr__(self, "initial_state", state)
        object.__setattr__(self, "input_count", model.input_count)
        for number in self.fed_back:
            if number is not None and np.ptp(model.rule_outputs[:, number], axis=0).any():
                raise ModelError(
                    f"{self.outputs[number].measures}: expected the same C in all rules, as its "
                    "measurement is a scheduled signal"
                )

    @property
    def measured(self) -> tuple[SimulatedOutput, ...]:
        return self.outputs

    @property
    def moved_by(self) -> tuple[Signal, ...]:
        return self.inputs

    def motion(self, seeds: Sequence[int]) -> Motion:
        return SystemMotion(self, seeds)


class SystemMotion(Motion):
    """T–S systems."""

    def __init__(self, scenario: SystemScenario, seeds: Sequence[int]) -> None:
        model, rate = scenario.model, scenario.rate
        shapes, parameters = model.rule_base.coded
        n, m, outputs = model.state_count, model.input_count, model.rule_outputs
        sizes = [n, m, model.schedule.shape[1], model.C.shape[0], *shapes.shape]
        self._sizes, steps = np.array(sizes, np.int64), substeps(rate)
        record = np.zeros(1, record_type("simulated_system", self._sizes))
        for name, value in {
            "substeps": steps,
            "substep": 1.0 / rate / steps,
            "rates": scenario.true_rates.reshape(-1, n + m),
            "outputs": outputs.reshape(-1, n),
            "shapes": shapes.ravel(),
            "parameters": parameters.reshape(-1, 4),
            "premise": np.hstack(
                [model.premise, np.zeros((len(model.premise), m)), model.schedule]
            ),
            "strengths": np.sqrt(scenario.process_noise / rate / steps),
        }.items():
            record[name] = value
        self._numbers, self._outputs = record.view(np.float64), outputs
        self.states = np.repeat([np.asarray(scenario.initial_state)], len(seeds), axis=0)
        self._kicks = steps * n if scenario.process_noise.any() else 0
        self._noise = RandomStream(seeds, Source.PROCESS)
        self.fed_back = tuple(
            (m + place, number)
            for place, number in enumerate(scenario.fed_back)
            if number is not None
        )

    def known_output(self, output: int) -> Array:
        value = np.zeros(len(self.states))
        # Term by term: a product of matrices has other last bits for another number of runs.
        for gain, state in zip(self._outputs[0, output], self.states.T, strict=True):
            value += gain * state
        return value

    def move(self, start: int, inputs: Array, torques: Array) -> tuple[Array, Array]:
        shape = inputs.shape[:2]
        states = np.empty((*shape, self.states.shape[1]))
        truths = np.empty((*shape, self._outputs.shape[1]))
        kicks = self._noise.take(shape[1], self._kicks)
        native.simulate_systems(
            self._sizes, self._numbers, inputs, kicks, self.states, states, truths
        )
        return states, truths
