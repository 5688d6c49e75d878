# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The recorder's selection of topics and its count of losses."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsobs_ros.nodes.recorder.topics import LossCounter, RecorderParameters

# A robot's topics, with hidden ones.
VISIBLE = {"/arm/joints", "/arm/torque", "/camera/image"}
GRAPH = VISIBLE | {"/arm/_raw", "/go/_action/feedback", "/arm/reset/_service_event"}


def full(_parameter: str, name: str) -> str:
    return name if name.startswith("/") else f"/arm/{name}"


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({}, VISIBLE),
        ({"topics": ("joints", "/camera/image")}, {"/arm/joints", "/camera/image"}),
        ({"topics": ("/arm/reset/_service_event",)}, {"/arm/reset/_service_event"}),
        ({"regex": "^/arm/.*e"}, {"/arm/torque", "/arm/reset/_service_event"}),
        ({"exclude_topics": ("joints",)}, VISIBLE - {"/arm/joints"}),
        ({"topics": ("joints", "torque"), "exclude_regex": "q"}, {"/arm/joints"}),
    ],
)
def test_what_is_selected_is_recorded(parameters: dict[str, Any], expected: set[str]) -> None:
    selection = RecorderParameters(**parameters).resolved(full)
    assert set(filter(selection.wants, GRAPH)) == expected


A, B = b"a", b"b"
AB = A + B


def counted(*steps: tuple[bytes, list[int | None]]) -> tuple[int, bool, int]:
    """Count numbers that arrive while publishers are there, each looked at twice in between."""
    counter = LossCounter()
    for publishers, numbers in steps:
        there = frozenset(bytes([p]) for p in publishers)
        counter.add(numbers, lambda there=there: there)
        counter.see(there)
        counter.see(there)
    return counter.lost, counter.is_exact, counter.earlier


# What arrives of one publisher after the other, in order, some numbers missing.
arrivals = st.lists(st.sets(st.integers(1, 40), min_size=1).map(sorted), max_size=5)


@given(arrivals)
def test_what_is_missing_of_publishers_that_follow_each_other_is_lost(
    arrived: list[list[int]],
) -> None:
    steps = [(bytes([k]), numbers) for k, numbers in enumerate(arrived)]
    gone: tuple[bytes, list[int | None]] = (b"", [])
    expected = sum(numbers[-1] - numbers[0] + 1 - len(numbers) for numbers in arrived)

    earlier = sum(numbers[0] - 1 for numbers in arrived)
    found = counted(*(step for pair in steps for step in (pair, gone)))

    assert found == (expected, True, earlier)


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        # A publisher that restarts between two looks is neither lost nor hides a loss.
        ([(A, [5, 6, 9]), (B, [1, 2, 5])], (2 + 2, True, 4)),
        ([(A, [5, 6, 9]), (B, [3, 4])], (2, True, 4 + 2)),
        ([(A, [5, 6, 9]), (b"", [11])], (2 + 1, True, 4)),
        # Several make losses unknown and are not counted.
        ([(AB, [1, 2, 3])], (0, False, 0)),
        ([(A, [100]), (AB, [1, 101, 2, 102])], (0, False, 99)),
        # One came and went before it could be seen.
        ([(A, [100]), (A, [1, 101, 102])], (0, False, 99)),
        # One is killed and still announced when the next one has come.
        ([(A, [100, 102]), (AB, [1, 3]), (B, [4, 7, 9])], (1 + 1, False, 99)),
        # The middleware gives no numbers.
        ([(A, [None, None])], (0, False, 0)),
    ],
)
def test_losses_are_exact_while_there_is_one_publisher(
    steps: list[tuple[bytes, list[int | None]]], expected: tuple[int, bool, int]
) -> None:
    assert counted(*steps) == expected
