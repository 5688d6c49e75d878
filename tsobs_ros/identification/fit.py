# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood: the numbers of a joint that explain its recordings best."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from tsobs_ros.checks import Array
from tsobs_ros.design.request import ArmRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.identification.diagnosis import news, output_fits, unseen
from tsobs_ros.identification.joint import (
    DELAY,
    FRICTION,
    OFFSET,
    TORQUE_GAIN,
    UNCERTAINTY,
    Found,
    Joint,
    Unknowns,
    numbers_of,
    require_arm,
    with_values,
)
from tsobs_ros.identification.likelihood import GATE, Evaluation, Likelihood, Recording, innovations
from tsobs_ros.identification.recordings import Samples, read, require_torque, wary
from tsobs_ros.identification.result import Fit
from tsobs_ros.model.arm import SIDES
from tsobs_ros.model.disturbance import DisturbanceTerm

Advance = Callable[[int], None]
"""Called with the number of filtered samples."""

_START_SAMPLES, _MIDDLE_SAMPLES = 4000, 12_000
"""Number of samples on which starts are compared, and number that is fitted before all samples."""

_STARTS, _FEW_STEPS, _MAX_STEPS = 3, 15, 40

_POOR = 85.0
"""Share of the outputs that a free run must explain [%]; else disturbed sensors are tried."""

_KNOWN, _MOST = 0.02, 0.8
"""Relative error below which a number need not be learnt, and largest error in a request."""

_TOLERANCE = 0.02
"""Expected gain below which no further step is taken [nat]: a fifth of a σ of a number."""


class Optimum(NamedTuple):
    """The most likely numbers: coordinates and 1σ in units of the priors, and the likelihood there.

    `coordinates` and `std` have the shape (k,).
    """

    unknowns: Unknowns
    coordinates: Array
    std: Array
    evaluation: Evaluation

    @property
    def joint(self) -> Joint:
        """The joint with these numbers."""
        return self.unknowns.at(self.coordinates)

    @property
    def numbers(self) -> tuple[Found, ...]:
        """The numbers in the form of reports."""
        each = zip(self.unknowns.numbers, self.coordinates.tolist(), self.std.tolist(), strict=True)
        return tuple(number.found(at, std) for number, at, std in each)


def maximise(
    unknowns: Unknowns,
    recording: Recording,
    advance: Advance,
    *,
    starts: int = _STARTS,
    begin: Array | None = None,
    steps: int = _MAX_STEPS,
) -> Optimum:
    """Return the most likely numbers.

    The search begins on a short part from several points, without a gate, and goes on with all data
    from the best of them or `begin`. The trust region uses Fisher's information plus the prior's.
    """
    k, rng, best = unknowns.count, np.random.default_rng(0), begin
    if best is None:
        short, longer = (
            Likelihood(unknowns, recording.middle(count), advance=advance)
            for count in (_START_SAMPLES, _MIDDLE_SAMPLES)
        )
        points = [np.zeros(k), *(0.5 * rng.standard_normal((starts - 1, k)))]
        # A filter that trusts a wrong model too much never sees that other numbers are likelier.
        points.append(wary(unknowns, 4.0))
        found = [_search(short, point, _FEW_STEPS) for point in points]
        best = _search(longer, min(found, key=short.cost), _FEW_STEPS)
    gated = Likelihood(unknowns, recording, GATE, advance)
    best = _search(gated, best, steps)
    made = gated.evaluate(best)
    inverse = np.linalg.inv(made.information + np.eye(k))
    # White innovations make both alike; for coloured ones the larger counts.
    robust = inverse @ (made.spread + np.eye(k)) @ inverse
    return Optimum(unknowns, best, np.sqrt(np.maximum(np.diag(robust), np.diag(inverse))), made)


def _search(likelihood: Likelihood, start: Array, steps: int) -> Array:
    """Return the point of least cost after at most so many steps."""
    unit, least = np.eye(len(start)), math.inf

    def settle(intermediate_result: OptimizeResult) -> None:
        nonlocal least
        made = likelihood.evaluate(intermediate_result.x)
        gained, least = least - made.cost, made.cost
        step = np.linalg.solve(made.information + unit, made.gradient)
        # For a wrong model the information is not the curvature, and small steps never end.
        if 0.5 * made.gradient @ step < _TOLERANCE or 0.0 < gained < 5.0 * _TOLERANCE:
            raise StopIteration

    radii = {"initial_trust_radius": 0.5, "max_trust_radius": 2.0}
    found = minimize(
        likelihood.cost,
        start,
        method="trust-exact",
        jac=lambda at: likelihood.evaluate(at).gradient,
        hess=lambda at: likelihood.evaluate(at).information + unit,
        callback=settle,
        options={"gtol": 0.0, "maxiter": steps, **radii},
    )
    return np.asarray(found.x)


