# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of an estimator: its state, its model, and what it says.

A state is all that an estimator remembers. Copying it is copying a record, two are equal if their
bytes are, an array of them is a batch or a history. core/estimator.h lists and
explains the fields of all records. Their shapes depend on the numbers of states n, outputs p,
inputs m and parameters k. Flags are integers, 0 or 1.
"""

import math
from dataclasses import asdict
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
from tsobs_ros.model.prediction import FlowSizes, Record, fill_matrix, flow_type, scratch_size
from tsobs_ros.model.torque_path import DIRECT, TorquePath


class Shape(NamedTuple):
    """Sizes of an estimator.

    Attributes:
        n: Number of augmented states.
        plant: Number of the plant's states, the first of them.
        p: Number of outputs.
        m: Number of inputs and scheduled signals.
        k: Number of learnt parameters.
        t: Number of torques that are estimated.
    """

    n: int
    plant: int
    p: int
    m: int
    k: int = 0
    t: int = 0

    def trim(self, name: str, values: Any) -> Any:
        """Return a field's numbers, shape (records, ...), of the n states only.

        Behind them there is room for auxiliary ones.
        """
        return values[(slice(None), *map(slice, self._wide.get(name, ())))]

    @property
    def _wide(self) -> dict[str, tuple[int, ...]]:
        n = self.n
        square = dict.fromkeys(("covariance", "X", "P", "posterior"), (n, n))
        return {"x": (n,), "upsilon": (self.k, n), "gain": (n, self.p), **square}


class Sizes(NamedTuple):
    """Sizes of an estimator's records, in the order of the compiled core; see core/estimator.h."""

    n: int
    width: int
    plant: int
    p: int
    m: int
    k: int
    t: int
    hypotheses: int
    past: int
    flow_size: int
    scratch: int


class Types(NamedTuple):
    """Types of an estimator's records, with the names of core/estimator.h."""

    state: "np.dtype[Any]"
    correction: "np.dtype[Any]"
    estimate: "np.dtype[Any]"
    work: "np.dtype[Any]"
    model: "np.dtype[Any]"


@cache
def types_of(sizes: Sizes) -> Types:
    """Return the types of an estimator's records; flows of a model are plain numbers."""
    sensor, hypothesis = (record_type(name, sizes) for name in ("sensor", "hypothesis"))
    state = record_type("state", sizes, {"sensors": sensor, "hypotheses": hypothesis})
    others = {name: record_type(name, sizes) for name in ("correction", "estimate", "work")}
    return Types(state=state, **others, model=record_type("model", sizes, {"initial": state}))


def types_of_model(model: Record) -> Types:
    """Return the types of the records that belong to a model record."""
    numbers = model.view(np.int64)[: len(Sizes._fields)].tolist()
    return types_of(Sizes(*numbers))


def new_model(
    shape: Shape,
    period: float,
    flow: Record,
    *,
    auxiliary: bool = False,
    torque: TorquePath = DIRECT,
) -> Record:
    """Return a model record with sizes, flow and a period, whose other numbers are zero.

    Args:
        shape: Sizes of the estimator.
        period: Nominal sampling period [s].
        flow: The prediction model, a record, shape (1,).
        auxiliary: Whether there are states of an unknown torque and of parts of the outputs, and
            other hypotheses than the design.
        torque: How torques reach the motor of an arm.

    Returns:
        The model record, shape (1,).
    """
    sizes = Sizes(
        n=shape.n,
        width=shape.n + (1 + max(2, shape.p) if auxiliary else 0),
        plant=shape.plant,
        p=shape.p,
        m=shape.m,
        k=shape.k,
        t=shape.t,
        hypotheses=native.HYPOTHESES if auxiliary else 1,
        past=torque.remembered(period, shape.p),
        flow_size=flow.dtype.itemsize // 8,
        scratch=scratch_size(FlowSizes(*(int(flow[name][0]) for name in FlowSizes._fields))),
    )
    model = np.zeros(1, types_of(sizes).model)
    model.view(np.int64)[: len(sizes)] = sizes
    model["flow"][0] = flow.view(np.float64)
    model["period"] = period
    model["gate"] = np.inf
    for name, value in asdict(torque).items():
        model[f"torque_{name}"] = value
    model["constants"] = [value for _, value, _ in native.bank_constants()]
    initial = model["initial"]
    initial["sensors"]["value"] = np.nan
    initial["sensors"]["noise_scale"] = initial["noise_scale"] = 1.0
    initial["torque_age"] = np.inf
    initial["past"][..., 1] = np.inf
    designed = initial["hypotheses"][:, 0]
    designed["live"], designed["cause"] = 1, Basis.STARTING
    designed["inlier"] = designed["nis"] = 1.0
    return model


def enter_torque_limits(model: Any, limits: TorqueLimits) -> None:
    """Enter which torques are plausible into one model record."""
    for name, value in limits._asdict().items():
        model[f"torque_{name}"] = value


def enter_gain(model: Any, certified: CertifiedGain, gain_mode: GainMode) -> None:
    """Enter gains and bounds into one model record, whose R, C and maps are there already."""
    n, p = certified.K.shape
    X, K, R = certified.X, certified.K, model["R"][:p, :p]
    C, H, T = (model[name][:, :n] for name in ("C", "disturbance_map", "torque_map"))
    C, H = C[:p], H[:p]
    model["late_factor"] = certified.late
    model["gain_mode"] = (
        native.GAIN_CERTIFIED if gain_mode is GainMode.CERTIFIED else native.GAIN_RICCATI
    )
    for name, matrix in (
        ("X", X),
        ("K", K),
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
    std = limits / math.sqrt(3.0) if options.initial_std is None else options.initial_std
    model["theta_deviation"] = std
    model["significance"], model["pass_time"] = options.significance, options.pass_time
    model["random_walk"] = options.random_walk_density
    model["adaptation_start"], model["memory"] = options.start, options.memory
    model["excitation"] = options.excitation
    designed = model["initial"]["hypotheses"][0]
    fill_matrix(designed["gamma"], np.diag(model["theta_deviation"] ** 2))


def enter_supervision(model: Any, options: SupervisionOptions) -> None:
    """Enter which samples are not used into one model record."""
    flow = _flow_of(model)
    is_arm = flow["kind"] == native.KIND_ARM
    for name, value in vars(options).items():
        model[name] = value
    model["supervised"] = 1
    for i in range(int(model["p"])):
        row = model["C"][i]
        if not (is_arm and (row[LINK_ANGLE] or row[MOTOR_ANGLE])):
            # The limit is for angles; another output has a unit of its own.
            model["disturbance_limit"][i] = math.inf


def _flow_of(model: Any) -> Any:
    """Return the record of the design's flow in one model record; its sizes follow its kind."""
    numbers = model["flow"]
    sizes = numbers[1 : 1 + len(FlowSizes._fields)].view(np.int64)
    return numbers.view(flow_type(FlowSizes(*sizes.tolist())))[0]
