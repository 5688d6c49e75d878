# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags damaged in ten ways: verify tells of it, recover makes nothing up and doubles nothing."""

import random
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import Reader as RosbagsReader

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.container import MAGIC, RECORD
from tsobs_ros.bag.recovery import recover
from tsobs_ros.bag.summary import summarise
from tsobs_ros.bag.verification import verify
from tsobs_ros.errors import BagReadError

BYTES = "std_msgs/msg/UInt8MultiArray"
TEXT = b"uint8[] data\n"
BOMB = zstandard.compress(bytes(2**27))

Entry = tuple[str, bytes, int, int]


class Made(NamedTuple):
    """A file, and the messages in it by chunk."""

    data: bytes
    chunks: list[tuple[int, int]]
    entries: list[list[Entry]]


def cdr(payload: bytes) -> bytes:
    return b"\0\1\0\0" + struct.pack("<I", len(payload)) + payload


def make(choose: random.Random, topics: str = "abc", nested: tuple[bytes, ...] = ()) -> Made:
    """Return a finished file of our layout with some chunks; its messages may carry others."""
    stream, entries = BytesIO(), list[list[Entry]]()
    compression = choose.choice(list(CompressionType))
    writer: Any = Writer(stream, 10**9, compression)
    writer.start("ros2", "some recorder")
    schema = writer.register_schema(BYTES, "ros2msg", TEXT)
    ids = {f"/{name}": writer.register_channel(f"/{name}", "cdr", schema) for name in topics}
    time = choose.randrange(10**18)
    for _ in range(choose.randint(2, 7)):
        entries.append([])
        for _ in range(choose.randint(1, 8)):
            topic = choose.choice(list(ids))
            payload = choose.choice([*nested, choose.randbytes(choose.randrange(150))])
            time += choose.randrange(1, 1000)
            entry = topic, cdr(payload), time + choose.randrange(2000), time
            writer.add_message(ids[topic], entry[2], entry[1], entry[3])
            entries[-1].append(entry)
        writer.flush()
    writer.finish()
    data = stream.getvalue()
    return Made(data, places(data, Opcode.CHUNK), entries)


def places(data: bytes, opcode: Opcode) -> list[tuple[int, int]]:
    """Return where the records of a kind start and end."""
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        end = at + RECORD.size + RECORD.unpack_from(data, at)[1]
        if data[at] == opcode:
            found.append((at, end))
        at = end
    return found


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
    return made.data[:at] + other.data[start:end] + made.data[at:]


def zero_block(made: Made, choose: random.Random) -> bytes:
    start = choose.randrange(len(made.data))
    end = min(len(made.data), start + choose.choice([1, 20, 512]))
    return made.data[:start] + bytes(end - start) + made.data[end:]


def lose_bytes(made: Made, choose: random.Random) -> bytes:
    start, end = choose.choice(made.chunks)
    at = choose.randrange(start, end)
    return made.data[:at] + made.data[at + choose.choice([1, 9, 31, 60]) :]


def wrong_length(made: Made, choose: random.Random) -> bytes:
    data = bytearray(made.data)
    start, _ = choose.choice([*made.chunks, *places(made.data, Opcode.MESSAGE_INDEX)])
    # Of the record; of a chunk's content and of the name of its compression.
    at, form = choose.choice(
        [(1, "<Q"), (25, "<Q"), (37, "<I")] if data[start] == 6 else [(1, "<Q")]
    )
    value = choose.choice([0, 1, 2**31, 2**32 - 1, choose.randrange(5000)])
    struct.pack_into(form, data, start + at, value)
    return bytes(data)


def bomb(made: Made, choose: random.Random) -> bytes:
    at = choose.choice(choose.choice(made.chunks))
    head = struct.pack("<QQQII", 0, 9, 2**27, 0, 4) + b"zstd" + struct.pack("<Q", len(BOMB))
    record = RECORD.pack(Opcode.CHUNK, len(head) + len(BOMB)) + head + BOMB
    return made.data[:at] + record + made.data[at:]


def damage_index(made: Made, choose: random.Random) -> bytes:
    data = bytearray(made.data)
    kinds = Opcode.CHUNK_INDEX, Opcode.STATISTICS, Opcode.MESSAGE_INDEX, Opcode.FOOTER
    start, end = choose.choice([one for kind in kinds for one in places(made.data, kind)])
    data[choose.randrange(start, end)] ^= choose.randrange(1, 256)
    if choose.random() < 0.5:  # nothing states that it is wrong
        summary = int.from_bytes(made.data[-28:-20], "little")
        data[-12:-8] = zlib.crc32(data[summary:-12]).to_bytes(4, "little")
    return bytes(data)


def swap_chunks(made: Made, choose: random.Random) -> bytes:
    (a, b), (c, d) = sorted(choose.sample(made.chunks, 2))
    data = made.data
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


KINDS: list[Callable[[Made, random.Random], bytes]] = [
    flip, truncate, double_chunk, chunk_of_another_file, zero_block, lose_bytes, wrong_length, bomb,
    damage_index, swap_chunks,
]  # fmt: skip


def attack(folder: Path, kind: Callable[[Made, random.Random], bytes], seed: int) -> None:
    """Damage a bag, check and recover it, and compare with what is true."""
    choose = random.Random(f"{kind.__name__} {seed}")
    inner = make(choose).data
    start, end = places(inner, Opcode.CHUNK)[0]
    nested = (inner, inner[start:end], inner[start:]) if seed % 3 == 0 else ()
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
        found = [(m.topic, m.data, m.log_time, m.publish_time) for m in BagReader(new).messages()]
        assert report.message_count == len(found) == summarise(new).messages
        assert Counter(found) <= Counter(true), "made up or doubled"
        assert verify(new).holds
        with RosbagsReader(new) as rosbags:
            assert rosbags.message_count == len(list(rosbags.messages())) == len(found)
        with (new / "new_0.mcap").open("rb") as stream:
            assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == len(found)
        if report.is_whole:
            assert Counter(found) == Counter(true)
    assert not verification.holds or Counter(found) == Counter(true)
    is_told = seed % 2 == 0 or kind is not chunk_of_another_file  # the index tells it apart
    if not nested and is_told and kind in (double_chunk, chunk_of_another_file, bomb):
        assert Counter(found) == Counter(true), "a sound chunk is lost"
    is_sound = data[: made.chunks[0][1]] == made.data[: made.chunks[0][1]]
    if is_sound and kind is not damage_index:
        assert not Counter(made.entries[0]) - Counter(found), "the first chunk is lost"


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags(tmp_path: Path, kind: Callable[[Made, random.Random], bytes]) -> None:
    for seed in range(6):
        attack(tmp_path / str(seed), kind, seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_bags(tmp_path: Path, kind: Callable[[Made, random.Random], bytes]) -> None:
    for seed in range(1000, 1100):
        attack(tmp_path / str(seed), kind, seed)
