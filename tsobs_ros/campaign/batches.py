# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Batches of simulated runs: their estimates, and the scores of these."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator, Rows
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.arm import SIDES
from tsobs_ros.report.metrics import SIGMAS, MetricsOptions, measure
from tsobs_ros.report.quantities import QUANTITIES, Quantity
from tsobs_ros.report.run import RecordedRun
from tsobs_ros.series import NANOSECONDS, Series
from tsobs_ros.simulation.plant import Trajectories

CLAIMS: Mapping[str, tuple[Basis, ...]] = {
    "certified": (Basis.CERTIFIED,),
    "learnt": (Basis.LEARNT,),
    "covariance": (
        Basis.COVARIANCE,
        Basis.STARTING,
        Basis.GAP,
        Basis.JUMP,
        Basis.HYPOTHESIS,
    ),
    "none": (Basis.CONTRADICTED, Basis.OUTSIDE),
}
"""What a claimed bound is said to be by its basis: the certificate's, the certificate's but for the
learnt parameters, a covariance; and nothing, which any other one is said to be."""

_CLAIM_OF = np.array(
    [[basis in bases for bases in CLAIMS.values()].index(True) for basis in Basis], np.int64
)


class Observed(NamedTuple):
    """Estimates of a batch of runs, at each sample from the samples up to it; NaN if there is none.

    Attributes:
        rows: Of `Estimator.row_type`, shape (runs, samples).
        events: What the supervision counted in each run.
    """

    rows: Rows
    events: tuple[dict[str, int], ...]

    @classmethod
    def of(cls, states: Array, disturbances: Array) -> "Observed":
        """Return estimates without bounds, shapes (runs, samples, 4) and (runs, samples, p)."""
        rows = np.full(
            states.shape[:2],
            np.nan,
            [
                ("state", np.float64, (4,)),
                ("state_bound", np.float64, (0,)),
                ("disturbance", np.float64, disturbances.shape[2:]),
                ("disturbance_bound", np.float64, (0,)),
                ("basis", np.float64),
                ("claimed", np.float64),
            ],
        )
        rows["state"], rows["disturbance"] = states, disturbances
        return cls(rows, ({},) * len(rows))

    def field(self, name: str) -> Array:
        """Return a field of `Estimate`, shape (runs, samples) or (runs, samples, numbers)."""
        return np.asarray(self.rows[name])

    def _of(self, name: str, width: int) -> Array:
        found = self.field(name)
        return found if found.shape[-1] else np.full((*found.shape[:-1], width), np.nan)

    @property
    def states(self) -> Array:
        """Estimated [q₁, q̇₁, q₂, q̇₂] (rad, rad/s), shape (runs, samples, 4)."""
        return self.field("state")

    @property
    def state_bounds(self) -> Array:
        """1σ bound of each, NaN if the method has none, shape (runs, samples, 4)."""
        return self._of("state_bound", 4)

    @property
    def disturbances(self) -> Array:
        """Estimated disturbances of the outputs, shape (runs, samples, p)."""
        return self._of("disturbance", 1)

    @property
    def disturbance_bounds(self) -> Array:
        """1σ bound of each, shape (runs, samples, p)."""
        return self._of("disturbance_bound", 1)

    @property
    def parameters(self) -> Array:
        """Learnt changes θ of the model's parameters, shape (runs, samples, k)."""
        return self.field("parameters")

    @property
    def parameter_bounds(self) -> Array:
        """1σ of each, shape (runs, samples, k)."""
        return self.field("parameter_bound")


class Scores(NamedTuple):
    """Errors of estimates of q quantities, those over the settled parts by a report's measures.

    NaN stands for what is not known.

    Attributes:
        rmse: Root mean square errors over the settled parts, shape (runs, q).
        bound: Root mean squares of the 1σ bounds there, shape (runs, q).
        inside: Shares of the errors there inside `SIGMAS` times their bound, shape (runs, q).
        normalised_rmse: Root mean square over the states of RMSE / scale, shape (runs,).
        claimed: Number of samples whose bounds are said to be one of `CLAIMS`, settled or not,
            shape (runs, claims).
        claims: At these samples the share of errors inside `SIGMAS` times their bound, and the root
            mean square and the largest of |error| / bound, shape (runs, claims, q, 3).
        reach: Largest size of the first true state, shape (runs,).
    """

    rmse: Array
    bound: Array
    inside: Array
    normalised_rmse: Array
    claimed: NDArray[np.int64]
    claims: Array
    reach: Array


class BatchObserver:
    """What the node runs, for batches of runs; the bits are those of `ts.estimate`.

    Args:
        design: The design of an arm.
        settings: Method, gates and timeouts; the node's defaults if None.
        estimator: The observer, if it is made already.

    Raises:
        ModelError: The method cannot observe this arm.
    """

    def __init__(
        self,
        design: Design,
        settings: ObserverSettings | None = None,
        estimator: Estimator | None = None,
    ) -> None:
        settings = settings or ObserverSettings()
        # Nothing is late.
        limits = TrackerOptions(
            design.arm_request.max_angle,
            history=0.0,
            restart_after=settings.stale_after,
            max_steps=1,
        )
        self._tracker = Tracker(estimator or make_estimator(design, settings), limits)

    def __call__(self, runs: Trajectories) -> Observed:
        """Observe a batch of runs; other threads of Python can run meanwhile."""
        tracker = self._tracker
        stamps = stamps_of(runs.times)
        rows, events = [], []
        for y, u in zip(runs.measurements, runs.torques, strict=True):
            tracker.reset()
            rows.append(tracker.follow(stamps, y, u))
            events.append(tracker.events)
        together = rows[0][np.newaxis] if len(rows) == 1 else np.stack(rows)
        return Observed(together, tuple(events))


