# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Batches of simulated runs: their estimates, and the scores of these."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.design.record import Design
from tsobs_ros.estimation.estimator import Estimator, Rows
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.arm import SIDES
from tsobs_ros.report.metrics import SAME_JUMP, SIGMAS, MetricsOptions
from tsobs_ros.report.quantities import QUANTITIES, Quantity
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.simulation.plant import Trajectories

CLAIMS: Mapping[str, tuple[Basis, ...]] = {
    "certified": (Basis.CERTIFIED,),
    "learnt": (Basis.LEARNT,),
    "covariance": (
        Basis.COVARIANCE,
        Basis.STARTING,
        Basis.GAP,
        Basis.JUMP,
        Basis.TORQUE,
        Basis.HYPOTHESIS,
    ),
    "none": (Basis.CONTRADICTED, Basis.OUTSIDE),
}
"""What a claimed bound is said to be by its basis: the certificate's, the certificate's but for the
learnt parameters, a covariance; and nothing, which any other one is said to be."""

_CLAIM_OF = np.array(
    [[basis in bases for bases in CLAIMS.values()].index(True) for basis in Basis], np.int64
)

_KINDS = ("state", "disturbance", "torque")
_FIELDS = {"torque": "torque_disturbance"}


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
        claim_inside: Shares of errors inside `SIGMAS` times their bound at these samples, shape
            (runs, claims, q).
        claim_ratio: Root mean square of error / bound there, shape (runs, claims, q).
        claim_worst: Largest |error| / bound there, shape (runs, claims, q).
        reach: Largest size of the first true state, shape (runs,).
    """

    rmse: Array
    bound: Array
    inside: Array
    normalised_rmse: Array
    claimed: NDArray[np.int64]
    claim_inside: Array
    claim_ratio: Array
    claim_worst: Array
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
    """Score estimates of a batch of runs.

    Args:
        runs: What is true.
        observed: Estimates at the same samples.
        options: Which parts of a run are settled, and the scale; the defaults if None.
        quantities: What is scored.
        sides: Of the design's torque disturbances, of "motor" and "link".
    """
    options = options or MetricsOptions()
    kept = np.array(
        [options.start_settle_time, options.jump_settle_time, SAME_JUMP, SIGMAS], np.float64
    )
    row_type = observed.rows.dtype
    places = np.array([_places(each, row_type, sides) for each in quantities], np.int64)
    jumps = np.array([options.jump_threshold if q.jump is None else q.jump for q in quantities])
    count = len(runs.states)
    settled = np.zeros((count, len(quantities), 5))
    claims = np.zeros((count, len(CLAIMS), len(quantities), 4))
    claimed = np.zeros((count, len(CLAIMS)), np.int64)
    reach = np.zeros(count)
    native.scores_add_up(
        kept,
        places,
        jumps,
        _CLAIM_OF,
        row_type.fields["basis"][1] // 8,
        np.ascontiguousarray(runs.times),
        np.ascontiguousarray(runs.physical),
        np.ascontiguousarray(runs.disturbances),
        np.ascontiguousarray(runs.torque_disturbances),
        _last_measured(runs.measurements),
        np.ascontiguousarray(observed.rows).view(np.float64),
        settled,
        claims,
        claimed,
        reach,
        np.zeros((2, len(quantities))),
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        rmse = np.sqrt(settled[..., 0] / settled[..., 1])
        bound = np.sqrt(settled[..., 2] / settled[..., 3])
        inside = settled[..., 4] / settled[..., 3]
        number = claims[..., 0]
        claim_inside = claims[..., 1] / number
        claim_ratio = np.sqrt(claims[..., 2] / number)
        claim_worst = np.where(number > 0.0, claims[..., 3], np.nan)
    states = [place for place, each in enumerate(quantities) if each.kind == "state"]
    relative = rmse[:, states] / np.array(options.scale)
    normalised = np.sqrt((relative * relative).sum(axis=1) / len(states))
    return Scores(
        rmse, bound, inside, normalised, claimed, claim_inside, claim_ratio, claim_worst, reach
    )


def _last_measured(measurements: Array) -> NDArray[np.intp]:
    """Return the last sample with a measurement in each run, which does not count itself."""
    there = np.asarray(np.isfinite(measurements).any(axis=2))
    samples = np.arange(there.shape[1])
    return np.asarray(np.where(there, samples, 0).max(axis=1))


def _places(quantity: Quantity, row_type: Any, sides: tuple[str, ...]) -> tuple[int, int, int, int]:
    """Return kind and column of a quantity's truth, its place and its bound's in a row, or -1."""
    field = _FIELDS.get(quantity.kind, quantity.kind)
    here = []
    for name in (field, f"{field}_bound"):
        numbers, begin, *_ = row_type.fields[name]
        here.append(begin // 8 + quantity.column if numbers.shape[0] else -1)
    column = quantity.column
    if quantity.kind == "torque":
        column = SIDES.index(sides[column])
    return _KINDS.index(quantity.kind), column, here[0], here[1]
