# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior Cramér–Rao bound of an arm's states, by the recursion of Tichavský et al.

P. Tichavský, C. H. Muravchik, A. Nehorai, "Posterior Cramér–Rao bounds for discrete-time nonlinear
filtering", IEEE Transactions on Signal Processing 46 (1998). With x' = f(x, c) + v, v of covariance
Q, constants c and F = ∂f/∂(c, x), the information J of (c, x) becomes that of (c, x') when x is
eliminated from

    [ J + E FᵀQ⁻¹F   −E FᵀQ⁻¹ ]
    [    −E Q⁻¹F         Q⁻¹  ]

and each sample adds its Fisher information. E is the mean over true runs. By the matrix inversion
lemma this is a Kalman filter's covariance along the mean derivative F̄, but for what the runs'
derivatives differ:

    P' = F̄ (P⁻¹ + V)⁻¹ F̄ᵀ + Q ,     V = E (F − F̄)ᵀQ⁻¹(F − F̄)

which is how it is computed, as Q is too small beside P for the former.

What it bounds: the mean square error, over runs whose start x(0) is drawn from the given
distribution, of every estimator that is unbiased in the constants: their true values are fixed, and
what is known of them beforehand only lowers the bound (the hybrid bound of Y. Rockah and P. M.
Schultheiss, IEEE Transactions on Acoustics, Speech, and Signal Processing 35, 1987). An estimator
that takes a constant for known is biased in it. It may have smaller errors if the truth is what it
takes it for.
"""

from collections.abc import Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.arm import LINK_VELOCITY
from tsobs_ros.model.flow import ArmFlow


def cramer_rao_std(
    flow: ArmFlow,
    states: Array,
    information: Array,
    *,
    initial_std: Array,
    offset_std: float,
    jumps: Sequence[int] = (),
) -> Array:
    """Return the least 1σ of errors after each sample, from the samples up to it.

    The constant is an offset of the output, which is another one from each of the jumps on.

    Args:
        flow: Of the true arm, the first of whose outputs is measured, with what of the disturbance
            is random.
        states: True states in that arm's design coordinates, shape (runs, samples, 4).
        information: Of each sample about its output [1/unit²], 0 if it is lost, shape (samples,).
        initial_std: 1σ of the flow's states at the first sample, shape (n,).

    Returns:
        1σ of the physical states (rad, rad/s) and of the disturbance, shape (samples, 5).
    """
    count, size = states.shape[1], 1 + flow.state_count
    noise, unit = np.zeros((size, size)), np.eye(size)
    noise[1:, 1:] = flow.nominal.noise
    root = np.linalg.inv(np.linalg.cholesky(flow.nominal.noise))
    C = np.append(1.0, flow.output_matrix[0])
    P = np.diag(np.append(offset_std, initial_std) ** 2.0)
    found = np.empty((count, size, size))
    for place in range(count):
        if place > 0:
            F, spread = _derivative(flow, root, *states[:, place - 1 : place + 1, 0].T)
            P = F @ np.linalg.solve(unit + P @ spread, P) @ F.T + noise
            P = 0.5 * (P + P.T)
        if place in jumps:
            P[0], P[:, 0] = 0.0, 0.0
            P[0, 0] = offset_std**2.0
        if information[place] > 0.0:
            cross = P @ C
            P = P - np.outer(cross, cross) / (C @ cross + 1.0 / information[place])
        found[place] = P
    read = np.zeros((5, size))
    read[:4, 1:5] = np.diag(flow.arm.to_physical(np.ones(4)))
    read[4, 0], read[4, 1:] = 1.0, flow.disturbance_map[0]
    return np.asarray(np.sqrt(np.einsum("ai,tij,aj->ta", read, found, read)))


def _derivative(flow: ArmFlow, root: Array, before: Array, after: Array) -> tuple[Array, Array]:
    """Return F̄ of a step of all runs between link angles, shape (runs,), and V.

    The root is of the inverse of the step's noise.
    """
    step, n = flow.nominal, flow.state_count
    # Half a kick by gravity, the linear flow, half a kick; the constant stays.
    A = np.zeros((len(before), 1 + n, 1 + n))
    A[:, 0, 0], A[:, 1:, 1:] = 1.0, step.phi
    A[:, 1:, 1] -= np.multiply.outer(step.half_kick * np.cos(before), step.phi[:, LINK_VELOCITY])
    A[:, 1 + LINK_VELOCITY] -= (step.half_kick * np.cos(after))[:, np.newaxis] * A[:, 1]
    mean = A.mean(axis=0)
    white = (root @ (A - mean)[:, 1:]).reshape(len(before) * n, -1)
    return mean, white.T @ white / len(before)
