# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What does not fit is refused before the core touches memory, and nothing is changed.

What the functions compute is tested with the classes that they are for.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros import core
from tsobs_ros.core import native
from tsobs_ros.core.records import record_type
from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.faults import FaultMonitor
from tsobs_ros.estimation.records import REASONS
from tsobs_ros.estimation.state import Shape, new_model
from tsobs_ros.estimation.tracker import Tracker, TrackerOptions
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.prediction import FlowSizes, flow_record, scratch_size
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

DESIGN = load_design(config_path(FIXED_DESIGN))
ESTIMATOR = load_design(config_path(SHIPPED_DESIGN)).supervised()
FLOW = DESIGN.request.flow
COUNT = 3
SIZES = np.array([2, 1, 0, 1, 1, 1])


def numbers(records: Any) -> Any:
    return records.view(np.float64)


def tracker(**options: Any) -> Tracker:
    return Tracker(DESIGN.supervised(), TrackerOptions(**options))


def zeros(*shape: int, kind: Any = float) -> Any:
    return np.zeros(shape, kind)


def calls() -> dict[str, dict[str, Any]]:
    """Return arguments of each function that are right; arrays have no number too many."""
    model, states = numbers(ESTIMATOR.model.copy()), numbers(ESTIMATOR.new_states(1))
    rows, work = zeros(ESTIMATOR.row_type.itemsize // 8), numbers(ESTIMATOR.new_work())
    corrections = numbers(ESTIMATOR.new_corrections(1))
    estimator = {"model": model, "states": states}
    one = tracker()
    own = numbers(one.estimator.model.copy())
    memories = {"model": own, "memory": numbers(one.memory), "ring": numbers(one.ring)}
    memories["scratch"] = zeros(native.history_scratch_size(own, len(one.ring)))
    width = one.estimator.row_type.itemsize // 8
    stamps = 10**9 + 5_000_000 * np.arange(1, COUNT + 1)
    given = {"stamps": stamps, "y": zeros(COUNT, 1), "u": zeros(COUNT, 1)}
    results = {
        "codes": zeros(COUNT, kind=int), "output_codes": zeros(COUNT, 1, kind=int),
        "innovations": zeros(COUNT, 1), "expected_std": zeros(COUNT, 1),
    }  # fmt: skip
    ticks = {
        "tick_stamps": stamps, "now": stamps, "known": np.arange(1, COUNT + 1),
        "newest": zeros(COUNT, kind=int), "there": zeros(COUNT, kind=int),
        "rows": zeros(COUNT, width), "stale_after": 10**18,
    }  # fmt: skip
    flow, n, m = numbers(flow_record(FLOW)), FLOW.state_count, FLOW.input_count
    arm = np.ones(2 * record_type("simulated_arm").itemsize // 8)
    system = np.ones(record_type("simulated_system", SIZES).itemsize // 8)
    for plant in (arm[:20], arm[20:], system):
        plant.view(np.int64)[0] = 5
    moves = {"kicks": zeros(2, 3, 10)}
    return {
        "estimator_correct": {**estimator, "y": zeros(1), "corrections": corrections},
        "estimator_predict": {
            **estimator, "u": zeros(1), "duration": 0.005, "between_samples": False, "work": work,
        },
        "estimator_read": {**estimator, "rows": rows, "work": work},
        "estimator_observe": {
            **estimator, "y": zeros(1), "u": zeros(1), "duration": 0.005, "samples": 1,
            "correction": corrections, "work": work, "rows": rows,
        },
        "history_offer": {**memories, **given, "now": 10**18, **results},
        "history_estimate": {**memories, "stamp": 10**9, "row": zeros(width)},
        "history_advance": {**memories, **given, **results, **ticks},
        "faults_add_samples": {
            "watches": numbers(FaultMonitor([0.1, 0.2]).watches), "stamps": stamps,
            "y": zeros(2, COUNT), "codes": zeros(2, COUNT, kind=int),
            "innovations": zeros(2, COUNT), "expected_std": zeros(2, COUNT),
        },
        "faults_add_estimates": {
            "watches": numbers(FaultMonitor([0.1]).watches), "stamp": 1, "disturbances": zeros(1),
            "bounds": zeros(1),
        },
        "advance_all": {
            "flow": flow, "x": zeros(2, n), "upsilon": zeros(0), "covariance": zeros(2, n, n),
            "theta": zeros(0), "y": zeros(0), "u": zeros(2, m), "duration": 0.01,
            "scratch": zeros(scratch_size(FlowSizes(n, m, 1, 1, 0, 4))),
        },
        "flow_over": {
            "series": zeros(4, 10), "terms": 4, "reach": 1.0, "duration": 1.0, "phi": zeros(4),
            "gamma": zeros(2), "noise": zeros(4), "scratch": zeros(20), "n": 2, "m": 1,
        },
        "grades_and_slopes": {
            "shape": 1, "parameters": zeros(4), "z": zeros(3), "grades": zeros(3),
            "slopes": zeros(3),
        },
        "weights_and_slopes_of_each": {
            "shapes": zeros(2, kind=int), "parameters": zeros(2, 4), "z": zeros(3),
            "weights": zeros(3, 2), "slopes": zeros(3, 2), "r": 2, "q": 1,
        },
        "simulate_arms": {
            "arms": arm, "carried": np.array([0, 1, 0]), "inputs": zeros(2, 3), **moves,
            "present": zeros(2, 4), "states": zeros(2, 3, 4), "torques": zeros(2, 3, 2),
        },
        "simulate_systems": {
            "sizes": SIZES, "system": system, "inputs": zeros(2, 3, 1), **moves,
            "present": zeros(2, 2), "states": zeros(2, 3, 2), "truths": zeros(2, 3, 1),
        },
    }  # fmt: skip


# They say how much there is of all else.
COUNTING = {"stamps", "tick_stamps", "x", "z", "present", "carried", "states of a system"}
CASES = [
    (function, name)
    for function, arguments in calls().items()
    for name, argument in arguments.items()
    if isinstance(argument, np.ndarray) and argument.size and name not in COUNTING
    and (function, name) != ("simulate_systems", "states")
]  # fmt: skip


@pytest.mark.parametrize(("function", "name"), CASES)
def test_an_array_that_is_too_short_is_refused_and_nothing_is_changed(
    function: str, name: str
) -> None:
    call, right = getattr(native, function), calls()[function]
    wrong = right | {name: right[name].reshape(-1)[:-1].copy()}
    before = [np.array(each, copy=True).tobytes() for each in wrong.values()]
    with pytest.raises(ValueError, match=rf"^{function}: "):
        call(*wrong.values())
    assert [np.array(each).tobytes() for each in wrong.values()] == before
    call(*right.values())


@pytest.mark.parametrize(
    ("function", "changes", "complaint"),
    [
        ("estimator_predict", {"duration": -1.0}, "duration: expected a finite"),
        ("estimator_observe", {"duration": np.nan}, "duration: expected a finite"),
        ("estimator_observe", {"samples": -1}, "samples: expected a number of at least 0"),
        ("estimator_observe", {"samples": 2}, "y: expected at least 2 numbers, got 1"),
        ("history_advance", {"known": np.array([1, 2, 4])}, "known: expected numbers of samples"),
        ("faults_add_estimates", {"watches": np.full(40, 151)}, "watches: expected records"),
        ("advance_all", {"flow": zeros(900)}, "flow: expected the record of a model"),
        ("advance_all", {"duration": -0.01}, "duration: expected at least 0"),
        ("flow_over", {"duration": np.inf}, "duration: expected at least 0"),
        ("flow_over", {"n": 4097}, "n: expected a size from 0 on, got 4097"),
        ("weights_and_slopes_of_each", {"q": 0}, "q: expected a size from 1 on, got 0"),
        ("simulate_arms", {"carried": np.array([0, 2, 0])}, "carried: expected 0 or 1"),
        ("simulate_arms", {"arms": zeros(40)}, "kicks: expected none, or two for each"),
        ("simulate_systems", {"system": zeros(50)}, "kicks: expected none, or one for each"),
        ("simulate_systems", {"sizes": -SIZES}, "sizes: expected sizes of a system"),
        ("simulate_systems", {"sizes": SIZES * 10_000}, "sizes: expected sizes of a system"),
    ],
)
def test_numbers_out_of_range_are_refused(
    function: str, changes: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ValueError, match=f"^{function}: {complaint}"):
        getattr(native, function)(*(calls()[function] | changes).values())


def test_arguments_of_another_kind_are_refused() -> None:
    with pytest.raises(TypeError, match="flow_over: expected 10 arguments, got 1"):
        native.flow_over(zeros(3))  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="elementary: values: expected aligned 8-byte numbers"):
        native.elementary("sine", np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="elementary: function: expected sine, cosine"):
        native.elementary("tangent", zeros(3))
    with pytest.raises(ValueError, match="layout: sizes: expected those of the record"):
        native.layout("model", np.full(10, -1))
    with pytest.raises(ValueError, match="layout: record: expected one that has so many sizes"):
        native.layout("model", np.ones(3, int))


def is_refused(model: Any) -> bool:
    try:
        native.history_scratch_size(numbers(model), 8)
    except ValueError:
        return True
    return False


@pytest.mark.parametrize(
    ("name", "values"),
    [
        *((each, (-1, 0, 1, 2**40)) for each in (0, 1, 7, 9)),  # n, width, hypotheses, flow_size
        *((each, (-1, 0, 7, 2**40)) for each in (3, 5, 10)),  # p, k, scratch
        ("period", (0.0, -1.0, np.nan, np.inf, 1e-300)),
    ],
)
def test_a_model_of_other_sizes_or_without_a_period_is_refused(
    name: Any, values: tuple[float, ...]
) -> None:
    model = ESTIMATOR.model.copy()
    number = model["period"] if name == "period" else model["sizes"][:, name]
    for value in set(values) - {number.item()}:
        number[:] = value
        assert is_refused(model), value


def test_more_outputs_than_a_step_moves_parts_of_are_refused() -> None:
    def model(p: int) -> Any:
        shape = Shape(FLOW.state_count, 4, p, FLOW.input_count)
        return new_model(shape, FLOW.period, flow_record(FLOW), auxiliary=True)

    count = FLOW.output_matrix.shape[0]
    assert [is_refused(model(count + more)) for more in range(4)] == [False, False, False, True]


@pytest.mark.parametrize(
    ("name", "value"),
    [("best", -1), ("best", 13), ("kind", 7), ("kind", -1), ("output", 1), ("fork", 5)],
)
def test_a_state_whose_counts_lie_outside_of_its_fields_is_refused(name: str, value: int) -> None:
    model, state = ESTIMATOR.model.copy(), ESTIMATOR.initial()
    for one in (model["initial"], state.records):
        (one if name == "best" else one["hypotheses"][:, 3])[name] = value
    assert is_refused(model)
    with pytest.raises(ValueError, match="state 0 is no state of this model"):
        ESTIMATOR.predict(state, [0.0], 0.005)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("period", (0.0, -1.0, np.nan, np.inf, 1e-300)),
        ("max_step", (0.0, -1.0, np.nan, 1e-300)),
        ("reach", (-1.0, np.nan)),
        ("terms", (-1, 61)),
    ],
)
def test_a_flow_whose_steps_do_not_end_is_refused(name: str, values: tuple[float, ...]) -> None:
    for value in values:
        settings = ObserverSettings(method="proportional_integral")
        model = make_estimator(DESIGN, settings).model.copy()
        assert not is_refused(model)
        flow = model["flow"].reshape(-1).view(np.int64 if name == "terms" else np.float64)
        kind = record_type("flow", flow.view(np.int64)[1:9].tolist())
        flow[kind.fields[name][1] // 8] = value
        assert is_refused(model), value


@pytest.mark.parametrize(
    ("field", "values"),
    [("first", (-1, 66)), ("length", (-1, 66)), ("has_base", (2,)), ("max_steps", (0, 65)),
     ("span", (-1,))],
)  # fmt: skip
def test_a_place_outside_of_the_ring_is_refused(field: str, values: tuple[int, ...]) -> None:
    for value in values:
        one = tracker(max_steps=64)
        one.memory[field] = value
        with pytest.raises(ValueError, match="history_estimate: memory: expected"):
            one.estimate(10**9)


def test_outcomes_have_the_codes_of_the_reasons() -> None:
    text = Path(core.__file__).with_name("estimator.h").read_text(encoding="utf-8")
    names = re.findall(r"^    ([A-Z_]+)", text[text.index("    USED,") :].partition("}")[0], re.M)
    assert names == ["USED", *(reason.name for reason in REASONS if reason), "OUTCOMES"]


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
