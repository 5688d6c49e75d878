# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Functions of the public API: simulate, estimate and compare, on plain arrays and whole bags."""

import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsobs_ros.checks import Array, Flags, as_matrix, check_names, numbers, shown
from tsobs_ros.design.file import load_design
from tsobs_ros.design.record import Design
from tsobs_ros.design.request import AnyRequest, ArmRequest, TSRequest
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.health import judge_rate, rate_of
from tsobs_ros.estimation.records import HEALTH, USED, Basis, RejectReason, rejections
from tsobs_ros.estimation.state import types_of
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import METHODS, ObserverSettings, given_or_default, make_tracker
from tsobs_ros.model.arm import SIDES, ElasticJointArm
from tsobs_ros.plants import scenario_of
from tsobs_ros.replay.health import PROVED, health_of
from tsobs_ros.series import NANOSECONDS
from tsobs_ros.settings import changed
from tsobs_ros.simulation.plant import Friction, Payload, Plant
from tsobs_ros.simulation.signals import KINDS, Signal, parse_kinds

if TYPE_CHECKING:
    from tsobs_ros.replay.estimate import Observer
    from tsobs_ros.replay.source import BagSource
    from tsobs_ros.report.comparison import ObserverErrors

_MAX_SAMPLES = 10**8

Disturbance = str | Mapping[str, Mapping[str, float]] | Iterable[Signal]


@dataclass(frozen=True)
class Simulation:
    """A simulated run of n samples: measurements and truth.

    Shapes are those of an arm with one output. For p outputs or a T–S system, angle and disturbance
    have shape (n, p). For a T–S system, torque holds the inputs and scheduled signals, with shape
    (n, m + s), and the states are the model's.

    Attributes:
        time: Time since the start [s], shape (n,).
        angle: Measured link angle [rad], NaN for a lost sample, shape (n,).
        torque: Torque applied from each sample to the next [N m], shape (n,).
        state: True [q₁, q̇₁, q₂, q̇₂] of link and motor (rad, rad/s), shape (n, 4).
        disturbance: True disturbance of the sensor, white noise and outliers not included [rad],
            shape (n,).
        torque_disturbance: True torques on motor and link in addition to the drive's, including
            friction and the effect of a payload [N m], shape (n, 2); for a T–S system (n, 0).
    """

    time: Array
    angle: Array
    torque: Array
    state: Array
    disturbance: Array
    torque_disturbance: Array


@dataclass(frozen=True)
class Estimates:
    """Estimates at n instants; NaN in a row without an estimate.

    Shapes are those of an arm with one encoder. For p outputs or a T–S system, disturbances have
    shape (n, p) and innovations (i, p), NaN for an output that was not used. The states of a T–S
    system are the model's.

    Attributes:
        time: Instants [s], shape (n,).
        state: Estimated [q₁, q̇₁, q₂, q̇₂] of link and motor (rad, rad/s), shape (n, 4).
        state_bound: 1σ bound of each, shape (n, 4).
        disturbance: Estimated disturbance of the sensor [rad], shape (n,).
        disturbance_bound: 1σ bound of it [rad], shape (n,).
        torque_disturbance: Estimated torque disturbances, the motor's first [N m], shape (n, t).
        torque_disturbance_bound: 1σ bound of each [N m], shape (n, t).
        innovation: y − ŷ of the i measurements that were used [rad], shape (i,).
        innovation_time: Their sampling times [s], shape (i,).
        parameters: Learnt changes θ of the model's parameters, shape (n, k).
        parameter_bound: 1σ of each, shape (n, k).
        parameters_valid: Whether the motion was rich enough for them to be relied on, shape (n,).
        basis: Basis of the bounds, codes of `tsobs_ros.estimation.records.Basis`, shape (n,).
        claimed: Whether the bounds are claimed to hold, shape (n,).
        noise_scale: Size of the sensor's noise relative to the design's, at least 1, shape (n,).
        coloured_power: Mean product of neighbouring innovations relative to their expected power;
            about 0 if the model is right, shape (n,).
        learning: State of the learning, codes of `Learning` in the same module, shape (n,).
        hypothesis: Hypothesis on the arm and its sensor, codes of `Hypothesis` in the same module,
            shape (n,).
        in_domain: Whether the estimated link angle is in the certificate's domain, shape (n,).
        used: Number of measurements used: outputs and inputs.
        rejected: Number of the others by reason; of some of them, outputs are used.
    """

    time: Array
    state: Array
    state_bound: Array
    disturbance: Array
    disturbance_bound: Array
    torque_disturbance: Array
    torque_disturbance_bound: Array
    innovation: Array
    innovation_time: Array
    parameters: Array
    parameter_bound: Array
    parameters_valid: Flags
    basis: Array
    claimed: Flags
    noise_scale: Array
    coloured_power: Array
    learning: Array
    hypothesis: Array
    in_domain: Flags
    used: int
    rejected: dict[str, int]

    @property
    def certified(self) -> Flags:
        """Whether the bounds are those of the certificate times the noise scale, shape (n,)."""
        return np.asarray(self.basis == Basis.CERTIFIED)

    @property
    def proved(self) -> Flags:
        """Whether the bounds are certified, maybe except for learnt parameters, shape (n,)."""
        return np.isin(self.basis, PROVED)


