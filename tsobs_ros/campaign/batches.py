# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Batches of simulated runs: their estimates, and the scores of these."""

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
    count, claims, truths = len(runs.states), _claims(observed), _truths(runs, quantities, sides)
    settled = _settled(runs, _have_jumped(truths, quantities, options), options)
    run = np.broadcast_to(np.arange(count)[:, np.newaxis], settled.shape)
    claim = run * len(CLAIMS) + claims
    shape = (count, len(CLAIMS))
    each: list[list[Array]] = [[] for _ in range(6)]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for quantity, truth in zip(quantities, truths, strict=True):
            estimate, bound = _estimated(observed, quantity)
            error = estimate - truth
            within, ratio = np.abs(error) <= SIGMAS * bound, np.abs(error) / bound
            known, bounded = np.isfinite(error), np.isfinite(bound)
            number, squares = _sums(run, settled & known, error * error)
            bounds, bound_squares, inside = _sums(
                run, settled & known & bounded, bound * bound, within
            )
            judged = known & bounded & (bound > 0.0) & (claims >= 0)
            said, said_inside, ratios = (
                sums.reshape(shape)
                for sums in _sums(claim, judged, within, ratio * ratio, bins=count * len(CLAIMS))
            )
            worst = np.where(said > 0, 0.0, np.nan)
            np.maximum.at(worst.reshape(-1), claim[judged], ratio[judged])
            found = (np.sqrt(squares / number), np.sqrt(bound_squares / bounds), inside / bounds)
            claim_found = (said_inside / said, np.sqrt(ratios / said), worst)
            for those, one in zip(each, (*found, *claim_found), strict=True):
                those.append(one)
    rmse, rms_bound, share_inside, claim_inside, claim_ratio, claim_worst = (
        np.stack(those, axis=-1) for those in each
    )
    claimed = np.bincount(claim[claims >= 0], minlength=count * len(CLAIMS)).reshape(shape)
    reach = np.abs(runs.physical[..., 0]).max(axis=1)
    states = [place for place, each in enumerate(quantities) if each.kind == "state"]
    relative = rmse[:, states] / np.array(options.scale)
    normalised = np.sqrt((relative * relative).sum(axis=1) / len(states))
    return Scores(
        rmse, rms_bound, share_inside, normalised,
        claimed, claim_inside, claim_ratio, claim_worst, reach,
    )  # fmt: skip


def _truths(
    runs: Trajectories, quantities: tuple[Quantity, ...], sides: tuple[str, ...]
) -> list[Array]:
    """Return what is true of each quantity, shape (runs, samples) each."""
    truths = {
        "state": runs.physical,
        "disturbance": runs.disturbances,
        "torque": runs.torque_disturbances,
    }
    columns = (SIDES.index(sides[q.column]) if q.kind == "torque" else q.column for q in quantities)
    return [truths[q.kind][..., column] for q, column in zip(quantities, columns, strict=True)]


def _estimated(observed: Observed, quantity: Quantity) -> tuple[Array, Array]:
    """Return estimates and bounds of a quantity, NaN without, shape (runs, samples) each."""
    field = _FIELDS.get(quantity.kind, quantity.kind)
    both = (observed.field(name) for name in (field, f"{field}_bound"))
    estimate, bound = (
        each[..., quantity.column] if each.shape[-1] else np.full(each.shape[:-1], np.nan)
        for each in both
    )
    return estimate, bound


def _have_jumped(
    truths: list[Array], quantities: tuple[Quantity, ...], options: MetricsOptions
) -> NDArray[np.bool_]:
    """Return whether a truth has jumped since the sample before, shape (runs, samples)."""
    jumps = np.zeros(truths[0].shape, np.bool_)
    for truth, quantity in zip(truths, quantities, strict=True):
        limit = options.jump_threshold if quantity.jump is None else quantity.jump
        if limit < np.inf:
            jumps[:, 1:] |= np.abs(np.diff(truth, axis=1)) > limit
    return jumps


def _settled(
    runs: Trajectories, jumps: NDArray[np.bool_], options: MetricsOptions
) -> NDArray[np.bool_]:
    """Return which samples count, before the last measurement of their run, (runs, samples)."""
    times = runs.times
    begins = np.full((len(jumps), len(times)), times[0] + options.start_settle_time)
    for run, jumped in enumerate(jumps):
        before = -np.inf
        for place in np.flatnonzero(jumped).tolist():
            after = times[place] + options.jump_settle_time
            # A fault that chatters is one event, which begins with its first jump.
            if times[place] - before > SAME_JUMP and after > begins[run, place]:
                begins[run, place:] = after
            before = times[place]
    measured, samples = np.isfinite(runs.measurements).any(axis=2), np.arange(len(times))
    last = np.where(measured, samples, 0).max(axis=1, keepdims=True)
    return np.asarray((times >= begins) & (samples < last))


def _claims(observed: Observed) -> NDArray[np.intp]:
    """Return what the bounds of each sample are said to be, by `CLAIMS`; -1 without any."""
    basis, claimed = (observed.field(name) for name in ("basis", "claimed"))
    known = (basis >= 0.0) & (basis < len(_CLAIM_OF))
    of_basis = _CLAIM_OF[np.where(known, basis, 0.0).astype(np.intp)]
    said = np.where(claimed == 0.0, len(CLAIMS) - 1, of_basis)
    return np.where(known, said, -1)


def _sums(
    place: NDArray[np.intp], mask: NDArray[np.bool_], *values: NDArray[Any], bins: int = 0
) -> list[NDArray[Any]]:
    """Return number and sums by the place, in the order of the samples: the same on any CPU."""
    places, bins = place[mask], bins or len(place)
    number = np.bincount(places, minlength=bins)
    return [number, *(np.bincount(places, each[mask], bins) for each in values)]
