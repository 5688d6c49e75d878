# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Excitation: a torque motion within limits that shows the wanted numbers of a joint.

The motion is a multisine in two parts, a slow one for gravity and friction and one up to beyond the
joint's resonance. Phases and amplitudes come from a seeded search for the largest information that
a recording of the motion would give, which is that of a simulated one. Each candidate is as large
as the limits allow, for the nominal arm and for others within the request's uncertainty.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.files import require_new, written_whole
from tsobs_ros.identification.joint import Unknowns, require_arm
from tsobs_ros.identification.likelihood import Likelihood, Recording
from tsobs_ros.identification.motion import (
    Limits,
    Mover,
    TrialArm,
    limits_of,
    simulated,
    trial_arms,
)
from tsobs_ros.model.arm import QUANTITIES

MARGIN = 0.15
"""Share of the limits of angle and velocity that the arms that are tried leave free."""

_DRAWS = 64
_TRIED = 4
"""Arms that candidates are simulated with: those that went farthest."""

_CANDIDATES = 120
_LEAST_CANDIDATES = 20
_FULL_TIME = 30.0
"""Duration up to which there are so many candidates [s]."""

_SAMPLES_PER_PERIOD = 16.0
"""Of the fastest tone, in the recordings that the search judges by."""

_STARTS = 8
_STAGES = 3
_LONGEST = 600.0
_SEEN = 0.5
"""1σ by the prior's from which on a number is not shown."""


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
        by_name = {each.name: each for each in self.numbers}
        return by_name.get(name) or by_name[f"arm.{name}"]

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


