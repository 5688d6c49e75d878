# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The path of a torque from a message to an arm's motor: a gain, an offset and a delay."""

from dataclasses import dataclass
from typing import ClassVar

from tsobs_ros.checks import finite, non_negative, positive
from tsobs_ros.errors import ModelError

MAX_DELAY = 20
"""Longest delay of a torque or an output, in periods."""


@dataclass(frozen=True)
class TorquePath:
    """How the torque in messages and logs reaches the motor: gain · u(t − delay) + offset.

    Each torque u is held from its sample to the next one, and so is its part at the motor. What
    reaches the motor is known as well as u is, so it moves truth and estimate alike: errors, their
    bounds and the certificate do not depend on it.

    Attributes:
        gain: Torque at the motor per torque in messages, above 0 [-].
        offset: Torque at the motor at u = 0 [N m].
        delay: Time from the sample of a torque until it acts [s].

    Raises:
        ModelError: A number is not finite, or of the wrong sign.
    """

    OMIT_EMPTY: ClassVar[bool] = True
    """Zeros are left out of files."""

    gain: float = 1.0
    offset: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        for name, check in (("gain", positive), ("offset", finite), ("delay", non_negative)):
            object.__setattr__(self, name, check(name, getattr(self, name)))


DIRECT = TorquePath()
"""The torque in messages is the one at the motor, at once."""


def require_delay(name: str, delay: float, period: float) -> None:
    """Raise `ModelError` for a delay of more than `MAX_DELAY` periods."""
    longest = MAX_DELAY * period
    if delay > longest * (1.0 + 1e-9):
        raise ModelError(
            f"{name}: expected at most {MAX_DELAY} periods, {longest:.4g} s, got {delay!r} s"
        )
