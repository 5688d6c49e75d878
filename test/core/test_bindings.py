# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What does not fit is refused before the core touches memory, and nothing is changed.

What the functions compute is tested with the classes that they are for, but for the core's own
sine, cosine, exponential and logarithm.
"""

import math
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros import core
from tsobs_ros.core import native
from tsobs_ros.core.functions import evaluate
from tsobs_ros.core.records import record_type
from tsobs_ros.design.file import load_design
from tsobs_ros.estimation.baselines import open_estimator
from tsobs_ros.estimation.records import RejectReason
from tsobs_ros.estimation.state import numbers_of as numbers
from tsobs_ros.estimation.tracker import Tracker
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.model.fuzzy import RuleBase, membership
from tsobs_ros.resources import FIXED_DESIGN, SHIPPED_DESIGN, config_path

DESIGN = load_design(config_path(FIXED_DESIGN))
ADAPTIVE = load_design(config_path(SHIPPED_DESIGN))
ESTIMATOR = make_estimator(ADAPTIVE, ObserverSettings())
FLOW = DESIGN.request.flow.record()
ENDLESS = FLOW.copy()
ENDLESS["reach"] = -1.0  # a step would be halved for ever
STEP = record_type("flow_step", FLOW["sizes"][0])
COUNT = 3
SIZES = np.array([2, 1, 0, 1, 1, 1])


def tracker(**options: Any) -> Tracker:
    return Tracker(make_estimator(DESIGN, ObserverSettings()), **options)


def zeros(*shape: int, kind: Any = float) -> Any:
    return np.zeros(shape, kind)


def calls() -> dict[str, dict[str, Any]]:
    """Return arguments of each function that are right; arrays have no number too many."""
    model, states = numbers(ESTIMATOR.model.copy()), numbers(ESTIMATOR.initial())
    rows, work = zeros(ESTIMATOR.row_type.itemsize // 8), numbers(ESTIMATOR.new_record("work"))
    corrections = numbers(ESTIMATOR.new_record("correction"))
    estimator = {"model": model, "states": states}
    one = tracker()
    own = numbers(one.estimator.model.copy())
    memories = {"model": own, "room": zeros(native.tracker_room(own, 1024))}
    memories["room"][: one.memory.itemsize // 8] = numbers(one.memory)
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
    plant = np.ones(record_type("simulated_plant", SIZES).itemsize // 8)
    plant.view(np.int64)[0] = 5
    return {
        "estimator_correct": {**estimator, "y": zeros(1), "corrections": corrections},
        "estimator_predict": {
            **estimator, "u": zeros(1), "duration": 0.005, "between_samples": False, "work": work,
        },
        "estimator_read": {**estimator, "rows": rows, "work": work},
        "history_offer": {**memories, **given, "now": 10**18, **results},
        "history_estimate": {**memories, "stamp": 10**9, "row": zeros(width)},
        "history_advance": {"records": tuple(memories.values()), **given, **results, **ticks},
        "flow_over": {
            "flow": numbers(FLOW), "duration": 1.0, "step": numbers(np.zeros(1, STEP)),
        },
        "weights_of_each": {
            "shapes": zeros(2, kind=int), "parameters": zeros(2, 4), "z": zeros(3),
            "weights": zeros(3, 2), "r": 2, "q": 1,
        },
        "simulate": {
            "sizes": SIZES, "plant": plant, "inputs": zeros(2, 3, 1), "kicks": zeros(2, 3, 10),
            "present": zeros(2, 2), "states": zeros(2, 3, 2), "outputs": zeros(2, 3, 1),
        },
    }  # fmt: skip


# They say how much there is of all else.
COUNTING = {"stamps", "tick_stamps", "x", "z", "present"}
CASES = [
    (function, name)
    for function, arguments in calls().items()
    for name, argument in arguments.items()
    if isinstance(argument, np.ndarray) and argument.size and name not in COUNTING
    and (function, name) != ("simulate", "states")
]  # fmt: skip


@pytest.mark.parametrize(("function", "name"), CASES)
def test_an_array_that_is_too_short_is_refused_and_nothing_is_changed(
    function: str, name: str
) -> None:
    call, right = getattr(native, function), calls()[function]
    wrong = right | {name: right[name].reshape(-1)[:-1].copy()}
    before = pickle.dumps(wrong)
    with pytest.raises(ValueError, match=rf"^{function}: "):
        call(*wrong.values())
    assert pickle.dumps(wrong) == before
    call(*right.values())


@pytest.mark.parametrize(
    ("function", "changes", "complaint"),
    [
        ("estimator_predict", {"duration": -1.0}, "duration: expected a finite"),
        ("estimator_correct", {"y": zeros(0)}, "argument 3: expected at least 1 numbers, got 0"),
        ("history_advance", {"known": np.array([1, 2, 4])}, "known: expected numbers of samples"),
        ("flow_over", {"duration": np.inf}, "duration: expected a finite"),
        ("flow_over", {"flow": zeros(99)}, "expected a flow's record"),
        ("flow_over", {"flow": numbers(ENDLESS)}, "expected a flow's record"),
        ("weights_of_each", {"q": 0}, "expected sizes within their limits"),
        ("simulate", {"sizes": -SIZES}, "expected sizes within their limits"),
        ("simulate", {"sizes": SIZES * 10_000}, "expected sizes within their limits"),
        ("simulate", {"sizes": SIZES * [1, 1, 1, 1, 0, 0]}, "expected the sizes of an arm"),
    ],
)
def test_numbers_out_of_range_are_refused(
    function: str, changes: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ValueError, match=f"^{function}: {complaint}"):
        getattr(native, function)(*(calls()[function] | changes).values())


def test_arguments_of_another_kind_are_refused() -> None:
    with pytest.raises(TypeError, match="flow_over: expected 3 arguments, got 1"):
        native.flow_over(zeros(3))
    with pytest.raises(ValueError, match="elementary: argument 2: expected aligned 8-byte numbers"):
        native.elementary("sine", np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="elementary: function: expected sine, cosine"):
        native.elementary("tangent", zeros(3))
    with pytest.raises(ValueError, match="layout: expected sizes within their limits"):
        native.layout("flow", np.full(7, -1))
    with pytest.raises(ValueError, match="layout: expected a record and its sizes"):
        native.layout("model", np.ones(3, int))


@pytest.mark.parametrize("place", range(11))
def test_a_model_of_other_sizes_is_refused(place: int) -> None:
    model = ESTIMATOR.model.copy()
    before = int(model["sizes"][0, place])
    for value in {-1, before - 1, before + 1, 2**40}:
        if place == 10 and value > before:  # scratch may be larger than a step needs
            continue
        model["sizes"][0, place] = value
        with pytest.raises(ValueError, match="tracker_room: expected a model's record"):
            native.tracker_room(numbers(model), 8)


def test_a_model_that_limits_a_torque_but_has_none_is_refused() -> None:
    free = open_estimator(
        -np.ones((1, 1, 1)), zeros(1, 1, 1), zeros(1, 1, 0), period=0.01, scale=np.ones(1),
        rule_base=RuleBase(((membership("always"),),)), C=np.eye(1), R=np.eye(1),
    )  # fmt: skip
    native.tracker_room(numbers(free.model), 8)
    free.model["torque_limit"] = 1.0
    with pytest.raises(ValueError, match="tracker_room: expected a model's record of numbers that"):
        native.tracker_room(numbers(free.model), 8)


def test_outcomes_have_the_codes_of_the_reasons() -> None:
    text = Path(core.__file__).with_name("estimator.h").read_text(encoding="utf-8")
    names = re.findall(r"^    ([A-Z_]+)", text[text.index("    USED,") :].partition("}")[0], re.M)
    assert names == ["USED", *(reason.name for reason in RejectReason), "OUTCOMES"]


@pytest.mark.parametrize("outputs", [1, 2])
def test_what_is_left_in_scratch_memory_decides_nothing(outputs: int) -> None:
    """Of a run with all that wakes the bank: forks, a tone, a stuck sensor, missing numbers."""
    design = "both_encoders.design.yaml"
    folder = Path(__file__).resolve().parents[1] / "estimation" / "data"
    chosen = ADAPTIVE if outputs == 1 else load_design(folder / design)
    one = make_estimator(chosen, ObserverSettings())
    rng, count = np.random.default_rng(3), 1200
    y = np.tile(0.3 * np.sin(0.02 * np.arange(count))[:, np.newaxis], outputs)
    y += 0.02 * rng.standard_normal(y.shape)
    u = np.sin(0.01 * np.arange(count))[:, np.newaxis]
    y[200:] += 0.3
    y[400:, 0] += 0.2 * np.sin(0.03 * np.arange(count - 400))
    y[600:640], u[700:720], u[900] = y[600], np.nan, 20.0
    y[[100, 101, 300, 1000], 0] = 5.0, 1e150, np.nan, 1e200
    stamps, found = 10**9 + 5_000_000 * np.arange(1, count + 1), []
    for fill in (0.0, np.nan, 1e300):
        own = Tracker(one)
        own._records[1][(own.memory.nbytes + own.ring.nbytes) // 8 :] = fill
        rows = numbers(own.run(stamps, y, u, (stamps, stamps, np.arange(1, count + 1))).rows)
        found.append(rows.tobytes() + own.state.tobytes())
        assert np.isfinite(rows).all()
    assert own.state["hypotheses"]["live"][0, 1:].any()
    assert found[0] == found[1] == found[2]


SYSTEM = {"sine": math.sin, "cosine": math.cos, "exponential": math.exp, "logarithm": math.log}


@pytest.mark.parametrize("function", SYSTEM)
def test_values_are_within_two_units_in_the_last_place(function: str) -> None:
    values = np.concatenate([np.geomspace(1e-320, 1e308, 5_000), np.linspace(0.7, 1.3, 5_001)])
    if function == "exponential":
        values = np.append(-np.geomspace(1e-17, 745.0, 5_000), 0.0)
    elif function != "logarithm":
        drawn = np.random.default_rng(3).uniform(-1.0, 1.0, (5, 3_000))
        angles = drawn * np.array([[1e-3], [0.7], [4.0], [1e3], [1e6]])
        values = np.append(angles, 0.5 * math.pi * np.arange(-60, 61))
    system = np.array([SYSTEM[function](x) for x in values.tolist()])
    error = np.abs(evaluate(function, values) - system)
    assert (error <= 2.0 * np.spacing(np.abs(system))).all()


def test_outside_of_their_range_they_are_zero_or_nan() -> None:
    assert evaluate("exponential", [-800.0, -math.inf]).tolist() == [0.0, 0.0]
    assert np.isnan(evaluate("exponential", math.nan))
    assert np.isnan(evaluate("logarithm", [0.0, -1.0, math.inf, math.nan])).all()
