# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of an estimator: its state, its model, and what it says.

A state is all that an estimator remembers. Copying it is copying a record, two are equal if their
bytes are, an array of them is a batch, a history or a checkpoint. The shapes of its fields depend
on the numbers of states n, outputs p, inputs m and parameters k. Flags are integers, 0 or 1.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.hypotheses import ALTERNATIVES
from tsobs_ros.estimation.options import (
    MAX_JUMP_BUDGET,
    AdaptationOptions,
    CertifiedGain,
    GainMode,
    SupervisionOptions,
    TorqueLimits,
)
from tsobs_ros.estimation.records import Basis
from tsobs_ros.estimation.repeats import REPEAT_FIELDS
from tsobs_ros.model import stepping
from tsobs_ros.model.arm import LINK_ANGLE, MOTOR_ANGLE
from tsobs_ros.model.matrices import congruent, inverse, joseph
from tsobs_ros.model.prediction import Record, fill_matrix
from tsobs_ros.model.stepping import Room, flow_type, record_type
from tsobs_ros.model.trigonometry import exponential

WINDOW = 24
"""Innovations that are looked at together for a jump."""

CONDITIONS = (
    "basis",
    "parameters_valid",
    "noise_scale",
    "coloured_power",
    "learning",
    "hypothesis",
)
"""Fields of a readout that say what its numbers are worth, in the order of a row."""

_ANGLE_STD = 0.028
"""1σ of the angle's noise that the default of `jump_std` is for [rad]."""

OPEN, RICCATI, CERTIFIED = 0, 1, 2
"""Gains of a sample: none, as it is held while the observer is integrated, or one of these."""


class Shape(NamedTuple):
    """Sizes of an estimator that are in use.

    Attributes:
        n: Number of augmented states.
        plant: Number of the plant's states, the first of them.
        p: Number of outputs.
        m: Number of inputs and scheduled signals.
        k: Number of learnt parameters.
        gap: Number of augmented states in a gap, 0 if the torque is held there.
        t: Number of torques that are estimated.
    """

    n: int
    plant: int
    p: int
    m: int
    k: int = 0
    gap: int = 0
    t: int = 0

    def trim(self, name: str, values: Any) -> Any:
        """Return a field's numbers, shape (records, ...), without the room that is not in use."""
        sizes = tuple(getattr(self, size) for size in _SIZES.get(name, ()))
        return values[(slice(None), *map(slice, sizes))]


_SIZES: dict[str, tuple[str, ...]] = {
    "x": ("n",),
    "covariance": ("n", "n"),
    "theta": ("k",),
    "gamma": ("k", "k"),
    "upsilon": ("k", "n"),
    "gram": ("k", "k"),
    "pending": ("k",),
    "anchor": ("k",),
    "gain": ("n", "p"),
    "sensors": ("p",),
    "innovation_covariance": ("p", "p"),
    "state": ("plant",),
    "state_bound": ("plant",),
    "parameters": ("k",),
    "parameter_bound": ("k",),
    "u": ("m",),
    "held": ("m",),
    "response": ("n",),
    **dict.fromkeys(
        (
            "y",
            "weight",
            "innovation",
            "disturbance",
            "disturbance_rate",
            "disturbance_bound",
            "designed_disturbance",
            "designed_bound",
        ),
        ("p",),
    ),
    **dict.fromkeys(("torque_disturbance", "torque_disturbance_bound"), ("t",)),
}

MAX_TORQUES = 2
"""Torques that a readout has room for: of the motor and of the link."""


@cache
def sensor_type() -> np.dtype[Any]:
    """Return the type of what is remembered of one output.

    recent, sizes, calm: its newest innovations in sigmas and in units, and the coloured power
    before each, the newest of `watched` last. leap: by how much they lean after a jump. nis,
    magnitude, coloured_power: averages of r², |r| and the product of neighbours. noise_scale: size
    of the white noise relative to the design's; scale_age: time it has been learnt for [s];
    previous, paired: the innovation before and its kind; since: time since the last sample [s].
    slow: low-passed innovation in sigmas; slow_power: power of it relative to a white one's.
    jump_ages, jump_count: of its jumps since a start; jumped: whether the newest sample shows one,
    or that all trust in it is lost. excluded: whether the other outputs contradict it.
    Then the fields of `repeats.REPEAT_FIELDS`, and counts.
    """
    number, count = np.float64, np.int64
    return record_type(
        [
            ("recent", number, (WINDOW,)),
            ("sizes", number, (WINDOW,)),
            ("calm", number, (WINDOW,)),
            ("watched", count),
            ("in_a_row", count),
            ("nis", number),
            ("magnitude", number),
            ("noise_scale", number),
            ("scale_age", number),
            ("previous", number),
            ("leap", number),
            ("paired", count),
            ("since", number),
            ("coloured_power", number),
            ("slow", number),
            ("slow_power", number),
            ("jump_ages", number, (MAX_JUMP_BUDGET,)),
            ("jump_count", count),
            ("jumped", count),
            ("excluded", count),
            *REPEAT_FIELDS,
            ("gated", count),
            ("missing", count),
        ]
    )


