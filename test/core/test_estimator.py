# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the steps of the compiled core refuse, before they touch memory."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.estimator import State
from tsobs_ros.estimation.state import types_of_model
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

ESTIMATOR = load_design(config_path(SHIPPED_DESIGN)).supervised()


def numbers(records: Any) -> Any:
    return records.view(np.float64)


def correct(model: Any, states: Any, y: int = 1, corrections: int = 1) -> None:
    effects = ESTIMATOR.new_corrections(corrections)
    native.estimator_correct(numbers(model), states, np.zeros(y), numbers(effects))


def predict(state: State, u: int = 1, duration: float = 0.005, work: int | None = None) -> None:
    scratch = numbers(ESTIMATOR.new_work())[:work]
    native.estimator_predict(
        numbers(ESTIMATOR.model), numbers(state.records), np.zeros(u), duration, False, scratch
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m, s: correct(m[:0], s), "estimator_correct: model: expected a model's record"),
        (lambda m, s: correct(m, s[:-1]), "estimator_correct: states: expected records of"),
        (lambda m, s: correct(m, s, y=0), "estimator_correct: y: expected at least 1 numbers"),
        (lambda m, s: correct(m, s, corrections=0), "estimator_correct: corrections: expected"),
        (lambda m, s: predict(ESTIMATOR.initial(), u=0), "estimator_predict: u: expected"),
        (lambda m, s: predict(ESTIMATOR.initial(), work=9), "estimator_predict: work: expected"),
        (lambda m, s: predict(ESTIMATOR.initial(), duration=-1.0), "duration: expected a finite"),
        (lambda m, s: predict(ESTIMATOR.initial(), duration=np.nan), "duration: expected a finite"),
        (
            lambda m, s: native.estimator_read(numbers(m), s, np.zeros(3), np.zeros(3)),
            "estimator_read: rows: expected",
        ),
        (
            lambda m, s: native.estimator_observe(
                numbers(m), s, np.zeros(5), np.zeros(5), 0.1, 6, s, s, s
            ),
            "estimator_observe: y: expected at least 6 numbers, got 5",
        ),
        (
            lambda m, s: native.estimator_observe(
                numbers(m), s, np.zeros(5), np.zeros(5), 0.1, -1, s, s, s
            ),
            "estimator_observe: samples: expected a number of at least 0",
        ),
        (lambda m, s: native.layout("model", np.full(10, -1)), "layout: sizes: expected"),
        (lambda m, s: native.layout("model", np.ones(3, int)), "layout: record: expected"),
        (lambda m, s: native.elementary("tangent", s), "elementary: function: expected"),
    ],
)
def test_arrays_of_other_lengths_are_refused(call: Callable[..., Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(ESTIMATOR.model, numbers(ESTIMATOR.new_states(1)))


@pytest.mark.parametrize(
    "name", ["n", "width", "p", "k", "hypothesis_count", "flow_size", "scratch"]
)
@pytest.mark.parametrize("size", [-1, 0, 1, 3, 2**40])
def test_a_model_of_other_sizes_is_refused(name: str, size: int) -> None:
    model = ESTIMATOR.model.copy()
    if size == model[name][0]:
        return
    model[name] = size
    with pytest.raises(ValueError, match="estimator_correct: model: expected a model's record"):
        correct(model, numbers(ESTIMATOR.new_states(1)))


@pytest.mark.parametrize(
    ("name", "value"),
    [("kind", 7), ("kind", -1), ("fork", 5), ("output", 1), ("best", 13), ("best", 3), ("live", 0)],
)
def test_a_state_whose_counts_lie_outside_of_its_fields_is_refused(name: str, value: int) -> None:
    state = ESTIMATOR.initial()
    owner = state.records if name == "best" else state.records["hypotheses"]
    owner[name] = value
    with pytest.raises(ValueError, match="state 0 is no state of this model"):
        ESTIMATOR.predict(state, [0.0], 0.005)


def test_the_types_of_records_are_made_from_the_sizes_in_the_model() -> None:
    types = types_of_model(ESTIMATOR.model)
    assert types.model == ESTIMATOR.model.dtype
    assert types.state == ESTIMATOR.new_states(1).dtype
    width = (ESTIMATOR.model["width"][0],) * 2
    assert types.state["hypotheses"].base["covariance"].shape == width


@pytest.mark.parametrize("outputs", [1, 2])
def test_what_is_left_in_scratch_memory_decides_nothing(outputs: int) -> None:
    """Of a run with all that wakes the bank: forks, a tone, a stuck sensor, missing numbers."""
    design = "both_encoders.design.yaml"
    folder = Path(__file__).resolve().parents[1] / "estimation" / "data"
    one = ESTIMATOR if outputs == 1 else load_design(folder / design).supervised()
    rng, count = np.random.default_rng(3), 1200
    y = np.tile(0.3 * np.sin(0.02 * np.arange(count))[:, np.newaxis], outputs)
    y += 0.02 * rng.standard_normal(y.shape)
    u = np.sin(0.01 * np.arange(count))[:, np.newaxis]
    y[200:] += 0.3
    y[400:, 0] += 0.2 * np.sin(0.03 * np.arange(count - 400))
    y[600:640], u[700:720], u[900] = y[600], np.nan, 20.0
    y[[100, 101, 300, 1000], 0] = 5.0, 1e150, np.nan, 1e200
    found = []
    for fill in (0.0, np.nan, 1e300):
        states, rows = one.new_states(1), one.new_rows(count)
        made = (one.new_corrections(), one.new_work())
        scratch = [numbers(each) for each in made]
        for each in scratch:
            each[:] = fill
        native.estimator_observe(
            numbers(one.model), numbers(states), y, u, one.period, count, *scratch, rows
        )
        found.append(rows.tobytes() + states.tobytes())
        assert np.isfinite(rows).all()
    assert states["hypotheses"]["live"][0, 1:].any()
    assert found[0] == found[1] == found[2]
