# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of our writer: byte for byte those of the library."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.definitions import MessageDefinition
from tsobs_ros.bag.file_writer import COMPRESSIONS, FileWriter
from tsobs_ros.bag.metadata import TopicInfo
from tsobs_ros.bag.writer import packed

CHUNK_SIZE = 400
TIMES = st.integers(0, 2**63 - 1)
MESSAGES = st.tuples(st.integers(1, 3), TIMES, st.binary(max_size=150), TIMES)
STEPS = st.lists(
    st.one_of(MESSAGES, st.just("flush"), st.just("metadata"), st.just("topic")), max_size=40
)


def by_library(compression: str, steps: Callable[[Any], None]) -> bytes:
    stream = BytesIO()
    writer = Writer(stream, CHUNK_SIZE, CompressionType[compression.upper()])
    writer.start("ros2", "a library")
    steps(writer)
    writer.finish()
    return stream.getvalue()


def by_ours(compression: str, steps: Callable[[FileWriter], None]) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.mcap"
        writer = FileWriter(path, "a library", compression, CHUNK_SIZE)
        steps(writer)
        writer.finish()
        writer.close()
        return path.read_bytes()


def topic(number: int) -> TopicInfo:
    definition = MessageDefinition("a/msg/B", "text", "")
    return TopicInfo(f"/t{number}", "a/msg/B", definition=definition)


@settings(max_examples=60)
@given(STEPS, st.sampled_from(COMPRESSIONS))
def test_a_file_has_the_bytes_that_the_library_writes(steps: list[Any], compression: str) -> None:
    def library(writer: Any) -> None:
        def add_topic(number: int) -> None:
            if number == 1:
                writer.register_schema("a/msg/B", "ros2msg", b"text")
            metadata = {"offered_qos_profiles": "[]", "topic_type_hash": ""}
            writer.register_channel(f"/t{number}", "cdr", 1, metadata)

        run(writer, add_topic, writer.add_message)

    def ours(writer: FileWriter) -> None:
        def add(channel: int, log_time: int, data: bytes, publish_time: int) -> None:
            writer.add_message(f"/t{channel}", data, log_time, publish_time)

        run(writer, lambda number: writer.add_topic(topic(number)), add)

    def run(writer: Any, add_topic: Callable[[int], None], add: Callable[..., None]) -> None:
        for number in (1, 2, 3):
            add_topic(number)
        for place, step in enumerate(steps):
            if step == "flush":
                writer.flush()
            elif step == "metadata":
                writer.flush()  # the library puts it before the chunk in progress
                writer.add_metadata("rosbag2", {"key": "value"})
            elif step == "topic":
                add_topic(10 + place)
            else:
                add(*step)

    assert by_ours(compression, ours) == by_library(compression, library)


@st.composite
def series(draw: st.DrawFn) -> list[tuple[int, MessageSeries]]:
    found = []
    for _ in range(draw(st.integers(1, 4))):
        count, size = draw(st.integers(1, 12)), draw(st.integers(0, 500))
        numbers = np.array(
            draw(st.lists(TIMES, min_size=2 * count, max_size=2 * count)), np.int64
        ).reshape(2, count)
        data = np.arange(count * size, dtype=np.uint8).reshape(count, size)
        found.append((draw(st.integers(1, 3)), MessageSeries("/t", "a/msg/B", *numbers, data)))
    return found


@settings(max_examples=40)
@given(series(), series(), st.sampled_from(COMPRESSIONS))
def test_arrays_of_messages_are_written_as_one_by_one(
    first: list[Any], second: list[Any], compression: str
) -> None:
    def together(writer: FileWriter) -> None:
        for each in (first, second):
            writer.add_records(packed(each))

    def one_by_one(writer: Any) -> None:
        for each in (first, second):
            messages = [(channel, *one) for channel, own in each for one in own.messages()]
            for channel, _, _, data, log_time, publish_time in sorted(messages, key=lambda m: m[4]):
                writer.add_message(channel, log_time, data, publish_time)

    assert by_ours(compression, together) == by_library(compression, one_by_one)
