# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A contact that pushes the link while the link's encoder slips: both estimated and distinguished.

The arm is the flexible joint of docs/encoders_and_contacts.md. Needs cvxpy, clarabel, matplotlib:
pip install 'tsobs_ros[design,report]'.

Usage: python contact_torque.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tsobs_ros as ts
from tsobs_ros.resources import config_path
from tsobs_ros.simulation.signals import BiasStep

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
folder.mkdir(parents=True, exist_ok=True)
design = ts.synthesise(ts.load_request(config_path("contact_torque.request.yaml")))
contact = 0.2 * design.request.arm.gravity_torque

# In place of your log: time [s], the angles of motor and link [rad] and the torque [N m].
run = ts.simulate(
    design,
    duration=20.0,
    torque=lambda t: 0.1 * np.sin(2.0 * t),
    torque_disturbance={"link": [BiasStep(contact, 10.0), BiasStep(-contact, 15.0)]},
    disturbance={"link_angle": {"bias_step": {"amplitude": 0.05, "start": 10.0}}},
    friction={"motor_viscous": 0.015, "motor_coulomb": 0.01},
    seed=1,
)
estimates = ts.estimate(design, run.time, run.angle, run.torque)

found = (estimates.torque_disturbance, estimates.torque_disturbance_bound)
slip = (estimates.disturbance, estimates.disturbance_bound)
signals = {  # true, estimated, 1-sigma bound; column 1 is the link, after the motor
    "contact torque [N m]": [each[:, 1] for each in (run.torque_disturbance, *found)],
    "link encoder's bias [rad]": [each[:, 1] for each in (run.disturbance, *slip)],
}
settled, late = run.time > 5.0, np.searchsorted(run.time, 14.0)
figure, axes = plt.subplots(2, sharex=True, layout="constrained", figsize=(8, 5))
for axis, (name, (true, guess, bound)) in zip(axes, signals.items(), strict=True):
    noticed = run.time[settled & (np.abs(guess) > 3 * bound)][0] - 10.0
    inside = np.mean(np.abs(guess - true)[settled] <= 3 * bound[settled])
    print(
        f"{name}: noticed after {noticed:.3f} s, {guess[late]:.4f} at 14 s, true {true[late]:.4f}"
    )
    print(f"    within three bounds: {inside:.3f}")
    axis.fill_between(run.time, guess - 3 * bound, guess + 3 * bound, alpha=0.25, lw=0)
    axis.plot(run.time, guess, label="estimated, with three bounds")
    axis.plot(run.time, true, "k", lw=1, label="true")
    axis.set(ylabel=name, ylim=(-1.5 * true.max(), 2.5 * true.max()), xlim=(5.0, 20.0))
axes[0].legend(loc="upper right")
axes[1].set(xlabel="time [s]")
figure.savefig(folder / "contact_torque.png", dpi=120)
print(f"wrote {folder / 'contact_torque.png'}")
