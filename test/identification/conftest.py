# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of a joint with encoders, moved by many tones."""

from collections.abc import Callable, Mapping

import pytest
from identified_joint import Recorded, tones

import tsobs_ros as ts
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest


@pytest.fixture
def recorded() -> Callable[..., Recorded]:
    """Records an arm: time, outputs and torque."""

    def record(
        request: ArmRequest,
        duration: float = 12.0,
        seed: int = 0,
        friction: Mapping[str, float] | None = None,
        torque: Array | None = None,
    ) -> Recorded:
        run = ts.simulate(
            request,
            duration=duration,
            seed=seed,
            torque=tones(duration, seed) if torque is None else torque,
            friction=friction,
            initial_state=[0.0] * 4,
        )
        return run.time, run.angle, run.torque

    return record
