# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated T–S systems: ẋ = Σ hᵢ(z)((Aᵢ + ΔAᵢ)x + (Bᵢ + ΔBᵢ)u), y = Σ hᵢ(z) Cᵢx.

They are integrated by the classical fourth-order Runge–Kutta method, in steps of at most a
millisecond, with inputs and scheduled signals held from a sample to the next.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, Integers, as_matrix, check_names, non_negative, positive
from tsobs_ros.compiled import compiled, compiled_nogil
from tsobs_ros.errors import ModelError
from tsobs_ros.model.memberships import rule_weights
from tsobs_ros.model.stepping import record_type
from tsobs_ros.model.ts_model import TSModel
from tsobs_ros.simulation.integrator import LONGEST_SUBSTEP
from tsobs_ros.simulation.motion import Motion
from tsobs_ros.simulation.plant import PlantScenario, SimulatedOutput
from tsobs_ros.simulation.series import Series, Span
from tsobs_ros.simulation.signals import Excitation, NoTorque, torque_at
from tsobs_ros.simulation.streams import RandomStream, Source

_STEPS = record_type([("rate", np.float64), ("substeps", np.int64), ("substep", np.float64)])


class Rules(NamedTuple):
    """The rules of a system, for compiled code.

    Attributes:
        rates: [Aᵢ Bᵢ], shape (r, n, n + m).
        outputs: Cᵢ, shape (r, p, n).
        shapes: Codes of the memberships, shape (r, q).
        parameters: Of the memberships, shape (r, q, 4).
        premise: Z, shape (q, n).
        schedule: Z_s, shape (q, s).
    """

    rates: Array
    outputs: Array
    shapes: Integers
    parameters: Array
    premise: Array
    schedule: Array


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
    inputs: tuple[Excitation, ...] = ()
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
    def excitations(self) -> tuple[Excitation, ...]:
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
        coded = model.rule_base.coded
        # Copies, since compiled code knows arrays that may not be written as another type.
        self._rules = Rules(
            np.array(rates),
            np.array(model.rule_outputs),
            coded.shapes.copy(),
            coded.parameters.copy(),
            np.array(model.premise),
            np.array(model.schedule),
        )
        substeps = max(1, math.ceil(1.0 / rate / LONGEST_SUBSTEP - 1e-9))
        self._steps = np.zeros(1, _STEPS)
        self._steps[0] = rate, substeps, 1.0 / rate / substeps
        self._strengths = np.sqrt(densities / rate / substeps)
        kicks = substeps * states.shape[1] if densities.any() else 0
        signals = model.input_count + model.schedule.shape[1]
        super().__init__(seeds, states, kicks, signals, 0, block)
        self._fed_back = fed_back

    @property
    def fed_back(self) -> tuple[tuple[int, int], ...]:
        """Places of the inputs that are measurements, each with the number of its output."""
        return self._fed_back

    def known_outputs(self) -> Array:
        """Return the present true values of the outputs that are fed back, shape (runs, p)."""
        C = self._rules.outputs
        values = np.zeros((len(self.states), C.shape[1]))
        for _, output in self._fed_back:
            # Term by term: a product of matrices has other last bits for another number of runs.
            for place, state in enumerate(self.states.T):
                values[:, output] += C[0, output, place] * state
        return values

    def move(self, span: Span, series: Series) -> None:
        """Write the next samples of every run and move on; see `Motion.move`."""
        _move_systems(
            self._steps,
            self._rules,
            self._strengths,
            self.excitations,
            self.states,
            self.kicks,
            span,
            series,
        )


@compiled_nogil
def _move_systems(
    steps: Any,
    rules: Rules,
    strengths: Array,
    excitations: Array,
    present: Array,
    kicks: Array,
    span: Span,
    series: Series,
) -> None:
    """Move every system, sample by sample; see `Motion.move`."""
    n, p, signals = present.shape[1], rules.outputs.shape[1], excitations.shape[0]
    substeps, h = int(steps[0].substeps), float(steps[0].substep)
    z, weights = np.empty(rules.premise.shape[0]), np.empty(rules.rates.shape[0])
    start, middle, slope, total = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    held = np.empty(signals)
    for step in range(span.samples):
        draw, place = span.drawn + step, span.place + step
        time = (span.start + step) / float(steps[0].rate)
        for run in range(present.shape[0]):
            state = present[run]
            for item in range(signals):
                if not series.given[item]:
                    series.inputs[run, place, item] = torque_at(excitations[item], time)
                held[item] = series.inputs[run, place, item]
            weigh(rules, state, held, z, weights)
            for row in range(n):
                series.states[run, place, row] = state[row]
            for row in range(p):
                series.truths[run, place, row] = blended(rules.outputs, weights, row, state, held)
            for substep in range(substeps):
                for row in range(n):
                    start[row] = middle[row] = state[row]
                    total[row] = 0.0
                for stage in range(4):
                    weigh(rules, middle, held, z, weights)
                    for row in range(n):
                        slope[row] = blended(rules.rates, weights, row, middle, held)
                    for row in range(n):
                        total[row] += slope[row] if stage == 0 or stage == 3 else 2.0 * slope[row]
                        middle[row] = start[row] + (h if stage == 2 else 0.5 * h) * slope[row]
                for row in range(n):
                    state[row] = start[row] + h / 6.0 * total[row]
                    if kicks.shape[2] > 0:
                        state[row] += strengths[row] * float(kicks[run, draw, substep * n + row])


@compiled
def weigh(rules: Rules, state: Array, held: Array, z: Array, weights: Array) -> None:
    """Write the weights of the rules at a state, and the premise variables.

    Args:
        rules: The system's.
        state: x, shape (n,).
        held: Inputs and scheduled signals, shape (m + s,).
        z: Z x + Z_s s, written, shape (q,).
        weights: h(z), written, shape (r,).
    """
    offset = held.shape[0] - rules.schedule.shape[1]
    for row in range(z.shape[0]):
        value = 0.0
        for item in range(state.shape[0]):
            value += rules.premise[row, item] * state[item]
        for item in range(rules.schedule.shape[1]):
            value += rules.schedule[row, item] * held[offset + item]
        z[row] = value
    rule_weights(rules.shapes, rules.parameters, z, weights)


@compiled
def blended(matrices: Array, weights: Array, row: int, state: Array, held: Array) -> float:
    """Return a row of Σ hᵢ Mᵢ [x; u].

    Args:
        matrices: Mᵢ, shape (r, rows, n) or (r, rows, n + m).
        weights: h, shape (r,).
        row: Its number.
        state: x, shape (n,).
        held: u and more, shape (m or more,).
    """
    n, total = state.shape[0], 0.0
    for rule in range(matrices.shape[0]):
        value = 0.0
        for item in range(n):
            value += matrices[rule, row, item] * state[item]
        for item in range(matrices.shape[2] - n):
            value += matrices[rule, row, n + item] * held[item]
        total += weights[rule] * value
    return total
