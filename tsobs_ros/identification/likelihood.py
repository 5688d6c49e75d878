# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The likelihood of a recording under a joint's numbers, by the innovations of a Kalman filter.

With the innovation e of each output given all before it and its variance s,

    −2 log L = Σ e²/s + log s

(the prediction error decomposition; an innovation beyond the gate counts as one at the gate and is
not used). With derivatives of e and s with respect to the numbers, the Fisher information is

    I = Σ (∂e ∂eᵀ)/s + (∂log s ∂log sᵀ)/2
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.estimation.estimator import riccati_estimator
from tsobs_ros.estimation.state import numbers_of
from tsobs_ros.identification.joint import DELAY, OFFSET, TORQUE_GAIN, Joint, Unknowns, delayed
from tsobs_ros.model.arm import QUANTITIES

WORKERS = 2
BLOCKS = 40
"""Number of parts of a recording whose scores are compared. Their spread gives that of the
estimates, even if the innovations are correlated."""

GATE = 6.0
"""Sigmas of an innovation from which on it is an outlier, once the numbers are about right."""

_STEP = 1e-2
"""Step of a finite difference, relative to the 1σ of the number."""


@dataclass(frozen=True)
class Recording:
    """Samples of one joint.

    Attributes:
        time: Since the first sample [s], shape (n,).
        durations: From each sample to the next [s], below 0 at the start of a gap, after which a
            filter starts again, shape (n,).
        y: Outputs of the request, NaN if missing, shape (n, p).
        u: Torque held from each sample on [N m], shape (n,).
    """

    time: Array
    durations: Array
    y: Array
    u: Array

    @property
    def count(self) -> int:
        """The number of samples."""
        return len(self.time)

    def part(self, begin: int, end: int) -> "Recording":
        """Return the samples from `begin` up to, but not including, `end`."""
        return Recording(*(values[begin:end] for values in vars(self).values()))

    def middle(self, count: int) -> "Recording":
        """Return `count` samples about the middle, or all if there are fewer."""
        begin = max(0, (self.count - count) // 2)
        return self.part(begin, begin + count)

    @classmethod
    def joined(cls, recordings: Sequence["Recording"]) -> "Recording":
        """Return recordings as one, with gaps between them."""
        columns = zip(*(vars(each).values() for each in recordings), strict=True)
        whole = cls(*(np.concatenate(column) for column in columns))
        whole.durations[np.cumsum([each.count for each in recordings]) - 1] = -1.0
        return whole


class Innovations(NamedTuple):
    """The innovations of a filter.

    Attributes:
        errors: y − ŷ of each output given those before it, NaN if it is missing, shape (n, p).
        variances: Expected squares of the errors, shape (n, p).
        states: Predicted states before each sample, in design coordinates, shape (n, states).
    """

    errors: Array
    variances: Array
    states: Array

    @property
    def standardised(self) -> Array:
        """The errors divided by their expected 1σ, shape (n, p)."""
        return np.asarray(self.errors / np.sqrt(self.variances))


def innovations(
    joint: Joint, recording: Recording, *, gate: float = GATE, corrected_until: int | None = None
) -> Innovations:
    """Filter a recording by a joint's model; outputs beyond `gate` sigmas are not used.

    From sample `corrected_until` on none is used; the innovations are then those of a simulation.
    """
    request = joint.request
    covariances = (request.measurement_covariance, request.initial_covariance)
    estimator = riccati_estimator(request.flow, *covariances)
    shape, model = estimator.shape, estimator.model
    scale = request.arm.to_physical(np.ones(4))
    for place, delay in enumerate(joint.of_outputs("delay")):
        if delay:
            angle = QUANTITIES.index(request.sensors[place].measures)
            model["C"][0, place, angle + 1] -= delay * scale[angle]
    gaps = recording.durations < 0.0
    durations = np.where(gaps, request.period, recording.durations)
    gain, offset, delay = (joint.extras[name] for name in (TORQUE_GAIN, OFFSET, DELAY))
    u = gain * delayed(recording.u, durations, delay) + offset
    n, count = shape.n, recording.count
    errors, variances = np.empty((count, shape.p)), np.empty((count, shape.p))
    states, arm, (motor, link) = np.empty((count, n)), request.arm, joint.friction
    native.estimator_innovations(
        model.view(np.float64),
        numbers_of(estimator.initial()),
        recording.durations,
        recording.y - np.array(joint.of_outputs("offset")),
        u,
        link / arm.link_inertia,
        motor / arm.motor_inertia * arm.stiffness / arm.link_inertia,
        gate,
        count if corrected_until is None else corrected_until,
        errors,
        variances,
        states,
        numbers_of(estimator.new_record("correction")),
        numbers_of(estimator.new_record("work")),
    )
    return Innovations(errors, variances, states)


class Evaluation(NamedTuple):
    """The likelihood at one point, with its derivatives.

    Attributes:
        cost: −log L, up to a constant, plus the prior's share.
        gradient: Gradient of the cost with respect to the coordinates, shape (k,).
        information: Information of the recording, without the prior's, shape (k, k).
        spread: Sum over blocks of the products of their scores, shape (k, k).
        outliers: Number of innovations beyond the gate.
    """

    cost: float
    gradient: Array
    information: Array
    spread: Array
    outliers: int


class Likelihood:
    """−log L of a recording over the coordinates of the unknown numbers, with their prior.

    Innovations beyond the gate [sigmas] are outliers; `advance` is called with the number of
    filtered samples.
    """

    def __init__(
        self,
        unknowns: Unknowns,
        recording: Recording,
        gate: float = math.inf,
        advance: Callable[[int], None] = lambda _: None,
    ) -> None:
        self.unknowns, self.recording = unknowns, recording
        self._gate, self._advance = gate, advance
        self._there = np.isfinite(recording.y)
        self._spacing = np.full(unknowns.count, 1e-4)
        self._known: dict[bytes, Evaluation] = {}

    def _filtered(
        self, coordinates: Array, recording: Recording, gate: float
    ) -> tuple[Array, Array]:
        """Return standardised innovations and logarithms of variances of all measured samples,
        (n,) each; those that are left out of the given recording are NaN.
        """
        found = innovations(self.unknowns.at(coordinates), recording, gate=gate)
        self._advance(recording.count)
        with np.errstate(all="ignore"):
            return found.standardised[self._there], np.log(found.variances[self._there])

    def cost(self, coordinates: Array) -> float:
        """Return −log L with the prior's share; infinite if the filter fails."""
        try:
            errors, logs = self._filtered(coordinates, self.recording, self._gate)
        except (ValueError, OverflowError):
            return math.inf
        return self._cost(coordinates, errors, logs)

    def _cost(self, coordinates: Array, errors: Array, logs: Array) -> float:
        squares = np.minimum(errors * errors, self._gate * self._gate)
        total = 0.5 * float(squares.sum() + logs.sum()) + 0.5 * float(coordinates @ coordinates)
        return total if math.isfinite(total) else math.inf

    def evaluate(self, coordinates: Array) -> Evaluation:
        """Return the cost with its derivatives, by differences of the innovations."""
        key = coordinates.tobytes()
        if key in self._known:
            return self._known[key]
        errors, logs = self._filtered(coordinates, self.recording, self._gate)
        regular = errors * errors <= self._gate * self._gate
        # If a sample were an outlier at only one of two points, their difference would jump.
        y = self.recording.y.copy()
        y[self._there] = np.where(regular, y[self._there], np.nan)
        cleaned = replace(self.recording, y=y)
        filtered = partial(self._filtered, recording=cleaned, gate=math.inf)
        with ThreadPoolExecutor(WORKERS) as pool:
            moved = list(pool.map(filtered, coordinates + np.diag(self._spacing)))
        by_error, by_log = (
            (np.stack(shifted, axis=1) - here[:, None]) / self._spacing
            for here, shifted in zip((errors, logs), zip(*moved, strict=True), strict=True)
        )
        # ∂e/√s at fixed s: the derivative of the standardised innovation also has a share from ∂s.
        by_error += 0.5 * errors[:, None] * by_log
        by_error[~regular] = by_log[~regular] = 0.0
        squares = np.where(regular, errors * errors, 1.0)
        # Score of each sample: ½ ∂(e²/s + log s).
        scores = errors[:, None] * by_error + 0.5 * (1.0 - squares)[:, None] * by_log
        information = by_error.T @ by_error + 0.5 * by_log.T @ by_log
        edges = np.linspace(0, len(scores), BLOCKS + 1).astype(int)[:-1]
        blocks = np.add.reduceat(scores, edges, axis=0)
        blocks -= blocks.mean(axis=0)
        made = Evaluation(
            self._cost(coordinates, errors, logs),
            scores.sum(axis=0) + coordinates,
            information,
            blocks.T @ blocks,
            int((~regular).sum()),
        )
        # The information gives the steps of the next differences.
        self._spacing = np.maximum(_STEP / np.sqrt(np.diag(information) + 1.0), 1e-7)
        self._known = {key: made}
        return made
