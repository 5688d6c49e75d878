# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The compiled core reads and writes no number outside of the arrays that it is given."""

from typing import Any

import numpy as np
import pytest

from tsobs_ros.core import native
from tsobs_ros.core.records import record_type

SIZES = np.array([2, 1, 0, 1, 1, 1])
ARM = np.ones(20)
ARM.view(np.int64)[0] = 5
SYSTEM = np.ones(record_type("simulated_system", SIZES).itemsize // 8)
SYSTEM.view(np.int64)[0] = 5
MOVERS: dict[str, dict[str, Any]] = {
    # Two arms, and two systems, over three samples of five steps.
    "simulate_arms": {
        "arms": np.concatenate([ARM, ARM]),
        "carried": np.array([0, 1, 0]),
        "inputs": np.zeros((2, 3)),
        "kicks": np.zeros((2, 3, 10)),
        "present": np.ones((2, 4)),
        "states": np.empty((2, 3, 4)),
        "torques": np.zeros((2, 3, 2)),
    },
    "simulate_systems": {
        "sizes": SIZES,
        "system": SYSTEM,
        "inputs": np.zeros((2, 3, 1)),
        "kicks": np.zeros((2, 3, 10)),
        "present": np.ones((2, 2)),
        "states": np.empty((2, 3, 2)),
        "truths": np.empty((2, 3, 1)),
    },
}


@pytest.mark.parametrize(
    ("mover", "name", "given", "complaint"),
    [
        ("simulate_arms", "arms", np.zeros(39), "arms: expected at least 40 numbers, got 39"),
        ("simulate_arms", "arms", np.zeros(40), "kicks: expected none, or two for each"),
        ("simulate_arms", "carried", np.array([0, 2, 0]), "carried: expected 0 or 1"),
        ("simulate_arms", "inputs", np.zeros(5), "inputs: expected at least 6"),
        ("simulate_arms", "kicks", np.zeros(59), "kicks: expected none, or two for each"),
        ("simulate_arms", "states", np.zeros(23), "states: expected at least 24"),
        ("simulate_arms", "torques", np.zeros(11), "torques: expected at least 12"),
        ("simulate_systems", "sizes", SIZES[:5], "sizes: expected at least 6"),
        ("simulate_systems", "sizes", -SIZES, "sizes: expected sizes of a system"),
        ("simulate_systems", "sizes", SIZES * 10_000, "sizes: expected sizes of a system"),
        ("simulate_systems", "system", np.zeros(20), "system: expected at least"),
        ("simulate_systems", "system", np.zeros(50), "kicks: expected none, or one for each"),
        ("simulate_systems", "inputs", np.zeros(5), "inputs: expected at least 6"),
        ("simulate_systems", "kicks", np.zeros(59), "kicks: expected none, or one for each"),
        ("simulate_systems", "truths", np.zeros(5), "truths: expected at least 6"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    mover: str, name: str, given: Any, complaint: str
) -> None:
    move, arguments = getattr(native, mover), MOVERS[mover]
    move(*arguments.values())
    move(*(arguments | {"kicks": np.empty(0)}).values())
    with pytest.raises(ValueError, match=f"{mover}: {complaint}"):
        move(*(arguments | {name: given}).values())
