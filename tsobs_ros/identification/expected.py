# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of a motion: its torque, what arms reach, and what a recording of it would show."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.files import require_new, written_whole
from tsobs_ros.identification.motion import Limits


class Expected(NamedTuple):
    """A number, and how well a recording of the motion would show it.

    Attributes:
        name: Its place in the request, e.g. "arm.stiffness".
        unit: Its unit, empty for none.
        value: The request's.
        prior_std: 1σ before the recording.
        std: 1σ after it.
        plain_std: 1σ after one of a plain sine within the same limits, the best of three.
        seen: Whether the recording shows it: its 1σ is at most half of the prior's.
    """

    name: str
    unit: str
    value: float
    prior_std: float
    std: float
    plain_std: float
    seen: bool


@dataclass(frozen=True)
class Excitation:
    """A torque motion, and what it shows.

    Attributes:
        request: Of the nominal arm.
        time: Since the start [s], shape (n,).
        torque: At the motor, held from each sample to the next [N m], shape (n,).
        angles: Of link and motor of the nominal arm [rad], shape (n, 2).
        numbers: The wanted numbers.
        limits: Largest torque, angle and velocity of link and motor that are allowed.
        nominal: What the nominal arm reaches of them.
        worst: What the farthest arm within the request's uncertainty reaches.
        arms: Number of arms that were simulated.
        frequencies: Slowest and fastest tone [rad/s].
        plain: Amplitude [N m] and frequency [rad/s] of the plain sine.
        gain: Mean factor by which 1σ is smaller than after the plain sine.
        seed: Of the search.
    """

    request: ArmRequest
    time: Array
    torque: Array
    angles: Array
    numbers: tuple[Expected, ...]
    limits: Limits
    nominal: Limits
    worst: Limits
    arms: int
    frequencies: tuple[float, float]
    plain: tuple[float, float]
    gain: float
    seed: int

    def number(self, name: str) -> Expected:
        """Return how well a number is shown.

        Raises:
            KeyError: It is not among the wanted ones.
        """
        for one in self.numbers:
            if name in (one.name, one.name.removeprefix("arm.")):
                return one
        raise KeyError(name)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Names of the wanted numbers that the motion does not show."""
        return tuple(each.name for each in self.numbers if not each.seen)

    def summary(self) -> dict[str, Any]:
        """Return what is expected as plain data."""
        return {
            "duration": float(self.time[-1]),
            "samples": len(self.time),
            "seed": self.seed,
            "limits": self.limits._asdict(),
            "nominal": self.nominal._asdict(),
            "worst": self.worst._asdict() | {"arms": self.arms},
            "frequencies": list(self.frequencies),
            "numbers": [each._asdict() for each in self.numbers],
            "unseen": list(self.unseen),
            "plain_sine": {
                "amplitude": self.plain[0],
                "frequency": self.plain[1],
                "gain": self.gain,
            },
        }

    def __str__(self) -> str:
        width = max(len(each.name) for each in self.numbers)
        lines = [
            f"{'number':{width}}  {'value':>10}  {'before':>9}  {'after':>9}  {'sine':>9}  unit"
        ]
        for each in self.numbers:
            seen = "" if each.seen else "   not shown"
            lines.append(
                f"{each.name:{width}}  {each.value:>10.4g}  {each.prior_std:>9.2g}  "
                f"{each.std:>9.2g}  {each.plain_std:>9.2g}  {each.unit}{seen}"
            )
        return "\n".join(
            [
                *lines,
                "before, after, sine: expected 1 sigma before a recording, after one of this "
                "motion, and after one of the best of three plain sines within the same limits, "
                f"{self.plain[1]:.3g} rad/s and {self.plain[0]:.3g} N m",
                f"after this motion 1 sigma is {self.gain:.3g} times smaller than after the sine",
                _reached("the nominal arm reaches", self.nominal, self.limits),
                _reached(f"the farthest of {self.arms} arms", self.worst, self.limits),
                f"{len(self.time):,} samples, {self.time[-1]:g} s, tones from "
                f"{self.frequencies[0] / math.tau:.3g} to {self.frequencies[1] / math.tau:.3g} Hz",
            ]
        )

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the motion as CSV: time, torque, and the nominal arm's angles.

        Args:
            path: Of the new file.
            force: Whether an existing file may be replaced.

        Raises:
            OutputError: The file cannot be written, or exists and may not be replaced.
        """
        path = Path(path)
        require_new([path], force=force)
        rows = np.column_stack([self.time, self.torque, self.angles]).tolist()
        with written_whole(path.parent, force=force) as folder:
            lines = (f"{t:.9g},{u:.9g},{link:.6g},{motor:.6g}\n" for t, u, link, motor in rows)
            text = _HEADER.format(
                duration=self.time[-1],
                rate=self.request.rate,
                limits=self.limits,
                worst=self.worst,
                seed=self.seed,
            )
            (folder / path.name).write_text(text + "".join(lines), encoding="utf-8")


_HEADER = """\
# A motion of `tsobs excite`: {duration:g} s at {rate:g} Hz, seed {seed}.
# torque: at the motor, held from its time to the next line's; 0 after the last one.
# expected_link_angle, expected_motor_angle: of the request's arm, from rest at 0.
# Limits of link and motor: {limits.torque:.4g} N m, {limits.angle:.4g} rad, \
{limits.velocity:.4g} rad/s.
# Arms within the request's uncertainty reach {worst.torque:.4g} N m, {worst.angle:.4g} rad, \
{worst.velocity:.4g} rad/s.
time [s],torque [N m],expected_link_angle [rad],expected_motor_angle [rad]
"""


def _reached(who: str, reached: Limits, limits: Limits) -> str:
    return (
        f"{who}: torque {reached.torque:.3g} of {limits.torque:.3g} N m, angle "
        f"{reached.angle:.3g} of {limits.angle:.3g} rad, velocity {reached.velocity:.3g} of "
        f"{limits.velocity:.3g} rad/s"
    )
