# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated T–S systems: ẋ = Σ hᵢ(z)((Aᵢ + ΔAᵢ)x + (Bᵢ + ΔBᵢ)u), y = Σ hᵢ(z) Cᵢx.

They are integrated by the classical fourth-order Runge–Kutta method, in steps of at most a
millisecond, with inputs and scheduled signals held from a sample to the next.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, as_matrix, check_names, non_negative, positive
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.errors import ModelError
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.simulation.integrator import LONGEST_SUBSTEP
from tsobs_ros.simulation.motion import Motion
from tsobs_ros.simulation.plant import PlantScenario, SimulatedOutput
from tsobs_ros.simulation.series import Series, Span
from tsobs_ros.simulation.signals import NoTorque, Signal
from tsobs_ros.simulation.streams import RandomStream, Source


@dataclass(frozen=True, eq=False)
class SystemScenario(PlantScenario):
    """How a T–S system is built, moved, disturbed and measured. Units are the model's.

    Attributes:
        model: The nominal system, the one an estimator knows.
        outputs: What measures each output, p of them.
        rate: Samples a second [Hz].
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
        change: [ΔAᵢ ΔBᵢ] that the true system's rules have besides, shape (r, n, n + m); none by
            default.

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
    _true: Array = field(init=False, repr=False)

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
            raise ModelError(f"outputs: expected {p}, one an output, got {len(self.outputs)}")
        object.__setattr__(self, "inputs", self.inputs or (NoTorque(),) * signals)
        if len(self.inputs) != signals:
            raise ModelError(
                f"inputs: expected {signals} signals, one an input and scheduled signal, "
                f"got {len(self.inputs)}"
            )
        shape = model.rates.shape
        change = np.zeros(shape) if self.change is None else self.change
        object.__setattr__(self, "_true", model.rates + as_matrix("change", change, shape))
        _ = model.rule_base.coded
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
        """The outputs, p of them."""
        return self.outputs

    @property
    def excitations(self) -> tuple[Signal, ...]:
        """The signal of each input and scheduled signal in the absence of a command."""
        return self.inputs

    @property
    def input_count(self) -> int:
        """Number of inputs that can be commanded."""
        return self.model.input_count

    def motion(self, seeds: Sequence[int], block: int) -> Motion:
        """Return the systems at the first sample, ready to move."""
        mean, spread = np.asarray(self.initial_state), np.asarray(self.initial_spread)
        start = np.empty((len(seeds), len(mean)))
        RandomStream(seeds, Source.INITIAL_STATE).fill(start)
        densities = np.asarray(self.process_noise)
        names, m = [output.measures for output in self.outputs], self.model.input_count
        return SystemMotion(
            self.model,
            self._true,
            densities,
            self.rate,
            seeds,
            mean + start * spread,
            block,
            tuple((m + k, names.index(name)) for k, name in enumerate(self.fed_back) if name),
        )


class SystemMotion(Motion):
    """T–S systems.

    Args:
        model: Their memberships, premises and outputs.
        rates: [Aᵢ Bᵢ] of the rules that move, shape (r, n, n + m).
        densities: Of white noise on each state's derivative, shape (n,).
        rate: Samples a second [Hz].
        seeds: One for each run.
        states: At the first sample, shape (runs, n).
        block: Samples that random numbers are drawn for at a time.
        fed_back: See `Motion.fed_back`.
    """

    def __init__(
        self,
        model: TSModel,
        rates: Array,
        densities: Array,
        rate: float,
        seeds: Sequence[int],
        states: Array,
        block: int,
        fed_back: tuple[tuple[int, int], ...] = (),
    ) -> None:
        coded, n = model.rule_base.coded, model.state_count
        self._sizes = np.array(
            [
                n,
                model.input_count,
                model.schedule.shape[1],
                model.C.shape[0],
                *coded.shapes.shape,
            ],
            np.int64,
        )
        substeps = max(1, math.ceil(1.0 / rate / LONGEST_SUBSTEP - 1e-9))
        record = np.zeros(1, record_type(native.simulated_system_layout(self._sizes)))
        for name, value in {
            "substeps": substeps,
            "substep": 1.0 / rate / substeps,
            "rates": rates.reshape(-1, rates.shape[2]),
            "outputs": model.rule_outputs.reshape(-1, n),
            "shapes": coded.shapes.ravel(),
            "parameters": coded.parameters.reshape(-1, 4),
            "premise": model.premise,
            "schedule": model.schedule,
            "strengths": np.sqrt(densities / rate / substeps),
        }.items():
            record[name] = value
        self._numbers, self._outputs = record.view(np.float64), model.rule_outputs
        kicks = substeps * n if densities.any() else 0
        signals = model.input_count + model.schedule.shape[1]
        super().__init__(seeds, states, kicks, signals, 0, rate, block)
        self._fed_back = fed_back

    @property
    def fed_back(self) -> tuple[tuple[int, int], ...]:
        """Places of the inputs that are measurements, each with the number of its output."""
        return self._fed_back

    def known_outputs(self) -> Array:
        """Return the present true values of the outputs that are fed back, shape (runs, p)."""
        C = self._outputs
        values = np.zeros((len(self.states), C.shape[1]))
        for _, output in self._fed_back:
            # Term by term: a product of matrices has other last bits for another number of runs.
            for place, state in enumerate(self.states.T):
                values[:, output] += C[0, output, place] * state
        return values

    def move(self, span: Span, series: Series) -> None:
        """Write the next samples of every run and move on; see `Motion.move`."""
        runs, samples = len(self.states), span.samples
        states = np.empty((runs, samples, self.states.shape[1]))
        truths = np.empty((runs, samples, self._outputs.shape[1]))
        native.simulate_systems(
            self._sizes,
            self._numbers,
            np.ascontiguousarray(span.of(series.inputs)),
            np.ascontiguousarray(span.drawn_for(self.kicks)),
            self.states,
            states,
            truths,
        )
        span.of(series.states)[...] = states
        span.of(series.truths)[...] = truths
