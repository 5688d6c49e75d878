# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whatever happens to a bag, what is whole in it is recovered, and nothing is made up."""

import random
import re
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable
from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import pytest
import zstandard
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2 import Reader as RosbagsReader

from tsobs_ros.bag import BagReader, BagWriter, QosProfile
from tsobs_ros.bag.mcap.messages import decode_messages
from tsobs_ros.bag.mcap.records import FRAME, MAGIC
from tsobs_ros.bag.metadata import read_metadata
from tsobs_ros.bag.recovery import Recovery, recover
from tsobs_ros.bag.recovery.destinations import Destinations
from tsobs_ros.bag.recovery.pieces import Content
from tsobs_ros.bag.recovery.scan import Scan
from tsobs_ros.bag.verification import verify
from tsobs_ros.errors import BagReadError, BagWriteError

STRING = "std_msgs/msg/String"
COMPRESSIONS = ["none", "lz4", "zstd"]
CHUNKS, PER_CHUNK = 3, 5


class Entry(NamedTuple):
    topic: str
    data: bytes
    log_time: int
    publish_time: int


class Sample(NamedTuple):
    """A finished file, what it holds, and where its chunks are."""

    data: bytes
    entries: list[Entry]
    chunks: list[tuple[int, int]]


def cdr(text: str) -> bytes:
    return b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text.encode() + b"\0"


def entry(number: int) -> Entry:
    # Text that hardly compresses, of several lengths, and log times out of order.
    text = random.Random(number).randbytes(8 + number % 5).hex()
    return Entry("/ab"[: 1 + number % 2] + "a", cdr(text), 1_000 + number ^ 1, number)


def write_bag(path: Path, **options: object) -> list[Entry]:
    entries = [entry(number) for number in range(CHUNKS * PER_CHUNK)]
    with BagWriter(path, custom_data={"why": "a test"}, **options) as writer:
        for topic in sorted({e.topic for e in entries}):
            writer.add_topic(topic, STRING, [QosProfile(durability="transient_local")])
        for number, each in enumerate(entries):
            if number % PER_CHUNK == 0:
                writer.flush()
            writer.write(*each)
    return entries


@cache
def sample(compression: str) -> Sample:
    with TemporaryDirectory() as folder:
        entries = write_bag(Path(folder) / "bag", compression=compression)
        data = (Path(folder) / "bag" / "bag_0.mcap").read_bytes()
    chunks = [(start, end) for opcode, start, end in frames(data) if opcode == Opcode.CHUNK]
    return Sample(data, entries, chunks)


def frames(data: bytes) -> Iterable[tuple[int, int, int]]:
    place = len(MAGIC)
    while place < len(data) - len(MAGIC):
        opcode, length = FRAME.unpack_from(data, place)
        yield opcode, place, place + FRAME.size + length
        place += FRAME.size + length


def scanned(data: bytes) -> list[tuple[bytes, int, int]]:
    """Return the messages a scan finds, without writing a bag."""
    pieces = Scan(BytesIO(data), len(data)).pieces()
    return [
        (message.data, message.log_time, message.publish_time)
        for piece in pieces
        if isinstance(piece, Content)
        for message in decode_messages(piece.records, Destinations())
    ]


def recovered(folder: Path, data: bytes, **options: bool) -> tuple[Recovery, list[Entry]]:
    """Recover a file and return what its new bag holds, in order of recording."""
    path = folder / "broken.mcap"
    path.write_bytes(data)
    result = recover(path, folder / "new", **options)
    return result, in_recorded_order(folder / "new")


def in_recorded_order(bag: Path) -> list[Entry]:
    messages = [
        Entry(m.topic, m.data, m.log_time, m.publish_time) for m in BagReader(bag).messages()
    ]
    return sorted(messages, key=lambda e: e.publish_time)