def stamps_of(times: Array) -> NDArray[np.int64]:
    """Return stamps [ns] of times since the start of a run [s]; it starts at 1 s."""
    return NANOSECONDS + np.round(times * NANOSECONDS).astype(np.int64)


def observe(
    design: Design,
    runs: Trajectories,
    settings: ObserverSettings | None = None,
    estimator: Estimator | None = None,
) -> Observed:
    """Observe a batch of runs once; see `BatchObserver`."""
    return BatchObserver(design, settings, estimator)(runs)


def score(
    runs: Trajectories,
    observed: Observed,
    options: MetricsOptions | None = None,
    quantities: tuple[Quantity, ...] = QUANTITIES,
    sides: tuple[str, ...] = (),
) -> Scores:
    """Score estimates of a batch of runs as a report does.

    Args:
        runs: What is true.
        observed: Estimates at the same samples.
        options: Which parts of a run are settled, and the scale; the defaults if None.
        quantities: What is scored.
        sides: Of the design's torque disturbances, of "motor" and "link".
    """
    count, q = len(runs.physical), len(quantities)
    settled, normalised = np.full((3, count, q), np.nan), np.full(count, np.nan)
    claimed = np.zeros((count, len(CLAIMS)), np.int64)
    claims = np.full((count, len(CLAIMS), q, 3), np.nan)
    for place in range(count):
        run = recorded(runs, observed, place, quantities, sides)
        metrics = measure(run, options)
        normalised[place] = _number(metrics.normalised_rmse)
        for column, one in enumerate(metrics.quantities):
            settled[:, place, column] = [
                _number(each) for each in (one.rmse, one.bound, one.inside)
            ]
        said = _said(observed, place)
        claimed[place] = np.bincount(said[said >= 0], minlength=len(CLAIMS))
        for column, quantity in enumerate(quantities):
            one_of = run.of(quantity)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.abs(one_of.error) / one_of.bounds
            known = np.isfinite(ratio)
            for claim in range(len(CLAIMS)):
                own = ratio[known & (said == claim)]
                if len(own):
                    inside, mean = np.mean(own <= SIGMAS), np.mean(own * own)
                    claims[place, claim, column] = inside, np.sqrt(mean), own.max()
    reach = np.abs(runs.physical[:, :, 0]).max(axis=1)
    rmse, bound, inside = settled
    return Scores(rmse, bound, inside, normalised, claimed, claims, reach)


def recorded(
    runs: Trajectories,
    observed: Observed,
    run: int,
    quantities: tuple[Quantity, ...] = QUANTITIES,
    sides: tuple[str, ...] = (),
) -> RecordedRun:
    """Return one run of a batch as if it had been recorded; see `score`."""
    stamps = stamps_of(runs.times)
    there = np.flatnonzero(np.isfinite(runs.measurements[run]).any(axis=1))
    torques = runs.torque_disturbances[run][:, [SIDES.index(side) for side in sides]]
    fields: dict[str, Any] = {}
    for key, bounds, name, width in (
        ("states", "state_bounds", "state", 4),
        ("disturbance", "disturbance_bounds", "disturbance", runs.disturbances.shape[2]),
        ("torque", "torque_bounds", "torque_disturbance", len(sides)),
    ):
        for field, part in ((key, name), (bounds, f"{name}_bound")):
            unknown = np.full((len(stamps), width), np.nan)
            numbers = observed.rows[part][run] if part in (observed.rows.dtype.names or ()) else ()
            fields[field] = numbers if np.size(numbers) else unknown
    return RecordedRun(
        name="run",
        joint="run",
        measurements=Series(
            stamps[there], np.hstack([runs.measurements[run], runs.torques[run]])[there]
        ),
        stamps=stamps,
        quantities=quantities,
        truth=Series(stamps, runs.physical[run]),
        true_disturbance=Series(stamps, runs.disturbances[run]),
        true_torque=Series(stamps, torques) if sides else None,
        **fields,
    )


def _said(observed: Observed, run: int) -> NDArray[np.int64]:
    """Return which of `CLAIMS` the bounds of a run are said to be, -1 without an estimate."""
    basis, claimed = (observed.rows[name][run] for name in ("basis", "claimed"))
    known = np.isfinite(basis)
    said = np.full(len(basis), -1, np.int64)
    said[known] = np.where(
        claimed[known] == 0.0, len(CLAIMS) - 1, _CLAIM_OF[basis[known].astype(int)]
    )
    return said


def _number(value: float | None) -> float:
    return math.nan if value is None else value
