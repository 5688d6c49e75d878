# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The container against the library's own reader, and against hostile files."""

import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, DataEnd, Footer, Header, McapRecord, Statistics

from tsobs_ros.bag.container import MAGIC, MAX_SIZE, MESSAGE, RecordError, read_chunk, read_summary
from tsobs_ros.errors import BagReadError


@pytest.mark.parametrize(
    ("compression", "compress"),
    [("", bytes), ("lz4", lz4.frame.compress), ("zstd", zstandard.compress)],
)
def test_a_chunk_is_what_it_states(compression: str, compress: Callable[[bytes], bytes]) -> None:
    records = MESSAGE.pack(Opcode.MESSAGE, MESSAGE.size - 9 + 1000, 1, 0, 0, 0) + bytes(1000)
    chunk = Chunk(compression, compress(records), 0, 0, zlib.crc32(records), len(records))
    assert read_chunk(chunk).data == records
    assert read_chunk(replace(chunk, uncompressed_crc=0)).data == records
    for change, reason in (
        ({"uncompressed_crc": 1}, "crc"),
        ({"uncompressed_size": 9}, "content"),
        ({"uncompressed_size": MAX_SIZE + 1}, "too many to read"),
        ({"data": chunk.data[:-20]}, "content|decompressed"),
        ({"compression": "zip"}, "compression 'zip' is not known"),
    ):
        with pytest.raises(RecordError, match=reason):
            read_chunk(replace(chunk, **change))


HEADER = Header(profile="ros2", library="")
STATISTICS = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
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
        ([HEADER], [replace(STATISTICS, chunk_count=2), CHUNK, CHUNK],
         "the index states chunks that overlap"),
        ([HEADER], [STATISTICS, b"\x0d" + bytes(3)], "the file is damaged"),
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
