# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Histories, fault watches and scores in the core: what does not fit is refused before it is used.

What they compute is tested with the trackers, monitors and campaigns that they are for.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsobs_ros import core
from tsobs_ros.core import native
from tsobs_ros.design.file import load_design
from tsobs_ros.errors import ModelError
from tsobs_ros.estimation.faults import new_watches
from tsobs_ros.estimation.history import REASONS, History
from tsobs_ros.estimation.tracker import Checkpoint, Tracker, TrackerOptions
from tsobs_ros.resources import FIXED_DESIGN, config_path

DESIGN = load_design(config_path(FIXED_DESIGN))
COUNT = 3


def tracker(**options: Any) -> Tracker:
    return Tracker(DESIGN.supervised(), TrackerOptions(**options))


WIDTH = DESIGN.supervised().row_type.itemsize // 8


def arrays(history: History) -> dict[str, list[Any]]:
    """Return arguments of each function that are right; arrays have no number too many."""
    stamps = 10**9 + 5_000_000 * np.arange(1, COUNT + 1)
    y, u = np.zeros((COUNT, 1)), np.zeros((COUNT, 1))
    codes = np.zeros(COUNT, np.int64)
    results = [codes, codes[:, np.newaxis].copy(), y.copy(), y.copy()]
    rows = np.zeros((COUNT, WIDTH))
    ticks = [stamps, stamps, np.arange(1, COUNT + 1), np.arange(1, COUNT + 1), codes - 1]
    replay = [stamps, y, u, codes + 2, codes.copy(), *ticks, np.zeros((COUNT, 8)), *results]
    of_ticks = [codes.copy(), codes.copy(), codes.copy(), np.zeros(2, np.int64), rows]
    return {
        "offer": [stamps, y, u, 10**18, *results],
        "estimate_at": [10**9, np.zeros(WIDTH)],
        "follow": [stamps, y, u, rows],
        "advance": [*replay, *of_ticks, 0, COUNT, 10**18],
    }


CASES = [
    (name, place)
    for name, arguments in arrays(tracker().history).items()
    for place, argument in enumerate(arguments)
    # All else has the length of the stamps, of samples or of ticks.
    if isinstance(argument, np.ndarray)
    and (name, place) not in {("offer", 0), ("follow", 0), ("advance", 0), ("advance", 5)}
]


@pytest.mark.parametrize(("name", "place"), CASES)
def test_an_array_that_is_too_short_is_refused_and_nothing_is_changed(
    name: str, place: int
) -> None:
    history = tracker().history
    call: Callable[..., Any] = getattr(history, name)
    arguments = arrays(history)[name]
    whole = arguments[place]
    arguments[place] = whole.reshape(-1)[:-1].copy()
    with pytest.raises(ValueError, match=r"^(history|replay)_\w+: "):
        call(*arguments)
    assert history.newest == 0
    arguments[place] = whole
    call(*arguments)


def test_stamps_that_do_not_ascend_and_ticks_of_samples_that_there_are_not_are_refused() -> None:
    history = tracker().history
    given = arrays(history)
    given["follow"][0] = given["follow"][0][::-1].copy()
    with pytest.raises(ValueError, match="expected them to ascend"):
        history.follow(*given["follow"])
    given["advance"][7] = given["advance"][7] + 1
    with pytest.raises(ValueError, match="do not belong to the samples"):
        history.advance(*given["advance"])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("first", -1),
        ("first", 66),
        ("length", 66),
        ("length", -1),
        ("has_base", 2),
        ("max_steps", 0),
        ("max_steps", 65),
        ("span", -1),
    ],
)
def test_a_place_outside_of_the_ring_is_refused(field: str, value: int) -> None:
    one = tracker(max_steps=64)
    one.memory[field] = value
    with pytest.raises(ValueError, match="history_estimate: memory: expected"):
        one.estimate(10**9)


def test_a_checkpoint_with_another_estimators_numbers_is_refused() -> None:
    one, other = tracker(), tracker()
    arguments = arrays(one.history)
    one.history.follow(*arguments["follow"])
    memory, ring = one.checkpoint()
    ring["hypotheses"]["kind"][:COUNT] = 10**6
    with pytest.raises(ModelError, match="expected the numbers of this estimator"):
        other.restore(Checkpoint(memory, ring))
    memory["length"] = 10**6
    with pytest.raises(ModelError, match="expected the numbers of this estimator"):
        other.restore(Checkpoint(memory, ring))
    assert other.newest is None


def test_histories_of_different_sizes_are_not_copied() -> None:
    with pytest.raises(ValueError, match="expected rings of the same size"):
        tracker().history.copy_to(tracker(max_steps=5).history)


def test_outcomes_have_the_codes_of_the_reasons() -> None:
    text = Path(core.__file__).with_name("outcomes.h").read_text(encoding="utf-8")
    names = re.findall(r"^    ([A-Z_]+)", text, re.MULTILINE)
    assert names == ["USED", *(reason.name for reason in REASONS if reason), "OUTCOMES"]


def test_watches_and_samples_that_do_not_fit_are_refused() -> None:
    watches, stamps = new_watches([0.1, 0.2]).view(np.float64), np.arange(1, COUNT + 1)
    codes, numbers = np.zeros((2, COUNT), np.int64), np.zeros((2, COUNT))
    right = [watches, stamps, numbers, codes, numbers, numbers]
    native.faults_add_samples(*right)
    for place in (0, 2, 3, 4, 5):
        wrong = [*right]
        wrong[place] = right[place].reshape(-1)[:-1].copy()
        with pytest.raises(ValueError, match=r"^faults_add_samples: "):
            native.faults_add_samples(*wrong)
    with pytest.raises(ValueError, match=r"^faults_add_estimates: bounds: expected at least 2"):
        native.faults_add_estimates(watches, 1, np.zeros(2), np.zeros(1))
    spoilt = new_watches([0.1])
    spoilt["count"] = 151
    with pytest.raises(ValueError, match="expected records of sensors"):
        native.faults_add_estimates(spoilt.view(np.float64), 1, np.zeros(1), np.zeros(1))


def test_runs_that_do_not_belong_together_are_not_scored() -> None:
    right: list[Any] = [
        np.zeros(4), np.zeros((1, 4), np.int64), np.ones(1), np.zeros(2, np.int64), 3,
        np.arange(3.0), np.zeros((2, 3, 4)), np.zeros((2, 3, 1)), np.zeros((2, 3, 2)),
        np.zeros(2, np.int64), np.zeros((2, 3, 5)), np.zeros((2, 1, 5)), np.zeros((2, 1, 1, 4)),
        np.zeros((2, 1), np.int64), np.zeros(2), np.zeros((2, 1)),
    ]  # fmt: skip
    native.scores_add_up(*right)
    wrong = {place: each.reshape(-1)[:-1].copy() for place, each in enumerate(right)
             if isinstance(each, np.ndarray) and place not in (2, 3, 9, 13)}  # fmt: skip
    changes: list[dict[int, Any]] = [{place: each} for place, each in wrong.items()]
    changes += [{4: 5}, {4: -1}, {1: np.array([[3, 0, 0, 0]])}, {1: np.array([[0, 4, 0, 0]])},
                {1: np.array([[0, 0, 5, 0]])}, {3: np.array([1, 0])}]  # fmt: skip
    for change in changes:
        with pytest.raises(ValueError, match=r"^scores_add_up: "):
            native.scores_add_up(*[change.get(i, each) for i, each in enumerate(right)])