class _Search:
    """What recordings of motions would show, and the motion that shows most.

    Args:
        mover: Makes the motions.
        free: Names of the numbers that a fit would estimate.
        seed: Of the noise of simulated recordings, and of the search.
    """

    def __init__(self, mover: Mover, free: Sequence[str], seed: int) -> None:
        self.mover, request = mover, mover.request
        self.unknowns = unknowns = Unknowns.of(request, free)
        self._rng = np.random.default_rng((seed, 0))
        noise = np.random.default_rng((seed, 2)).standard_normal
        self._noise = noise((len(mover.times), len(request.sensors))) * request.output_std
        joint = unknowns.at(np.zeros(unknowns.count))
        self._trial = TrialArm(joint.request.arm, joint.friction)
        # A noise shows with any motion.
        noises = unknowns.noises().numbers
        moved = [each not in noises for each in unknowns.numbers]
        self._wanted = np.array(moved) if any(moved) else np.full(unknowns.count, True)

    def std(self, torque: Array) -> Array:
        """Return 1σ of the numbers after a recording, by that before it, shape (k,)."""
        request, k = self.mover.request, self.unknowns.count
        states = simulated(request, self._trial, torque, request.process_noise)
        durations = np.full(len(torque), request.period)
        y = states[:, _columns(request)] + self._noise
        recording = Recording("the motion", self.mover.times, durations, y, torque)
        information = Likelihood(self.unknowns, [recording]).evaluate(np.zeros(k)).information
        return np.sqrt(np.diag(np.linalg.inv(information + np.eye(k))))

    def mean(self, std: Array) -> float:
        """Return the mean log of 1σ of the wanted numbers."""
        return float(np.log(std[self._wanted]).mean())

    def best(
        self, all_arms: Sequence[TrialArm], candidates: int, advance: Callable[[int], None]
    ) -> Array:
        """Return the genes of the motion that shows most, of so many within the arms' limits."""
        mover, steps = self.mover, self.mover.steps

        def tried(
            genes: Array, arms: Sequence[TrialArm], scale: float, rounds: int = 1
        ) -> tuple[float, Array, float]:
            torque, scale, _ = mover.scaled(mover.angle(genes), arms, scale=scale, rounds=rounds)
            advance(1)
            return self.mean(self.std(torque)), genes, scale

        def farthest(genes: Array, scale: float) -> list[TrialArm]:
            """Return the nominal arm and those that come closest to their limits, or beyond."""
            torque = mover.torque(scale * mover.angle(genes))
            reached = mover.reached(torque, all_arms) / np.array(mover.limits)
            order = np.argsort(-reached[1:, 1:].max(axis=1), kind="stable")[:_TRIED]
            return [all_arms[0], *(all_arms[1 + at] for at in order.tolist())]

        starts = [mover.random(self._rng) for _ in range(min(_STARTS, candidates))]
        arms = farthest(starts[0], 0.3)
        cost, genes, scale = min((tried(each, arms, 0.3, 3) for each in starts), key=itemgetter(0))
        size = 0.5
        for _ in range(_STAGES):
            arms = farthest(genes, scale)
            cost, genes, scale = tried(genes, arms, scale)
            for _ in range((candidates - len(starts)) // _STAGES):
                other = genes + steps * size * self._rng.standard_normal(len(genes))
                moved = tried(other, arms, scale)
                size = min(size * 1.5, 1.5) if moved[0] < cost else size * 0.9
                if moved[0] < cost:
                    cost, genes, scale = moved
        return genes

    def plainest(self, arms: Sequence[TrialArm]) -> tuple[Array, float]:
        """Return the torque of the plain sine that shows most, of three frequencies, and its."""
        mover, found = self.mover, []
        for share in (0.0, 0.25, 0.5):
            frequency = mover.slowest * (mover.fastest / mover.slowest) ** share
            torque, *_ = mover.scaled(mover.sine(frequency), arms, scale=0.1, rounds=4)
            found.append((self.mean(self.std(torque)), torque, frequency))
        return min(found, key=itemgetter(0))[1:]


def excite(
    request: ArmRequest,
    *,
    duration: float = 30.0,
    max_torque: float | None = None,
    max_angle: float | None = None,
    max_velocity: float | None = None,
    free: Sequence[str] = (),
    seed: int = 0,
    candidates: int | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> Excitation:
    """Return a torque motion within limits that shows a joint's numbers to `fit`.

    The limits hold in simulation, with a margin, for the request's arm and for others within its
    `uncertainty` (±30 % of what that does not name), from rest at 0.

    Args:
        request: An arm's request, e.g. with the numbers of data sheets.
        duration: Of the motion [s].
        max_torque: Largest torque at the motor [N m]; half of the request's `torque_limit`, at most
            the gravity torque, or 10 rad/s² of both inertias without gravity.
        max_angle: Largest angle of link and motor [rad]; 0.9 of the request's `x_max`.
        max_velocity: Largest velocity of both [rad/s]; that of the request's reach.
        free: Names of the wanted numbers, as of `fit`; all but the torque's gain if empty.
        seed: Of the search: the same seed gives the same motion.
        candidates: Number of motions that the search tries; 120, fewer of long ones, if None.
        advance: Called with the number of motions that were tried, for progress.

    Raises:
        ModelError: The request is for no arm, a name is unknown, a limit allows no motion that
            could be measured, or the duration is too short for the slowest frequency.

    >>> import tsobs_ros as ts
    >>> motion = ts.excite(ts.ArmRequest(rate=50.0), duration=20.0, candidates=1)
    >>> motion.number("stiffness").std < motion.number("stiffness").prior_std
    True
    >>> motion.time.shape, bool(abs(motion.torque).max() <= motion.limits.torque)
    ((1001,), True)
    """
    require_arm(request)
    if positive("duration", duration) > _LONGEST:
        raise ModelError(f"duration: expected at most {_LONGEST:g} s, got {duration:g}")
    limits, path = limits_of(request, max_torque, max_angle, max_velocity), request.torque
    at_motor = path.gain * limits.torque - abs(path.offset)
    if at_motor <= 0.0:
        raise ModelError(
            f"max_torque: expected more than the offset of the request's torque takes, "
            f"{abs(path.offset) / path.gain:g} N m, got {limits.torque:g}"
        )
    # What a fit would find of delays, gain and offset does not depend on theirs.
    known, request = request, request.at_rate(request.rate)
    inner = Limits(at_motor, *((1.0 - MARGIN) * each for each in limits[1:]))
    mover = Mover(request, duration, inner)
    arms = trial_arms(request, _DRAWS, seed)
    whole = _Search(mover, free, seed)
    search = _Search(Mover(_thinned(request, mover.fastest), duration, inner), free, seed)
    if candidates is None:
        share = min(1.0, _FULL_TIME / duration)
        candidates = max(_LEAST_CANDIDATES, round(_CANDIDATES * share))
    elif candidates < 1:
        raise ModelError(f"candidates: expected at least 1, got {candidates}")
    _require_visible(mover, arms[:1], limits, seed)
    genes = search.best(arms, candidates, advance)
    torque, _, worst = mover.scaled(mover.angle(genes), arms, rounds=5)
    plain, frequency = whole.plainest(arms)
    after, sine = whole.std(torque), whole.std(plain)
    numbers = tuple(
        Expected(
            each.name,
            each.unit,
            each.before,
            each.deviation(0.0, 1.0),
            each.deviation(0.0, one),
            each.deviation(0.0, other),
            one <= _SEEN,
        )
        for each, one, other in zip(
            whole.unknowns.numbers, after.tolist(), sine.tolist(), strict=True
        )
    )
    commands = (torque - path.offset) / path.gain
    largest = float(np.abs(commands).max())
    return Excitation(
        request=known,
        time=mover.times,
        torque=commands,
        angles=simulated(request, arms[0], torque)[:, ::2],
        numbers=numbers,
        limits=limits,
        nominal=Limits(largest, *mover.reached(torque, arms[:1])[0, 1:].tolist()),
        worst=worst._replace(torque=largest),
        arms=len(arms),
        frequencies=(mover.slowest, mover.fastest),
        plain=(float(np.abs(plain).max()), frequency),
        gain=math.exp(whole.mean(sine) - whole.mean(after)),
        seed=seed,
    )


def _columns(request: ArmRequest) -> list[int]:
    """Return the places of what is measured in the state."""
    return [QUANTITIES.index(each.measures) for each in request.sensors]


def _thinned(request: ArmRequest, fastest: float) -> ArmRequest:
    """Return a request of fewer samples that are as precise together."""
    fewer = int(request.rate / (_SAMPLES_PER_PERIOD * fastest / math.tau))
    if fewer < 2:
        return request
    share = 1.0 / math.sqrt(fewer)
    outputs = [
        replace(each, measurement_std=share * each.measurement_std) for each in request.sensors
    ]
    changes: dict[str, Any] = {"measurement_std": outputs[0].measurement_std}
    if request.outputs:
        changes["outputs"] = tuple(outputs)
    try:
        return replace(request, rate=request.rate / fewer, **changes)
    except ModelError:  # a disturbance would be too fast for the samples
        return request


def _require_visible(mover: Mover, arms: Sequence[TrialArm], limits: Limits, seed: int) -> None:
    """Refuse limits within which no output moves by more than its noise."""
    request, angle = mover.request, mover.angle(mover.random(np.random.default_rng(seed)))
    torque, _, reached = mover.scaled(angle, arms)
    states = simulated(request, TrialArm(request.arm), torque)
    moved = np.abs(states[:, _columns(request)]).max(axis=0)
    if (moved > request.output_std).any():
        return
    shares = {name: getattr(reached, name) / getattr(limits, name) for name in limits._fields}
    name = max(shares, key=shares.__getitem__)
    raise ModelError(
        f"max_{name}: {getattr(limits, name):g} allows no motion that can be measured: "
        f"{request.sensors[0].measures} would move by {moved[0]:.2g}, and its noise is "
        f"{request.output_std[0]:.2g}"
    )
