# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Any Takagi-Sugeno system: request, certified design, estimates from arrays.

The request is a file with matrices and memberships: a pendulum with an encoder and a gyroscope
whose bias drifts. Needs cvxpy and clarabel: pip install 'tsobs_ros[design]'.

Usage: python ts_system.py [REQUEST.yaml]
"""

import sys

import numpy as np
from scipy.integrate import solve_ivp

import tsobs_ros as ts
from tsobs_ros.resources import config_path

path = sys.argv[1] if len(sys.argv) > 1 else config_path("ts_example.request.yaml")
design = ts.synthesise(ts.load_request(path))
print(design.request.claim)

# In place of your log: the true pendulum with x' = [x2, -9.81 sin x1 - 0.2 x2 + u], held inputs.
rng = np.random.default_rng(1)
time = np.arange(0.0, 10.0, design.request.period)
u = np.sin(2.0 * time)
states = [np.array([0.5, 0.0])]
for k in range(len(time) - 1):
    step = solve_ivp(
        lambda _, x, u=u[k]: [x[1], -9.81 * np.sin(x[0]) - 0.2 * x[1] + u],
        (time[k], time[k + 1]), states[-1], rtol=1e-8,
    )  # fmt: skip
    states.append(step.y[:, -1])
truth = np.array(states)
bias = 0.15
y = truth + np.array([0.0, bias]) + rng.normal(0.0, design.request.measurement_std, truth.shape)

estimates = ts.estimate(design, time, y, u)

settled = time > 5.0
rmse = np.sqrt(np.mean((estimates.state - truth)[settled] ** 2, axis=0))
for name, unit, place in (("angle", "rad", 0), ("rate", "rad/s", 1)):
    sensor = np.sqrt(np.mean((y - truth)[settled, place] ** 2))
    print(f"{name}: RMSE {rmse[place]:.4f} {unit}, of the sensor alone {sensor:.4f} {unit}")
print(f"bias of the gyroscope: {estimates.disturbance[-1, 1]:.3f} rad/s, true {bias:.3f} rad/s")
for name, theta in zip(design.request.uncertainty, estimates.parameters[-1], strict=True):
    print(f"learnt change of {name}: {theta:+.3f}")