def _with_zero(optimum: Optimum, recording: Recording, advance: Advance) -> Optimum:
    """Return the optimum without the first offset of an angle that is not significant, if any.

    Gravity shows this offset, but an offset of the torque has nearly the same effect.
    """
    for place, each in enumerate(optimum.numbers):
        if each.name.endswith("_angle.offset") and not each.significant:
            fewer = optimum.unknowns.without(each.name)
            others = np.arange(optimum.unknowns.count) != place
            bend = optimum.evaluation.information + np.eye(len(others))
            # The others follow, as a gate would keep out the angle for good if its offset jumped.
            follow = np.linalg.solve(bend[np.ix_(others, others)], bend[others, place])
            begin = optimum.coordinates[others] + follow * optimum.coordinates[place]
            return maximise(fewer, recording, advance, begin=begin)
    return optimum


def _with_disturbed_sensor(
    request: ArmRequest,
    free: Sequence[str],
    optimum: Optimum,
    recording: Recording,
    advance: Advance,
) -> tuple[ArmRequest, Optimum, list[str]]:
    """Return request and optimum with a drifting sensor if that explains far more of the motion.

    If a precise sensor measures an arm that differs from the model, e.g. by a flexible link, the
    most likely process noise is so large that nothing else can be found. Innovations are then
    small, but a free run fails. It succeeds if the sensor may be off for a while.
    """
    part = recording.middle(_MIDDLE_SAMPLES)
    numbers = zip(optimum.unknowns.numbers, optimum.coordinates.tolist(), strict=True)
    noisy = any(one.name.startswith("process_noise") and at > 1.0 for one, at in numbers)
    before, tried = _free_run(optimum.joint, part) if noisy else 100.0, []
    for place, output in enumerate(request.sensors if before < _POOR else ()):
        if not output.model.state_count:
            swing = float(np.nanstd(part.y[:, place]))
            term = DisturbanceTerm("gauss_markov", {"std": 0.02 * swing, "time_constant": 0.03})
            disturbed = request.with_terms(place, (term,))
            unknowns = Unknowns.of(disturbed, free)
            found = maximise(unknowns, part, advance, starts=1, steps=_FEW_STEPS)
            tried.append((_free_run(found.joint, part), disturbed, found, output.measures))
    best, changed, chosen, name = max(tried, key=itemgetter(0), default=(0.0, request, optimum, ""))
    if not 100.0 - best < 0.5 * (100.0 - before):
        return request, optimum, []
    text = f"something that {name} shows and the arm does not do: a free run explains "
    text += f"{best:.3g} % with it, {before:.3g} % without"
    found = maximise(chosen.unknowns, recording, advance, begin=chosen.coordinates)
    return changed, found, [text]


