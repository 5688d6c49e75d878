# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recovery loses only what is damaged and makes nothing up, whatever happens to a bag."""

import os
import random
import re
import struct
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

import pytest
import zstandard
from foreign import CHANNEL, SCHEMA, STRING, Entry, cdr, places, write_mcap
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import Reader as RosbagsReader

from tsobs_ros.bag import BagReader, BagWriter, QosProfile
from tsobs_ros.bag.container import RECORD
from tsobs_ros.bag.damaged import FileWalker
from tsobs_ros.bag.metadata import read_metadata
from tsobs_ros.bag.recovery import Recovery, recover
from tsobs_ros.bag.summary import summarise
from tsobs_ros.bag.verification import verify
from tsobs_ros.errors import BagReadError, BagWriteError

BOMB = zstandard.compress(bytes(2**28))


def scanned(data: bytes) -> list[tuple[bytes, int, int]]:
    """Return data and times of the messages found, without writing a bag."""
    with TemporaryFile() as stream:
        stream.write(data)
        stream.flush()
        return [
            (content.data[begin : begin + size], log_time, publish_time)
            for part in FileWalker(stream, len(data)).parts()
            if (content := part.content)
            for _, log_time, publish_time, begin, size, _ in content.rows.tolist()
        ]


def recovered(folder: Path, data: bytes) -> tuple[Recovery, list[Entry]]:
    """Recover a file and return what its new bag holds, in order of recording."""
    path = folder / "broken.mcap"
    path.write_bytes(data)
    result = recover(path, folder / "new")
    return result, in_recorded_order(folder / "new")


def in_recorded_order(bag: Path) -> list[Entry]:
    messages = [Entry(m.topic, *m[2:]) for m in BagReader(bag).messages()]
    return sorted(messages, key=lambda e: e.publish_time)


def zero(data: bytes, start: int, end: int) -> bytes:
    return data[:start] + bytes(end - start) + data[end:]


def test_a_damaged_chunk_is_dropped_and_what_it_held_is_missing(tmp_path: Path) -> None:
    made = make(random.Random(1))
    (start, end), (first, lost, *rest) = made.chunks[1], made.entries
    result, found = recovered(tmp_path, zero(made.data, end - 12, end - 8))
    (part,) = result.files[0].damage
    assert (part.offset, part.size) == (start, end - start)
    assert found == [*first, *(entry for entries in rest for entry in entries)]
    assert result.files[0].missing.total() == len(lost)
    assert re.search(rf"bytes {part.offset} to .*: .*checksum", result.text())
    assert "NOT EVERYTHING" in result.text()
    assert result.as_mapping()["files"][0]["damage"] == [vars(part)]


def test_messages_outside_of_chunks_are_recovered_up_to_any_cut(tmp_path: Path) -> None:
    messages = [(1, 5 + number, cdr("x" * 9), number) for number in range(20)]
    path = write_mcap(tmp_path / "x.mcap", messages, enable_crcs=False, use_chunking=False)
    data = path.read_bytes()
    ends = [end for _, end in places(data, Opcode.MESSAGE)]
    for cut in range(0, len(data), 7):
        found = [m[2] for m in scanned(data[:cut] + bytes(cut % 2 * 50))]
        assert found == list(range(len(found)))
        # Whether the zeros at the end of the last message are its own is unknown.
        assert len(found) >= sum(end <= cut for end in ends) - 1
    text = recover(path, tmp_path / "new").text()
    assert "unchecked 20: no checksum" in text
    assert "20 UNCHECKED, damage in them is not noticed" in text


def make_split(path: Path) -> list[Entry]:
    """Write a bag of several files, with log times out of order."""
    entries = [Entry("/ab"[: 2 + n % 2], cdr("x" * n), 10**18 + (n ^ 1), n) for n in range(15)]
    with BagWriter(path, custom_data={"why": "a test"}, max_duration_ns=4) as writer:
        for topic in ("/a", "/ab"):
            writer.add_topic(topic, STRING, [QosProfile(durability="transient_local")])
        for each in entries:
            writer.write(*each)
    assert len(list(path.glob("*.mcap"))) > 2
    return entries


def cut_last_file(bag: Path) -> None:
    last = max(bag.glob("*.mcap"))
    last.write_bytes(last.read_bytes()[:-200])