@cache
def alternative_type(room: Room) -> np.dtype[Any]:
    """Return the type of a filter under another hypothesis.

    x, covariance, upsilon: as of the estimator, with states of its own behind the design's. score:
    logarithm of its likelihood relative to the best. nis: one-second average of the squares of its
    innovations in sigmas. variances: expected of the newest innovations.
    """
    n, p, _, k = room[:4]
    number = np.float64
    return record_type(
        [
            ("x", number, (n,)),
            ("covariance", number, (n, n)),
            ("upsilon", number, (k, n)),
            ("score", number),
            ("nis", number),
            ("variances", number, (p,)),
        ]
    )


@cache
def state_type(room: Room) -> np.dtype[Any]:
    """Return the type of a state.

    stamp, y, u: of the newest sample [ns], a missing output is NaN. sample: the newest of each
    output. held: inputs in use, those of the newest sample with plausible ones; torque_age: time
    since that [s]; torque_unknown: whether it is not the newest. torque_change to distrust: of
    `torque`, as what was suspected of it, and since when.
    x: estimate in design coordinates. covariance: of its error; the certificate's bound while
    `certified`. While `in_gap` both have the unknown torque's states too. late: whether it is read
    after the stamp at which the next sample was due. settling: least time with Riccati gains left
    [s]. corrected: whether a sample was used since the last prediction. cause: code of the `Basis`
    of that covariance.

    theta, gamma, upsilon (by rows), gram, age: of the adaptation. pending: change of theta that is
    used once it is significant. anchor, pass_age [s], passes: where the present pass of learning
    began, how long it takes, and how many there were. theta_before, pending_before, gamma_before:
    of two earlier samples, the older one last; kept: samples until the next are kept. centre,
    spread: mean and variance of x over some seconds. relearned: used part of the budget of
    learning; resting: whether it is used up. pinned: time for which a parameter has been at its
    limit [s]; strained: time for which innovations have contradicted the model [s]. pause: time for
    which the adaptation rests after a jump [s].

    sensors: of the outputs, see `sensor_type`. nis, coloured_power, noise_scale, slow_power: the
    largest of theirs. since: time since the last sample [s]. doubt: time for which nothing is
    certified [s]; doubted: code of the `Basis` meanwhile. watch_age: time since a start [s]. awake,
    awake_time [s]: of the alternatives, which are in the order of `Hypothesis`. hypothesis: its
    code. score: of the design. The others are counts.
    """
    n, p, m, k = room[:4]
    number, count = np.float64, np.int64
    return record_type(
        [
            ("stamp", count),
            ("y", number, (p,)),
            ("sample", number, (p,)),
            ("u", number, (m,)),
            ("held", number, (m,)),
            ("torque_age", number),
            ("torque_unknown", count),
            ("torque_change", number),
            ("torque_step", number),
            ("step_age", number),
            ("departure", number),
            ("response", number, (n,)),
            ("evidence", number),
            ("distrust", number),
            ("x", number, (n,)),
            ("covariance", number, (n, n)),
            ("settling", number),
            ("certified", count),
            ("late", count),
            ("corrected", count),
            ("in_gap", count),
            ("theta", number, (k,)),
            ("gamma", number, (k, k)),
            ("upsilon", number, (k, n)),
            ("gram", number, (k, k)),
            ("pending", number, (k,)),
            ("significant", count),
            ("anchor", number, (k,)),
            ("pass_age", number),
            ("passes", count),
            ("theta_before", number, (2, k)),
            ("pending_before", number, (2, k)),
            ("gamma_before", number, (2, k, k)),
            ("kept", count),
            ("centre", number, (n,)),
            ("spread", number, (n,)),
            ("cause", count),
            ("age", number),
            ("sensors", sensor_type(), (p,)),
            ("nis", number),
            ("coloured_power", number),
            ("noise_scale", number),
            ("slow_power", number),
            ("since", number),
            ("strained", number),
            ("doubt", number),
            ("doubted", count),
            ("resting", count),
            ("relearned", number),
            ("awake", count),
            ("awake_time", number),
            ("hypothesis", count),
            ("score", number),
            ("alternatives", alternative_type(room), (ALTERNATIVES,)),
            ("watch_age", number),
            ("pause", number),
            ("pinned", number),
            ("outliers", count),
            ("jumps", count),
            ("losses", count),
            ("adaptation_resets", count),
            ("gated", count),
            ("implausible", count),
            ("restarts", count),
            ("failures", count),
        ]
    )