def _free_run(joint: Joint, recording: Recording) -> float:
    """Return the share of an output that free runs explain [%], the least of all outputs."""
    fits, _ = output_fits(joint, recording, recording.count // 4)
    return min(each.free_run for each in fits)


def _observable(optimum: Optimum, recording: Recording, advance: Advance) -> ArmRequest:
    """Return the request of an observer, which has Coulomb friction as a torque disturbance.

    A sign has no bounded slope, so no certificate covers friction in the model; it does cover a
    Gauss–Markov torque, with the friction's size as its 1σ and the time between two reversals as
    its time constant. Likelier time constants are shorter, but do not allow for lasting friction.
    The noises are the likeliest of a filter without friction.
    """
    joint, numbers, known = optimum.joint, optimum.numbers, list[str]()
    request, found = joint.request, {each.name: each for each in numbers}
    significant = {each.name for each in numbers if each.significant}
    for side, name in zip(SIDES, FRICTION, strict=True):
        torques = request.torque_disturbance
        if name in significant:
            size, time_constant = found[name].value, _reversal_time(joint, recording, side)
            values = {"std": size, "time_constant": time_constant}
            term = DisturbanceTerm("gauss_markov", values)
            # A smaller drift is what the filter found beside friction; this term includes it.
            others = (one for one in getattr(torques, side) if one.get("std", math.inf) > size)
            changed = replace(torques, **{side: (term, *others)})
            request = replace(request, torque_disturbance=changed)
            known += [f"torque_disturbance.{side}.0.{key}" for key in values]
    if significant.intersection(FRICTION):
        smooth = with_values(replace(joint, request=request), dict.fromkeys(FRICTION, 0.0))
        noises = replace(Unknowns.of(request).noises().without(*known), joint=smooth)
        request = maximise(noises, recording, advance, starts=1).joint.request
    bounds = {  # the arm's numbers that are found suit the torque as it is
        name: bound
        for name, bound in request.uncertainty.items()
        if not (name.endswith("damping") and f"arm.{name}" in found) and name != "torque_gain"
    }
    for name, entry in UNCERTAINTY.items():
        if (each := found.get(f"arm.{name}")) is not None:
            relative = 3.0 * each.std / each.value
            if relative < _KNOWN:
                bounds.pop(entry, None)
            elif each.seen or entry not in bounds:
                bounds[entry] = float(f"{min(relative, _MOST):.2g}")
    values = {
        each.name: float(f"{each.start:.6g}")
        for each in numbers_of(request)
        if each.before and each.positive and each.name != TORQUE_GAIN
    }
    nothing = [each.name for each in numbers if not (each.before or each.significant)]
    values |= dict.fromkeys(values.keys() & nothing, 0.0)
    own = Joint.of(replace(request, uncertainty=bounds))
    path = replace(joint, request=with_values(own, values).request)
    return path.with_path(significant | ({DELAY, OFFSET} - found.keys()))


def _reversal_time(joint: Joint, recording: Recording, side: str) -> float:
    """Return the mean time between reversals of a side's motion [s]."""
    states = joint.request.arm.to_physical(innovations(joint, recording).states[:, :4])
    velocity = states[:, 3 if side == "motor" else 1]
    moving = velocity[np.abs(velocity) > 0.02 * np.abs(velocity).max()]
    reversals = 1 + int((np.diff(np.sign(moving)) != 0.0).sum())
    return float(f"{np.maximum(recording.durations, 0.0).sum() / reversals:.3g}")


def fit(
    request: ArmRequest,
    *logs: str | Path | Samples,
    free: Sequence[str] = (),
    held_out: float = 0.25,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    joint: str | None = None,
    topic: str | None = None,
    advance: Advance = lambda _: None,
) -> Fit:
    """Fit the numbers of a joint to recordings.

    Args:
        request: An arm's request, e.g. with the numbers of data sheets. The search starts at these
            numbers; the request's `uncertainty` limits how far off they are expected to be.
        logs: Recordings: paths of CSV logs or bags, or tuples (time, angle, torque) of arrays.
        free: Names of the numbers to estimate, such as "stiffness" or "torque.delay"; all but the
            torque's gain if empty.
        held_out: Share at the end of each recording that is not fitted but predicted.
        columns: For CSV logs: titles by quantity, as in `tsobs estimate --columns`.
        units: For CSV logs: units by quantity.
        joint: Name of the joint in the recordings; needed if there are several.
        topic: Topic of the measurements in bags; None if there is only one.
        advance: Called with the number of filtered samples, for progress.

    Raises:
        ModelError: The request is not for an arm, or a name is unknown.
        LogError: A recording is unusable; one line gives the reason.
        BagReadError: A bag cannot be read.

    >>> import tsobs_ros as ts
    >>> run = ts.simulate(duration=8.0, torque=lambda t: 2.0 if t % 3.0 < 1.0 else -1.0)
    >>> sheet = ts.ArmRequest(ts.ElasticJointArm(stiffness=13.0))
    >>> found = ts.fit(sheet, (run.time, run.angle, run.torque), free=["stiffness"])
    >>> 9.5 < found.number("stiffness").value < 10.5
    True
    """
    require_arm(request)
    if not 0.0 <= held_out <= 0.9:
        raise ModelError(f"held_out: expected a share from 0 to 0.9, got {held_out!r}")
    joints = [joint] if joint else []
    start, recordings, notes = read(
        request, logs, topic=topic, joints=joints, columns=columns, units=units
    )
    unknowns = Unknowns.of(start, free)
    begins = [round((1.0 - held_out) * each.count) for each in recordings]
    parts = [each.part(0, end) for each, end in zip(recordings, begins, strict=True)]
    fitted = Recording.joined(parts)
    require_torque(unknowns, fitted.middle(_START_SAMPLES))
    optimum = maximise(unknowns, fitted, advance)
    start, optimum, disturbed = _with_disturbed_sensor(start, free, optimum, fitted, advance)
    optimum = _with_zero(optimum, fitted, advance)
    whole, begin = max(zip(recordings, begins, strict=True), key=lambda each: each[0].count)
    shown_from = begin if held_out else whole.count // 2
    outputs, traces = output_fits(optimum.joint, whole, shown_from)
    added, lacks = news(optimum.numbers)
    return Fit(
        request=_observable(optimum, fitted, advance),
        before=start,
        joint=optimum.joint,
        numbers=optimum.numbers,
        unseen=unseen(optimum.unknowns, optimum.evaluation.information),
        added=(*disturbed, *added),
        lacks=tuple(lacks),
        outputs=outputs,
        samples=(fitted.count, sum(each.count for each in recordings) - fitted.count),
        outliers=optimum.evaluation.outliers,
        notes=tuple(notes),
        traces=traces,
    )