def simulate(
    arm: ElasticJointArm | Design | ArmRequest | TSRequest | str | Path | None = None,
    *,
    duration: float = 20.0,
    rate: float | None = None,
    seed: int = 0,
    noise_std: float | Sequence[float] | None = None,
    disturbance: Disturbance | Mapping[str, Disturbance] = "none",
    torque: Callable[[float], ArrayLike] | ArrayLike | None = None,
    mismatch: Mapping[str, float] | None = None,
    initial_state: Sequence[float] | None = None,
    friction: Mapping[str, float] | None = None,
    torque_disturbance: Mapping[str, Disturbance] | None = None,
    payload: Mapping[str, float] | None = None,
) -> Simulation:
    """Simulate an arm with an elastic joint, or a T–S system, and its sensors.

    Args:
        arm: The arm, or a request, design or design's file, whose plant, outputs, rate and noise
            are taken; the default arm if None.
        duration: Length of the run [s].
        rate: Sample rate [Hz]; if None, the design's, or 200.
        seed: Seed of everything random: the same seed gives the same numbers.
        noise_std: 1σ of the sensors' white noise [rad], one number for all outputs or one each;
            if None, the design's, or 0.028.
        disturbance: Disturbance of the first output: "none", a kind or a sum of kinds such as
            "bias_step+ramp", a mapping of kinds to their parameters, or components of
            `simulation.signals`. Or a mapping from names of outputs to such disturbances.
        torque: A number, one number per sample, or a function of the time [s], in N m; sin t if
            None. For m inputs, shape (n, m), or a function that returns m numbers.
        mismatch: Relative changes of the true arm's parameters, such as {"stiffness": 0.2}; for a
            T–S system, the true θ.
        initial_state: True state at the start (rad, rad/s for an arm); by default drawn around
            the one in `Scenario`, 0 for a T–S system.
        friction: Friction of the true arm, such as {"motor_viscous": 0.1}; see `simulation.plant`.
        torque_disturbance: Torques on "motor" and "link" in addition to the drive's [N m], each in
            a form of `disturbance`.
        payload: Load of the link from `start` on for `duration` [s] (0: for ever): `mass` [kg] at a
            `distance` [m], `link_inertia` [kg m²] and `gravity_torque` [N m].

    Raises:
        TsobsError: A number is out of range, a kind, output or parameter is unknown, a T–S system
            gets what only arms have, torques do not match the samples, or the state diverges.

    >>> import tsobs_ros as ts
    >>> run = ts.simulate(duration=2.0, disturbance={"bias_step": {"amplitude": 0.1, "start": 1.0}})
    >>> run.angle.shape, run.state.shape, float(run.disturbance[-1])
    ((401,), (401, 4), 0.1)
    >>> contact = {"bias_step": {"amplitude": 3.0, "start": 1.0}}
    >>> touched = ts.simulate(duration=2.0, torque_disturbance={"link": contact})
    >>> touched.torque_disturbance[-1].tolist()
    [0.0, 3.0]
    """
    if arm is None or isinstance(arm, ElasticJointArm):
        arm = ArmRequest(arm or ElasticJointArm())
    request = arm if isinstance(arm, ArmRequest | TSRequest) else _design("arm", arm).request
    is_arm, names = isinstance(request, ArmRequest), request.output_names
    others: dict[str, Any] = {"rate": request.rate if rate is None else rate, "duration": duration}
    if is_arm:
        check_names("torque_disturbance", torque_disturbance or {}, SIDES)
        others["friction"] = changed(Friction(), friction or {})
        others["payload"] = changed(Payload(), payload or {})
    elif friction or payload or torque_disturbance:
        raise ModelError(
            "friction, payload, torque_disturbance: expected none for a T-S system, which has no "
            "torques"
        )
    disturbed: Mapping[str, Any] = {names[0]: disturbance}
    if isinstance(disturbance, Mapping) and any(name in names for name in disturbance):
        disturbed = disturbance
        check_names("disturbance", disturbed, names)
    signals: dict[str, list[Any]] = {name: _components(each) for name, each in disturbed.items()}
    for side, terms in (torque_disturbance or {}).items():
        signals[f"{side}_torque"] = _components(terms)
    if noise_std is not None:
        stds = [noise_std] * len(names) if np.ndim(noise_std) == 0 else noise_std
        for name, std in zip(names, as_matrix("noise_std", stds, (len(names),)), strict=True):
            signals.setdefault(name, []).append({"noise_std": float(std)})
    scenario = scenario_of(
        request, mismatch, initial_state=initial_state, signals=signals, **others
    )
    if scenario.sample_count > _MAX_SAMPLES:
        raise ModelError(f"duration: expected at most {_MAX_SAMPLES:,} samples, got {duration!r} s")
    if torque is not None:
        values: Any = torque
        if callable(torque):
            times = np.arange(scenario.sample_count) / scenario.rate
            values = [torque(time) for time in times.tolist()]
        torque = _columns("torque", values, scenario.sample_count, scenario.input_count)
    run = Plant(scenario, seed).run(scenario.sample_count, torque)
    if not (there := np.isfinite(run.physical).all(axis=1)).all():
        why = "it diverges" + ", or no rule of the T-S system fires there" * (not is_arm)
        raise ModelError(
            f"simulate: the state is not finite from {run.times[np.argmin(there)]:g} s on: {why}"
        )
    alone = is_arm and len(names) == 1
    return Simulation(
        time=run.times,
        angle=run.measurements[:, 0] if alone else run.measurements,
        torque=run.torques[:, 0] if is_arm else run.torques,
        state=run.physical,
        disturbance=run.disturbances[:, 0] if alone else run.disturbances,
        torque_disturbance=run.torque_disturbances,
    )


