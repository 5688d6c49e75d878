# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Histories and fault watches in the core: what does not fit is refused before it is used.

What they compute is tested with the trackers and monitors that they are for.
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
    ticks = [stamps, stamps, np.arange(1, COUNT + 1), codes.copy(), codes.copy(), rows]
    return {
        "offer": [stamps, y, u, 10**18, *results],
        "estimate_at": [10**9, np.zeros(WIDTH)],
        "advance": [stamps, y, u, *results, *ticks, 10**18],
    }


CASES = [
    (name, place)
    for name, arguments in arrays(tracker().history).items()
    for place, argument in enumerate(arguments)
    # All else has the length of the stamps, of samples or of ticks.
    if isinstance(argument, np.ndarray)
    and (name, place) not in {("offer", 0), ("advance", 0), ("advance", 7)}
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
    with pytest.raises(ValueError, match=r"^history_\w+: "):
        call(*arguments)
    assert history.newest == 0
    arguments[place] = whole
    call(*arguments)


@pytest.mark.parametrize("known", [[1, 2, COUNT + 1], [2, 1, 3], [-1, 1, 2]])
def test_ticks_of_samples_that_there_are_not_are_refused(known: list[int]) -> None:
    history = tracker().history
    given = arrays(history)["advance"]
    given[9] = np.array(known)
    with pytest.raises(ValueError, match="known: expected numbers of samples that ascend"):
        history.advance(*given)


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
    one.history.advance(*arrays(one.history)["advance"])
    memory, ring = one.checkpoint()
    ring["hypotheses"]["kind"][:COUNT] = 10**6
    with pytest.raises(ModelError, match="expected the numbers of this estimator"):
        other.restore(Checkpoint(memory, ring))
    memory["length"] = 10**6
    with pytest.raises(ModelError, match="expected the numbers of this estimator"):
        other.restore(Checkpoint(memory, ring))
    assert other.newest is None


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
