# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is left in scratch memory decides nothing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

ESTIMATOR = load_design(config_path(SHIPPED_DESIGN)).supervised()


def numbers(records: Any) -> Any:
    return records.view(np.float64)


@pytest.mark.parametrize("outputs", [1, 2])
def test_what_is_left_in_scratch_memory_decides_nothing(outputs: int) -> None:
    """Of a run with all that wakes the bank: forks, a tone, a stuck sensor, missing numbers."""
    design = "both_encoders.design.yaml"
    folder = Path(__file__).resolve().parents[1] / "estimation" / "data"
    one = ESTIMATOR if outputs == 1 else load_design(folder / design).supervised()
    rng, count = np.random.default_rng(3), 1200
    y = np.tile(0.3 * np.sin(0.02 * np.arange(count))[:, np.newaxis], outputs)
    y += 0.02 * rng.standard_normal(y.shape)
    u = np.sin(0.01 * np.arange(count))[:, np.newaxis]
    y[200:] += 0.3
    y[400:, 0] += 0.2 * np.sin(0.03 * np.arange(count - 400))
    y[600:640], u[700:720], u[900] = y[600], np.nan, 20.0
    y[[100, 101, 300, 1000], 0] = 5.0, 1e150, np.nan, 1e200
    found = []
    for fill in (0.0, np.nan, 1e300):
        states, rows = one.new_states(1), one.new_rows(count)
        made = (one.new_corrections(), one.new_work())
        scratch = [numbers(each) for each in made]
        for each in scratch:
            each[:] = fill
        native.estimator_observe(
            numbers(one.model), numbers(states), y, u, one.period, count, *scratch, rows
        )
        found.append(rows.tobytes() + states.tobytes())
        assert np.isfinite(rows).all()
    assert states["hypotheses"]["live"][0, 1:].any()
    assert found[0] == found[1] == found[2]