def estimate(
    design: Design | str | Path,
    time: ArrayLike,
    angle: ArrayLike,
    torque: ArrayLike,
    *,
    settings: ObserverSettings | None = None,
) -> Estimates:
    """Estimate from arrays with the code of the observer node and of `tsobs estimate`.

    Row k is the estimate at `time[k]` from the rows up to k. Measurements that are not finite,
    come twice, or are later than `settings.history` allows are rejected and counted; other late
    ones are put in their place. A `UserWarning` says, like `tsobs estimate`, if times go back too
    far, if the rate or the measurements do not fit the design, or if many are rejected.

    Args:
        design: From `load_design` or `synthesise`, or its file.
        time: Sampling times [s], n of them.
        angle: Measured link angles [rad], shape (n,). For p outputs, encoders or those of a T–S
            system, shape (n, p), with the columns in the order of `design.request.output_names`.
        torque: Torque applied from each sample to the next [N m], a number or shape (n,); inputs
            and scheduled signals of a T–S system, shape (n, m + s), in the order of
            `design.request.input_names`.
        settings: Method, gates and timeouts; the node's defaults if None.

    Raises:
        ModelError: The design is neither one nor a file's path, a time is not finite, or the arrays
            differ in length or do not have the shapes that the design needs.

    >>> import tsobs_ros as ts
    >>> design = ts.load_design()
    >>> run = ts.simulate(design, duration=2.0, seed=1)
    >>> estimates = ts.estimate(design, run.time, run.angle, run.torque)
    >>> bool(abs(estimates.state - run.state)[-1, 0] < 3 * estimates.state_bound[-1, 0])
    True
    >>> estimates.used, estimates.rejected
    (401, {})
    """
    design, settings = _design("design", design), given_or_default(settings)
    times, request = numbers("time", time), design.request
    stamps, tracker = _stamps(times), make_tracker(design, settings)
    y = _columns("angle", angle, len(times), len(request.output_names))
    u = _columns("torque", torque, len(times), len(request.input_names))
    count = len(stamps)
    ticks = stamps, np.maximum.accumulate(stamps), np.arange(1, count + 1)
    made = tracker.run(stamps, y, u, ticks)
    outcomes = Counter(made.outcomes.codes.tolist())
    late = np.flatnonzero(made.outcomes.codes == RejectReason.TOO_OLD)
    if len(late):
        _warn(
            f"time[{late[0]}] is earlier than one before it by more than `history`, "
            f"{settings.history:g} s: {len(late)} of {count} samples are not used for that; sort "
            "them by time"
        )
    off, text = judge_rate(rate_of(stamps), request.rate)
    health = health_of(np.column_stack([made.rows[name] for name in HEALTH]), tracker)
    reasons = ", ".join(reason.text for reason in rejections(outcomes))
    misfit = health.misfit if health else f"no estimate was made; rejected: {reasons}"
    _warn(text if off else None, misfit)
    innovations = made.outcomes.innovations
    return _estimates(request, tracker, times, made.rows, times, innovations, outcomes)


