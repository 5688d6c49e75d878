# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion of simulated plants between samples, in every run of a batch."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.model.flow import ProcessNoise
from tsobs_ros.simulation.channels import Channels
from tsobs_ros.simulation.integrator import ArmIntegrator, Friction, Payload
from tsobs_ros.simulation.series import Series, Span
from tsobs_ros.simulation.signals import NoTorque, Signal, recurs
from tsobs_ros.simulation.streams import RandomStream, Source


class Motion(ABC):
    """The plants of a batch, which are moved from sample to sample.

    Args:
        seeds: One for each run.
        states: States at the first sample, shape (runs, n).
        kicks: Normal numbers a sample that the process noise takes.
        input_count: Number of inputs and scheduled signals.
        torque_count: Number of torques that can be disturbed.
        rate: Samples a second [Hz].
        block: Samples that random numbers are drawn for at a time.

    Attributes:
        states: Present states, shape (runs, n).
        torques: The disturbances of the torques.
        kicks: Normal numbers of the process noise, shape (runs, block, kicks).
        excitations: The inputs' signals.
        rate: Samples a second [Hz].
    """

    def __init__(
        self,
        seeds: Sequence[int],
        states: Array,
        kicks: int,
        input_count: int,
        torque_count: int,
        rate: float,
        block: int,
    ) -> None:
        self.states, self.rate = np.ascontiguousarray(states), rate
        self.torques = Channels(seeds, Source.TORQUE, torque_count, block, rate)
        self.kicks = np.empty((len(seeds), block, kicks))
        self.excitations: list[Signal] = [NoTorque()] * input_count
        self._stream = RandomStream(seeds, Source.PROCESS) if kicks else None

    def excite(self, place: int, excitation: Signal) -> None:
        """Let another signal move an input from the next sample on."""
        self.excitations[place] = excitation

    def draw(self) -> None:
        """Draw the next random numbers."""
        if self._stream is not None:
            self._stream.fill(self.kicks)
        self.torques.draw()

    def add_inputs(self, inputs: Array, given: int, index: int) -> None:
        """Write the signals of the inputs.

        Args:
            inputs: To write, shape (runs, samples, inputs).
            given: Number of the first inputs that are written already.
            index: Index of the first sample.
        """
        times = np.arange(index, index + inputs.shape[1]) / self.rate
        for place in range(given, len(self.excitations)):
            inputs[..., place] = self.excitations[place].values(times)

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
            series: With inputs and disturbances of torques; states, truths and torques are written.
        """


class ArmMotion(Motion):
    """Elastic-joint arms, in physical coordinates.

    Args:
        arm: The arm that moves.
        friction: Its friction.
        payload: What it carries for a time.
        process_noise: Densities of its random accelerations.
        backlash: Play of its gear [rad].
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
        backlash: float,
        columns: Sequence[int],
        rate: float,
        seeds: Sequence[int],
        states: Array,
        block: int,
    ) -> None:
        bare, loaded = (
            ArmIntegrator(
                arm,
                1.0 / rate,
                friction,
                payload=carried,
                process_noise=process_noise,
                backlash=backlash,
            )
            for carried in (None, payload)
        )
        self._arms = np.concatenate([bare.numbers, loaded.numbers])
        self._payload, self._columns = payload, list(columns)
        kicks = 2 * bare.substeps if process_noise.link or process_noise.motor else 0
        super().__init__(seeds, states, kicks, 1, 2, rate, block)

    def move(self, span: Span, series: Series) -> None:
        """Write the next samples of every run and move on; see `Motion.move`."""
        since = span.times(self.rate) - self._payload.start
        states, torques = np.empty((len(self.states), span.samples, 4)), span.of(series.torques)
        moving = torques.copy()
        for side in range(moving.shape[2]):
            self.torques.add_drifts(moving[..., side], side, span)
        native.simulate_arms(
            self._arms,
            recurs(since, self._payload.duration, 0.0).astype(np.int64),
            np.ascontiguousarray(span.of(series.inputs)),
            np.ascontiguousarray(span.drawn_for(self.kicks)),
            self.states,
            states,
            moving,
        )
        torques[...] = moving
        span.of(series.states)[...] = states
        span.of(series.truths)[...] = states[..., self._columns]
