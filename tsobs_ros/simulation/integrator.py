# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixed-step integration of plants: the true motion the observers are judged by.

The classical fourth-order Runge–Kutta method at 1 ms keeps the undriven arm's energy to 1e-10
over a minute, so its error is far below any noise; no adaptive solver or exact-flow splitting is
needed. One small-array NumPy operation takes longer than a whole scalar Runge–Kutta step, so
`ArmIntegrator` writes the arm out column by column; the same lines run on plain floats (one arm,
about 2 µs a step) and on arrays (a batch of runs).
"""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tsobs_ros.checks import Array, positive
from tsobs_ros.errors import ModelError
from tsobs_ros.model.arm import ElasticJointArm

LONGEST_SUBSTEP = 1e-3
"""Upper limit of an integration step [s]; a sampling period is cut into equal steps below it."""

Column = TypeVar("Column", float, Array)
"""One state of one arm, or of every arm of a batch."""


class ArmIntegrator:
    """Advances an elastic-joint arm by one sampling period, in physical coordinates.

    Physical, because the design coordinates of a true arm and of the nominal one it is compared
    with differ as soon as their stiffnesses do.

    Args:
        arm: The arm that moves.
        period: Time that one call of `advance` covers [s].
        longest_substep: Upper limit of the integration step [s].

    Raises:
        ModelError: The period or the step limit is not a finite number above zero.
    """

    def __init__(
        self, arm: ElasticJointArm, period: float, longest_substep: float = LONGEST_SUBSTEP
    ) -> None:
        positive("longest_substep", longest_substep)
        # A period of exactly five steps must not become six because .005/.001 rounds upwards.
        self.substeps = max(1, math.ceil(positive("period", period) / longest_substep - 1e-9))
        self.substep = period / self.substeps
        self._arm = arm

    def advance(self, state: ArrayLike, torque: ArrayLike, kicks: ArrayLike | None = None) -> Array:
        """Return the physical state one period later.

        Args:
            state: [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (4,) or (runs, 4).
            torque: Motor torque held over the period [N m], shape (1,) or (runs, 1).
            kicks: Velocity steps of link and motor [rad/s] at the end of each integration step,
                shape (substeps, 2) or (runs, substeps, 2): the process noise.

        Raises:
            ModelError: The state or the kicks have another shape.
        """
        start, held = np.asarray(state, dtype=np.float64), np.asarray(torque, dtype=np.float64)
        if start.ndim not in (1, 2) or start.shape[-1] != 4:
            raise ModelError(f"state: expected shape (4,) or (runs, 4), got {start.shape}")
        noise = None if kicks is None else np.asarray(kicks, dtype=np.float64)
        if noise is not None and noise.shape != (*start.shape[:-1], self.substeps, 2):
            raise ModelError(
                f"kicks: expected shape {(*start.shape[:-1], self.substeps, 2)}, got {noise.shape}"
            )
        if start.ndim == 1:
            q1, v1, q2, v2 = start.tolist()
            pairs = None if noise is None else noise.tolist()
            return np.array(self._columns(math.sin, q1, v1, q2, v2, held.item(), pairs))
        q1, v1, q2, v2 = np.ascontiguousarray(start.T)
        columns_torque = np.ascontiguousarray(held[..., 0])
        rows = None if noise is None else list(np.ascontiguousarray(noise.transpose(1, 2, 0)))
        return np.stack(self._columns(np.sin, q1, v1, q2, v2, columns_torque, rows), axis=-1)

    def _columns(
        self,
        sine: Callable[[Column], Column],
        q1: Column,
        v1: Column,
        q2: Column,
        v2: Column,
        torque: Column,
        kicks: Sequence[Sequence[Column]] | None,
    ) -> tuple[Column, Column, Column, Column]:
        """Run the substeps on one arm's floats or on a batch's columns."""
        arm, h = self._arm, self.substep
        half, sixth, gravity = 0.5 * h, h / 6.0, arm.gravity_gain
        link_spring = arm.stiffness / arm.link_inertia
        link_drag = arm.link_damping / arm.link_inertia
        motor_spring = arm.stiffness / arm.motor_inertia
        motor_drag = arm.motor_damping / arm.motor_inertia
        drive = torque / arm.motor_inertia

        def accelerations(q1: Column, v1: Column, q2: Column, v2: Column) -> tuple[Column, Column]:
            twist = q2 - q1
            link = link_spring * twist - gravity * sine(q1) - link_drag * v1
            return link, drive - motor_spring * twist - motor_drag * v2

        for index in range(self.substeps):
            a1, b1 = accelerations(q1, v1, q2, v2)
            # The velocity of each stage is the slope of the angle: w of the link, s of the motor.
            w2, s2 = v1 + half * a1, v2 + half * b1
            a2, b2 = accelerations(q1 + half * v1, w2, q2 + half * v2, s2)
            w3, s3 = v1 + half * a2, v2 + half * b2
            a3, b3 = accelerations(q1 + half * w2, w3, q2 + half * s2, s3)
            w4, s4 = v1 + h * a3, v2 + h * b3
            a4, b4 = accelerations(q1 + h * w3, w4, q2 + h * s3, s4)
            q1 = q1 + sixth * (v1 + 2.0 * (w2 + w3) + w4)
            q2 = q2 + sixth * (v2 + 2.0 * (s2 + s3) + s4)
            v1 = v1 + sixth * (a1 + 2.0 * (a2 + a3) + a4)
            v2 = v2 + sixth * (b1 + 2.0 * (b2 + b3) + b4)
            if kicks is not None:
                v1 = v1 + kicks[index][0]
                v2 = v2 + kicks[index][1]
        return q1, v1, q2, v2
