# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion of simulated plants between samples, in every run of a batch."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from tsobs_ros.checks import Array, Flags, Integers
from tsobs_ros.compiled import compiled_nogil
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.stepping import record_type
from tsobs_ros.simulation.channels import Channels, Sums, add_drifts, without_drifts
from tsobs_ros.simulation.integrator import (
    ArmIntegrator,
    Friction,
    Payload,
    advance_arms,
    missing_torques,
)
from tsobs_ros.simulation.series import Series, Span
from tsobs_ros.simulation.signals import ROW, Excitation, excitation_row, recurs, torque_at
from tsobs_ros.simulation.streams import RandomStream, Source

_ARM = record_type(
    [
        ("rate", np.float64),
        ("link_kick", np.float64),
        ("motor_kick", np.float64),
        ("payload_start", np.float64),
        ("payload_duration", np.float64),
    ]
)


class Motion(ABC):
    """The plants of a batch, which are moved from sample to sample.

    Args:
        seeds: One for each run.
        states: States at the first sample, shape (runs, n).
        kicks: Normal numbers a sample that the process noise takes.
        input_count: Number of inputs and scheduled signals.
        torque_count: Number of torques that can be disturbed.
        block: Samples that random numbers are drawn for at a time.

    Attributes:
        states: Present states, shape (runs, n).
        torques: The disturbances of the torques.
        kicks: Normal numbers of the process noise, shape (runs, block, kicks).
        excitations: Rows of the inputs' signals, shape (inputs, ROW).
    """

    def __init__(
        self,
        seeds: Sequence[int],
        states: Array,
        kicks: int,
        input_count: int,
        torque_count: int,
        block: int,
    ) -> None:
        self.states = states
        self.torques = Channels(seeds, Source.TORQUE, torque_count, block)
        self.kicks = np.empty((len(seeds), block, kicks))
        self.excitations = np.zeros((input_count, ROW))
        self._others: list[Excitation | None] = [None] * input_count
        self._stream = RandomStream(seeds, Source.PROCESS) if kicks else None

    def excite(self, place: int, excitation: Excitation) -> None:
        """Let another signal move an input from the next sample on."""
        row = excitation_row(excitation)
        self._others[place] = excitation if row is None else None
        self.excitations[place] = 0.0 if row is None else row

    def draw(self) -> None:
        """Draw the next random numbers."""
        if self._stream is not None:
            self._stream.fill(self.kicks)
        self.torques.draw()

    def add_others(self, inputs: Array, given: Flags, index: int, rate: float) -> None:
        """Write the signals that are not those of `signals`, and mark their inputs as given.

        Args:
            inputs: To write, shape (runs, samples, inputs).
            given: Which inputs are given, shape (inputs,).
            index: Index of the first sample.
            rate: Samples a second [Hz].
        """
        for place, other in enumerate(self._others):
            if other is not None and not given[place]:
                samples = range(index, index + inputs.shape[1])
                inputs[..., place] = [other.torque(sample / rate) for sample in samples]
                given[place] = True

    @property
    def fed_back(self) -> tuple[tuple[int, int], ...]:
        """Places of the inputs that are measurements, each with the number of its output."""
        return ()

    def known_outputs(self) -> Array:
        """Return the present true values of the outputs that are fed back, shape (runs, p)."""
        raise NotImplementedError

    @abstractmethod
    def move(self, span: Span, series: Series) -> None:
        """Write the next samples of every run and move on.

        Args:
            span: The samples.
            series: With the given inputs; states, truths, other inputs and torques are written.
        """


class ArmMotion(Motion):
    """Elastic-joint arms, in physical coordinates.

    Args:
        arm: The arm that moves.
        friction: Its friction.
        payload: What it carries for a time.
        process_noise: Densities of its random accelerations.
        columns: Places of the measured quantities in the state, shape (p,).
        rate: Samples a second [Hz].
        seeds: One for each run.
        states: [q₁, q̇₁, q₂, q̇₂] at the first sample (rad, rad/s), shape (runs, 4).
        block: Samples that random numbers are drawn for at a time.
    """

    def __init__(
        self,
        arm: ElasticJointArm,
        friction: Friction,
        payload: Payload,
        process_noise: ProcessNoise,
        columns: Sequence[int],
        rate: float,
        seeds: Sequence[int],
        states: Array,
        block: int,
    ) -> None:
        bare = ArmIntegrator(arm, 1.0 / rate, friction)
        loaded = ArmIntegrator(arm, 1.0 / rate, friction, payload=payload)
        self._motions = np.empty(2, bare.motion.dtype)
        self._motions[:1], self._motions[1:] = bare.motion, loaded.motion
        self._columns = np.array(columns, dtype=np.int64)
        self._numbers = np.zeros(1, _ARM)
        self._numbers[0] = (
            rate,
            math.sqrt(process_noise.link * bare.substep),
            math.sqrt(process_noise.motor * bare.substep),
            payload.start,
            payload.duration,
        )
        kicks = 2 * bare.substeps if process_noise.link or process_noise.motor else 0
        super().__init__(seeds, states, kicks, 1, 2, block)

    def move(self, span: Span, series: Series) -> None:
        """Write the next samples of every run and move on; see `Motion.move`."""
        _move_arms(
            self._numbers,
            self._motions,
            self._columns,
            self.excitations,
            self.torques.sums,
            self.states,
            self.kicks,
            span,
            series,
        )


@compiled_nogil
def _move_arms(
    plant: Any,
    motions: Any,
    columns: Integers,
    excitations: Array,
    sums: Sums,
    present: Array,
    kicks: Array,
    span: Span,
    series: Series,
) -> None:
    """Move every arm, sample by sample; see `Motion.move`."""
    numbers, rate, runs = plant[0], float(plant[0].rate), present.shape[0]
    start, duration = float(numbers.payload_start), float(numbers.payload_duration)
    link_kick, motor_kick = float(numbers.link_kick), float(numbers.motor_kick)
    torques, pushes = np.empty(runs), np.empty((2, runs))
    for step in range(span.samples):
        draw, place, index = span.drawn + step, span.place + step, span.start + step
        time = index / rate
        motion = motions[1 if recurs(time - start, duration, 0.0) else 0]
        torque = 0.0 if series.given[0] else torque_at(excitations[0], time)
        for side in range(2):
            added, _ = without_drifts(sums, side, index, rate)
            for run in range(runs):
                pushes[side, run] = float(series.torques[run, place, side]) + added
            add_drifts(pushes[side], sums, side, index, rate, draw)
        for run in range(runs):
            state = present[run]
            for item in range(4):
                series.states[run, place, item] = state[item]
            for item in range(columns.shape[0]):
                series.truths[run, place, item] = state[columns[item]]
            if not series.given[0]:
                series.inputs[run, place, 0] = torque
            torques[run] = series.inputs[run, place, 0]
            missing = missing_torques(motion, state, float(pushes[0, run]), float(pushes[1, run]))
            series.torques[run, place, 0], series.torques[run, place, 1] = missing
        advance_arms(motion, present, torques, pushes, kicks, draw, link_kick, motor_kick)