class BagEstimates(NamedTuple):
    """Estimates of a bag or a log.

    Attributes:
        joints: Estimates by names of the joints; times are stamps, in seconds since the epoch.
        reproduced: Share of the live observer's recorded estimates that are the same to the last
            bit; None if there are none.
        remarks: Notes on the recording, such as damage at which the estimates end.
    """

    joints: dict[str, Estimates]
    reproduced: float | None
    remarks: tuple[str, ...]


def estimate_bag(
    path: str | Path,
    design: Design | str | Path | None = None,
    *,
    rate: float | None = None,
    joints: Sequence[str] = (),
    settings: ObserverSettings | None = None,
    output: str | Path | None = None,
) -> BagEstimates:
    """Estimate over a bag or a CSV log, as `tsobs estimate`.

    If a bag has a live observer's estimates, new ones are made at the same instants and compared;
    else they are made at every measurement. Warnings are as those of `estimate`.

    Args:
        path: A bag's folder, an MCAP file, or a log: any other file.
        design: A design or its file; if None, the one that the bag's observer ran, else the shipped
            one.
        rate: Estimate at this rate [Hz] instead.
        joints: Names of the joints; all that were measured if empty.
        settings: Method, gates and timeouts; those of the bag's observer if None.
        output: Folder of a new bag with the estimates, which must not exist; None to write none.

    Raises:
        BagReadError: The bag cannot be read, or does not have the measurements.
        LogError: The log cannot be read.
        BagWriteError: The new bag exists or cannot be written.

    >>> import tsobs_ros as ts
    >>> estimates = ts.estimate_bag("docs/examples/arm_log.csv")
    >>> estimates.joints["elastic_joint"].state.shape
    (600, 4)
    """
    from tsobs_ros.replay.estimate import run_observers

    source, observers = _observers(path, design, settings, (), joints)
    bag = None if output is None else Path(output)
    (run,) = run_observers(source, observers, bag, rate=rate, as_live=rate is None, keep=True)
    _warn(*run.warnings())
    for name, health in run.health().items():
        _warn(health.misfit and f"{name}: {health.misfit}")
    joints_of = {}
    for joint, name in enumerate(source.joints):
        made, innovations = run.kept(joint)
        joints_of[name] = _estimates(
            observers[0].designs[joint].request,
            run.trackers[joint],
            made.stamps / NANOSECONDS,
            made.rows,
            innovations.seconds(),
            innovations.values,
            run.outcomes[joint],
        )
    live = run.agreement()
    reproduced = None if live is None or not live.recorded else live.reproduced / live.recorded
    damage = [] if source.damage is None else [str(source.damage)]
    return BagEstimates(joints_of, reproduced, (*source.remarks, *damage))


