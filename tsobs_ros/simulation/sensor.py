# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The angle sensor of a simulated plant."""

import math
from dataclasses import dataclass, fields

from tsobs_ros.checks import Array, check_each, non_negative
from tsobs_ros.compiled import compiled
from tsobs_ros.errors import ModelError
from tsobs_ros.model.trigonometry import exponential
from tsobs_ros.simulation.signals import recurs


@dataclass(frozen=True)
class Sensor:
    """Numbers of the sensor; the default noise is Example 3's 5 % of the largest angle.

    Attributes:
        noise_std: σ of the noise of a sample [rad].
        outlier_probability: Probability that a sample is an outlier.
        outlier_size: What an outlier adds, with either sign [rad].
        dropout_interval: Time from the beginning of a dropout to that of the next, the first one
            after one interval [s]; 0 for none.
        dropout_duration: Length of a dropout [s].
        outlier_is_uniform: Whether an outlier adds anything up to its size, and not just its size.
        noise_time_constant: τ of the noise's correlation e^(−t/τ) [s]; 0 for white noise.
        noise_degrees: Degrees of freedom of Student's t, which σ multiplies; 0 for normal noise.
        burst_interval: Time from the beginning of louder noise to that of the next, the first one
            after one interval [s]; 0 for none.
        burst_duration: Length of a burst [s].
        burst_factor: What multiplies the noise in a burst.
        latency: Age of the angle that is measured [s], rounded to whole samples; a disturbance is
            that of the sample.
        resolution: Step of the measured value [rad]; 0 for none.
    """

    noise_std: float = 0.028
    outlier_probability: float = 0.0
    outlier_size: float = 1.0
    dropout_interval: float = 0.0
    dropout_duration: float = 0.5
    outlier_is_uniform: bool = False
    noise_time_constant: float = 0.0
    noise_degrees: int = 0
    burst_interval: float = 0.0
    burst_duration: float = 1.5
    burst_factor: float = 4.0
    latency: float = 0.0
    resolution: float = 0.0

    def __post_init__(self) -> None:
        names = [item.name for item in fields(self)]
        check_each(non_negative, self, *(name for name in names if "outlier" not in name))
        if not 0.0 <= self.outlier_probability <= 1.0:
            raise ModelError(
                f"outlier_probability: expected 0 to 1, got {self.outlier_probability!r}"
            )
        if not math.isfinite(self.outlier_size):
            raise ModelError(f"outlier_size: expected a finite number, got {self.outlier_size!r}")


@compiled
def is_within(time: float, interval: float, duration: float) -> bool:
    """Return whether a time [s] lies in a dropout or a burst, the first after one interval."""
    return interval > 0.0 and recurs(time - interval, duration, interval)


@compiled
def outlier(luck: float, probability: float, size: float, is_uniform: bool) -> float:
    """Return what an outlier adds [rad], 0 if it is none, by a number drawn from [0, 1)."""
    if not luck < probability:
        return 0.0
    if is_uniform:
        return size * (2.0 * luck / probability - 1.0)
    return -size if luck < 0.5 * probability else size


@compiled
def student(number: float, others: Array) -> float:
    """Return a number of Student's t from a normal one and as many as its degrees of freedom."""
    total = 0.0
    for i in range(others.shape[0]):
        total += float(others[i]) * float(others[i])
    return number / math.sqrt(total / others.shape[0])


@compiled
def correlated(before: float, number: float, period: float, time_constant: float) -> float:
    """Return a number of unit variance a period [s] after another, from an independent one."""
    decay = exponential(-period / time_constant)
    return decay * before + math.sqrt(1.0 - decay * decay) * number
