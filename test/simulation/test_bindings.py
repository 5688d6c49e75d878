# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The compiled core reads and writes no number outside of the arrays that it is given."""

from typing import Any

import numpy as np
import pytest

from tsobs_ros.core import native
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.simulation.integrator import ArmIntegrator

SIZES = np.array([2, 1, 0, 1, 1, 1])


def arms(**changes: Any) -> list[Any]:
    """Return arguments for two arms that move over three samples."""
    numbers = ArmIntegrator(ElasticJointArm(), 0.005).numbers
    arguments = {
        "arms": np.concatenate([numbers, numbers]),
        "carried": np.array([0, 1, 0]),
        "inputs": np.zeros((2, 3)),
        "kicks": np.zeros((2, 3, 10)),
        "present": np.ones((2, 4)),
        "states": np.empty((2, 3, 4)),
        "torques": np.zeros((2, 3, 2)),
    }
    return list((arguments | changes).values())


def system(**changes: Any) -> list[Any]:
    """Return arguments for two systems that move over three samples."""
    rows = (row * column for _, _, row, column in native.simulated_system_layout(SIZES))
    record = np.ones(sum(rows))
    record.view(np.int64)[0] = 5
    arguments = {
        "sizes": SIZES,
        "system": record,
        "inputs": np.zeros((2, 3, 1)),
        "kicks": np.zeros((2, 3, 10)),
        "present": np.ones((2, 2)),
        "states": np.empty((2, 3, 2)),
        "truths": np.empty((2, 3, 1)),
    }
    return list((arguments | changes).values())


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"arms": np.zeros(39)}, "arms: expected at least 40 numbers, got 39"),
        ({"arms": np.zeros(40)}, "kicks: expected none, or two for each"),
        ({"carried": np.array([0, 2, 0])}, "carried: expected 0 or 1"),
        ({"inputs": np.zeros(5)}, "inputs: expected at least 6"),
        ({"kicks": np.zeros(59)}, "kicks: expected none, or two for each"),
        ({"states": np.zeros(23)}, "states: expected at least 24"),
        ({"torques": np.zeros(11)}, "torques: expected at least 12"),
    ],
)
def test_arms_in_arrays_that_are_too_short_are_refused(
    changes: dict[str, Any], complaint: str
) -> None:
    native.simulate_arms(*arms())
    native.simulate_arms(*arms(kicks=np.empty(0)))
    with pytest.raises(ValueError, match=f"simulate_arms: {complaint}"):
        native.simulate_arms(*arms(**changes))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"sizes": SIZES[:5]}, "sizes: expected at least 6"),
        ({"sizes": -SIZES}, "sizes: expected sizes of a system"),
        ({"sizes": SIZES * 10_000}, "sizes: expected sizes of a system"),
        ({"system": np.zeros(20)}, "system: expected at least"),
        ({"system": np.zeros(50)}, "kicks: expected none, or one for each"),
        ({"inputs": np.zeros(5)}, "inputs: expected at least 6"),
        ({"kicks": np.zeros(59)}, "kicks: expected none, or one for each"),
        ({"truths": np.zeros(5)}, "truths: expected at least 6"),
    ],
)
def test_systems_in_arrays_that_are_too_short_are_refused(
    changes: dict[str, Any], complaint: str
) -> None:
    native.simulate_systems(*system())
    native.simulate_systems(*system(kicks=np.empty(0)))
    with pytest.raises(ValueError, match=f"simulate_systems: {complaint}"):
        native.simulate_systems(*system(**changes))
