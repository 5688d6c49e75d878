# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The link of an arm whose only encoder is on the motor, with unmodelled friction.

The arm is the flexible joint of docs/encoders_and_contacts.md. Needs cvxpy and clarabel:
pip install 'tsobs_ros[design]'.

Usage: python motor_encoder.py [REQUEST.yaml]
"""

import sys

import numpy as np

import tsobs_ros as ts
from tsobs_ros.resources import config_path

path = sys.argv[1] if len(sys.argv) > 1 else config_path("motor_encoder.request.yaml")
design = ts.synthesise(ts.load_request(path))
print(design.text())

# In place of your log: time [s], the encoder's angle [rad] and the motor's torque [N m].
run = ts.simulate(
    design,
    duration=30.0,
    torque=lambda t: 0.15 * np.sin(3.0 * t),
    friction={"motor_viscous": 0.015, "motor_coulomb": 0.01},
    seed=1,
)
estimates = ts.estimate(design, run.time, run.angle, run.torque)

settled = run.time > 10.0
error = estimates.state - run.state
print("errors after 10 s       RMSE    1-sigma bound   within three")
for place, name in enumerate(("link angle", "link velocity", "motor angle", "motor velocity")):
    rmse = np.sqrt(np.mean(error[settled, place] ** 2))
    bound = estimates.state_bound[settled, place]
    inside = np.mean(np.abs(error[settled, place]) <= 3 * bound)
    print(f"{name:<20}{rmse:8.4f}{bound[-1]:17.4f}{inside:15.3f}")

naive = np.sqrt(np.mean((run.angle - run.state[:, 0])[settled] ** 2))
print(f"the motor's angle taken for the link's would be {naive:.4f} rad off")

friction, bound = run.torque_disturbance[:, 0], estimates.torque_disturbance_bound[-1, 0]
rmse = np.sqrt(np.mean((estimates.torque_disturbance[:, 0] - friction)[settled] ** 2))
size = np.sqrt(np.mean(friction[settled] ** 2))
print(f"friction of {size:.4f} N m is estimated to {rmse:.4f} N m, 1-sigma bound {bound:.4f} N m")
