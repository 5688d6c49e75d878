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

from collections.abc import Iterator, Sequence

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.arm import LINK_VELOCITY
from tsobs_ros.model.flow import ArmFlow

_CHUNK = 1000
"""Samples whose derivatives are in memory at once."""


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
    C = np.append(1.0, flow.output_matrix[0])
    P = np.diag(np.append(offset_std, initial_std) ** 2.0)
    found = np.empty((count, size, size))
    for place, (F, spread) in enumerate(_derivatives(flow, states)):
        if place > 0:
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


def _derivatives(flow: ArmFlow, states: Array) -> Iterator[tuple[Array, Array]]:
    """Yield F̄ of the step to each sample, and V."""
    n, step, (runs, count) = flow.state_count, flow.nominal, states.shape[:2]
    root = np.linalg.inv(np.linalg.cholesky(step.noise))
    for begin in range(0, count, _CHUNK):
        after = np.arange(begin, min(begin + _CHUNK, count))
        before = np.maximum(after - 1, 0)
        slopes = [step.half_kick * np.cos(states[:, each, 0]) for each in (before, after)]
        # Half a kick by gravity, the linear flow, half a kick; the constant stays.
        A = np.zeros((runs, len(after), 1 + n, 1 + n))
        A[..., 0, 0], A[..., 1:, 1:] = 1.0, step.phi
        A[..., 1:, 1] -= slopes[0][..., np.newaxis] * step.phi[:, LINK_VELOCITY]
        A[..., 1 + LINK_VELOCITY, :] -= slopes[1][..., np.newaxis] * A[..., 1, :]
        mean = A.mean(axis=0)
        white = np.moveaxis(root @ (A - mean)[..., 1:, :], 0, 1).reshape(len(after), runs * n, -1)
        yield from zip(mean, np.swapaxes(white, 1, 2) @ white / runs, strict=True)