class Comparison(tuple["ObserverErrors", ...]):
    """Errors of observers on the same recording, one entry per observer; `str` makes a table."""

    def __str__(self) -> str:
        from tsobs_ros.report.comparison import render_comparison

        return render_comparison(self)


def compare(
    path: str | Path,
    design: Design | str | Path | None = None,
    *,
    methods: Sequence[str] = tuple(METHODS),
    joints: Sequence[str] = (),
    held_out: str | None = None,
    held_out_std: float | None = None,
) -> Comparison:
    """Compare observers on the same bag or log, as `tsobs compare`.

    Args:
        path: As for `estimate_bag`.
        design: As for `estimate_bag`.
        methods: Names of the observers; with several, those that do not fit the arm are left out.
        joints: Names of the joints; all that were measured if empty.
        held_out: Sensor to check estimates against, which no observer gets, as for `--held-out`:
            `link_angle`, or with its place `link_angle=COLUMN`.
        held_out_std: 1σ of its noise (rad, rad/s); if None, estimated from high frequencies.

    Raises:
        ModelError: There is no such method, none can observe this arm, or the observers measure
            what is held out.
        BagReadError: The bag cannot be read, or does not have the measurements.
        LogError: The log cannot be read.

    >>> import tsobs_ros as ts
    >>> rows = ts.compare("docs/examples/arm_log.csv", methods=["certified", "high_gain"])
    >>> [row.observer for row in rows]
    ['certified', 'high_gain']
    """
    from tsobs_ros.replay.estimate import run_observers
    from tsobs_ros.report.comparison import measure_runs
    from tsobs_ros.report.held_out import read_held_out

    source, observers = _observers(path, design, None, methods, joints, held_out)
    source.observe([design.request for design in observers[0].designs])
    sensors = read_held_out(source, held_out_std)
    runs = run_observers(source, observers, keep=True)
    _warn(None if source.damage is None else f"{source.damage}; compared up to there")
    return Comparison(errors for errors, _ in measure_runs(source, runs, sensors))


def _observers(
    path: str | Path,
    design: Design | str | Path | None,
    settings: ObserverSettings | None,
    methods: Sequence[str],
    joints: Sequence[str],
    held_out: str | None = None,
) -> "tuple[BagSource, list[Observer]]":
    # Not needed for arrays, and slow to import.
    from tsobs_ros.replay.estimate import make_observers, open_source, without_misfits

    no_torque = None if settings is None else given_or_default(settings).assume_zero_torque
    source = open_source(path, joints=joints, assume_zero_torque=no_torque, held_out=held_out)
    if design is None:
        designs = source.choose_designs()
    else:
        design = _design("design", design)
        source.take_for_system([design.request])
        designs = {"own": (design,) * len(source.joints)}
    settings = settings or source.ran.settings()
    observers = make_observers(designs, methods or (settings.method,), settings)
    return source, without_misfits(observers)[0] if len(methods) > 1 else observers