@cache
def correction_type(room: Room) -> np.dtype[Any]:
    """Return the type of a sample's effect, with scratch numbers of the same step."""
    n, p, _, k = room[:4]
    number, wide = np.float64, max(n, p)
    return record_type(
        [
            ("innovation", number, (p,)),
            ("innovation_covariance", number, (p, p)),
            ("gain", number, (n, p)),
            ("weight", number, (p,)),
            ("known", number, (p, p)),
            ("explained", number, (p, p)),
            ("omega", number, (p, k)),
            ("cross", number, (p, k)),
            ("factor", number, (p, p)),
            ("crossed", number, (p, n)),
            ("turned", number, (p, k)),
            ("shift", number, (k, 1)),
            ("scaled", number, (k, 1)),
            ("root", number, (k, k)),
            ("nothing", number, (wide, wide)),
            ("squares", number, (3, n, wide)),
        ]
    )


@cache
def readout_type(room: Room) -> np.dtype[Any]:
    """Return the type of an estimate in physical units; see `Readout` for the fields.

    finite: whether all numbers are.
    """
    number, count = np.float64, np.int64
    n, p, _, k = room[:4]
    return record_type(
        [
            ("state", number, (n,)),
            ("state_bound", number, (n,)),
            ("disturbance", number, (p,)),
            ("disturbance_rate", number, (p,)),
            ("disturbance_bound", number, (p,)),
            ("parameters", number, (k,)),
            ("parameter_bound", number, (k,)),
            ("designed_disturbance", number, (p,)),
            ("designed_bound", number, (p,)),
            ("torque_disturbance", number, (MAX_TORQUES,)),
            ("torque_disturbance_bound", number, (MAX_TORQUES,)),
            ("basis", count),
            ("parameters_valid", count),
            ("noise_scale", number),
            ("coloured_power", number),
            ("learning", count),
            ("hypothesis", count),
            ("finite", count),
        ]
    )


@cache
def work_type(room: Room) -> np.dtype[Any]:
    """Return the type of a prediction's scratch numbers."""
    return record_type(
        [
            ("flow", stepping.work_type(room)),
            ("square", np.float64, (room.n, room.n)),
            ("small", np.float64, (room.k, room.k)),
        ]
    )


@cache
def alternative_model_type(room: Room) -> np.dtype[Any]:
    """Return the type of a hypothesis' model.

    n: number of its states, the last of them a torque; 0 if it is not considered. C: outputs.
    variances: of the white noise of one sample of each. added: initial variances of its own states.
    prior: by how much its score must exceed the design's. hysteresis: by how much less, once it is
    selected.
    """
    number = np.float64
    return record_type(
        [
            ("flow", flow_type(room)),
            ("n", np.int64),
            ("C", number, (room.p, room.n)),
            ("variances", number, (room.p,)),
            ("prior", number),
            ("hysteresis", number),
            ("added", number, (room.n,)),
        ]
    )


@cache
def model_type(room: Room) -> np.dtype[Any]:
    """Return the type of a model: flows, output, gains, bounds, options and the initial state."""
    n, p, _, k = room[:4]
    number, count = np.float64, np.int64
    return record_type(
        [
            ("flow", flow_type(room)),
            ("gap", flow_type(room)),
            ("alternatives", alternative_model_type(room), (ALTERNATIVES,)),
            ("has_alternatives", count),
            ("initial", state_type(room)),
            ("n", count),
            ("plant", count),
            ("p", count),
            ("m", count),
            ("k", count),
            ("n_gap", count),
            ("t", count),
            ("period", number),
            ("shortest", number),
            ("longest", number),
            ("late_factor", number),
            ("rate_variance", number),
            ("torque_limit", number),
            ("torque_rate_limit", number),
            ("torque_spread", number),
            ("torque_doubt", number),
            ("gain_mode", count),
            ("C", number, (p, n)),
            ("D", number, (p, p)),
            ("R", number, (p, p)),
            ("K", number, (n, p)),
            ("X", number, (n, n)),
            ("P", number, (n, n)),
            ("posterior", number, (n, n)),
            ("innovation_covariance", number, (p, p)),
            ("scale", number, (n,)),
            ("disturbance_map", number, (p, n)),
            ("disturbance_direct", number, (p, p)),
            ("rate_map", number, (p, n)),
            ("torque_map", number, (MAX_TORQUES, n)),
            ("disturbed", count, (p,)),
            ("state_std", number, (n,)),
            ("disturbance_std", number, (p,)),
            ("torque_std", number, (MAX_TORQUES,)),
            ("limits", number, (k,)),
            ("theta_variance", number),
            ("motion_share", number),
            ("random_walk", number),
            ("significance", number),
            ("pass_time", number),
            ("pass_reach", number),
            ("adaptation_start", number),
            ("memory", number),
            ("excitation", number),
            ("covered", count),
            ("supervised", count),
            ("gate", number),
            ("reject", number),
            ("jump_std", number, (p,)),
            ("jump_duration", number),
            ("jump_quiet", number),
            ("jump_budget", count),
            ("jump_budget_window", number),
            ("lost", number),
            ("stuck_samples", count),
            ("disturbance_limit", number, (p,)),
            ("strain", number),
            ("relearn_budget", count),
            ("relearn_time", number),
            ("second_share", number),
            ("magnitude_share", number),
            ("sign_share", number),
            ("sign_power_share", number),
            ("score_fade", number),
        ]
    )