def snapshot(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {p.name: (p.read_bytes(), p.stat().st_mtime_ns) for p in sorted(folder.iterdir())}


@pytest.mark.parametrize("tail", [b"", bytes(100)], ids=["cut", "zeros"])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_cut_at_any_byte_loses_only_what_comes_after(compression: str, tail: bytes) -> None:
    data, entries, chunks = sample(compression)
    expected = [tuple(e[1:]) for e in entries]
    for cut in range(len(data) + 1):
        found = scanned(data[:cut] + tail)
        whole = PER_CHUNK * sum(end <= cut for _, end in chunks)
        assert len(found) >= whole, f"cut at byte {cut}"
        assert found == expected[: len(found)], f"cut at byte {cut}"


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_cut_bag_becomes_a_whole_one(tmp_path: Path, compression: str) -> None:
    data, entries, chunks = sample(compression)
    first = chunks[0][1]
    for number, cut in enumerate((first, *range(first + 50, len(data), 700), len(data))):
        folder = tmp_path / str(number)
        folder.mkdir()
        result, found = recovered(folder, data[:cut])
        assert found == entries[: len(found)]
        assert result.message_count == len(found) >= PER_CHUNK * sum(e <= cut for _, e in chunks)
        verification = verify(folder / "new")
        assert (verification.errors, verification.remarks) == ((), ())
        topics = BagReader(folder / "new").topics.values()
        assert {topic.qos_profiles for topic in topics} == {
            (QosProfile(durability="transient_local"),)
        }
        by_log_time = sorted(found, key=lambda e: e.log_time)
        with RosbagsReader(folder / "new") as reader:
            assert [(c.topic, d, t) for c, t, d in reader.messages()] == [
                tuple(e[:3]) for e in by_log_time
            ]
        with (folder / "new" / "new_0.mcap").open("rb") as stream:
            assert [
                Entry(channel.topic, message.data, message.log_time, message.publish_time)
                for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
            ] == by_log_time


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_the_front_of_a_chunk_that_is_cut_off_is_kept(compression: str) -> None:
    """Not of one this small by zstd and lz4, whose blocks are all or nothing."""
    data, _, chunks = sample(compression)
    start, end = chunks[-1]
    found = len(scanned(data[: (start + end) // 2])) - PER_CHUNK * (CHUNKS - 1)
    assert 0 < found < PER_CHUNK if compression == "none" else found == 0


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_the_front_of_a_large_compressed_chunk_is_kept(tmp_path: Path, compression: str) -> None:
    with BagWriter(tmp_path / "bag", compression=compression) as writer:
        writer.add_topic("/a", STRING)
        for number in range(7):
            writer.write("/a", random.Random(number).randbytes(100_000), number, number)
    data = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    found = scanned(data[:500_000])
    assert [m[0] for m in found] == [random.Random(i).randbytes(100_000) for i in range(len(found))]
    assert len(found) >= 3


@settings(max_examples=200)
@given(st.sampled_from(COMPRESSIONS), st.integers(0, 10**9), st.integers(1, 255))
@example("none", 9, 255)
def test_a_changed_byte_costs_one_chunk_and_invents_nothing(
    compression: str, place: int, change: int
) -> None:
    data, entries, chunks = sample(compression)
    place %= len(data)
    damaged = bytearray(data)
    damaged[place] ^= change
    found = scanned(bytes(damaged))
    expected = [tuple(e[1:]) for e in entries]
    for number, (start, end) in enumerate(chunks):
        if not start <= place < end:
            of_chunk = expected[number * PER_CHUNK : (number + 1) * PER_CHUNK]
            assert [m for m in found if m in of_chunk] == of_chunk
    in_order = iter(expected)
    assert all(message in in_order for message in found)


def overwrite(data: bytes, start: int, end: int) -> bytes:
    return data[:start] + random.Random(1).randbytes(end - start) + data[end:]


def zero(data: bytes, start: int, end: int) -> bytes:
    return data[:start] + bytes(end - start) + data[end:]


def remove(data: bytes, start: int, end: int) -> bytes:
    return data[:start] + data[end:]


def insert(data: bytes, start: int, end: int) -> bytes:
    return data[:start] + random.Random(1).randbytes(end - start) + data[start:]


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("damage", [overwrite, zero, remove, insert])
@pytest.mark.parametrize(("begin", "size"), [(-5, 30), (0, 9), (20, 40), (60, 25), (None, 30)])
def test_damage_within_a_chunk_costs_that_chunk(
    compression: str,
    damage: Callable[[bytes, int, int], bytes],
    begin: int | None,
    size: int,
) -> None:
    data, entries, chunks = sample(compression)
    start = chunks[1][1] - 10 if begin is None else chunks[1][0] + begin
    expected = [tuple(e[1:]) for e in entries]
    found = scanned(damage(data, start, start + size))
    # Bytes that come in between two chunks cost none.
    assert found == [*expected[:PER_CHUNK], *expected[2 * PER_CHUNK :]] or (
        found == expected and damage is insert and begin is not None and begin <= 0
    )


def test_what_a_damaged_chunk_held_is_told_by_its_index(tmp_path: Path) -> None:
    data, entries, chunks = sample("none")
    start = chunks[1][1] - 12
    result, _ = recovered(tmp_path, overwrite(data, start, start + 4))
    (file,) = result.files
    (part,) = file.damage
    assert (part.offset, part.size) == (chunks[1][0], chunks[1][1] - chunks[1][0])
    assert part.messages == PER_CHUNK
    assert "checksum" in part.reason
    assert sum(file.missing.values()) == PER_CHUNK
    assert "NOT EVERYTHING" in result.text()
    assert f"bytes {part.offset} to" in result.text()
    mapping = result.as_mapping()
    assert mapping["messages"] == len(entries) - PER_CHUNK
    assert mapping["files"][0]["damage"][0]["messages"] == PER_CHUNK


def test_unchecked_messages_are_kept_only_when_asked_for(tmp_path: Path) -> None:
    data, entries, chunks = sample("none")
    start = chunks[1][1] - 12
    _, found = recovered(tmp_path, zero(data, start, start + 4), keep_unchecked=True)
    assert len(found) == len(entries)
    assert sum(a != b for a, b in zip(found, entries, strict=True)) == 1


@pytest.mark.parametrize("damage", [overwrite, zero, remove])
def test_topics_of_a_lost_chunk_are_found_in_the_folders_metadata(
    tmp_path: Path, damage: Callable[[bytes, int, int], bytes]
) -> None:
    """The first chunk alone describes the topics, and without an end nothing repeats them."""
    entries = write_bag(tmp_path / "bag", compression="none")
    path = tmp_path / "bag" / "bag_0.mcap"
    data, chunks = path.read_bytes(), sample("none").chunks
    (start, middle), (_, last) = chunks[0], chunks[-1]
    path.write_bytes(damage(data[:last], start, middle))
    recover(tmp_path / "bag", tmp_path / "new")
    assert in_recorded_order(tmp_path / "new") == entries[PER_CHUNK:]
    assert verify(tmp_path / "new").holds


@pytest.mark.parametrize("change", ["no metadata", "other hash", "other writer"])
def test_messages_of_topics_that_stay_unknown_are_counted(tmp_path: Path, change: str) -> None:
    write_bag(tmp_path / "bag", compression="none")
    path = tmp_path / "bag" / "bag_0.mcap"
    _, _, chunks = sample("none")
    data = zero(path.read_bytes()[: chunks[-1][1]], *chunks[0])
    description = tmp_path / "bag" / "metadata.yaml"
    if change == "no metadata":
        description.unlink()
    elif change == "other hash":
        description.write_text(re.sub("RIHS01_....", "RIHS01_0000", description.read_text()))
    else:
        data = data.replace(b"tsobs_ros ", b"otherbags ", 1)
    path.write_bytes(data)
    with pytest.raises(BagReadError, match=r"no message can be recovered: .*bytes"):
        recover(tmp_path / "bag", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def make_split(path: Path) -> list[Entry]:
    entries = write_bag(path, max_duration_ns=PER_CHUNK - 1)
    assert len(list(path.glob("*.mcap"))) > 2
    return entries


def cut_last_file(bag: Path) -> None:
    last = max(bag.glob("*.mcap"))
    last.write_bytes(last.read_bytes()[:-200])


def cut_metadata(bag: Path) -> None:
    path = bag / "metadata.yaml"
    path.write_bytes(path.read_bytes()[:-150])


def forget_last_file(bag: Path) -> None:
    """As a recorder that was killed between a split and the next sync."""
    cut_last_file(bag)
    path = bag / "metadata.yaml"
    text = path.read_text()
    last = max(bag.glob("*.mcap")).name
    text = text.replace(f"  - {last}\n", "")
    path.write_text(re.sub(rf"  - path: {last}\n(    .*\n)+", "", text))


@pytest.mark.parametrize(
    "damage",
    [
        cut_last_file,
        cut_metadata,
        forget_last_file,
        lambda bag: (bag / "metadata.yaml").unlink(),
        lambda bag: (bag / "metadata.yaml").write_bytes(b""),
        lambda bag: (bag / "metadata.yaml").write_bytes(b"\xff" * 100),
    ],
)
def test_a_folder_is_recovered_file_by_file(
    tmp_path: Path, damage: Callable[[Path], object]
) -> None:
    entries = make_split(tmp_path / "bag")
    damage(tmp_path / "bag")
    recover(tmp_path / "bag", tmp_path / "new")
    assert in_recorded_order(tmp_path / "new") == entries
    verification = verify(tmp_path / "new")
    assert (verification.errors, verification.remarks) == ((), ())
    assert [BagReader(p).message_count for p in sorted((tmp_path / "new").glob("*.mcap"))] == [
        # Of the old file only what it holds can be told where its end is cut.
        len(scanned(p.read_bytes()))
        for p in sorted((tmp_path / "bag").glob("*.mcap"))
    ]
    assert read_metadata(tmp_path / "new").custom_data == {"why": "a test"}


def test_a_missing_and_an_empty_file_do_not_keep_the_others_from_being_recovered(
    tmp_path: Path,
) -> None:
    make_split(tmp_path / "bag")
    files = sorted((tmp_path / "bag").glob("*.mcap"))
    files[0].unlink()
    files[1].write_bytes(b"")
    result = recover(tmp_path / "bag", tmp_path / "new")
    assert result.files[0].error == "No such file or directory"
    assert "bag_0.mcap: not read: No such file" in result.text()
    assert result.files[1].size == 0
    assert not result.is_whole
    left = [entry for path in files[2:] for entry in scanned(path.read_bytes())]
    assert [tuple(e[1:]) for e in in_recorded_order(tmp_path / "new")] == left


def test_a_bag_that_is_whole_stays_whole(tmp_path: Path) -> None:
    entries = make_split(tmp_path / "bag")
    result = recover(tmp_path / "bag", tmp_path / "new", compression="lz4")
    assert result.is_whole
    assert "nothing known to be lost" in result.text()
    assert in_recorded_order(tmp_path / "new") == entries


def test_the_bag_of_a_killed_process_is_recovered(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\n"
        "from tsobs_ros.bag import BagWriter\n"
        "writer = BagWriter(sys.argv[1])\n"
        f"writer.add_topic('/a', '{STRING}')\n"
        "for number in range(1_000_000):\n"
        "    if number == 3_000: writer.flush(); print(flush=True)\n"
        "    writer.write('/a', b'%d' % number, number, number)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "bag")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.kill()
    with pytest.raises(BagReadError, match=r"has no end.*tsobs bag recover"):
        BagReader(tmp_path / "bag")
    recover(tmp_path / "bag", tmp_path / "new")
    found = [int(m.data) for m in BagReader(tmp_path / "new").messages()]
    assert len(found) >= 3_000
    assert found == list(range(len(found)))


def test_the_damaged_bag_is_not_touched(tmp_path: Path) -> None:
    make_split(tmp_path / "bag")
    cut_last_file(tmp_path / "bag")
    (tmp_path / "bag").chmod(0o555)
    for path in (tmp_path / "bag").iterdir():
        path.chmod(0o444)
    before = snapshot(tmp_path / "bag")
    recover(tmp_path / "bag", tmp_path / "new")
    assert snapshot(tmp_path / "bag") == before
    with pytest.raises(BagWriteError, match=r"is inside of the bag .*, which is not touched"):
        recover(tmp_path / "bag", tmp_path / "bag" / "new")
    assert snapshot(tmp_path / "bag") == before


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    make_split(tmp_path / "bag")
    (tmp_path / "new").mkdir()
    with pytest.raises(BagWriteError, match="new: exists already, bags are not overwritten"):
        recover(tmp_path / "bag", tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "it is empty"),
        (MAGIC, "it holds no messages"),
        (bytes(10_000), "nothing but zeros"),
        (b"SQLite format 3\0" * 1_000, "not a record"),
        (random.Random(1).randbytes(100_000), "not a record|chunk"),
    ],
)
def test_where_nothing_can_be_recovered_nothing_is_made(
    tmp_path: Path, content: bytes, reason: str
) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BagReadError, match=rf"no message can be recovered: x\.mcap: .*({reason})"):
        recover(path, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_what_is_no_bag_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagReadError, match="none: there is no such bag"):
        recover(tmp_path / "none", tmp_path / "new")
    with pytest.raises(BagReadError, match=r"not a bag, there is no \.mcap file in it"):
        recover(tmp_path, tmp_path / "new")


def hostile_chunk(length: int, size: int, inner: int, data: bytes) -> bytes:
    head = b"".join(n.to_bytes(8, "little") for n in (0, 0, size)) + bytes(4)
    head += (4).to_bytes(4, "little") + b"zstd" + inner.to_bytes(8, "little")
    return FRAME.pack(Opcode.CHUNK, length) + head + data


@cache
def bomb() -> bytes:
    """Return what is 256 MiB when it is decompressed."""
    return zstandard.compress(bytes(2**28))


@pytest.mark.parametrize(
    "hostile",
    [
        lambda: hostile_chunk(2**62, 100, 2**62 - 44, b"x" * 100),
        lambda: hostile_chunk(2**27, 2**62, 2**27 - 44, b"x" * 100),
        lambda: hostile_chunk(44 + len(bomb()), 100, len(bomb()), bomb()),
        lambda: hostile_chunk(44 + len(bomb()), 2**40, len(bomb()), bomb()),
        lambda: hostile_chunk(2**20, 1_000, 2**20 - 44, bomb()),
    ],
)
def test_a_stated_length_costs_no_memory(tmp_path: Path, hostile: Callable[[], bytes]) -> None:
    data, entries, chunks = sample("zstd")
    chunk = hostile()
    tracemalloc.start()
    try:
        _, found = recovered(tmp_path, data[: chunks[0][1]] + chunk)
        assert found == entries[:PER_CHUNK]
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()


def unchunked() -> bytes:
    """Return a file of twenty messages outside of chunks."""
    stream = BytesIO()
    writer = Writer(stream, use_chunking=False)
    writer.start(profile="ros2")
    schema = writer.register_schema(STRING, "ros2msg", b"string data\n")
    channel = writer.register_channel("/a", "cdr", schema)
    for number in range(20):
        writer.add_message(channel, 5 + number, cdr("x" * 9), number)
    writer.finish()
    return stream.getvalue()


def test_messages_outside_of_chunks_are_recovered_up_to_any_cut() -> None:
    data = unchunked()
    ends = [end for opcode, _, end in frames(data) if opcode == Opcode.MESSAGE]
    for cut in range(len(data)):
        for tail in (b"", bytes(50)):
            found = [m[2] for m in scanned(data[:cut] + tail)]
            assert found == list(range(len(found)))
            # Whether the zeros at the end of the last message are its own cannot be told.
            assert len(found) >= sum(end <= cut for end in ends) - 1


def test_after_damage_the_next_message_outside_of_chunks_is_found() -> None:
    data = unchunked()
    start = next(start for opcode, start, _ in frames(data) if opcode == Opcode.MESSAGE)
    found = [m[2] for m in scanned(overwrite(data, start + 400, start + 403))]
    assert found == sorted(set(found))
    assert 18 <= len(found) <= 20


def test_what_no_bag_can_hold_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="x")
        string = writer.register_schema(STRING, "ros2msg", b"string data\n")
        empty = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        channels = [
            writer.register_channel("/a", "cdr", string),
            writer.register_channel("/a", "cdr", empty),
            writer.register_channel("/json", "json", string),
            writer.register_channel("/lost", "cdr", 9),
        ]
        for channel in channels:
            writer.add_message(channel, 5, cdr("x"), 5)
        writer.add_message(channels[0], 2**63, cdr("x"), 5)
        writer.finish()
    result = recover(path, tmp_path / "new")
    (file,) = result.files
    assert file.kept == {"/a": 1}
    assert sorted(file.dropped) == [
        "of /a as std_msgs/msg/Empty, which is two types",
        "of /a, whose times do not fit 63 bits",
        "of /json, which is encoded in 'json'",
        "of /lost, whose type is lost",
    ]
    assert result.remarks == ("x.mcap: its profile is 'x', expected 'ros2'",)
    assert "dropped 1: of /json" in result.text()


def test_another_definition_language_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2idl", b"module std_msgs {};")
        writer.add_message(writer.register_channel("/a", "cdr", schema), 1, b"x", 1)
        writer.finish()
    recover(path, tmp_path / "new")
    definition = BagReader(tmp_path / "new").topics["/a"].definition
    assert (definition.encoding, definition.text) == ("ros2idl", "module std_msgs {};")


def test_recovering_twice_gives_the_same(tmp_path: Path) -> None:
    make_split(tmp_path / "bag")
    cut_last_file(tmp_path / "bag")
    recover(tmp_path / "bag", tmp_path / "one" / "new")
    shutil.copytree(tmp_path / "one" / "new", tmp_path / "copy")
    recover(tmp_path / "copy", tmp_path / "two" / "new")
    one, two = snapshot(tmp_path / "one" / "new"), snapshot(tmp_path / "two" / "new")
    assert {k: v[0] for k, v in one.items()} == {k: v[0] for k, v in two.items()}