def forget_last_file(bag: Path) -> None:
    """Leave the bag as a recorder that was killed between a split and the next sync does."""
    cut_last_file(bag)
    path, last = bag / "metadata.yaml", max(bag.glob("*.mcap")).name
    text = path.read_text().replace(f"  - {last}\n", "")
    path.write_text(re.sub(rf"  - path: {last}\n(    .*\n)+", "", text))


@pytest.mark.parametrize(
    "damage",
    [cut_last_file, forget_last_file, lambda bag: (bag / "metadata.yaml").write_bytes(b"\xff")],
)
def test_a_folder_is_recovered_file_by_file_and_not_touched(
    tmp_path: Path, damage: Callable[[Path], object]
) -> None:
    bag, new = tmp_path / "bag", tmp_path / "new"
    entries = make_split(bag)
    damage(bag)
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in bag.iterdir()}
    read: list[int] = []
    info = summarise(bag)
    result = recover(bag, new, progress=read.append)
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in bag.iterdir()} == before
    assert sum(read) == sum(path.stat().st_size for path in bag.glob("*.mcap"))
    assert result.is_whole == ("nothing known to be lost" in result.text())
    assert in_recorded_order(new) == entries
    assert verify(new).holds
    if info["problem"]:
        assert info["messages"] == len(entries)
        assert info.text().startswith("NOT FINISHED: ")
    assert len(list(new.iterdir())) == len(list(bag.iterdir()))
    assert read_metadata(new).custom_data == {"why": "a test"}


