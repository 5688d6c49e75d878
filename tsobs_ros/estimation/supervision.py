# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Watching the innovations: outliers are downweighted, jumps and lost tracks are noticed.

The observer's model says how large an innovation may be. A lone one that is far too large is an
outlier. Eight in a row that lean to one side are a sensor that has jumped. A long average that is
far too large is an estimate that has lost the arm. Everything is decided on the normalised
innovation r = e/√s and on durations between stamps.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from tsobs_ros.checks import non_negative, positive
from tsobs_ros.errors import ModelError

_WINDOW = 8
_WINDOW_CLIP = 5.0
_SAME_SIGN = 7
_LEAN = 6.0 * math.sqrt(_WINDOW)
_LOST_CLIP = 4.0
_CALM = 2.0


@dataclass(frozen=True)
class SupervisionOptions:
    """When to react, and how strongly; the defaults are for 200 Hz.

    Attributes:
        gate: Innovations beyond so many σ are downweighted to it.
        reject: Innovations beyond so many σ are not used at all.
        jump_std: 1σ of the uncertainty re-opened after a jump [rad]; 0 switches jumps off.
        jump_duration: Riccati gains are used for at least so long after a jump [s].
        jump_quiet: No jump is looked for so soon after a start [s]; the start itself leans.
        jump_budget: At most so many jumps in `jump_budget_window`: under a wrong model every
            innovation leans, and unbudgeted reactions make the error worse.
        jump_budget_window: [s].
        lost: Half-second average of |r| beyond which the estimate is given up.
        stuck_samples: From so many repetitions of the very same value on, samples of the sensor
            are not used; 0 for a sensor whose steps are larger than its noise.
        disturbance_limit: The estimated disturbance is kept within so much [rad]; beyond π the arm
            and its sensor turned together look the same.
        strain: `nis` above 2, or a parameter at its limit, for so long starts learning again [s].
        relearn_budget: After so many times the parameters are frozen at their nominal values.
    """

    gate: float = 5.0
    reject: float = 50.0
    jump_std: float = 0.15
    jump_duration: float = 1.5
    jump_quiet: float = 8.0
    jump_budget: int = 3
    jump_budget_window: float = 20.0
    lost: float = 6.0
    stuck_samples: int = 10
    disturbance_limit: float = math.pi
    strain: float = 1.0
    relearn_budget: int = 4

    def __post_init__(self) -> None:
        positive("gate", self.gate)
        non_negative("jump_std", self.jump_std)
        non_negative("jump_duration", self.jump_duration)
        non_negative("jump_quiet", self.jump_quiet)
        non_negative("jump_budget", self.jump_budget)
        non_negative("jump_budget_window", self.jump_budget_window)
        positive("lost", self.lost)
        non_negative("stuck_samples", self.stuck_samples)
        positive("disturbance_limit", self.disturbance_limit)
        if not self.reject >= self.gate:
            raise ModelError(
                f"reject: expected at least the gate {self.gate!r}, got {self.reject!r}"
            )
        positive("strain", self.strain)
        non_negative("relearn_budget", self.relearn_budget)


class Watch(NamedTuple):
    """What the supervision remembers.

    Attributes:
        recent: The last normalised innovations, clipped, oldest first.
        nis: One-second average of min(r², 25); 1 when the model fits.
        calm_nis: `nis` from before the window of recent innovations.
        magnitude: Half-second average of |r|.
        strained: How long `nis` has been above 2 [s].
        age: Time since the start or the last loss [s].
        jumps: Ages at which a jump was found, newest last.
    """

    recent: tuple[float, ...] = ()
    nis: float = 1.0
    calm_nis: tuple[float, ...] = ()
    magnitude: float = 1.0
    strained: float = 0.0
    age: float = 0.0
    jumps: tuple[float, ...] = ()


class Verdict(NamedTuple):
    """What one innovation says.

    Attributes:
        weight: In [0, 1]: the share of the correction to apply.
        jumped: Whether the sensor has jumped.
        lost: Whether the estimate has lost the arm.
        strained: Whether the innovations have been too large for too long.
    """

    weight: float
    jumped: bool = False
    lost: bool = False
    strained: bool = False


def elapse(watch: Watch, duration: float) -> Watch:
    """Return the watch a time `duration` [s] later."""
    return Watch(*watch[:5], watch.age + duration, watch.jumps)


def judge(
    watch: Watch, normalised: float, period: float, options: SupervisionOptions
) -> tuple[Watch, Verdict]:
    """Take in a normalised innovation.

    Args:
        watch: What is remembered so far.
        normalised: r = e/√s.
        period: Sampling period, which the averages are taken by [s].
        options: When to react.
    """
    size = abs(normalised)
    limit = options.gate * math.sqrt(watch.nis) if watch.nis > 1.0 else options.gate
    weight = limit / size if size > limit else 1.0
    if size > options.reject:
        weight = 0.0
    clipped = normalised if size < _WINDOW_CLIP else math.copysign(_WINDOW_CLIP, normalised)
    recent = (*watch.recent, clipped)[-_WINDOW:]
    nis = watch.nis - math.expm1(-period) * (clipped * clipped - watch.nis)
    # A lone value of any size must not give the estimate up.
    believable = min(size, _LOST_CLIP * options.lost)
    magnitude = watch.magnitude - math.expm1(-2.0 * period) * (believable - watch.magnitude)
    calm = (*watch.calm_nis, watch.nis)[-_WINDOW:]
    lost = magnitude > options.lost
    jumped = not lost and _leans(recent) and calm[0] < _CALM and _may_jump(watch, options)
    if lost:
        return Watch(), Verdict(weight, lost=True)
    if jumped:
        # The averages start over: they belong to the time before the jump.
        jumps = (*watch.jumps, watch.age)[-max(1, options.jump_budget) :]
        return Watch(age=watch.age, jumps=jumps), Verdict(weight, jumped=True)
    strained = watch.strained + period if nis > _CALM else 0.0
    verdict = Verdict(weight, strained=strained >= options.strain)
    if verdict.strained:
        strained = 0.0
    return Watch(recent, nis, calm, magnitude, strained, watch.age, watch.jumps), verdict


def _leans(recent: tuple[float, ...]) -> bool:
    if len(recent) < _WINDOW or abs(sum(recent)) <= _LEAN:
        return False
    positives = sum(value > 0.0 for value in recent)
    return max(positives, _WINDOW - positives) >= _SAME_SIGN


def _may_jump(watch: Watch, options: SupervisionOptions) -> bool:
    if options.jump_std == 0.0 or options.jump_budget == 0 or watch.age < options.jump_quiet:
        return False
    if watch.jumps and watch.age - watch.jumps[-1] < options.jump_duration:
        return False
    full = len(watch.jumps) >= options.jump_budget
    return not full or watch.age - watch.jumps[0] > options.jump_budget_window
