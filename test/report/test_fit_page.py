# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A page of a fit has its numbers, what they predict and what is left, and needs only itself."""

import shutil
from dataclasses import replace

import pytest

import tsobs_ros as ts
from tsobs_ros.cli.main import main
from tsobs_ros.design.request import Output
from tsobs_ros.identification.result import Lack
from tsobs_ros.report.fit import write_page

HOSTILE = "<script>alert(1)</script>.csv"
FREE = ("stiffness", "motor_friction", "torque.offset", "link_damping", "motor_angle")


@pytest.fixture(scope="module")
def recorded():
    """Return a request whose stiffness is wrong, and a run of an arm that has friction."""
    request = ts.ArmRequest(x_max=3.0, uncertainty={}).with_outputs(
        [Output("motor_angle", 0.002), Output("link_angle", 0.002)]
    )
    run = ts.simulate(
        request, duration=12.0, friction={"motor_coulomb": 0.4},
        torque=lambda t: 4.0 if t % 1.7 < 0.8 else -3.0 if t % 1.1 < 0.6 else 1.0,
    )  # fmt: skip
    return replace(request, arm=replace(request.arm, stiffness=13.0)), run
