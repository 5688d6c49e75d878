# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Chunks split into rows by the compiled core: as message by message, whatever the bytes are."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tsobs_ros.bag.container import MESSAGE, RecordError, split_messages
from tsobs_ros.bag.message_rows import by_size, gather, split_rows
from tsobs_ros.core import native

TOPICS = {1: 0, 2: -1, 3: 1}
TIMES = st.integers(0, 2**63 - 1)
MESSAGES = st.builds(
    lambda channel, log_time, publish_time, data: (
        MESSAGE.pack(5, 22 + len(data), channel, 7, log_time, publish_time) + data
    ),
    st.sampled_from([1, 1, 2, 3]),
    TIMES,
    TIMES,
    st.one_of(st.binary(max_size=40), st.binary(min_size=16, max_size=16)),
)
OTHERS = st.builds(
    lambda kind, body: struct.pack("<BQ", kind, len(body)) + body,
    st.sampled_from([3, 4, 200]),
    st.binary(max_size=20),
)
RECORDS = st.lists(st.one_of(MESSAGES, MESSAGES, OTHERS), max_size=12).map(b"".join)


@st.composite
def changed(draw: st.DrawFn) -> bytes:
    data = bytearray(draw(RECORDS))
    for _ in range(draw(st.integers(0, 2))):
        if data:
            data[draw(st.integers(0, len(data) - 1))] = draw(st.sampled_from([0, 1, 5, 128, 255]))
    return bytes(data[: draw(st.integers(0, len(data)))])


@settings(max_examples=300)
@given(st.one_of(RECORDS, changed()))
def test_rows_are_the_messages(data: bytes) -> None:
    try:
        expected = list(split_messages(data))
    except RecordError:
        assert split_rows(data, 0, TOPICS) is None
        return
    rows = split_rows(data, 9, TOPICS)
    if not {one[0] for one in expected} <= TOPICS.keys():
        assert rows is None
        return
    assert rows is not None
    wanted = [one for one in expected if TOPICS[one[0]] >= 0]
    assert rows.topics.tolist() == [TOPICS[one[0]] for one in wanted]
    assert rows.log_times.view(np.uint64).tolist() == [one[1] for one in wanted]
    assert rows.publish_times.view(np.uint64).tolist() == [one[2] for one in wanted]
    assert set(rows.chunks.tolist()) <= {9}
    for size, places in by_size(rows):
        found = gather(rows.take(places), {9: np.frombuffer(data, np.uint8)}, size)
        assert [row.tobytes() for row in found] == [wanted[place][4] for place in places]


def test_room_is_looked_at() -> None:
    data = MESSAGE.pack(5, 22, 1, 0, 0, 0) * 2
    assert native.messages_split(data, np.empty((5, 1), np.int64)) == -1
    assert native.messages_split(b"", np.empty((5, 0), np.int64)) == 0
    with pytest.raises(ValueError, match="messages_split: found: expected 5 rows"):
        native.messages_split(data, np.empty(7, np.int64))
