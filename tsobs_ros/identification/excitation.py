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
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array, positive
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.identification.expected import Excitation, Expected
from tsobs_ros.identification.joint import Unknowns
from tsobs_ros.identification.likelihood import Likelihood, Recording
from tsobs_ros.identification.motion import (
    Genes,
    Limits,
    Mover,
    Scaled,
    TrialArm,
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


class _Candidate(NamedTuple):
    """A motion: mean log of 1σ by the prior's of the wanted numbers, its genes and scale."""

    cost: float
    genes: Genes
    scale: float


class _Search:
    """The search for the motion that shows most.

    Args:
        mover: Makes the motions.
        free: Names of the numbers that a fit would estimate.
        limits: With the margin.
        seed: Of the noise of simulated recordings, and of the search.
        advance: Called with the number of motions that were tried.
    """

    def __init__(
        self,
        mover: Mover,
        free: Sequence[str],
        limits: Limits,
        seed: int,
        advance: Callable[[int], None],
    ) -> None:
        self.mover, self.limits, self._advance = mover, limits, advance
        request = mover.request
        self.unknowns = unknowns = Unknowns.of(request, free)
        self._rng = np.random.default_rng((seed, 0))
        noise = np.random.default_rng((seed, 2)).standard_normal
        self._noise = noise((len(mover.times), len(request.sensors))) * request.output_std
        joint = unknowns.at(np.zeros(unknowns.count))
        self._trial = TrialArm(joint.request.arm, joint.friction)
        # A noise shows with any motion.
        noises = {each.name for each in unknowns.noises().numbers}
        moved = [each.name not in noises for each in unknowns.numbers]
        self._wanted = np.array(moved) if any(moved) else np.full(unknowns.count, True)

    def std(self, torque: Array) -> Array:
        """Return 1σ of the numbers after a recording, by that before it, shape (k,)."""
        request, k = self.mover.request, self.unknowns.count
        columns = [QUANTITIES.index(each.measures) for each in request.sensors]
        y = simulated(request, self._trial, torque, request.process_noise)[:, columns] + self._noise
        durations = np.full(len(torque), request.period)
        recording = Recording("the motion", self.mover.times, durations, y, torque)
        information = Likelihood(self.unknowns, [recording]).evaluate(np.zeros(k)).information
        return np.sqrt(np.diag(np.linalg.inv(information + np.eye(k))))

    def mean(self, std: Array) -> float:
        """Return the mean log of 1σ of the wanted numbers."""
        return float(np.log(std[self._wanted]).mean())

    def _try(
        self, genes: Genes, arms: Sequence[TrialArm], scale: float, rounds: int = 1
    ) -> _Candidate:
        angle = self.mover.angle(genes, self.limits)
        made = self.mover.scaled(angle, arms, self.limits, scale=scale, rounds=rounds)
        self._advance(1)
        return _Candidate(self.mean(self.std(made.torque)), genes, made.scale)

    def best(self, all_arms: Sequence[TrialArm], candidates: int) -> Genes:
        """Return the tones that show most.

        Args:
            all_arms: That must stay within the limits; the nominal one first.
            candidates: Number of motions to try.
        """
        starts = [self.mover.random(self._rng) for _ in range(min(_STARTS, candidates))]
        arms = self._farthest(starts[0], all_arms, 0.3)
        found = min((self._try(each, arms, 0.3, 3) for each in starts), key=lambda one: one.cost)
        size = 0.5
        for _ in range(_STAGES):
            arms = self._farthest(found.genes, all_arms, found.scale)
            found = self._try(found.genes, arms, found.scale)
            for _ in range((candidates - len(starts)) // _STAGES):
                moved = self._try(self._changed(found.genes, size), arms, found.scale)
                size = min(size * 1.5, 1.5) if moved.cost < found.cost else size * 0.9
                found = min(found, moved, key=lambda one: one.cost)
        return found.genes

    def _changed(self, genes: Genes, size: float) -> Genes:
        """Return other tones in the neighbourhood."""
        draw = self._rng.standard_normal
        return Genes(
            tuple(each + size * draw(len(each)) for each in genes.phases),
            tuple(each + 2.0 * size * draw(len(each)) for each in genes.levels),
            genes.shares + size * draw(len(genes.shares)),
        )

    def _farthest(self, genes: Genes, arms: Sequence[TrialArm], scale: float) -> list[TrialArm]:
        """Return the nominal arm and those that come closest to their limits, or beyond."""
        torque = self.mover.torque(scale * self.mover.angle(genes, self.limits))
        shares = (self.mover.reached(torque, arms)[:, 1:] / self.limits[1:]).max(axis=1)
        order = sorted(range(1, len(arms)), key=lambda at: -float(shares[at]))
        return [arms[at] for at in (0, *order[:_TRIED])]


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
    >>> motion = ts.excite(ts.ArmRequest(rate=50.0), duration=20.0, candidates=4)
    >>> motion.number("stiffness").std < motion.number("stiffness").prior_std
    True
    >>> motion.time.shape, bool(abs(motion.torque).max() <= motion.limits.torque)
    ((1001,), True)
    """
    if not isinstance(request, ArmRequest):
        raise ModelError("request: expected one for an arm; a T-S system has no numbers to fit")
    if positive("duration", duration) > _LONGEST:
        raise ModelError(f"duration: expected at most {_LONGEST:g} s, got {duration:g}")
    limits, path = Limits.of(request, max_torque, max_angle, max_velocity), request.torque
    at_motor = path.gain * limits.torque - abs(path.offset)
    if at_motor <= 0.0:
        raise ModelError(
            f"max_torque: expected more than the offset of the request's torque takes, "
            f"{abs(path.offset) / path.gain:g} N m, got {limits.torque:g}"
        )
    # What a fit would find of delays, gain and offset does not depend on theirs.
    known, request = request, request.at_rate(request.rate)
    mover = Mover(request, duration)
    inner = Limits(at_motor, *((1.0 - MARGIN) * each for each in limits[1:]))
    arms = trial_arms(request, _DRAWS, seed)
    whole = _Search(mover, free, inner, seed, advance)
    thinned = _thinned(request, mover.fastest)
    search = _Search(Mover(thinned, duration), free, inner, seed, advance)
    if candidates is None:
        share = min(1.0, _FULL_TIME / duration)
        candidates = max(_LEAST_CANDIDATES, round(_CANDIDATES * share))
    elif candidates < 1:
        raise ModelError(f"candidates: expected at least 1, got {candidates}")
    # What is too small to be measured needs no search.
    first = mover.angle(mover.random(np.random.default_rng(seed)), inner)
    _require_visible(request, mover.scaled(first, arms[:1], inner), limits)
    made = mover.scaled(mover.angle(search.best(arms, candidates), inner), arms, inner, rounds=5)
    plain, frequency = _plainest(whole, arms)
    after, sine = whole.std(made.torque), whole.std(plain)
    states = simulated(request, arms[0], made.torque)
    numbers = tuple(
        Expected(
            each.name,
            each.unit,
            0.0 if each.from_nothing else each.start,
            each.deviation(0.0, 1.0),
            each.deviation(0.0, one),
            each.deviation(0.0, other),
            one <= _SEEN,
        )
        for each, one, other in zip(
            whole.unknowns.numbers, after.tolist(), sine.tolist(), strict=True
        )
    )
    commands = (made.torque - path.offset) / path.gain
    largest = float(np.abs(commands).max())
    return Excitation(
        request=known,
        time=mover.times,
        torque=commands,
        angles=states[:, ::2],
        numbers=numbers,
        limits=limits,
        nominal=Limits(largest, *mover.reached(made.torque, arms[:1])[0, 1:].tolist()),
        worst=made.reached._replace(torque=largest),
        arms=len(arms),
        frequencies=(float(mover.parts[0].frequencies[0]), mover.fastest),
        plain=(float(np.abs(plain).max()), frequency),
        gain=math.exp(whole.mean(sine) - whole.mean(after)),
        seed=seed,
    )


def _plainest(search: _Search, arms: Sequence[TrialArm]) -> tuple[Array, float]:
    """Return the torque of the plain sine that shows most, of three frequencies, and its own."""
    mover, found = search.mover, []
    slow, fast = float(mover.parts[0].frequencies[0]), mover.fastest
    for share in (0.0, 0.25, 0.5):
        frequency = slow * (fast / slow) ** share
        made = mover.scaled(mover.sine(frequency), arms, search.limits, scale=0.1, rounds=4)
        found.append((search.mean(search.std(made.torque)), frequency, made.torque))
    _, frequency, torque = min(found, key=lambda one: one[0])
    return torque, frequency


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


def _require_visible(request: ArmRequest, made: Scaled, limits: Limits) -> None:
    """Refuse limits within which no output moves by more than its noise."""
    columns = [QUANTITIES.index(each.measures) for each in request.sensors]
    states = simulated(request, TrialArm(request.arm), made.torque)
    moved = np.abs(states[:, columns]).max(axis=0)
    if (moved > request.output_std).any():
        return
    shares = {name: getattr(made.reached, name) / getattr(limits, name) for name in limits._fields}
    name = max(shares, key=shares.__getitem__)
    output = request.sensors[0].measures
    raise ModelError(
        f"max_{name}: {getattr(limits, name):g} allows no motion that can be measured: "
        f"{output} would move by {moved[0]:.2g}, and its noise is {request.output_std[0]:.2g}"
    )
