# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The angle sensor of a simulated plant."""

import math
from dataclasses import dataclass

from tsobs_ros.checks import non_negative
from tsobs_ros.compiled import compiled
from tsobs_ros.errors import ModelError


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


@compiled
def is_dropped(time: float, interval: float, duration: float) -> bool:
    """Return whether a sample at a time [s] lies in a dropout."""
    if interval == 0.0 or time < interval:
        return False
    # The margin keeps a sample that lies on a border on its side, whatever % rounds to.
    return (time + 1e-9) % interval < duration - 1e-9


@compiled
def outlier(luck: float, probability: float, size: float) -> float:
    """Return what an outlier adds [rad], 0 if it is none, by a number drawn from [0, 1)."""
    if luck < 0.5 * probability:
        return -size
    return size if luck < probability else 0.0
