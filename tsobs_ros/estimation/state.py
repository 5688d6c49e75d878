# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of an estimator: its state, its model, and what it says.

A state is all that an estimator remembers. Copying it is copying a record, two are equal if their
bytes are, an array of them is a batch, a history or a checkpoint. core/estimator.h lists and
explains the fields of all records. Their shapes depend on the numbers of states n, outputs p,
inputs m and parameters k. Flags are integers, 0 or 1.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.estimation.options import (
    AdaptationOptions,
    CertifiedGain,
    GainMode,
    SupervisionOptions,
    TorqueLimits,
)
from tsobs_ros.estimation.records import Basis
from tsobs_ros.model.arm import LINK_ANGLE, MOTOR_ANGLE
from tsobs_ros.model.matrices import congruent, inverse, joseph
from tsobs_ros.model.prediction import FlowSizes, Record, fill_matrix, flow_type

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


class Shape(NamedTuple):
    """Sizes of an estimator.

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
        """Return a field's numbers, shape (records, ...), of the n states only.

        Behind them there may be room for those in a gap, or of an alternative.
        """
        return values[(slice(None), *map(slice, self._wide.get(name, ())))]

    @property
    def _wide(self) -> dict[str, tuple[int, ...]]:
        n = self.n
        square = dict.fromkeys(("covariance", "X", "P", "posterior"), (n, n))
        return {"x": (n,), "response": (n,), "upsilon": (self.k, n), "gain": (n, self.p), **square}


class Sizes(NamedTuple):
    """Sizes of an estimator's records, in the order of the compiled core.

    Attributes:
        n: See `Shape`.
        width: The most states of n, of a gap and of the alternatives.
        plant: See `Shape`.
        p: See `Shape`.
        m: See `Shape`.
        k: See `Shape`.
        n_gap: Number of augmented states in a gap.
        t: See `Shape`.
        bank: Number of alternatives.
        flow_size: Length of the record of the design's flow.
        gap_size: Of the flow in a gap.
        bank_size: Of the longest flow of an alternative.
        scratch: Numbers of scratch that their steps need.
    """

    n: int
    width: int
    plant: int
    p: int
    m: int
    k: int
    n_gap: int
    t: int
    bank: int
    flow_size: int
    gap_size: int
    bank_size: int
    scratch: int


class Types(NamedTuple):
    """Types of an estimator's records, with the names of core/estimator.h."""

    state: "np.dtype[Any]"
    correction: "np.dtype[Any]"
    readout: "np.dtype[Any]"
    work: "np.dtype[Any]"
    model: "np.dtype[Any]"


@cache
def types_of(sizes: Sizes) -> Types:
    """Return the types of an estimator's records; flows of a model are plain numbers."""
    layouts = native.estimator_layouts(*sizes)
    plain = {name: record_type(layouts[name]) for name in ("sensor", "alternative")}
    state = record_type(
        layouts["state"], {"sensors": plain["sensor"], "alternatives": plain["alternative"]}
    )
    others = {name: record_type(layouts[name]) for name in ("correction", "readout", "work")}
    alternatives = record_type(layouts["alternative_model"])
    model = record_type(layouts["model"], {"initial": state, "alternatives": alternatives})
    return Types(state=state, **others, model=model)


def types_of_model(model: Record) -> Types:
    """Return the types of the records that belong to a model record."""
    return types_of(Sizes(*(int(model[name][0]) for name in Sizes._fields)))


def new_model(
    shape: Shape,
    period: float,
    flow: Record,
    gap: Record | None = None,
    bank: Sequence[Record | None] = (),
) -> Record:
    """Return a model record with sizes, flows and a period, whose other numbers are zero.

    Args:
        shape: Sizes of the estimator.
        period: Nominal sampling period [s].
        flow: The design's prediction model, a record, shape (1,).
        gap: The same in a gap; None if the torque is held there.
        bank: Those of the alternatives, in the order of `Hypothesis`, None for those that have no
            use; empty if there are none.

    Returns:
        The model record, shape (1,).
    """
    flows = [flow] if gap is None else [flow, gap]
    flows += [each for each in bank if each is not None]
    counts = [int(each["n"][0]) for each in flows]
    scratch = [
        native.flow_scratch_size(*(int(each[name][0]) for name in FlowSizes._fields))
        for each in flows
    ]
    lengths = [each.dtype.itemsize // 8 for each in flows]
    known = 1 if gap is None else 2
    sizes = Sizes(
        n=shape.n,
        width=max(counts),
        plant=shape.plant,
        p=shape.p,
        m=shape.m,
        k=shape.k,
        n_gap=shape.gap,
        t=shape.t,
        bank=native.ALTERNATIVES if bank else 0,
        flow_size=lengths[0],
        gap_size=sum(lengths[1:known]),
        bank_size=max(lengths[known:], default=0),
        scratch=max(scratch),
    )
    model = np.zeros(1, types_of(sizes).model)
    for name, size in sizes._asdict().items():
        model[name] = size
    model["flow"][0] = flow.view(np.float64)
    if gap is not None:
        model["gap"][0] = gap.view(np.float64)
    for place, each in enumerate(bank):
        if each is not None:
            model["alternatives"]["flow"][0, place, : each.dtype.itemsize // 8] = each.view(
                np.float64
            )
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
    model["gain_mode"] = (
        native.GAIN_CERTIFIED if gain_mode is GainMode.CERTIFIED else native.GAIN_RICCATI
    )
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
    model["motion_share"] = 1.0 - native.exponential(-0.5 * float(model["period"]))
    model["significance"] = options.significance
    model["pass_time"], model["pass_reach"] = options.pass_time, 0.5
    model["random_walk"] = options.random_walk_density
    model["adaptation_start"], model["memory"] = options.start, options.memory
    model["excitation"] = options.excitation
    gamma = np.eye(len(limits)) * model["theta_variance"]
    fill_matrix(model["initial"]["gamma"], gamma)
    model["initial"]["gamma_before"] = gamma.ravel()


def enter_supervision(model: Any, options: SupervisionOptions) -> None:
    """Enter when to react, and how strongly, into one model record."""
    flow = _flow_of(model)
    is_arm = flow["kind"] == native.KIND_ARM
    for name, value in vars(options).items():
        model[name] = value
    model["supervised"] = 1
    for i in range(int(model["p"])):
        row = model["C"][i]
        if not (is_arm and (row[LINK_ANGLE] or row[MOTOR_ANGLE])):
            # The options are for angles; another output has a unit of its own.
            model["jump_std"][i] *= math.sqrt(model["R"][i, i]) / _ANGLE_STD
            model["disturbance_limit"][i] = math.inf
    if is_arm:
        # The step of the torque whose effect over a sample is a third of the certified bound.
        n = int(model["n"])
        effect = congruent(flow["gamma"][:n, :1].T, model["P"][:n, :n]).item()
        model["torque_doubt"] = 1.0 / (3.0 * math.sqrt(effect)) if effect > 0.0 else 0.0
    # Shares of a sample in the averages over one second, and over half a second.
    period = float(model["period"])
    model["second_share"] = 1.0 - native.exponential(-period)
    model["magnitude_share"] = 1.0 - native.exponential(-2.0 * period)


def _flow_of(model: Any) -> Any:
    """Return the record of the design's flow in one model record; its sizes follow its kind."""
    numbers = model["flow"]
    sizes = numbers[1 : 1 + len(FlowSizes._fields)].view(np.int64)
    return numbers.view(flow_type(FlowSizes(*sizes.tolist())))[0]
