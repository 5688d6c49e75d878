# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags hold what was written, in rosbag2's layout, for every reader."""

import resource
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import yaml
from foreign import STRING, cdr, write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType

from tsobs_ros.bag import BagReader, BagWriter, QosProfile
from tsobs_ros.bag.cdr import MessageSeries
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.metadata import read_metadata
from tsobs_ros.bag.recovery import recover
from tsobs_ros.bag.summary import summarise
from tsobs_ros.bag.verification import verify
from tsobs_ros.errors import BagReadError, BagWriteError

TOPICS = {"/a": STRING, "/b": "sensor_msgs/msg/JointState"}


def records(path: Path) -> Iterator[McapRecord]:
    with path.open("rb") as stream:
        try:
            yield from StreamReader(stream, validate_crcs=True).records
        except EndOfFile:
            return


def test_the_file_carries_its_metadata_and_definitions_as_rosbag2_does(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        for topic, msgtype in TOPICS.items():
            writer.add_topic(topic, msgtype, [QosProfile()])
        writer.write("/a", b"x", 5, 3)
        writer.write("/a", b"y", 4, 2)
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
    assert summary is not None
    for channel in summary.channels.values():
        definition = find_definition(TOPICS[channel.topic])
        assert set(channel.metadata) == {"offered_qos_profiles", "topic_type_hash"}
        assert channel.metadata["topic_type_hash"] == definition.type_hash
        assert summary.schemas[channel.schema_id].data == definition.text.encode()
    carried = [record for record in records(path / "bag_0.mcap") if isinstance(record, Metadata)]
    assert [record.name for record in carried] == ["rosbag2", "rosbag2"]
    first, last = (yaml.safe_load(r.metadata["serialized_metadata"]) for r in carried)
    assert (first["message_count"], first["topics_with_message_count"]) == (0, [])
    in_folder = yaml.safe_load((path / "metadata.yaml").read_text())
    assert last == in_folder["rosbag2_bagfile_information"]


def test_qos_is_the_first_and_what_is_flushed_can_be_read_unfinished(tmp_path: Path) -> None:
    offers = [QosProfile(), QosProfile(reliability="best_effort")]
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/a", STRING, offers)
        writer.add_topic("/a", STRING, [QosProfile(durability="transient_local")])
        writer.write("/a", b"one", 1, 1)
        writer.write("/a", b"two", 2, 2)
        writer.flush()
        writer.write("/a", b"three", 3, 3)
        stored = [r for r in records(tmp_path / "bag" / "bag_0.mcap") if isinstance(r, Message)]
        assert [message.data for message in stored] == [b"one", b"two"]
    assert BagReader(tmp_path / "bag").topics["/a"].qos_profiles == tuple(offers)
    (topic,) = read_metadata(tmp_path / "bag").topics_with_message_count
    assert topic.topic_metadata.offered_qos_profiles == tuple(offers)


@settings(max_examples=20)
@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 9), st.integers(1, 300)), max_size=5)
)
def test_arrays_of_messages_are_in_order_of_log_time(drawn: list[tuple[str, int, int]]) -> None:
    series = [
        MessageSeries(
            f"/{name}", STRING, start + np.arange(count) // 3, np.arange(count),
            np.full((count, 40 * (1 + start)), start, np.uint8),
        )
        for name, start, count in drawn
    ]  # fmt: skip
    with TemporaryDirectory() as folder:
        with BagWriter(Path(folder) / "bag") as writer:
            for name in "abc":
                writer.add_topic(f"/{name}", STRING)
            writer.write_series(series)
        found = list(BagReader(Path(folder) / "bag").messages())
        assert verify(Path(folder) / "bag").messages == len(found)
    expected = [
        (one.topic, STRING, one.data[k].tobytes(), one.log_times[k], one.publish_times[k])
        for one in series
        for k in range(len(one.data))
    ]
    assert found == sorted(expected, key=lambda message: message[3])


