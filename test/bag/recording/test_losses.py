# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Losses are exact, publisher by publisher, however the messages come in."""

import random
from collections import defaultdict

from hypothesis import given
from hypothesis import strategies as st

from tsobs_ros.bag.recording import losses
from tsobs_ros.bag.recording.losses import LossCounter

Numbers = dict[bytes, set[int]]

# What arrives of each publisher, some numbers missing.
arrivals = st.dictionaries(
    st.binary(min_size=16, max_size=16), st.sets(st.integers(1, 40), min_size=1), max_size=5
)


def missing(arrived: Numbers) -> dict[bytes, int]:
    return {who: max(them) - min(them) + 1 - len(them) for who, them in arrived.items()}


@given(arrivals, st.randoms(use_true_random=False))
def test_the_publishers_of_a_topic_are_told_apart(arrived: Numbers, rng: random.Random) -> None:
    streams = {who: sorted(them) for who, them in arrived.items()}
    counter = LossCounter()
    while streams:
        who = rng.choice(sorted(streams))
        assert counter.is_new(who, streams[who].pop(0))
        if not streams[who]:
            del streams[who]
    assert counter.lost_by_publisher == missing(arrived)
    assert counter.lost == sum(missing(arrived).values())
    assert counter.complete


@given(arrivals, st.integers(1, 3), st.randoms(use_true_random=False))
def test_a_message_is_new_once_however_often_and_late_it_comes(
    arrived: Numbers, subscriptions: int, rng: random.Random
) -> None:
    messages = [(who, number) for who, them in arrived.items() for number in them] * subscriptions
    rng.shuffle(messages)
    counter = LossCounter()
    new = defaultdict(list)
    for who, number in messages:
        if counter.is_new(who, number):
            new[who].append(number)
    assert {who: sorted(them) for who, them in new.items()} == {
        who: sorted(them) for who, them in arrived.items()
    }
    assert counter.lost_by_publisher == missing(arrived)


def test_what_was_sent_before_the_first_message_is_not_lost() -> None:
    counter = LossCounter()
    assert counter.is_new(b"a", 1000)
    assert counter.is_new(b"a", 1001)
    assert counter.lost == 0


def test_a_new_publisher_begins_anew() -> None:
    counter = LossCounter()
    for who, number in ((b"a", 7), (b"a", 9), (b"b", 1), (b"b", 2), (b"b", 4)):
        assert counter.is_new(who, number)
    assert counter.lost_by_publisher == {b"a": 1, b"b": 1}


def test_a_middleware_without_numbers_is_admitted() -> None:
    counter = LossCounter()
    assert counter.is_new(b"a", None)
    assert counter.is_new(b"a", None)
    assert counter.lost == 0
    assert not counter.complete


def test_countless_publishers_and_gaps_take_no_memory(monkeypatch) -> None:
    monkeypatch.setattr(losses, "_MAX_PUBLISHERS", 4)
    monkeypatch.setattr(losses, "_MAX_OPEN_GAPS", 4)
    counter = LossCounter()
    for visit in range(100):
        assert counter.is_new(b"host", 2 * visit)
        for number in (1, 3):
            assert counter.is_new(b"guest %d" % visit, number)
    assert counter.lost == 99 + 100
    assert counter.lost_by_publisher[b"host"] == 99
    assert len(counter.lost_by_publisher) < 12
    assert not counter.is_new(b"host", 1), "a gap so old is taken to stay"
    assert counter.is_new(b"host", 197)
