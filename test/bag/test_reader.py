# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The reader gives messages in log order, and says clearly why it cannot."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from foreign import CHANNEL, SCHEMA, STRING, cdr, write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType

from tsobs_ros.bag import BagReader, BagWriter, QosProfile
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.bag.recovery import recover
from tsobs_ros.errors import BagReadError


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    with BagWriter(tmp_path / "bag", max_duration_ns=10) as writer:
        writer.add_topic("/a", STRING, [QosProfile()])
        writer.add_topic("/b", STRING)
        for topic, time in (("/a", 5), ("/b", 3), ("/a", 15), ("/b", 14), ("/a", 12)):
            writer.write(topic, cdr(f"{topic} {time}"), time, time - 1)
    return tmp_path / "bag"


def test_messages_and_topics_are_those_of_all_files_in_log_order(bag: Path) -> None:
    reader = BagReader(bag)
    assert len(reader.files) == 2
    expected = [("/b", 3), ("/a", 5), ("/a", 12), ("/b", 14), ("/a", 15)]
    assert [(m.topic, m.log_time) for m in reader.messages()] == expected
    assert next(reader.messages()) == BagMessage("/b", STRING, cdr("/b 3"), 3, 2)
    decoded = list(reader.decoded())
    assert [m.message.data for m in decoded] == [f"{topic} {time}" for topic, time in expected]
    assert [(m.topic, m.type, m.publish_time) for m in decoded[:1]] == [("/b", STRING, 2)]
    assert {m.topic for m in reader.decoded({"/a"}, 6, 15)} == {"/a"}
    assert list(reader.messages([])) == []
    assert {t.name: (t.type, t.count) for t in reader.topics.values()} == {
        "/a": (STRING, 3),
        "/b": (STRING, 2),
    }
    assert (reader.message_count, reader.start_time, reader.end_time) == (5, 3, 15)


timed = st.lists(st.tuples(st.sampled_from(["/a", "/b"]), st.integers(0, 20)), max_size=40)


@settings(max_examples=12)
@given(timed, st.integers(1, 6), st.integers(0, 21), st.integers(0, 21), st.integers(1, 3))
def test_any_order_of_recording_is_read_in_log_order(
    written: list[tuple[str, int]], chunk: int, start: int, end: int, depth: int
) -> None:
    with TemporaryDirectory() as folder:
        with BagWriter(Path(folder) / "bag", max_duration_ns=12) as writer:
            for topic in ("/a", "/b"):
                writer.add_topic(topic, STRING)
            for number, (topic, time) in enumerate(written):
                writer.write(topic, b"%d" % number, time, 0)
                if number % chunk == 0:
                    writer.flush()
        reader = BagReader(Path(folder) / "bag")
        expected = sorted((time, number, topic) for number, (topic, time) in enumerate(written))
        assert [(m.log_time, int(m.data), m.topic) for m in reader.messages()] == expected
        for topic in ("/a", "/b"):
            of_topic = [entry for entry in expected if entry[2] == topic]
            part = reader.messages([topic], start, end)
            assert [int(m.data) for m in part] == [e[1] for e in of_topic if start <= e[0] < end]
            before = [e[1] for e in of_topic if e[0] < start][-depth:]
            found = reader.last_before(start, [topic], depth)
            assert sorted(m.log_time for m in found) == sorted(written[n][1] for n in before)


def test_damage_is_noticed_where_it_is_reached_and_chunks_out_of_reach_are_not_read(
    tmp_path: Path,
) -> None:
    with BagWriter(tmp_path / "bag", compression="none") as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, STRING)
        for time, (topic, data) in enumerate(
            [("/a", b"first"), ("/a", b"damaged"), ("/b", b"damaged"), ("/a", b"whole")]
        ):
            writer.write(topic, data, time, time)
            writer.flush()
    path = tmp_path / "bag" / "bag_0.mcap"
    path.write_bytes(path.read_bytes().replace(b"damaged", b"DAMAGED"))
    reader = BagReader(tmp_path / "bag")
    assert [m.data for m in reader.messages(start_ns=3)] == [b"whole"]
    assert [m.data for m in reader.last_before(9, ["/a"])] == [b"whole"]
    messages = reader.messages(["/a"])
    assert next(messages).data == b"first"
    with pytest.raises(BagReadError, match=r"bag_0\.mcap: the file is damaged: .*crc"):
        next(messages)


