# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The running disturbance of a plant: its components added up, sample by sample."""

import math
from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.simulation.signals import Component, GaussMarkov, StuckSensor
from tsobs_ros.simulation.streams import RandomStream, Seeds, Source, batch_shape


class DisturbanceSource:
    """The sum of components, sampled once a period and in order.

    Args:
        components: What is added up; of stuck sensors any one that holds freezes the value.
        period: Sampling period [s].
        seeds: One seed, or one for each run.
        generation: Tells the random streams of disturbances put in one after another apart.
    """

    def __init__(
        self, components: Sequence[Component], period: float, seeds: Seeds, generation: int = 0
    ) -> None:
        self._plain = [c for c in components if not isinstance(c, GaussMarkov | StuckSensor)]
        self._stuck = [c for c in components if isinstance(c, StuckSensor)]
        self._ones = np.ones((*batch_shape(seeds), 1))
        self._drifts = [
            _Drift(component, period, seeds, (generation, place))
            for place, component in enumerate(components)
            if isinstance(component, GaussMarkov)
        ]

    def sample(self, time: float) -> Array:
        """Return the added disturbance [rad] at the next time [s], shape (1,) or (runs, 1)."""
        value = 0.0
        for component in self._plain:
            value += component.value(time)
        total = value * self._ones
        for drift in self._drifts:
            total = total + drift.sample(time)
        return total

    def stuck(self, time: float) -> bool:
        """Return whether the sensor is stuck at a time [s]."""
        return bool(self._stuck) and any(component.holds(time) for component in self._stuck)


class _Drift:
    """The running value of a Gauss–Markov component."""

    def __init__(
        self, component: GaussMarkov, period: float, seeds: Seeds, key: tuple[int, ...]
    ) -> None:
        self._start = component.start
        self._decay = math.exp(-period / component.time_constant)
        self._step_std = component.std * math.sqrt(1.0 - self._decay**2)
        self._stream = RandomStream(seeds, Source.DISTURBANCE, (1,), key=key)
        self._value: Array | None = None

    def sample(self, time: float) -> Array:
        step = self._stream.draw()
        if time < self._start:
            return np.zeros_like(step)
        if self._value is None:
            self._value = np.zeros_like(step)
        else:
            self._value = np.asarray(self._decay * self._value + self._step_std * step)
        return self._value
