# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Model records whose numbers belong together by size, and would lead a step out of its memory."""

from typing import Any

import numpy as np
import pytest

from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import Estimator
from tsobs_ros.estimation.state import Shape, new_model
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.prediction import flow_record
from tsobs_ros.resources import FIXED_DESIGN, config_path

DESIGN = load_design(config_path(FIXED_DESIGN))


def estimator(method: str = "certified") -> Estimator:
    return make_estimator(DESIGN, ObserverSettings(method=method))


def is_refused(model: Any) -> bool:
    try:
        native.history_scratch_size(model.view(np.float64), 8)
    except ValueError:
        return True
    return False


def test_more_outputs_than_a_step_moves_parts_of_are_refused() -> None:
    flow = DESIGN.request.flow
    count = flow.output_matrix.shape[0]

    def model(p: int) -> Any:
        shape = Shape(flow.state_count, 4, p, flow.input_count)
        return new_model(shape, flow.period, flow_record(flow), auxiliary=True)

    assert [is_refused(model(count + more)) for more in range(4)] == [False, False, False, True]


@pytest.mark.parametrize(
    ("name", "value"),
    [("best", -1), ("best", 13), ("kind", 7), ("kind", -1), ("output", 1), ("fork", 5)],
)
def test_an_initial_state_whose_counts_lie_outside_of_its_fields_is_refused(
    name: str, value: int
) -> None:
    model = estimator().model.copy()
    initial = model["initial"]
    assert not is_refused(model)
    (initial if name == "best" else initial["hypotheses"][:, 3])[name] = value
    assert is_refused(model)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, 1e-300])
def test_a_period_that_cannot_be_counted_is_refused(value: float) -> None:
    whole = estimator().model.copy()
    whole["period"] = value
    assert is_refused(whole)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("period", [0.0, -1.0, np.nan, np.inf, 1e-300]),
        ("max_step", [0.0, -1.0, np.nan, 1e-300]),
        ("reach", [-1.0, np.nan]),
        ("terms", [-1, 61]),
    ],
)
def test_a_flow_whose_steps_do_not_end_is_refused(name: str, values: list[float]) -> None:
    for value in values:
        model = estimator("proportional_integral").model.copy()
        assert not is_refused(model)
        flow = model["flow"].reshape(-1).view(np.int64 if name == "terms" else np.float64)
        flow[_place(flow, name)] = value
        assert is_refused(model), value


def _place(flow: Any, name: str) -> int:
    sizes = flow.view(np.int64)[1:9].tolist()
    return int(record_type("flow", sizes).fields[name][1] // 8)


def test_a_duration_whose_periods_cannot_be_counted_is_refused() -> None:
    one = estimator()
    with pytest.raises(ValueError, match="duration: expected a finite number"):
        one.predict(one.initial(), [0.0], 1e300)
