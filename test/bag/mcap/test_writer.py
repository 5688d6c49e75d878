# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The MCAP writer against the library's: the same bytes for the same calls."""

from io import BytesIO
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.exceptions import UnsupportedCompressionError
from mcap.writer import CompressionType, Writer

from tsobs_ros.bag.mcap.writer import McapWriter

COMPRESSIONS = {
    "": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}
TIMES = st.integers(0, 2**63 - 1)
CALLS = st.lists(
    st.one_of(
        st.tuples(st.just("message"), st.integers(1, 3), TIMES, st.binary(max_size=80), TIMES),
        st.just(("flush",)),
        st.just(("channel",)),
        st.tuples(st.just("metadata"), st.dictionaries(st.text(max_size=5), st.text(max_size=5))),
    ),
    max_size=40,
)


def written(writer: Any, calls: list[tuple[Any, ...]], stream: BytesIO) -> bytes:
    writer.start(profile="ros2", library="some library")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
    for place in range(3):
        writer.register_channel(f"/topic_{place}", "cdr", schema, {"offered_qos_profiles": ""})
    for name, *arguments in calls:
        if name == "message":
            writer.add_message(*arguments)
        elif name == "flush":
            writer.flush()
        elif name == "channel":
            writer.register_channel("/late", "cdr", schema, {})
        else:
            writer.flush()
            writer.add_metadata("rosbag2", *arguments)
    writer.finish()
    return stream.getvalue()


@given(CALLS, st.sampled_from(sorted(COMPRESSIONS)), st.sampled_from([1, 300, 10_000]))
def test_the_bytes_are_those_of_the_library(calls, compression: str, chunk_size: int) -> None:
    ours, theirs = BytesIO(), BytesIO()
    library = Writer(theirs, chunk_size=chunk_size, compression=COMPRESSIONS[compression])

    assert written(McapWriter(ours, chunk_size, compression), calls, ours) == written(
        library, calls, theirs
    )


def test_an_unknown_compression_is_refused() -> None:
    with pytest.raises(UnsupportedCompressionError):
        McapWriter(BytesIO(), 100, "zip")
