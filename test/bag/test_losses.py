# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Losses are counted where the numbering can tell, and disclaimed where it cannot."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from tsobs_ros.bag.losses import LossCounter


@st.composite
def batches_of_survivors(draw: st.DrawFn) -> list[list[int]]:
    survivors = sorted(draw(st.sets(st.integers(1, 60), min_size=1)))
    cuts = sorted(draw(st.lists(st.integers(0, len(survivors)), max_size=4)))
    edges = [0, *cuts, len(survivors)]
    return [survivors[a:b] for a, b in itertools.pairwise(edges)]


@given(batches_of_survivors())
def test_every_gap_of_a_single_publisher_is_counted(batches: list[list[int]]) -> None:
    counter = LossCounter()
    for batch in batches:
        counter.observe(batch, publishers=1)
    seen = [sequence for batch in batches for sequence in batch]
    assert counter.lost == seen[-1] - seen[0] + 1 - len(seen)
    assert counter.complete


def test_what_came_before_the_first_message_is_not_lost() -> None:
    counter = LossCounter()
    counter.observe([1000, 1001], publishers=1)
    assert counter.lost == 0


def test_a_restarted_publisher_is_not_a_loss() -> None:
    counter = LossCounter()
    counter.observe([7, 8, 1, 2, 4], publishers=1)
    assert counter.lost == 1
    assert counter.complete


def test_two_publishers_are_not_told_apart() -> None:
    counter = LossCounter()
    counter.observe([100, 5, 101, 6], publishers=2)
    assert counter.lost == 0
    assert not counter.complete


def test_messages_of_a_publisher_that_left_are_not_gaps() -> None:
    counter = LossCounter()
    counter.observe([100, 5], publishers=2)
    counter.observe([101, 6], publishers=1)
    counter.observe([7, 9], publishers=1)
    assert counter.lost == 1


def test_a_middleware_without_numbers_is_admitted() -> None:
    counter = LossCounter()
    counter.observe([None, None], publishers=1)
    assert counter.lost == 0
    assert not counter.complete