def test_files_that_cannot_be_read_do_not_keep_the_others_from_being_recovered(
    tmp_path: Path,
) -> None:
    make_split(tmp_path / "bag")
    files = sorted((tmp_path / "bag").glob("*.mcap"))
    left = [entry for path in files[3:] for entry in scanned(path.read_bytes())]
    files[0].unlink()
    files[1].write_bytes(b"")
    files[2].unlink()
    os.mkfifo(files[2])
    result = recover(tmp_path / "bag", tmp_path / "new")
    assert [file.error for file in result.files[:3]] == [
        "No such file or directory", "", "not a regular file",
    ]  # fmt: skip
    assert "bag_0.mcap: not read: No such file" in result.text()
    assert not result.is_whole
    assert [e[1:] for e in in_recorded_order(tmp_path / "new")] == left


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "it holds no messages"),
        (bytes(10_000), "nothing but zeros"),
        (random.Random(1).randbytes(100_000), "not a record|chunk"),
    ],
)
def test_if_nothing_can_be_recovered_nothing_is_made(
    tmp_path: Path, content: bytes, reason: str
) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BagReadError, match=rf"no message can be recovered: x\.mcap: .*({reason})"):
        recover(path, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_outputs_and_inputs_that_cannot_be_are_named(tmp_path: Path) -> None:
    with pytest.raises(BagReadError, match="none: there is no such file"):
        recover(tmp_path / "none", tmp_path / "new")
    with pytest.raises(BagReadError, match=r"not a bag, there is no \.mcap file in it"):
        recover(tmp_path, tmp_path / "new")
    make_split(tmp_path / "bag")
    with pytest.raises(BagWriteError, match=r"is inside of the bag .*, which is not touched"):
        recover(tmp_path / "bag", tmp_path / "bag" / "new")
    (tmp_path / "new").mkdir()
    with pytest.raises(BagWriteError, match="new: exists already, bags are not overwritten"):
        recover(tmp_path / "bag", tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []


def hostile_chunk(length: int, size: int, data: bytes) -> bytes:
    """Return a chunk that states a length of its record and of its decompressed content."""
    head = struct.pack("<QQQII", 0, 0, size, 0, 4) + b"zstd" + struct.pack("<Q", length - 44)
    return RECORD.pack(Opcode.CHUNK, length) + head + data


@pytest.mark.parametrize(
    ("length", "size"),
    [(2**62, 100), (2**27, 2**62), (44 + len(BOMB), 100), (44 + len(BOMB), 2**40), (2**20, 1_000)],
)
def test_a_stated_length_costs_no_memory(tmp_path: Path, length: int, size: int) -> None:
    made = make(random.Random(1))
    tracemalloc.start()
    try:
        _, found = recovered(
            tmp_path, made.data[: made.chunks[0][1]] + hostile_chunk(length, size, BOMB)
        )
        assert found == made.entries[0]
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()


def test_what_no_bag_can_hold_is_counted(tmp_path: Path) -> None:
    schemas = [
        SCHEMA,
        ("std_msgs/msg/Empty", "ros2msg", b""),
        ("std_msgs/msg/Bool", "ros2idl", b"module std_msgs {};"),
    ]
    channels = [
        CHANNEL,
        ("/a", "cdr", 2, {}),
        ("/json", "json", 1, {}),
        ("/lost", "cdr", 9, {}),
        ("/idl", "cdr", 3, {"offered_qos_profiles": "["}),
    ]
    messages = [(id_, 5, cdr("x"), 5) for id_ in range(1, 6)] + [(1, 2**63, cdr("x"), 5)]
    path = write_mcap(
        tmp_path / "x.mcap", messages, profile="x", schemas=schemas, channels=channels
    )
    result = recover(path, tmp_path / "new")
    (file,) = result.files
    assert file.kept == {"/a": 1, "/idl": 1}
    assert sorted(file.dropped) == [
        "/a: is std_msgs/msg/Empty here, but std_msgs/msg/String before",
        "/a: times do not fit 63 bits",
        "/json: is encoded in 'json', not in cdr",
        "/lost: has no type",
    ]
    assert "its profile is 'x', expected 'ros2'" in result.text()
    assert "dropped 1: /json" in result.text()
    definition = BagReader(tmp_path / "new").topics["/idl"].definition
    assert definition == ("std_msgs/msg/Bool", "module std_msgs {};", "", "ros2idl")


BYTES = "std_msgs/msg/UInt8MultiArray"


class Made(NamedTuple):
    """A file, and the messages in it by chunk."""

    data: bytes
    chunks: list[tuple[int, int]]
    entries: list[list[Entry]]


def make(choose: random.Random, topics: str = "abc", nested: tuple[bytes, ...] = ()) -> Made:
    """Return a finished file of our layout with some chunks; its messages may carry others."""
    stream, entries = BytesIO(), list[list[Entry]]()
    compression = choose.choice(list(CompressionType))
    writer: Any = Writer(stream, 10**9, compression)
    writer.start("ros2", "some recorder")
    schema = writer.register_schema(BYTES, "ros2msg", b"uint8[] data\n")
    ids = {f"/{name}": writer.register_channel(f"/{name}", "cdr", schema) for name in topics}
    time = choose.randrange(10**18)
    for _ in range(choose.randint(2, 7)):
        entries.append([])
        for _ in range(choose.randint(1, 8)):
            topic = choose.choice(list(ids))
            payload = choose.choice([*nested, choose.randbytes(choose.randrange(150))])
            time += choose.randrange(1, 1000)
            data = b"\0\1\0\0" + struct.pack("<I", len(payload)) + payload
            entry = Entry(topic, data, time + choose.randrange(2000), time)
            writer.add_message(ids[topic], entry[2], entry[1], entry[3])
            entries[-1].append(entry)
        writer.flush()
    writer.finish()
    made = stream.getvalue()
    return Made(made, places(made, Opcode.CHUNK), entries)


def flip(made: Made, choose: random.Random) -> bytes:
    data = bytearray(made.data)
    for _ in range(choose.randint(1, 4)):
        data[choose.randrange(len(data))] ^= 1 << choose.randrange(8)
    return bytes(data)


def truncate(made: Made, choose: random.Random) -> bytes:
    return made.data[: choose.randrange(len(made.data))] + bytes(choose.choice([0, 0, 300]))


def double_chunk(made: Made, choose: random.Random) -> bytes:
    (start, end), (_, at) = choose.choice(made.chunks), choose.choice(made.chunks)
    return made.data[:at] + made.data[start:end] + made.data[at:]


def chunk_of_another_file(made: Made, choose: random.Random) -> bytes:
    other = make(choose, topics="xyz")
    start, end = other.chunks[0]  # it describes its topics, as does the first one of ours
    at = choose.choice(made.chunks)[1]
    return made.data[:at] + other.data[start:end] + made.data[at + end - start :]


def zero_block(made: Made, choose: random.Random) -> bytes:
    start = choose.randrange(len(made.data))
    end = min(len(made.data), start + choose.choice([1, 20, 512]))
    return made.data[:start] + bytes(end - start) + made.data[end:]


def bomb(made: Made, choose: random.Random) -> bytes:
    at = choose.choice(choose.choice(made.chunks))
    return made.data[:at] + hostile_chunk(44 + len(BOMB), 2**27, BOMB) + made.data[at:]


def damage_index(made: Made, choose: random.Random) -> bytes:
    data = bytearray(made.data)
    kinds = Opcode.CHUNK_INDEX, Opcode.STATISTICS, Opcode.MESSAGE_INDEX, Opcode.FOOTER
    start, end = choose.choice([one for kind in kinds for one in places(made.data, kind)])
    data[choose.randrange(start, end)] ^= choose.randrange(1, 256)
    if choose.random() < 0.5:  # nothing states that it is wrong
        summary = int.from_bytes(made.data[-28:-20], "little")
        data[-12:-8] = zlib.crc32(data[summary:-12]).to_bytes(4, "little")
    return bytes(data)


KINDS: list[Callable[[Made, random.Random], bytes]] = [
    flip, truncate, double_chunk, chunk_of_another_file, zero_block, bomb,
    damage_index,
]  # fmt: skip


def attack(folder: Path, kind: Callable[[Made, random.Random], bytes], seed: int) -> None:
    """Damage a bag, check and recover it, and compare with what is true."""
    choose = random.Random(f"{kind.__name__} {seed}")
    inner = make(choose).data
    nested = (inner,) if seed % 3 == 0 else ()
    made = make(choose, nested=nested)
    if seed % 2 and kind is not damage_index:  # its recorder was killed
        made = made._replace(data=made.data[: places(made.data, Opcode.MESSAGE_INDEX)[-1][1]])
    data = kind(made, choose)
    folder.mkdir()
    path, new = folder / "x.mcap", folder / "new"
    path.write_bytes(data)
    true = [entry for entries in made.entries for entry in entries]
    verification = verify(path)
    found: list[Entry] = []
    report = None
    with suppress(BagReadError):  # no message can be recovered
        report = recover(path, new)
    assert new.exists() == (report is not None)
    if report:
        found = in_recorded_order(new)
        summary, (file,) = summarise(new), report.files
        assert report.message_count == len(found) == summary["messages"]
        assert file.span == (summary["start_ns"], summary["end_ns"])
        assert Counter(found) <= Counter(true), "made up or doubled"
        assert verify(new).holds
        with RosbagsReader(new) as rosbags:
            assert rosbags.message_count == len(list(rosbags.messages())) == len(found)
        if report.is_whole:
            assert Counter(found) == Counter(true)
    assert not verification.holds or Counter(found) == Counter(true)
    if not nested and kind in (double_chunk, bomb):
        assert Counter(found) == Counter(true), "a sound chunk is lost"
    if not nested and kind is not damage_index:
        scan = Counter(scanned(data))
        for (start, end), entries in zip(made.chunks, made.entries, strict=True):
            if made.data[start:end] in data:
                assert Counter(each[1:] for each in entries) <= scan, "a sound chunk is lost"
    is_sound = data[: made.chunks[0][1]] == made.data[: made.chunks[0][1]]
    if is_sound and kind is not damage_index:
        assert Counter(made.entries[0]) <= Counter(found), "the first chunk is lost"


@pytest.mark.parametrize(
    "seeds", [range(4), pytest.param(range(1000, 1100), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags(
    tmp_path: Path, kind: Callable[[Made, random.Random], bytes], seeds: range
) -> None:
    for seed in seeds:
        attack(tmp_path / str(seed), kind, seed)


def filled(path: Path, topics: list[str], **options: Any) -> Path:
    """Write a file of small chunks with ten messages of each of some channels."""
    writer = Writer(str(path), chunk_size=100, compression=CompressionType.NONE, **options)
    writer.start("ros2", "")
    schema = writer.register_schema(STRING, "ros2msg", b"string data")
    for place, topic in enumerate(topics):
        channel = writer.register_channel(topic, "cdr", schema)
        for time in range(10 * place + 1, 10 * place + 11):
            writer.add_message(channel, time, cdr("abcd"), time)
    writer.finish()
    return path


def test_what_is_lost_of_both_channels_of_a_topic_is_missing(tmp_path: Path) -> None:
    data = bytearray(filled(tmp_path / "two.mcap", ["/a", "/a"]).read_bytes())
    data[data.find(b"abcd")] ^= 1
    data[data.rfind(b"abcd")] ^= 1
    report, there = recovered(tmp_path, bytes(data))
    assert report.files[0].missing == {"/a": 20 - len(there)} != {"/a": 0}


def test_a_bag_without_message_indexes_is_summarised(tmp_path: Path) -> None:
    path = filled(tmp_path / "no_index.mcap", ["/a", "/b"], index_types=IndexType.CHUNK)
    assert summarise(path)["messages"] == 20
