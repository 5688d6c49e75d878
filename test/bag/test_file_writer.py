# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of our writer: byte for byte those of the library."""

from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.file_writer import COMPRESSIONS, FileWriter
from tsobs_ros.bag.metadata import TopicInfo

CHUNK_SIZE = 400
TIMES = st.integers(0, 2**63 - 1)
MESSAGES = st.tuples(st.integers(1, 3), TIMES, st.binary(max_size=150), TIMES)


OTHERS = st.sampled_from(["flush", "metadata", "topic"])
STEPS = st.lists(st.one_of(MESSAGES, MESSAGES, OTHERS), max_size=25)


def by_library(steps: list[Any], compression: str) -> bytes:
    stream = BytesIO()
    writer: Any = Writer(stream, CHUNK_SIZE, CompressionType[compression.upper()])
    writer.start("ros2", "a library")
    writer.register_schema("a/msg/B", "ros2msg", b"text")
    for place, step in enumerate(steps):
        if step == "topic":
            metadata = {"offered_qos_profiles": "[]", "topic_type_hash": ""}
            writer.register_channel(f"/t{place + 1}", "cdr", 1, metadata)
        elif step in ("flush", "metadata"):
            writer.flush()  # the library puts metadata before the chunk in progress
            if step == "metadata":
                writer.add_metadata("rosbag2", {"key": "value"})
        else:
            writer.add_message(*step)
    writer.finish()
    return stream.getvalue()


def by_ours(steps: list[Any], compression: str, path: Path) -> bytes:
    writer = FileWriter(path, "a library", compression, CHUNK_SIZE)
    for place, step in enumerate(steps):
        if step == "topic":
            definition = MessageDefinition("a/msg/B", "text", "")
            writer.add_topic(TopicInfo(f"/t{place + 1}", "a/msg/B", definition=definition))
        elif step == "flush":
            writer.flush()
        elif step == "metadata":
            writer.add_metadata("rosbag2", {"key": "value"})
        else:
            channel, log_time, data, publish_time = step
            writer.add_message(f"/t{channel}", data, log_time, publish_time)
    writer.finish()
    writer.close()
    return path.read_bytes()


@settings(max_examples=40)
@given(STEPS, st.sampled_from(COMPRESSIONS))
def test_a_file_has_the_bytes_that_the_library_writes(steps: list[Any], compression: str) -> None:
    steps = ["topic"] * 3 + steps
    with TemporaryDirectory() as folder:
        ours = by_ours(steps, compression, Path(folder) / "x.mcap")
    assert ours == by_library(steps, compression)
