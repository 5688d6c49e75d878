# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An observer for your own arm: request, certified design, estimates, a figure.

Needs cvxpy, clarabel and matplotlib: pip install 'tsobs_ros[design,report]'.

Usage: python own_arm.py [FOLDER for the design and the figure; the current one if omitted]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

import tsobs_ros as ts

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
folder.mkdir(parents=True, exist_ok=True)

# The same can be written as YAML and read by ts.load_request("my_arm.request.yaml").
request = ts.ArmRequest(
    arm=ts.ElasticJointArm(
        link_inertia=0.8, motor_inertia=1.5, stiffness=25.0, gravity_torque=6.0, link_damping=0.1
    ),
    measurement_std=0.01,  # of the angle sensor [rad]
    rate=500.0,  # [Hz]
    x_max=0.9,  # the link angle stays within ±0.9 rad
)
design = ts.synthesise(request)  # if no observer exists, the error explains why
print(*design.certificate.inequalities, sep="\n")
path = folder / "my_arm.design.yaml"
ts.save_design(design, path)
print(f"wrote {path}; next, and with `ros2 run tsobs_ros` before `observer` in a workspace:")
print(f"tsobs verify {path}", f"observer --ros-args -p design:={path}", sep="\n")

# In place of the simulation: your log's time [s], angle [rad] and torque [N m].
ramp = {"ramp": {"rate": 0.02, "start": 4.0}}  # the sensor drifts away [rad/s], from 4 s on
run = ts.simulate(design, duration=10.0, disturbance=ramp, torque=lambda t: 2.0 * (t % 4 < 2))
estimates = ts.estimate(design, run.time, run.angle, run.torque)

figure, (top, bottom) = plt.subplots(2, sharex=True, layout="constrained")
bound = 2 * estimates.state_bound[:, 1]
top.plot(run.time, run.state[:, 1], "k", label="true")
top.plot(run.time, estimates.state[:, 1], label="estimated")
top.fill_between(
    run.time, estimates.state[:, 1] - bound, estimates.state[:, 1] + bound, alpha=0.3, label="±2σ"
)
top.set_ylabel("link velocity [rad/s]")
top.legend()
bottom.plot(run.time, run.disturbance, "k")
bottom.plot(run.time, estimates.disturbance)
bottom.set(xlabel="time [s]", ylabel="sensor disturbance [rad]", ylim=(-0.1, 0.2))
figure.savefig(folder / "my_arm.png", dpi=120)
print(f"wrote {folder / 'my_arm.png'}")
