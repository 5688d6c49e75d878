# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Repetitions of a sample's value that speak for a stuck sensor.

If a sensor's noise hides its steps, every repetition counts. Else it repeats its value whenever the
arm rests or moves by less than a step. Then a repetition counts only if the prediction has left the
value: if |y − ŷ| exceeds the least that it has been since the value came by more than a step and
the prediction's own 1σ, √(S − R).

The step is learnt as the smallest difference of successive values. It grows by a fiftieth with each
difference, so that a single odd value is forgotten. The noise is learnt as the running median of
the differences of successive innovations, as the arm's motion is not in them.
"""

import math
from typing import Any

import numpy as np

from tsobs_ros.compiled import compiled

REPEAT_FIELDS = (
    ("value", np.float64),
    ("step", np.float64),
    ("rough", np.float64),
    ("before", np.float64),
    ("nearest", np.float64),
    ("repeats", np.int64),
)
"""Fields of a record that `count_repeats` works on.

value: the latest one, NaN before the first. step, rough: of the sensor, and of the differences of
its innovations, 0 before the first difference. before: innovation of the sample before. nearest:
least |y − ŷ| of the value. repeats: repetitions that count.
"""

_RATE = 1.02
_HIDDEN = 3.0


@compiled
def count_repeats(
    record: Any, y: float, innovation: float, variance: float, noise: float, tolerance: float
) -> None:
    """Take in a sample.

    Args:
        record: With the fields of `REPEAT_FIELDS`; of the same unit as y.
        y: The sample.
        innovation: y − ŷ.
        variance: S, expected of the innovation.
        noise: R, expected of the sample's noise.
        tolerance: Values that differ by no more are the same.
    """
    distance, difference = abs(innovation), abs(y - record.value)
    if difference <= tolerance:
        if distance < record.nearest:
            record.nearest = distance
        known = variance - noise
        own = math.sqrt(known) if known > 0.0 else 0.0
        step = record.step if record.step > 0.0 else math.sqrt(noise)
        if record.rough > _HIDDEN * step or distance > record.nearest + step + own:
            record.repeats += 1
    else:
        change = abs(innovation - record.before)
        if not math.isfinite(difference) or not math.isfinite(change):
            pass
        elif record.step == 0.0:
            record.step, record.rough = difference, change
        else:
            record.step = min(difference, _RATE * record.step)
            if change > record.rough:
                record.rough *= _RATE
            else:
                record.rough /= _RATE
        record.value, record.nearest, record.repeats = y, distance, 0
    record.before = innovation


@compiled
def forget_value(record: Any) -> None:
    """Take the next sample for a new value: the prediction has moved for another reason."""
    record.value, record.before, record.repeats = math.nan, math.nan, 0