def _design(name: str, design: object) -> Design:
    """Return a design, or the one in a file."""
    if isinstance(design, str | Path):
        return load_design(design)
    if not isinstance(design, Design):
        raise ModelError(
            f"{name}: expected a Design (of load_design or synthesise) or the path of its file, "
            f"got {type(design).__name__}"
        )
    return design


def _warn(*texts: str | None) -> None:
    """Warn the caller of a public function, unless a text is None."""
    for text in filter(None, texts):
        warnings.warn(text, stacklevel=3)


def _components(disturbance: Disturbance) -> list[Any]:
    if isinstance(disturbance, str):
        return [KINDS[kind]() for kind in parse_kinds(disturbance)]
    if not isinstance(disturbance, Mapping):
        signals = list(disturbance) if isinstance(disturbance, Iterable) else [disturbance]
        for each in signals:
            if not isinstance(each, Signal):
                raise ModelError(
                    "disturbance: expected kinds, such as 'bias_step', a mapping from kinds to "
                    f"their parameters, or a list of signals, got {shown(each)}"
                )
        return signals
    kinds = parse_kinds("+".join(disturbance) or "none")
    return [changed(KINDS[k](), disturbance[k]) for k in kinds]


def _estimates(
    request: AnyRequest,
    tracker: Tracker,
    time: Array,
    rows: Any,
    innovation_time: Array,
    innovations: Array,
    outcomes: Counter[int],
) -> Estimates:
    """Return estimates as plain arrays, with a column per output but of an arm with only one."""
    estimator, used = tracker.estimator, np.isfinite(innovations).any(axis=1)
    types = types_of(tuple(estimator.model["sizes"][0].tolist()))["estimate"]
    columns: dict[str, Any] = {}
    for name in types.names or ():
        columns[name] = np.array(rows[name])
        if name in estimator.lacking:
            columns[name] = np.full((len(rows), *types[name].shape), np.nan)
    for name in ("claimed", "parameters_valid", "in_domain"):
        columns[name] = columns[name] == 1.0
    kept = innovations[used]
    if isinstance(request, ArmRequest) and len(request.output_names) == 1:
        kept = kept[:, 0]
        for name in ("disturbance", "disturbance_bound"):
            columns[name] = columns[name][:, 0]
    return Estimates(
        time=time,
        innovation=kept,
        innovation_time=innovation_time[used],
        used=outcomes[USED],
        rejected={reason.text: count for reason, count in rejections(outcomes).items()},
        **{item.name: columns[item.name] for item in fields(Estimates) if item.name in columns},
    )


def _columns(name: str, value: ArrayLike, rows: int, columns: int) -> Array:
    """Return shape (rows, columns) from a number, from that shape or, if columns = 1, (rows,)."""
    array = numbers(name, value)
    if array.ndim == 0 or (array.ndim == 1 and columns == 1 and len(array) == rows):
        array = np.broadcast_to(array.reshape(-1, 1), (rows, columns))
    if array.shape != (rows, columns):
        plain = f"({rows},) or " if columns == 1 else ""
        raise ModelError(
            f"{name}: expected shape {plain}({rows}, {columns}) as there are {rows} times, "
            f"got {array.shape}"
        )
    return np.ascontiguousarray(array)


def _stamps(times: Array) -> NDArray[np.int64]:
    """Return the times in ns, moved to begin at 1 s unless all are above 0 (0 means no stamp)."""
    if times.ndim != 1 or not len(times):
        raise ModelError(f"time: expected shape (n,) with n > 0, got {times.shape}")
    wrong = np.flatnonzero(~(np.abs(times) < 2**31))
    if len(wrong):
        raise ModelError(
            f"time[{wrong[0]}]: expected finite seconds below 2^31, got {times[wrong[0]]}; divide "
            "nanoseconds by 1e9"
        )
    stamps = np.round(times * NANOSECONDS).astype(np.int64)
    first = int(stamps.min())
    return stamps + (0 if first > 0 else NANOSECONDS - first)
