# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood: the numbers of a joint that explain its recordings best."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from tsobs_ros.checks import Array
from tsobs_ros.design.problem import DisturbanceTerm
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.identification.diagnosis import lacks, output_fits
from tsobs_ros.identification.joint import (
    DELAY,
    FRICTION,
    OFFSET,
    TORQUE_GAIN,
    UNCERTAINTY,
    Joint,
    Unknowns,
    numbers_of,
    with_values,
)
from tsobs_ros.identification.likelihood import (
    Evaluation,
    Likelihood,
    Recording,
    innovations,
    log_likelihood,
)
from tsobs_ros.identification.recordings import Samples, read, require_torque
from tsobs_ros.identification.result import Fit, Found, Lack, Unseen, ranked
from tsobs_ros.model.arm import SIDES

GATE = 6.0
"""Sigmas of an innovation from which on it is an outlier, once the numbers are about right."""

_START_SAMPLES = 4000
"""Samples with which starts are compared."""

_MIDDLE_SAMPLES = 12_000
"""Samples that are fitted before all of them, without a gate."""

_POOR = 85.0
"""Share of the outputs that a free run must explain [%]; else disturbed sensors are tried."""

_STARTS = 3

_KNOWN = 0.02
"""Relative error of a number that need not be learnt."""

_MOST = 0.8
"""Largest relative error that a request may name."""

_FEW_STEPS, _MAX_STEPS = 15, 40
_TOLERANCE = 0.02
"""Gain of a step that is expected and no longer taken [nat]: a fifth of a σ of a number."""


@dataclass(frozen=True)
class Optimum:
    """The most likely numbers.

    Attributes:
        unknowns: What was estimated.
        coordinates: Where, in units of the priors, shape (k,).
        covariance: Of the coordinates, shape (k, k).
        evaluation: The likelihood there.
    """

    unknowns: Unknowns
    coordinates: Array
    covariance: Array
    evaluation: Evaluation

    @property
    def joint(self) -> Joint:
        """The joint with these numbers."""
        return self.unknowns.at(self.coordinates)

    @property
    def std(self) -> Array:
        """1σ of the coordinates, shape (k,)."""
        return np.sqrt(np.diag(self.covariance))


def maximise(
    unknowns: Unknowns,
    recordings: Sequence[Recording],
    *,
    seed: int = 0,
    starts: int = _STARTS,
    begin: Array | None = None,
    steps: int = _MAX_STEPS,
    advance: Callable[[int], None] = lambda _: None,
) -> Optimum:
    """Return the most likely numbers.

    First on a short part from several points, without a gate; then on everything from the best of
    them. The Hessian is Fisher's information with the prior's, in a trust region.

    Args:
        unknowns: The numbers.
        recordings: The samples.
        seed: Of the further points that the search starts from.
        starts: Number of points.
        begin: Where to start from, without a search for it.
        steps: Largest number of steps with all samples.
        advance: Called with the number of filtered samples.
    """
    k, rng = unknowns.count, np.random.default_rng(seed)
    longest = max(recordings, key=lambda recording: recording.count)
    short, longer = (
        Likelihood(unknowns, [_middle_of(longest, count)], advance=advance)
        for count in (_START_SAMPLES, _MIDDLE_SAMPLES)
    )
    best = begin
    if best is None:
        points = [np.zeros(k), *(0.5 * rng.standard_normal((starts - 1, k)))]
        found = [_search(short, point, _FEW_STEPS) for point in points]
        best = min(found, key=short.cost)
        best = _search(longer, best, _FEW_STEPS)
    gated = Likelihood(unknowns, recordings, GATE, advance)
    best = _search(gated, best, steps)
    made = gated.evaluate(best)
    hessian = made.information + np.eye(k)
    inverse = np.linalg.inv(hessian)
    # White innovations make both alike; coloured ones do not, and then their spread counts.
    robust = inverse @ (made.spread + np.eye(k)) @ inverse
    ratio = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse), 1.0))
    covariance = inverse * np.outer(ratio, ratio)
    return Optimum(unknowns, best, covariance, made)


