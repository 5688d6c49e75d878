# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion of simulated plants between samples, in every run of a batch."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.compiled import compiled_nogil
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.model.stepping import record_type
from tsobs_ros.simulation.channels import Channels, Counts, Flags, drifts_in, with_drifts
from tsobs_ros.simulation.integrator import (
    ArmIntegrator,
    Friction,
    Payload,
    advance_arm,
    missing_torques,
)
from tsobs_ros.simulation.signals import (
    ROW,
    Excitation,
    disturbance_at,
    excitation_row,
    recurs,
    torque_at,
)
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
    def move(
        self,
        index: int,
        drawn: int,
        samples: int,
        states: Array,
        truths: Array,
        inputs: Array,
        given: Flags,
        torques: Array,
        first: int,
    ) -> None:
        """Write the next samples of every run and move on.

        Args:
            index: Index of the first sample.
            drawn: Its place in the blocks of random numbers.
            samples: Number of samples.
            states: To write, shape (runs, all, n).
            truths: True values of the outputs, to write, shape (runs, all, p).
            inputs: To write unless they are given, shape (runs, all, inputs).
            given: Which inputs are given, shape (inputs,).
            torques: Disturbances of the torques to add to, shape (runs, all, t); what an
                undisturbed plant would need to move so is written in their place.
            first: Place of the first sample in these.
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

    def move(
        self,
        index: int,
        drawn: int,
        samples: int,
        states: Array,
        truths: Array,
        inputs: Array,
        given: Flags,
        torques: Array,
        first: int,
    ) -> None:
        """Write the next samples of every run and move on; see `Motion.move`."""
        channels = self.torques
        _move_arms(
            self._numbers,
            self._motions,
            self._columns,
            self.excitations,
            channels.rows,
            channels.ends,
            channels.injected,
            channels.drifts,
            channels.noise,
            self.states,
            self.kicks,
            index,
            drawn,
            samples,
            states,
            truths,
            inputs,
            bool(given[0]),
            torques,
            first,
        )


@compiled_nogil
def _move_arms(
    plant: Any,
    motions: Any,
    columns: Counts,
    excitations: Array,
    rows: Array,
    ends: Counts,
    injected: Counts,
    drifts: Array,
    drift_noise: Array,
    present: Array,
    kicks: Array,
    index: int,
    drawn: int,
    samples: int,
    states: Array,
    truths: Array,
    inputs: Array,
    is_given: bool,
    torques: Array,
    first: int,
) -> None:
    """Move every arm, sample by sample; see `Motion.move`."""
    numbers, rate, motor_end, link_end = plant[0], float(plant[0].rate), ends[0], ends[1]
    start, duration = float(numbers.payload_start), float(numbers.payload_duration)
    motor_drifts = drifts_in(rows, 0, motor_end)
    for step in range(samples):
        draw, place, time = drawn + step, first + step, (index + step) / rate
        motion = motions[1 if recurs(time - start, duration, 0.0) else 0]
        torque = 0.0 if is_given else torque_at(excitations[0], time)
        motor_since = index + step - injected[0]
        link_since = index + step - injected[1]
        motor_added = disturbance_at(rows[:motor_end], motor_since / rate)
        link_added = disturbance_at(rows[motor_end:], link_since / rate)
        for run in range(present.shape[0]):
            state = present[run]
            for item in range(4):
                states[run, place, item] = state[item]
            for item in range(columns.shape[0]):
                truths[run, place, item] = state[columns[item]]
            if is_given:
                torque = float(inputs[run, place, 0])
            else:
                inputs[run, place, 0] = torque
            motor_push = float(torques[run, place, 0]) + motor_added
            link_push = float(torques[run, place, 1]) + link_added
            if motor_end > 0:
                motor_push = with_drifts(
                    motor_push,
                    rows,
                    0,
                    motor_end,
                    motor_since,
                    rate,
                    drifts,
                    drift_noise,
                    0,
                    run,
                    draw,
                )
            if link_end > motor_end:
                link_push = with_drifts(
                    link_push,
                    rows,
                    motor_end,
                    link_end,
                    link_since,
                    rate,
                    drifts,
                    drift_noise,
                    motor_drifts,
                    run,
                    draw,
                )
            missing = missing_torques(motion, state, motor_push, link_push)
            torques[run, place, 0], torques[run, place, 1] = missing
            advance_arm(
                motion,
                state,
                torque,
                motor_push,
                link_push,
                kicks[run, draw],
                float(numbers.link_kick),
                float(numbers.motor_kick),
            )
