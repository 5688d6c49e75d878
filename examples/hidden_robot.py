# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A stand-in for a robot: an arm with hidden numbers plays a motion and is recorded.

Each number differs by up to 30 % from motor_encoder.request.yaml, the data sheet. The motor has
Coulomb friction, its torque is late and has an offset, and the encoders count in steps.

Usage: python hidden_robot.py MOTION.csv RECORDING.csv [SEED]
"""

import math
import sys
from dataclasses import asdict

import numpy as np

import tsobs_ros as ts
from tsobs_ros.design.request import Output
from tsobs_ros.model.arm import TorquePath
from tsobs_ros.resources import config_path

if len(sys.argv) < 3:
    sys.exit(__doc__)
motion, recording = sys.argv[1:3]
seed = int(sys.argv[3]) if len(sys.argv) > 3 else 1  # another seed is another robot

draw = np.random.default_rng(seed).uniform
sheet = ts.load_request(config_path("motor_encoder.request.yaml"))
robot = ts.ArmRequest(
    ts.ElasticJointArm(**{k: v * draw(0.7, 1.3) for k, v in asdict(sheet.arm).items()}),
    outputs=(Output("motor_angle", 0.0003), Output("link_angle", 0.0003)),
    torque=TorquePath(offset=draw(-0.01, 0.01), delay=1.5 * sheet.period),
    process_noise=sheet.process_noise,
    rate=sheet.rate,
    x_max=sheet.x_max,
)

# Time and torque; comments and titles are skipped.
columns = {"delimiter": ",", "comments": ["#", "time"], "usecols": (0, 1), "unpack": True}
time, torque = np.loadtxt(motion, **columns)
run = ts.simulate(
    robot,
    duration=time[-1] - time[0],
    torque=torque,
    initial_state=[0.0, 0.0, 0.0, 0.0],
    friction={"motor_coulomb": 0.01},  # [N m]
    seed=seed,
)
step = 2.0 * math.pi / 4096  # of the encoders [rad]
np.savetxt(
    recording,
    np.column_stack([run.time, step * np.round(run.angle / step), run.torque]),
    delimiter=",",
    fmt="%.9g",
    header="time [s],motor_angle [rad],link_angle [rad],torque [N m]",
    comments="",
)
print(f"wrote {recording}: {len(run.time):,} samples, {run.time[-1]:g} s")