def _middle_of(recording: Recording, count: int) -> Recording:
    """Return so many samples about the middle of a recording, all if it has fewer."""
    begin = max(0, (recording.count - count) // 2)
    return recording.part(begin, min(begin + count, recording.count))


def _search(likelihood: Likelihood, start: Array, steps: int) -> Array:
    """Return the point of least cost that so many steps lead to."""
    unit, least = np.eye(len(start)), math.inf

    def settle(intermediate_result: OptimizeResult) -> None:
        nonlocal least
        made = likelihood.evaluate(intermediate_result.x)
        gained, least = least - made.cost, made.cost
        step = np.linalg.solve(made.information + unit, made.gradient)
        # Of a wrong model the information is not the curvature: small steps go on for ever.
        if 0.5 * made.gradient @ step < _TOLERANCE or 0.0 < gained < 5.0 * _TOLERANCE:
            raise StopIteration

    found = minimize(
        likelihood.cost,
        start,
        method="trust-exact",
        jac=lambda at: likelihood.evaluate(at).gradient,
        hess=lambda at: likelihood.evaluate(at).information + unit,
        callback=settle,
        options={
            "initial_trust_radius": 0.5,
            "max_trust_radius": 2.0,
            "gtol": 0.0,
            "maxiter": steps,
        },
    )
    return np.asarray(found.x)


def _found(optimum: Optimum) -> tuple[Found, ...]:
    """Return the numbers of an optimum."""
    found = []
    for number, at, std in zip(
        optimum.unknowns.numbers,
        optimum.coordinates.tolist(),
        optimum.std.tolist(),
        strict=True,
    ):
        before = 0.0 if number.from_nothing else number.start
        known = min(max(1.0 - std * std, 0.0), 1.0)
        found.append(
            Found(
                number.name,
                number.unit,
                before,
                number.value(at),
                number.deviation(at, std),
                known,
                number.deviation(at, 1.0),
            )
        )
    return tuple(found)


def _with_zero(
    optimum: Optimum, recordings: Sequence[Recording], advance: Callable[[int], None]
) -> Optimum:
    """Return the optimum with the first angle's zero as it is, unless it is surely another one.

    Gravity shows it, but a torque's offset does nearly the same.
    """
    for place, each in enumerate(_found(optimum)):
        if each.name.endswith("_angle.offset") and not each.significant:
            fewer = optimum.unknowns.without(each.name)
            begin = np.delete(optimum.coordinates, place)
            return maximise(fewer, recordings, begin=begin, advance=advance)
    return optimum


def with_disturbed_sensor(
    request: ArmRequest,
    free: Sequence[str],
    optimum: Optimum,
    recordings: Sequence[Recording],
    advance: Callable[[int], None],
) -> tuple[ArmRequest, Optimum, list[Lack]]:
    """Return request and optimum with a drifting sensor if that explains far more of the motion.

    A precise sensor of an arm that is not quite the model, such as one with a flexible link, is
    likeliest with so much process noise that nothing else is left to be found. The innovations are
    small then, but a free run fails. It succeeds if the sensor may be off for a while.

    Args:
        request: Without.
        free: As of `fit`.
        optimum: Without.
        recordings: What is fitted.
        advance: Called with the number of filtered samples.
    """
    longest = max(recordings, key=lambda recording: recording.count)
    parts = [_middle_of(longest, _MIDDLE_SAMPLES)]
    chosen: tuple[ArmRequest, str, Array] | None = None
    noisy = any(
        number.name.startswith("process_noise") and coordinate > 1.0
        for number, coordinate in zip(
            optimum.unknowns.numbers, optimum.coordinates.tolist(), strict=True
        )
    )
    before = best = _free_run(optimum.joint, parts[0]) if noisy else 100.0
    for place, output in enumerate(request.sensors if before < _POOR else ()):
        if output.model.state_count:
            continue
        swing = float(np.nanstd(parts[0].y[:, place]))
        term = DisturbanceTerm("gauss_markov", {"std": 0.02 * swing, "time_constant": 0.03})
        changed = request.with_terms(place, (term,))
        unknowns = Unknowns.of(changed, free)
        tried = maximise(unknowns, parts, starts=1, steps=_FEW_STEPS, advance=advance)
        reached = _free_run(tried.joint, parts[0])
        if 100.0 - reached < 0.5 * (100.0 - best):
            chosen, best = (changed, output.measures, tried.coordinates), reached
    if chosen is None:
        return request, optimum, []
    changed, name, begin = chosen
    text = f"something that {name} shows and the arm does not do: a free run explains "
    text += f"{best:.3g} % with it, {before:.3g} % without"
    lack = Lack(text, f"the fitted request has a gauss_markov disturbance of {name} for it")
    found = maximise(Unknowns.of(changed, free), recordings, begin=begin, advance=advance)
    return changed, found, [lack]


def _free_run(joint: Joint, recording: Recording) -> float:
    """Return the share of the outputs that free runs explain [%], the least of them."""
    fits, _ = output_fits(joint, recording, recording.count // 4, GATE)
    return min(each.free_run for each in fits)


def observable(
    joint: Joint,
    numbers: Sequence[Found],
    recordings: Sequence[Recording],
    advance: Callable[[int], None] = lambda _: None,
) -> ArmRequest:
    """Return the request of an observer, which has Coulomb friction as a torque disturbance.

    A sign has no bounded slope, so no certificate covers friction in the model; as a Gauss–Markov
    torque it is covered. Its 1σ is the friction's size and its time constant the time between two
    reversals: likelier ones are shorter, and do not allow for friction that lasts. The noises are
    the likeliest of a filter without friction.

    Args:
        joint: The likeliest joint.
        numbers: What was found.
        recordings: What it was found from.
        advance: Called with the number of filtered samples.
    """
    request = joint.request
    by_name = {each.name: each for each in numbers}
    rubbing = [
        (side, by_name[name].value)
        for side, name in zip(SIDES, FRICTION, strict=True)
        if name in by_name and by_name[name].significant
    ]
    known = set[str]()
    for side, torque in rubbing:
        if not getattr(request.torque_disturbance, side):
            time = _reversal_time(joint, recordings, side)
            term = DisturbanceTerm("gauss_markov", {"std": torque, "time_constant": time})
            known |= {f"torque_disturbance.{side}.0.{key}" for key in ("std", "time_constant")}
            torques = replace(request.torque_disturbance, **{side: (term,)})
            request = replace(request, torque_disturbance=torques)
    if rubbing:
        smooth = replace(joint, request=request, friction=(0.0, 0.0))
        noises = Unknowns.of(request).noises()
        chosen = tuple(each for each in noises.numbers if each.name not in known)
        noises = replace(noises, joint=smooth, numbers=chosen)
        request = maximise(noises, recordings, starts=1, advance=advance).joint.request
    bounds = dict(request.uncertainty)
    for name, entry in UNCERTAINTY.items():
        if (each := by_name.get(f"arm.{name}")) is not None:
            relative = 3.0 * each.std / each.value
            if relative < _KNOWN:
                bounds.pop(entry, None)
            elif each.seen:
                bounds[entry] = float(f"{relative:.2g}")
            else:
                bounds.setdefault(entry, float(f"{min(relative, _MOST):.2g}"))
    for name in ("link_damping", "motor_damping"):
        if (each := by_name.get(f"arm.{name}")) is not None:
            bounds.pop(name, None)
    shown = {
        each.name: float(f"{each.start:.6g}")
        for each in numbers_of(request)
        if not each.from_nothing and each.positive and each.name != TORQUE_GAIN
    }
    for each in numbers:
        if not (each.before or each.significant) and each.name in shown:
            shown[each.name] = 0.0
    own = Joint.of(replace(request, uncertainty=bounds))
    path = replace(joint, request=with_values(own, shown).request)
    significant = [each.name for each in numbers if each.significant]
    kept = [name for name in (DELAY, OFFSET) if name not in by_name]
    return path.with_path([*significant, *kept])


def _reversal_time(joint: Joint, recordings: Sequence[Recording], side: str) -> float:
    """Return the mean time between reversals of a side's motion [s]."""
    time, reversals = 0.0, 1
    for recording in recordings:
        states = innovations(joint, recording, gate=GATE, with_states=True).states
        velocity = joint.request.arm.to_physical(states[:, :4])[:, 3 if side == "motor" else 1]
        moving = velocity[np.abs(velocity) > 0.02 * np.abs(velocity).max()]
        reversals += int((np.diff(np.sign(moving)) != 0.0).sum())
        time += float(np.maximum(recording.durations, 0.0).sum())
    return float(f"{time / reversals:.3g}")


def unseen(optimum: Optimum) -> tuple[Unseen, ...]:
    """Return the directions in which the recordings know less than the prior."""
    values, vectors = np.linalg.eigh(optimum.evaluation.information)
    names = [each.name for each in optimum.unknowns.numbers]
    found = []
    for value, vector in zip(values.tolist(), vectors.T, strict=True):
        if value > 3.0:
            break
        parts = ranked(list(zip(names, vector.tolist(), strict=True)), 0.3)
        named = [name.removeprefix("arm.") for name, _ in parts]
        shown = named[0]
        if len(named) > 1:
            shown = f"{', '.join(named[:-1])} and {named[-1]}, which look alike"
        motion = next((text for name, text in _MOTIONS.items() if name in parts[0][0]), "")
        found.append(Unseen(parts, f"{shown}{motion}"))
    return tuple(found)


_MOTIONS = {
    "stiffness": ": a motion near the joint's resonance would show it",
    "gravity": ": slow motion through larger angles would show it",
    "inertia": ": faster accelerations would show it",
    "damping": ": long motion at several speeds would show it",
    "friction": ": slow motion with many reversals would show it, if there is any",
    "offset": ": rest at several angles, or motion in both directions, would show it",
    "delay": ": steps of the torque would show it",
    "process_noise": ": it is too small to matter beside the other noises",
    "time_constant": ": a longer recording would show it",
    "density": ": a longer recording would show it",
}
"""What would show a number, by a part of its name."""


def _found_lacks(numbers: Sequence[Found]) -> list[Lack]:
    """Return what was found that the request did not have."""
    made = []
    for each in numbers:
        if not each.significant or each.before:
            continue
        value = f"{each.value:.3g} {each.unit}"
        if each.name in FRICTION:
            side = SIDES[FRICTION.index(each.name)]
            made.append(
                Lack(
                    f"Coulomb friction of the {side}, {value}",
                    f"the fitted request has a torque disturbance of the {side} for it",
                )
            )
        elif each.name == OFFSET:
            made.append(Lack(f"an offset of the torque, {value}", "the fitted request has it"))
        elif each.name.endswith(".offset"):
            name = each.name.removesuffix(".offset")
            made.append(
                Lack(f"an offset of {name}, {value}", "subtract it from what the driver publishes")
            )
        elif each.name == DELAY and each.value > 0.0:
            made.append(Lack(f"a delay of the torque, {value}", "the fitted request has it"))
        elif each.name == DELAY:
            made.append(
                Lack(
                    f"a torque that acts {-each.value:.3g} s before its stamp",
                    "",
                )
            )
        elif each.name.endswith("damping"):
            made.append(
                Lack(f"{each.name.removeprefix('arm.')} of {value}", "the fitted request has it")
            )
    return made


def _mean_log_likelihoods(
    joint: Joint, recordings: Sequence[tuple[Recording, int]]
) -> tuple[float, float]:
    """Return the log likelihood per sample before the held-out parts begin, and in them."""
    totals, counts = [0.0, 0.0], [0, 0]
    for recording, begin in recordings:
        found = innovations(joint, recording, gate=GATE)
        for place, part in enumerate((slice(0, begin), slice(begin, None))):
            totals[place] += log_likelihood(found.errors[part], found.variances[part], GATE)
            counts[place] += len(found.errors[part])
    fitted, held_out = (
        total / count if count else math.nan for total, count in zip(totals, counts, strict=True)
    )
    return fitted, held_out


def fit(
    request: ArmRequest,
    *logs: str | Path | Samples,
    free: Sequence[str] = (),
    held_out: float = 0.25,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    joint: str | None = None,
    topic: str | None = None,
    seed: int = 0,
    advance: Callable[[int], None] = lambda _: None,
) -> Fit:
    """Fit the numbers of a joint to recordings.

    Args:
        request: An arm's request, e.g. with the numbers of data sheets: they are where the search
            starts, and its `uncertainty` says how far off they may be.
        logs: Recordings: paths of CSV logs or bags, or tuples (time, angle, torque) of arrays.
        free: Names of the numbers to estimate, such as "stiffness" or "torque.delay"; all but the
            torque's gain if empty.
        held_out: Share at the end of each recording that is not fitted but predicted.
        columns: Of CSV logs: titles by what they are, as of `tsobs estimate --columns`.
        units: Of CSV logs: units by quantity.
        joint: Name of the joint in the recordings; needed if there are several.
        topic: Topic of the measurements in bags; None if there is only one.
        seed: Of the points that the search starts from.
        advance: Called with the number of filtered samples, for progress.

    Raises:
        ModelError: The request is for no arm, or a name is unknown.
        LogError: A recording is of no use; one line says why.
        BagReadError: A bag cannot be read.

    >>> import tsobs_ros as ts
    >>> run = ts.simulate(duration=20.0, torque=lambda t: 2.0 if t % 3.0 < 1.0 else -1.0)
    >>> sheet = ts.ArmRequest(ts.ElasticJointArm(stiffness=13.0))
    >>> found = ts.fit(sheet, (run.time, run.angle, run.torque), free=["stiffness"])
    >>> 9.5 < found.number("stiffness").value < 10.5
    True
    """
    if not isinstance(request, ArmRequest):
        raise ModelError("request: expected one for an arm; a T-S system has no numbers to fit")
    if not 0.0 <= held_out <= 0.9:
        raise ModelError(f"held_out: expected a share from 0 to 0.9, got {held_out!r}")
    start, recordings, notes = read(
        request, logs, columns=columns, units=units, joint=joint, topic=topic
    )
    unknowns = Unknowns.of(start, free)
    begins = [round((1.0 - held_out) * each.count) for each in recordings]
    fitted = [each.part(0, end) for each, end in zip(recordings, begins, strict=True)]
    require_torque(unknowns, _middle_of(fitted[0], _START_SAMPLES))
    optimum = maximise(unknowns, fitted, seed=seed, advance=advance)
    start, optimum, added = with_disturbed_sensor(start, free, optimum, fitted, advance)
    optimum = _with_zero(optimum, fitted, advance)
    likeliest = optimum.joint
    numbers = _found(optimum)
    observed = observable(likeliest, numbers, fitted, advance)
    longest = max(range(len(recordings)), key=lambda place: recordings[place].count)
    whole = recordings[longest]
    begin = begins[longest] if held_out else whole.count // 2
    outputs, traces = output_fits(likeliest, whole, begin, GATE)
    rest = list(zip(recordings, begins, strict=True))
    before, after = (_mean_log_likelihoods(each, rest) for each in (unknowns.joint, likeliest))
    return Fit(
        request=observed,
        before=start,
        joint=likeliest,
        numbers=numbers,
        unseen=unseen(optimum),
        lacks=(*added, *_found_lacks(numbers), *lacks(likeliest, fitted, GATE)),
        outputs=outputs,
        log_likelihood=(before[0], after[0]),
        log_likelihood_held_out=(before[1], after[1]),
        samples=(sum(begins), sum(each.count - end for each, end in rest)),
        outliers=optimum.evaluation.outliers,
        notes=notes,
        traces=traces,
    )