def test_chunks_without_indexes_are_read_and_files_without_chunks_once_recovered(
    tmp_path: Path,
) -> None:
    """Rosbag2's preset `fastwrite` makes no chunks."""
    bare = write_mcap(tmp_path / "bare.mcap", [(1, 5, cdr("x"), 5)], use_chunking=False)
    with pytest.raises(BagReadError, match=r"no chunks.*'tsobs bag recover' makes"):
        BagReader(bare)
    recover(bare, tmp_path / "bare")
    assert [m.data for m in BagReader(tmp_path / "bare").messages()] == [cdr("x")]
    path = write_mcap(
        tmp_path / "x.mcap",
        [(1 + time % 2, time, bytes(400_000), time) for time in (5, 3, 9, 1)],
        channels=[CHANNEL, ("/b", *CHANNEL[1:])],
        index_types=IndexType.CHUNK,
        compression=CompressionType.LZ4,
        enable_crcs=False,
    )
    reader = BagReader(path)
    assert [m.log_time for m in reader.messages()] == [1, 3, 5, 9]
    assert [m.log_time for m in reader.messages(["/b"], 3, 9)] == [3, 5]
    assert list(reader.messages(["/a"])) == []


def test_what_is_not_there_is_named(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(BagReadError, match="bag: no topic /c; topics: /a, /b"):
        BagReader(bag).messages(["/a", "/c"])
    with pytest.raises(BagReadError, match=r"none\.mcap: there is no such file"):
        BagReader(tmp_path / "none.mcap")
    with pytest.raises(BagReadError, match=r"not a bag folder, it has no metadata\.yaml$"):
        BagReader(tmp_path)
    (bag / "bag_1.mcap").unlink()
    with pytest.raises(BagReadError, match=r"bag_1\.mcap: cannot read it"):
        BagReader(bag)
    (tmp_path / "text.mcap").write_text("no bag")
    with pytest.raises(BagReadError, match=r"text\.mcap: not an MCAP file"):
        BagReader(tmp_path / "text.mcap")
    metadata = bag / "metadata.yaml"
    for text, reason in (
        (metadata.read_text().replace(": mcap", ": sqlite3"), "'sqlite3' is not supported"),
        ("a: 1", "not the metadata of a bag: it has no rosbag2_bagfile_information"),
    ):
        metadata.write_text(text)
        with pytest.raises(BagReadError, match=reason):
            BagReader(bag)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"profile": "ros1"}, "not a bag of ROS 2: its profile is 'ros1'"),
        ({"channels": [("/a", "json", 1, {})]}, "/a: is encoded in 'json', not in cdr"),
        ({"channels": [("/a", "cdr", 7, {})]}, "/a: has no type"),
        ({"repeat_channels": False}, "damaged: 1 channels, but 0 in the index"),
    ],
)  # fmt: skip
def test_what_is_no_bag_of_ros_2_is_refused(
    tmp_path: Path, options: dict[str, Any], reason: str
) -> None:
    path = write_mcap(tmp_path / "x.mcap", [(1, 1, b"", 1)], **options)
    with pytest.raises(BagReadError, match=rf"x\.mcap: .*{reason}"):
        list(BagReader(path).messages())


@pytest.mark.parametrize(
    ("schema", "data", "reason"),
    [
        ((STRING, "ros2idl", b""), cdr("x"), "defined in 'ros2idl', but only ros2msg"),
        ((STRING, "ros2msg", b"string \x1b[2J\n"), cdr("x"),
         "the definition of std_msgs/msg/String is malformed"),
        (SCHEMA, b"\x00\x01\x00\x00\xff\x00", "the message of /a at 1 ns is not a std_msgs/msg/St"),
    ],
)  # fmt: skip
def test_what_cannot_be_decoded_is_read_and_its_decoding_refused(
    tmp_path: Path, capsys, schema: tuple[str, str, bytes], data: bytes, reason: str
) -> None:
    path = write_mcap(tmp_path / "x.mcap", [(1, 1, data, 1)], schemas=[schema])
    reader = BagReader(path)
    assert [m.data for m in reader.messages()] == [data]
    with pytest.raises(BagReadError, match=reason):
        list(reader.decoded())
    assert capsys.readouterr().err == ""  # nothing of a hostile definition
