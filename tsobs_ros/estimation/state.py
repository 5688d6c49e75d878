# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of an estimator: its state, its model and its estimates.

To copy a state is to copy its record. Two states are equal if their bytes are, and an array of
states is a batch or a history. core/estimator.h explains the fields of all records. Flags are
integers, 0 or 1.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.estimation.records import Basis
from tsobs_ros.model.prediction import Flow, Record, Uncertainty


class Shape(NamedTuple):
    """Sizes of an estimator, as in `estimator_sizes` of core/estimator.h."""

    n: int
    plant: int
    p: int
    m: int
    k: int = 0
    t: int = 0


def likeliest(state: Record) -> Any:
    """Return the likeliest hypothesis of a state, without copying it."""
    return state["hypotheses"][0, state["best"][0]]


def numbers_of(records: Record) -> Array:
    """Return the numbers of records, shape (numbers,), without copying them."""
    return records.view(np.float64)


def copy_records(source: Record) -> Record:
    """Return a copy of records; NumPy would be slower, since it copies field by field."""
    return numbers_of(source).copy().view(source.dtype)


@cache
def types_of(sizes: tuple[int, ...]) -> dict[str, Any]:
    """Return the record types for the sizes of a model record, by their names in the core."""
    names = ("sensor", "hypothesis", "correction", "estimate", "work")
    types = {name: record_type(name, sizes) for name in names}
    inner = {"sensors": types["sensor"], "hypotheses": types["hypothesis"]}
    types["state"] = record_type("state", sizes, inner)
    return types | {"model": record_type("model", sizes, {"initial": types["state"]})}


def new_model(
    shape: Shape, flow: Flow, uncertainty: Uncertainty | None = None, *, auxiliary: bool = False
) -> Record:
    """Return a model record, shape (1,), with sizes, flow and period; the rest is zero.

    Args:
        shape: Sizes of the estimator.
        flow: The prediction model.
        uncertainty: Its uncertain parameters.
        auxiliary: Whether there are states for an unknown torque and for parts of the outputs, and
            hypotheses other than the design.
    """
    n, plant, p, m, k, t = shape
    torque, record = flow.torque_path, flow.record(uncertainty)
    # Torques on their way: one message per output and period, and a few more for jitter.
    late = p * (math.ceil(torque.delay / flow.period) + 1) + 1 if torque.delay else 0
    scratch = record_type("flow_step", record["sizes"][0])
    sizes = (
        n, n + (1 + max(6, p) if auxiliary else 0), plant, p, m, k, t,
        native.HYPOTHESES if auxiliary else 1, late,
        record.dtype.itemsize // 8, scratch.itemsize // 8,
    )  # fmt: skip
    model = np.zeros(1, types_of(sizes)["model"])
    model["sizes"], model["flow_record"][0] = sizes, record.view(np.float64)
    model["period"], model["gate"] = flow.period, np.inf
    model["torque_gain"], model["torque_delay"] = torque.gain, torque.delay
    model["constants"] = [value for _, value, _ in native.BANK_CONSTANTS]
    initial = model["initial"]
    initial["sensors"]["value"] = np.nan
    initial["sensors"]["noise_scale"] = 1.0
    initial["torque_age"] = np.inf
    initial["past"][..., 1] = np.inf
    designed = initial["hypotheses"][:, 0]
    designed["live"], designed["cause"] = 1, Basis.STARTING
    designed["inlier"] = designed["nis"] = 1.0
    return model
