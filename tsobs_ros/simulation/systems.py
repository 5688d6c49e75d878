# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated T–S systems: ẋ = Σ hᵢ(z)((Aᵢ + ΔAᵢ)x + (Bᵢ + ΔBᵢ)u), y = Σ hᵢ(z) Cᵢx.

They are integrated by the classical fourth-order Runge–Kutta method, in steps of at most a
millisecond, with inputs and scheduled signals held from a sample to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, check_names, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.simulation.integrator import Motion, substeps
from tsobs_ros.simulation.plant import PlantScenario, SimulatedOutput
from tsobs_ros.simulation.signals import NoTorque, Signal
from tsobs_ros.simulation.streams import RandomStream, Source


@dataclass(frozen=True, eq=False)
class SystemScenario(PlantScenario):
    """How a T–S system is built, moved, disturbed and measured. Units are the model's.

    Attributes:
        model: The nominal system, the one an estimator knows.
        outputs: What measures each output, p of them.
        rate: Samples per second [Hz].
        duration: How long a campaign simulates [s].
        initial_state: Mean of x(0), shape (n,); zero by default.
        initial_spread: 1σ of x(0), shape (n,); none by default.
        process_noise: Densities of white noise on each state's derivative, shape (n,); none by
            default.
        inputs: Signals of the inputs, then of the scheduled signals, m + s of them; none by
            default.
        fed_back: Names of the outputs whose measurements are scheduled signals, one for each of
            these, None of a signal of its own; none by default. What is held is the last finite
            value.
        change: [ΔAᵢ ΔBᵢ] of the true system's rules, shape (r, n, n + m); none by default.

    Raises:
        ModelError: A number is not finite, of the wrong sign or shape.
    """

    model: TSModel
    outputs: tuple[SimulatedOutput, ...]
    rate: float = 200.0
    duration: float = 60.0
    initial_state: ArrayLike | None = None
    initial_spread: ArrayLike | None = None
    process_noise: ArrayLike | None = None
    inputs: tuple[Signal, ...] = ()
    fed_back: tuple[str | None, ...] = ()
    change: ArrayLike | None = None
    true_rates: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        model = self.model
        n, p = model.state_count, model.C.shape[0]
        signals = model.input_count + model.schedule.shape[1]
        positive("rate", self.rate)
        non_negative("duration", self.duration)
        for name in ("initial_state", "initial_spread", "process_noise"):
            given = getattr(self, name)
            values = as_matrix(name, np.zeros(n) if given is None else given, (n,))
            if name != "initial_state" and (values < 0.0).any():
                raise ModelError(f"{name}: expected numbers of at least 0, got {values.tolist()}")
            object.__setattr__(self, name, values)
        if len(self.outputs) != p:
            raise ModelError(f"outputs: expected {p}, one per output, got {len(self.outputs)}")
        object.__setattr__(self, "inputs", self.inputs or (NoTorque(),) * signals)
        if len(self.inputs) != signals:
            raise ModelError(
                f"inputs: expected {signals} signals, one per input and scheduled signal, "
                f"got {len(self.inputs)}"
            )
        shape = model.rates.shape
        change = np.zeros(shape) if self.change is None else self.change
        object.__setattr__(self, "true_rates", model.rates + as_matrix("change", change, shape))
        object.__setattr__(self, "input_count", model.input_count)
        names = [output.measures for output in self.outputs]
        check_names("fed_back", filter(None, self.fed_back), names)
        for name in filter(None, self.fed_back):
            rows = model.rule_outputs[:, names.index(name)]
            if (rows != rows[0]).any():
                raise ModelError(
                    f"fed_back: expected an output with the same C in all rules, got {name}, whose "
                    "value would depend on itself"
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
        densities = np.asarray(scenario.process_noise)
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
            "strengths": np.sqrt(densities / rate / steps),
        }.items():
            record[name] = value
        self._numbers, self._outputs = record.view(np.float64), outputs
        spread = RandomStream(seeds, Source.INITIAL_STATE).take(n)
        self.states = np.asarray(scenario.initial_state) + spread * np.asarray(
            scenario.initial_spread
        )
        self._kicks = steps * n if densities.any() else 0
        self._noise = RandomStream(seeds, Source.PROCESS)
        names = [output.measures for output in scenario.outputs]
        self.fed_back = tuple(
            (m + place, names.index(name)) for place, name in enumerate(scenario.fed_back) if name
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
