# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Losses are exact while a topic has one publisher, and admitted to be unknown otherwise."""

from hypothesis import given
from hypothesis import strategies as st

from tsobs_ros.bag.losses import LossCounter

A, B = b"a", b"b"
AB = A + B


def counted(*steps: tuple[bytes, list[int | None]]) -> tuple[int, bool]:
    """Count numbers that arrive while publishers are there, each looked at twice in between."""
    counter = LossCounter()
    for publishers, numbers in steps:
        there = frozenset(bytes([p]) for p in publishers)
        counter.add(numbers, lambda there=there: there)
        counter.see(there)
        counter.see(there)
    return counter.lost, counter.is_exact


# What arrives of one publisher after the other, in order, some numbers missing.
arrivals = st.lists(st.sets(st.integers(1, 40), min_size=1).map(sorted), max_size=5)


@given(arrivals)
def test_what_is_missing_of_publishers_that_follow_each_other_is_lost(
    arrived: list[list[int]],
) -> None:
    steps = [(bytes([k]), numbers) for k, numbers in enumerate(arrived)]
    gone: tuple[bytes, list[int | None]] = (b"", [])
    expected = sum(numbers[-1] - numbers[0] + 1 - len(numbers) for numbers in arrived)

    assert counted(*(step for pair in steps for step in (pair, gone))) == (expected, True)


def test_a_publisher_that_restarts_between_two_looks_is_neither_lost_nor_hides_a_loss() -> None:
    assert counted((A, [5, 6, 9]), (B, [12, 1, 2, 5])) == (2 + 2, False)
    assert counted((A, [5, 6, 9]), (B, [1, 2, 5])) == (2 + 2, True)
    assert counted((A, [5, 6, 9]), (b"", [11])) == (2 + 1, True)


def test_several_publishers_make_losses_unknown_and_are_not_counted() -> None:
    assert counted((AB, [1, 2, 3])) == (0, False)
    assert counted((A, [100]), (AB, [1, 101, 2, 102])) == (0, False)
    # One came and went before it could be seen.
    assert counted((A, [100]), (A, [1, 101, 102])) == (0, False)
    # One is killed and still announced when the next one has come: counted again when it is gone.
    assert counted((A, [100, 102]), (AB, [1, 3]), (B, [4, 7, 9])) == (1 + 3, False)


def test_a_middleware_without_numbers_is_admitted() -> None:
    assert counted((A, [None, None])) == (0, False)