def new_model(room: Room, shape: Shape, period: float) -> Record:
    """Return a model record with sizes and a period, whose other numbers are zero, shape (1,)."""
    model = np.zeros(1, model_type(room))
    for name, size in zip(("n", "plant", "p", "m", "k", "n_gap", "t"), shape, strict=True):
        model[name] = size
    model["period"] = period
    model["initial"]["cause"] = Basis.STARTING
    sensors = model["initial"]["sensors"]
    sensors["value"] = np.nan
    for name in ("nis", "magnitude", "noise_scale"):
        sensors[name] = 1.0
    for name in ("nis", "noise_scale"):
        model["initial"][name] = 1.0
    model["initial"]["torque_age"] = model["initial"]["step_age"] = np.inf
    return model


def enter_torque_limits(model: Any, limits: TorqueLimits) -> None:
    """Enter which torques are plausible into one model record."""
    for name, value in limits._asdict().items():
        model[f"torque_{name}"] = value


def enter_gain(
    model: Any, certified: CertifiedGain, measurement_covariance: Array, gain_mode: GainMode
) -> None:
    """Enter gains and bounds into one model record, whose C and maps are there already."""
    n, p = certified.K.shape
    X, K, R = certified.X, certified.K, measurement_covariance
    C, H, T = (model[name][:, :n] for name in ("C", "disturbance_map", "torque_map"))
    C, H = C[:p], H[:p]
    model["late_factor"] = certified.late
    model["gain_mode"] = CERTIFIED if gain_mode is GainMode.CERTIFIED else RICCATI
    for name, matrix in (
        ("X", X),
        ("K", K),
        ("R", R),
        ("P", inverse(X)),
        ("posterior", joseph(C, R, X, K)),
        ("innovation_covariance", congruent(C, X, R)),
        ("state_std", np.sqrt(X.diagonal())),
        ("disturbance_std", np.sqrt(np.maximum(congruent(H, X).diagonal(), 0.0))),
        ("torque_std", np.sqrt(np.maximum(congruent(T, X).diagonal(), 0.0))),
    ):
        fill_matrix(model[name], matrix)


def enter_adaptation(model: Any, limits: Array, options: AdaptationOptions, covered: bool) -> None:
    """Enter what is learnt, and how fast, into one model record."""
    fill_matrix(model["limits"], limits)
    model["covered"] = covered
    model["theta_variance"] = options.initial_std * options.initial_std
    model["motion_share"] = 1.0 - exponential(-0.5 * float(model["period"]))
    model["significance"] = options.significance
    model["pass_time"], model["pass_reach"] = options.pass_time, 0.5
    model["random_walk"] = options.random_walk_density
    model["adaptation_start"], model["memory"] = options.start, options.memory
    model["excitation"] = options.excitation
    gamma = np.eye(len(limits)) * model["theta_variance"]
    fill_matrix(model["initial"]["gamma"], gamma)
    for before in model["initial"]["gamma_before"]:
        fill_matrix(before, gamma)


def enter_supervision(model: Any, options: SupervisionOptions) -> None:
    """Enter when to react, and how strongly, into one model record."""
    for name, value in vars(options).items():
        model[name] = value
    model["supervised"] = 1
    for i in range(int(model["p"])):
        row = model["C"][i]
        if not (model["flow"]["kind"] == stepping.ARM and (row[LINK_ANGLE] or row[MOTOR_ANGLE])):
            # The options are for angles; another output has a unit of its own.
            model["jump_std"][i] *= math.sqrt(model["R"][i, i]) / _ANGLE_STD
            model["disturbance_limit"][i] = math.inf
    # The step of the torque whose effect over a sample is a third of the certified bound.
    n, flow = int(model["n"]), model["flow"]
    effect = congruent(flow["gamma"][:n, :1].T, model["P"][:n, :n]).item()
    if flow["kind"] == stepping.ARM and effect > 0.0:
        model["torque_doubt"] = 1.0 / (3.0 * math.sqrt(effect))
    # Shares of a sample in the averages over one second, and over half a second.
    period = float(model["period"])
    model["second_share"] = 1.0 - exponential(-period)
    model["magnitude_share"] = 1.0 - exponential(-2.0 * period)
