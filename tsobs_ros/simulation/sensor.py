# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The angle sensor: white noise, and what can happen to its samples on the way."""

import math
from dataclasses import dataclass

import numpy as np

from tsobs_ros.checks import Array, non_negative
from tsobs_ros.errors import ModelError
from tsobs_ros.simulation.streams import RandomStream, Seeds, Source


@dataclass(frozen=True)
class Sensor:
    """Numbers of the sensor; the default noise is Example 3's 5 % of the largest angle.

    Attributes:
        noise_std: σ of the white noise of a sample [rad].
        outlier_probability: Probability that a sample is an outlier.
        outlier_size: What an outlier adds, with either sign [rad].
        dropout_interval: Time from the beginning of a dropout to that of the next, the first one
            after one interval [s]; 0 for none.
        dropout_duration: Length of a dropout [s].
    """

    noise_std: float = 0.028
    outlier_probability: float = 0.0
    outlier_size: float = 1.0
    dropout_interval: float = 0.0
    dropout_duration: float = 0.5

    def __post_init__(self) -> None:
        for name in ("noise_std", "dropout_interval", "dropout_duration"):
            non_negative(name, getattr(self, name))
        if not 0.0 <= self.outlier_probability <= 1.0:
            raise ModelError(
                f"outlier_probability: expected 0 to 1, got {self.outlier_probability!r}"
            )
        if not math.isfinite(self.outlier_size):
            raise ModelError(f"outlier_size: expected a finite number, got {self.outlier_size!r}")

    def drops(self, time: float) -> bool:
        """Return whether a sample at a time [s] is lost."""
        if self.dropout_interval == 0.0 or time < self.dropout_interval:
            return False
        # The margin keeps a sample that lies on a border on its side, whatever % rounds to.
        return (time + 1e-9) % self.dropout_interval < self.dropout_duration - 1e-9


class SensorNoise:
    """The random part of the samples, drawn once a sample and in order.

    Args:
        seeds: One seed, or one for each run.
    """

    def __init__(self, seeds: Seeds) -> None:
        self._noise = RandomStream(seeds, Source.MEASUREMENT, (1,))
        self._luck = RandomStream(seeds, Source.OUTLIER, (1,), uniform=True)

    def sample(self, sensor: Sensor) -> tuple[Array, Array | None]:
        """Return white noise and outliers [rad] of the next sample, each (1,) or (runs, 1).

        The outliers are None where there cannot be any. Both streams move on whatever the
        sensor's numbers are, so that these may change at any sample without a change of the
        others.
        """
        noise = sensor.noise_std * self._noise.draw()
        luck, probability = self._luck.draw(), sensor.outlier_probability
        if probability == 0.0:
            return noise, None
        sign = np.where(luck < 0.5 * probability, -1.0, 1.0)
        return noise, np.where(luck < probability, sensor.outlier_size * sign, 0.0)
