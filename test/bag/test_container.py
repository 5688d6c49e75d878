# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The container against the library's own reader, and against hostile files."""

import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import lz4.frame
import pytest
import zstandard
from foreign import write_mcap
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType

from tsobs_ros.bag.container import (
    MAGIC,
    MAX_SIZE,
    RecordError,
    chunk_records,
    parse_record,
    read_summary,
    split_records,
)
from tsobs_ros.errors import BagReadError

TIMES = st.integers(0, 2**64 - 1)
CALLS = st.lists(st.tuples(st.integers(1, 3), TIMES, st.binary(max_size=80), TIMES), max_size=30)


def written_chunk(calls, compression: CompressionType, path: Path) -> Chunk:
    channels = [(f"/topic_{place}", "cdr", 1, {}) for place in range(3)]
    write_mcap(path, calls, channels=channels, compression=compression)
    with path.open("rb") as stream:
        records = StreamReader(stream, emit_chunks=True).records
        return next(record for record in records if isinstance(record, Chunk))


@settings(max_examples=30)
@given(CALLS.filter(bool), st.sampled_from(CompressionType))
def test_messages_are_those_that_the_library_reads(calls, compression: CompressionType) -> None:
    with TemporaryDirectory() as folder:
        chunk = written_chunk(calls, compression, Path(folder) / "x.mcap")
    expected = [
        (m.channel_id, m.log_time, m.publish_time, m.data)
        for m in breakup_chunk(chunk, validate_crc=True)
        if isinstance(m, Message)
    ]
    found = split_records(chunk_records(chunk))
    assert [(a, b % 2**64, c % 2**64, data) for a, b, c, data in found.messages()] == expected
    descriptions = [parse_record(one) for one in found.descriptions()]
    assert [type(one) for one in descriptions] == [Schema, *[Channel] * 3]
    with pytest.raises(RecordError, match="no record"):
        split_records(found.data[:-1])


@pytest.mark.parametrize(
    ("compression", "compress"),
    [("", bytes), ("lz4", lz4.frame.compress), ("zstd", zstandard.compress)],
)
def test_a_chunk_is_what_it_states(compression: str, compress: Callable[[bytes], bytes]) -> None:
    records = bytes(1000)
    chunk = Chunk(compression, compress(records), 0, 0, zlib.crc32(records), len(records))
    assert chunk_records(chunk) == records
    assert chunk_records(replace(chunk, uncompressed_crc=0)) == records
    for change, reason in (
        ({"uncompressed_crc": 1}, "crc"),
        ({"uncompressed_size": 1001}, "content"),
        ({"uncompressed_size": MAX_SIZE + 1}, "too many to read"),
        ({"data": chunk.data[:-20]}, "content|decompressed"),
        ({"compression": "zip"}, "compression 'zip' is not known"),
    ):
        with pytest.raises(RecordError, match=reason):
            chunk_records(replace(chunk, **change))


HEADER = Header(profile="ros2", library="")
STATISTICS = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
BARE = replace(STATISTICS, message_count=1)
CHUNK = ChunkIndex(50, 8, "", 0, 2, 0, {}, 1, 0)


def bytes_of(*parts: McapRecord | bytes) -> bytes:
    builder = RecordBuilder()
    for part in parts:
        builder.write(part) if isinstance(part, bytes) else part.write(builder)
    return bytes(builder.end())


@pytest.mark.parametrize(
    ("data", "summary", "reason"),
    [
        ([HEADER], [STATISTICS], None),
        ([DataEnd(0)], [STATISTICS], "it does not start with a header"),
        ([HEADER], [], "has no index"),
        ([HEADER], [replace(STATISTICS, chunk_count=1)], "1 chunks, but 0 in the index"),
        ([HEADER], [replace(STATISTICS, chunk_count=1), replace(CHUNK, chunk_length=2**63)],
         "the index states a chunk up to byte"),
        ([HEADER, b"\x05" + bytes(8)], [BARE], "has only 0 bytes"),
        ([HEADER, b"\x05" + b"\xff" * 8], [BARE], "ends at byte"),
        ([HEADER], [BARE, b"\x0d" + bytes(3)], "the file is damaged"),
    ],
)  # fmt: skip
def test_a_hostile_summary_is_refused(tmp_path: Path, data, summary, reason: str | None) -> None:
    front = MAGIC + bytes_of(*data)
    footer = Footer(summary_start=len(front), summary_offset_start=0, summary_crc=0)
    path = tmp_path / "x.mcap"
    path.write_bytes(front + bytes_of(*summary, footer) + MAGIC)
    if reason is None:
        assert read_summary(path).profile == "ros2"
        return
    with pytest.raises(BagReadError, match=rf"x\.mcap: .*{reason}"):
        read_summary(path)


def test_a_summary_of_gigabytes_is_refused_unread(tmp_path: Path) -> None:
    front = MAGIC + bytes_of(HEADER)
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        stream.write(front)
        stream.seek(4 * MAX_SIZE)  # a hole
        stream.write(bytes_of(Footer(len(front), 0, 0)) + MAGIC)
    with pytest.raises(BagReadError, match="too many to read"):
        read_summary(path)