@settings(max_examples=10)
@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 60)), max_size=40),
    st.sampled_from(CompressionType),
    st.sets(st.sampled_from(["/a", "/b", "/c"])),
    st.integers(1, 400),
)
def test_topics_that_others_recorded_are_copied_in_the_same_order(
    written: list[tuple[str, int]], compression: CompressionType, topics: set[str], chunk_size: int
) -> None:
    calls = [(1 + "abc".index(name), t, cdr(f"{k}"), 9 + k) for k, (name, t) in enumerate(written)]
    channels = [(f"/{name}", "cdr", 1, {}) for name in "abc"]
    with TemporaryDirectory() as folder:
        source, target = Path(folder) / "x.mcap", Path(folder) / "new"
        options = {"compression": compression, "chunk_size": chunk_size}
        reader = BagReader(write_mcap(source, calls, channels=channels, **options))
        with BagWriter(target) as writer:
            writer.add_topics(one for one in reader.topics.values() if one.name in topics)
            writer.copy_topics(reader, topics)
        expected = [one for one in reader.messages() if one.topic in topics]
        assert list(BagReader(target).messages()) == expected
        assert verify(target).errors == ()


def test_a_topic_is_registered_once_with_a_type_that_there_is(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/a", STRING)
        for call, reason in (
            (lambda: writer.write("/b", b"", 1, 1), "bag: topic /b has not been added"),
            (lambda: writer.add_topic("/a", "std_msgs/msg/Empty"), f"/a is {STRING} already"),
            (lambda: writer.add_topic("/b", "no_msgs/msg/None"), "None is not installed"),
            (lambda: writer.write("/a", b"", -1, 1), "times must be at least 0 and fit 63 bits"),
            (
                lambda: BagWriter(tmp_path / "x", compression="zip"),
                "'zip', there is none, lz4, zstd",
            ),
        ):
            with pytest.raises(BagWriteError, match=reason):
                call()
        assert [topic.name for topic in writer.topics] == ["/a"]


def test_a_closed_bag_stays_as_it_is_after_an_error_too(tmp_path: Path) -> None:
    def write_and_fail() -> None:
        with writer:
            writer.add_topic("/a", STRING)
            writer.write("/a", b"x", 1, 1)
            raise RuntimeError("elsewhere")

    writer = BagWriter(tmp_path / "bag")
    with pytest.raises(RuntimeError, match="elsewhere"):
        write_and_fail()
    content = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    writer.close()
    writer.sync()
    series = MessageSeries("/a", STRING, *np.ones((2, 1), np.int64), np.zeros((1, 4), np.uint8))
    for use in (
        writer.flush,
        lambda: writer.write_series([series]),
        lambda: writer.write("/a", b"", 1, 1),
        lambda: writer.add_topic("/b", STRING),
    ):
        with pytest.raises(BagWriteError, match="bag: the bag is closed"):
            use()
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes() == content
    assert BagReader(tmp_path / "bag").message_count == 1


def test_a_bag_on_a_full_disk_takes_no_more_and_gives_back_what_was_flushed(tmp_path: Path) -> None:
    data, refusal = bytes(100_000), r"bag_0\.mcap: cannot write it: .* too large"
    writer = BagWriter(tmp_path / "bag", compression="none")
    writer.add_topic("/a", STRING)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))
    try:
        with pytest.raises(BagWriteError, match=refusal):
            any(writer.write("/a", data, time, time) for time in range(20))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    # Even now that there is room again: half a chunk is in the file.
    for step in (lambda: writer.write("/a", data, 99, 99), writer.flush, writer.split):
        with pytest.raises(BagWriteError, match=refusal):
            step()
    with pytest.raises(BagWriteError, match=refusal):
        writer.close()
    writer.close()
    with pytest.raises(BagReadError, match=r"has no end: .* 'tsobs bag recover'"):
        BagReader(tmp_path / "bag")
    recover(tmp_path / "bag", tmp_path / "recovered")
    assert [m.log_time for m in BagReader(tmp_path / "recovered").messages()] == list(range(8))


def test_the_last_time_there_is_and_an_empty_bag_are_shown(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "far") as writer:
        writer.add_topic("/a", STRING)
        writer.write("/a", b"", 2**63 - 2, 0)
    assert "Start:        2262-04-11" in summarise(tmp_path / "far").text()
    BagWriter(tmp_path / "empty").close()
    summary = summarise(tmp_path / "empty")
    assert (summary["messages"], summary["start_ns"], summary["duration_ns"]) == (0, None, 0)
    assert "Start:        none" in summary.text()
