# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A joint with encoders, its data sheet, a torque of many tones, and recordings of both."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

import tsobs_ros as ts
from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest, Output, TorqueDisturbance
from tsobs_ros.model.flow import ProcessNoise

ARM = ts.ElasticJointArm(0.0059, 0.0021, 1.61, 0.2372, 0.0, 0.1109)
WRONG = ts.ElasticJointArm(0.0077, 0.0015, 2.09, 0.166, 0.0, 0.144)
"""The same arm by a data sheet that is 30 % wrong everywhere."""

Recorded = tuple[Array, Array, Array]


def request_of(arm: ts.ElasticJointArm = ARM, *outputs: str, **changes: Any) -> ArmRequest:
    """Return the request of an arm with precise encoders, at 500 Hz."""
    measured = tuple(Output(name, 0.001) for name in outputs or ("motor_angle", "link_angle"))
    request = ArmRequest(
        arm,
        outputs=measured,
        process_noise=ProcessNoise(0.01, 0.01),
        torque_disturbance=TorqueDisturbance(),
        rate=500.0,
        x_max=3.1,
        initial_std=(0.3, 2.0, 0.3, 2.0),
        uncertainty={},
    )
    return replace(request, **changes)


def tones(duration: float, seed: int) -> Array:
    """Return the torque of twelve tones up to 8 Hz [N m] at 500 Hz, with phases by a seed."""
    rng, time = np.random.default_rng(seed), np.arange(round(500 * duration) + 1) / 500.0
    frequencies = 2.0 * np.pi * np.linspace(0.3, 8.0, 12)
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    return 0.05 * np.sin(np.outer(time, frequencies) + phases).sum(axis=1)


def run_of(
    request: ArmRequest,
    duration: float,
    seed: int = 0,
    friction: Mapping[str, float] | None = None,
    torque: Array | None = None,
) -> Any:
    """Return a simulation of an arm from rest at 0."""
    torque = tones(duration, seed) if torque is None else torque
    start = [0.0] * 4
    return ts.simulate(
        request, duration=duration, seed=seed, torque=torque, friction=friction, initial_state=start
    )


def recorded(request: ArmRequest, duration: float, *args: Any, **kwargs: Any) -> Recorded:
    """Return time, outputs and torque of `run_of`."""
    run = run_of(request, duration, *args, **kwargs)
    return run.time, run.angle, run.torque
