# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The arm's step, kick–drift–kick: of one arm, a batch of equal arms, or a stack of any.

A stack has a leading axis in the matrices too, so that each of its arms has its own.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.arm import LINK_ANGLE, LINK_VELOCITY
from tsobs_ros.model.products import mapped, transposed


class Transition(NamedTuple):
    """The linear flow over one step.

    Attributes:
        duration: T [s].
        phi: State transition Φ(T), shape (n, n).
        gamma: Effect of a held torque Γ(T), shape (n, 1).
        noise: Covariance the process noise adds, shape (n, n).
        half_kick: (T/2) mgl/J₁ [1/s].

    In a stack of k arms all but the duration have a leading axis, the kick's shape being (k,).
    """

    duration: float
    phi: Array
    gamma: Array
    noise: Array
    half_kick: float | Array


def predicted(x: Array, u: Array, steps: Sequence[Transition]) -> Array:
    """Return the augmented state after some steps; see `ArmFlow.predict`.

    Args:
        x: Shape (..., n), or (k, n) for steps that are stacks of k.
        u: Shape (..., 1).
        steps: Their matrices may have a leading axis: each arm of a stack has its own.
    """
    for step in steps:
        x = _moved(x, u, step)
    return x


def predicted_with_covariance(
    x: Array, covariance: Array, u: Array, steps: Sequence[Transition]
) -> tuple[Array, Array]:
    """Return state and covariance after some steps; see `ArmFlow.predict_with_covariance`."""
    if covariance.ndim <= x.ndim:
        covariance = np.broadcast_to(covariance, (*x.shape, x.shape[-1]))
    for step in steps:
        covariance = _sheared(covariance, step.half_kick * np.cos(x.T[LINK_ANGLE].T))
        covariance = step.phi @ covariance @ transposed(step.phi) + step.noise
        x = _moved(x, u, step)
        # The second half kick has left the angle as it was.
        covariance = _sheared(covariance, step.half_kick * np.cos(x.T[LINK_ANGLE].T))
    return x, covariance


def _moved(x: Array, u: Array, step: Transition) -> Array:
    kicked = x.copy()
    _kick(kicked, step.half_kick)
    moved = mapped(step.phi, kicked) + u * step.gamma[..., 0]
    _kick(moved, step.half_kick)
    return moved


def _kick(x: Array, half_kick: Array | float) -> None:
    """Kick the velocities in place; the transpose has the states first, whatever the batch."""
    states = x.T
    states[LINK_VELOCITY] -= half_kick * np.sin(states[LINK_ANGLE])


def _sheared(covariance: Array, gain: Array) -> Array:
    """Return K Σ Kᵀ for the kick matrix K of `gain`, by one row and one column operation."""
    sheared = covariance.copy()
    gain = np.asarray(gain)[..., np.newaxis]
    sheared[..., LINK_VELOCITY, :] -= gain * sheared[..., LINK_ANGLE, :]
    sheared[..., :, LINK_VELOCITY] -= gain * sheared[..., :, LINK_ANGLE]
    return sheared
