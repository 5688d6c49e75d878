# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulated arm with a good sensor: what all bad input departs from and comes back to."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from staging import to_stamp
from tsobs_ros.estimation.records import Measurement
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.simulation.plant import Trajectories
from tsobs_ros.simulation.scenarios import SCENARIOS, simulate

SECONDS = 20.0
"""Length of the run; after it the arm restarts, which no observer can know."""


@lru_cache(maxsize=4)
def _simulated(rate: float, seconds: float) -> tuple[Trajectories, NDArray[np.float64]]:
    scenario = replace(SCENARIOS["noise"], rate=rate)
    run = simulate(scenario, [8], seconds)
    return run, scenario.arm.to_physical(run.states[0])


class Arm:
    """A run of an arm that starts at a stamp.

    Args:
        origin: Stamp of the first sample [ns].
        joint: The joint's name.
        rate: Samples a second [Hz].
        seconds: Length of the run [s].
    """

    def __init__(
        self,
        origin: int,
        joint: str = "elastic_joint",
        rate: float = 200.0,
        seconds: float = SECONDS,
    ) -> None:
        self.origin, self.joint = origin, joint
        self.period = round(NANOSECONDS / rate)
        run, self._states = _simulated(rate, seconds)
        self._angles, self._torques = run.measurements[0], run.torques[0]

    def stamps(self, begin: int, seconds: float) -> Iterator[int]:
        """Return the stamps of the samples from `begin` on."""
        first = -(-(begin - self.origin) // self.period)
        last = -(-(begin + round(seconds * NANOSECONDS) - self.origin) // self.period)
        return (self.origin + index * self.period for index in range(first, last))

    def measurement(self, stamp: int) -> Measurement:
        """Return the sample taken at the stamp, or last before it."""
        index = (stamp - self.origin) // self.period % (len(self._angles) - 1)
        return Measurement(stamp, self._angles[index], self._torques[index])

    def message(self, stamp: int, **changes: Any) -> JointState:
        """Return that sample as a message, with any of its fields changed."""
        sample = self.measurement(stamp)
        fields = {
            "name": [self.joint],
            "position": sample.y.tolist(),
            "effort": sample.u.tolist(),
            **changes,
        }
        message = JointState(**fields)
        message.header.stamp = to_stamp(stamp)
        return message

    def truth(self, stamp: int) -> NDArray[np.float64]:
        """Return the true [q₁, q̇₁, q₂, q̇₂] (rad, rad/s) at any stamp."""
        index, rest = divmod(stamp - self.origin, self.period)
        index %= len(self._angles) - 1
        before, after = self._states[index : index + 2]
        return np.asarray(before + (after - before) * (rest / self.period))
