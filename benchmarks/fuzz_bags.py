# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Crafted bags: each asks for as much work or memory as its bytes allow."""

import os
import socket
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    Schema,
    Statistics,
)

MAGIC = b"\x89MCAP0\r\n"
STRING = "std_msgs/msg/String"
NAME = "x_0.mcap"
_RECORD = struct.Struct("<BQ")
_MIB = 2**20
_SIZE = 8 * _MIB
_TIMES = 10**18, 2 * 10**18


def record(opcode: int, body: bytes) -> bytes:
    """Return a record."""
    return _RECORD.pack(opcode, len(body)) + body


def written(*records: McapRecord) -> bytes:
    """Return the library's records as bytes."""
    builder = RecordBuilder()
    for one in records:
        one.write(builder)
    return bytes(builder.end())


def message(time: int = _TIMES[0], data: bytes = b"", channel: int = 1) -> bytes:
    """Return a message."""
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", channel, 0, time, time) + data)


def chunk(
    records: bytes,
    compression: str = "",
    times: tuple[int, int] = _TIMES,
    *,
    size: int | None = None,
    crc: int | None = None,
) -> bytes:
    """Return a chunk, which may have a wrong size or checksum."""
    pack = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression]
    data, name = pack(records), compression.encode()
    size = len(records) if size is None else size
    crc = zlib.crc32(records) if crc is None else crc
    head = struct.pack("<QQQII", *times, size, crc, len(name))
    return record(Opcode.CHUNK, head + name + struct.pack("<Q", len(data)) + data)


DESCRIBED = written(
    Schema(id=1, data=b"string data\n", encoding="ros2msg", name=STRING),
    Channel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=1),
)
FRONT = MAGIC + written(Header(profile="ros2", library=""))


def finished(
    path: Path,
    data: Iterable[bytes],
    summary: Callable[[list[tuple[int, int]]], Iterable[bytes]] | None = None,
    counts: tuple[int, int] = (1, 1),
) -> None:
    """Write a file with an end; by default with an index of its chunks and correct statistics.

    Args:
        path: The file.
        data: Its pieces; by default each is indexed as a chunk.
        summary: Returns other records for the summary, given places and sizes of the pieces.
        counts: The numbers of messages and channels that the statistics state.
    """
    with path.open("wb") as stream:
        stream.write(FRONT)
        pieces = []
        for piece in data:
            pieces.append((stream.tell(), len(piece)))
            stream.write(piece)
        stream.write(written(DataEnd(0)))
        start = stream.tell()
        for piece in _indexes(pieces, counts) if summary is None else summary(pieces):
            stream.write(piece)
        stream.write(written(Footer(start, 0, 0)) + MAGIC)


def _statistics(chunks: int, messages: int = 1, channels: int = 1) -> bytes:
    return written(
        Statistics(
            attachment_count=0,
            channel_count=channels,
            channel_message_counts={1: messages},
            chunk_count=chunks,
            message_count=messages,
            message_end_time=_TIMES[1],
            message_start_time=_TIMES[0],
            metadata_count=0,
            schema_count=1,
        )
    )


def index(offset: int, size: int, places: Mapping[int, int] | None = None) -> bytes:
    """Return a chunk index."""
    return written(ChunkIndex(size, offset, "", 0, _TIMES[1], 0, dict(places or {}), _TIMES[0], 0))


def _indexes(pieces: list[tuple[int, int]], counts: tuple[int, int]) -> Iterator[bytes]:
    yield DESCRIBED
    yield _statistics(len(pieces), *counts)
    for place, size in pieces:
        yield index(place, size)


def _alike(compression: bytes = b"", crc: int = 1) -> bytes:
    """Return heads of chunks that each reach to the end."""
    step, parts = 49 + len(compression), []
    for left in range(_SIZE, step, -step):
        head = struct.pack("<QQQII", 0, 2**63, left - step, crc, len(compression))
        body = head + compression + struct.pack("<Q", left - step)
        parts.append(_RECORD.pack(Opcode.CHUNK, left - 9) + body)
    return b"".join(parts)


def _unfinished(folder: Path, *parts: bytes) -> None:
    (folder / NAME).write_bytes(FRONT + DESCRIBED + b"".join(parts))


def _wrapped_alikes() -> bytes:
    """Return heads of chunks without checksum, inside valid records, up to a wrong one."""
    parts, left = [], _SIZE
    while left > 400:
        filler = record(0x80, b"") * 20
        left -= 9 + 49 + len(filler)
        head = _RECORD.pack(Opcode.CHUNK, 40 + left) + struct.pack(
            "<QQQIIQ", 0, 2**63, left, 0, 0, left
        )
        parts.append(_RECORD.pack(0x80, 49) + head + filler)
    return b"".join(parts)


def _bombs(compression: str, unit: bytes, **lies: int) -> Callable[[Path], None]:
    """Make twenty chunks of 250 MB, which may state other sizes."""

    def make(folder: Path) -> None:
        finished(
            folder / NAME, [chunk(unit * (250 * 10**6 // len(unit)), compression, **lies)] * 20
        )

    return make


def _sparse(
    *, tail: bytes = b"", front: bytes = b"", size: int = 20 * 10**9
) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        with (folder / NAME).open("wb") as stream:
            stream.write(FRONT + DESCRIBED + front)
            stream.truncate(size)
            stream.seek(size)
            stream.write(tail)

    return make


def _sparse_attachment(folder: Path) -> None:
    """A finished file whose data section is an attachment that is a hole, with a checksum."""
    size = 20 * 10**9
    with (folder / NAME).open("wb") as stream:
        stream.write(FRONT + _RECORD.pack(Opcode.ATTACHMENT, size))
        stream.seek(size, 1)
        stream.write(written(DataEnd(1)))
        start = stream.tell()
        stream.write(DESCRIBED + _statistics(0, 0) + written(Footer(start, 0, 0)) + MAGIC)


def _large_statistics(folder: Path) -> None:
    size = _SIZE // 10 * 10
    body = struct.pack("<QHIIIIQQI", *[0] * 8, size) + bytes(size)
    _put(folder, [], record(Opcode.STATISTICS, body))


def _lengths() -> Iterator[bytes]:
    return (_RECORD.pack(Opcode.METADATA, min(left, 2**24)) for left in range(_SIZE, 0, -9))


def _many_chunks(*, overlap: bool) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        first = message(_TIMES[0]) + message(_TIMES[1])
        one = chunk(first if overlap else message(_TIMES[0]))
        finished(
            folder / NAME,
            [chunk(DESCRIBED + first), *[one] * (_SIZE // (len(one) + 100))],
        )

    return make


def _same_chunk(folder: Path) -> None:
    """Thousands of chunk indexes of one chunk."""
    bomb = chunk(message() * 8_000_000, "zstd")
    finished(
        folder / NAME,
        [bomb],
        lambda pieces: [DESCRIBED, _statistics(50_000, 8), *[index(*pieces[0])] * 50_000],
    )


def _same_index(folder: Path) -> None:
    """Chunk indexes whose message indexes are all the same large one."""
    entries = struct.pack("<QQ", _TIMES[0], 0) * (_SIZE // 32)
    body = struct.pack("<HI", 1, len(entries)) + entries
    one = chunk(message())

    def summary(pieces: list[tuple[int, int]]) -> Iterator[bytes]:
        yield DESCRIBED
        chunks = pieces[:-1]
        yield _statistics(len(chunks), 8)
        for place, size in chunks:
            yield index(place, size, dict.fromkeys(range(20), pieces[-1][0]))

    finished(folder / NAME, [*[one] * 5_000, record(Opcode.MESSAGE_INDEX, body)], summary)


def _channels(folder: Path) -> None:
    """As many channels as there can be, of one large type, each with different offers."""
    schema = Schema(id=1, data=b"int8 a\n" * 200_000, encoding="ros2msg", name=STRING)

    def summary(_: object) -> Iterator[bytes]:
        yield written(schema)
        for id_ in range(2**16 - 1):
            yield written(_channel(id_, {"offered_qos_profiles": f"- {{a: {id_}}}\n"}))
        yield _statistics(0, 0, 1)

    finished(folder / NAME, [], summary)


def _channel(id_: int, offers: dict[str, str]) -> Channel:
    return Channel(id=id_, message_encoding="cdr", metadata=offers, schema_id=1, topic=f"/t{id_}")


def _metadata(folder: Path, text: str) -> None:
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")


def _metadata_records(folder: Path) -> None:
    one = written(Metadata(name="rosbag2", metadata={"serialized_metadata": "- 1\n" * 99_000}))
    _unfinished(folder, one * 20, chunk(message()))


def _socket(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)  # paths of sockets have at most 107 bytes
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(f"/proc/self/fd/{descriptor}/{NAME}")
    os.close(descriptor)


def _put(
    folder: Path, data: Iterable[bytes], *summary: bytes, counts: tuple[int, int] = (1, 1)
) -> None:
    """Make a finished file, with these records in its summary if there are any."""
    finished(folder / NAME, data, (lambda _: summary) if summary else None, counts)


_EMPTY = record(0x80, b"")
_FOOTER = written(DataEnd(0), Footer(9, 0, 0)) + MAGIC
_ENDS = b"".join(map(message, (0, 1, 2**63 - 1, 2**63, 2**64 - 1)))

BAGS: Mapping[str, Callable[[Path], object]] = {
    "metadata: 80 MB": lambda folder: _metadata(folder, "- 1\n" * 20_000_000),
    "metadata: 99,000 values": lambda folder: _metadata(folder, "- 1\n" * 99_000),
    "metadata: nested to 49": lambda folder: _metadata(
        folder, "[" + ("[" * 48 + "]" * 48 + ",") * 10_000 + "]"
    ),
    "metadata: base 60": lambda folder: _metadata(folder, "a: 1" + ":1" * 500_000),
    "metadata: tag directives": lambda folder: _metadata(
        folder, "".join(f"%TAG !a{k}! b\n" for k in range(55_000))
    ),
    "metadata: pipe": lambda folder: os.mkfifo(folder / "metadata.yaml"),
    "metadata: device": lambda folder: (folder / "metadata.yaml").symlink_to("/dev/zero"),
    "metadata: in records": _metadata_records,
    "alikes: chunks": lambda folder: _unfinished(folder, _alike()),
    "alikes: unchecked chunks": lambda folder: _unfinished(folder, _alike(crc=0)),
    "alikes: zstd chunks": lambda folder: _unfinished(folder, _alike(b"zstd")),
    "alikes: wrapped chunks": lambda folder: _unfinished(folder, _wrapped_alikes(), b"\xff" * 300),
    "alikes: metadata": lambda folder: _unfinished(folder, *_lengths()),
    "alikes: channels": lambda folder: _unfinished(
        folder, chunk(message()), (b"\0" + DESCRIBED) * (_SIZE // 100)
    ),
    "alikes: every ninth byte": lambda folder: _unfinished(
        folder, _RECORD.pack(Opcode.CHANNEL, 0) * (_SIZE // 9)
    ),
    "bombs: zstd, zeros": _bombs("zstd", b"\0"),
    "bombs: zstd, messages": _bombs("zstd", message()),
    "bombs: zstd, empty records": _bombs("zstd", _EMPTY),
    "bombs: zstd, channels": _bombs("zstd", DESCRIBED),
    "bombs: zstd, states little": _bombs("zstd", message(), size=1000, crc=0),
    "bombs: zstd, states much": _bombs("zstd", message(), size=2**63, crc=0),
    "bombs: lz4, messages": _bombs("lz4", message()),
    "bombs: lz4, states little": _bombs("lz4", message(), size=1000, crc=0),
    "sparse: 20 GB": _sparse(),
    "sparse: 20 GB, end": _sparse(tail=_FOOTER),
    "sparse: 20 GB, chunk": _sparse(tail=chunk(message()) + _FOOTER),
    "sparse: 20 GB, summary": _sparse(tail=written(Footer(len(FRONT), 0, 0)) + MAGIC),
    "sparse: 20 GB, attachment": _sparse_attachment,
    "summary: empty records": lambda folder: _put(
        folder, [], _EMPTY * (_SIZE // 9), _statistics(0, 0)
    ),
    "summary: statistics": _large_statistics,
    "summary: chunk indexes": lambda folder: _put(
        folder,
        [],
        DESCRIBED,
        *(index(10**6 + k, 0) for k in range(_SIZE // 80)),
        _statistics(_SIZE // 80, 8),
    ),
    "summary: index of channels": lambda folder: _put(
        folder,
        [],
        DESCRIBED,
        *[index(9, 0, dict.fromkeys(range(2**16), 9))] * 12,
        _statistics(12, 8),
    ),
    "summary: one chunk": _same_chunk,
    "summary: one message index": _same_index,
    "summary: channels": _channels,
    "many chunks": _many_chunks(overlap=False),
    "many chunks that overlap": _many_chunks(overlap=True),
    "many messages": lambda folder: _put(
        folder, [chunk(DESCRIBED + message() * (_SIZE // 31))], counts=(_SIZE // 31, 1)
    ),
    "outside of chunks": lambda folder: _put(
        folder,
        [DESCRIBED, message() * (_SIZE // 31)],
        DESCRIBED,
        _statistics(0, _SIZE // 31),
    ),
    "outside: empty records": lambda folder: _put(
        folder, [DESCRIBED, _EMPTY * (_SIZE // 9), message()], DESCRIBED, _statistics(0)
    ),
    "outside: attachments": lambda folder: _put(
        folder,
        [DESCRIBED, record(Opcode.ATTACHMENT, b"") * (_SIZE // 9), message()],
        DESCRIBED,
        _statistics(0),
    ),
    "times at the limits": lambda folder: _put(
        folder, [chunk(DESCRIBED + _ENDS, times=(0, 2**64 - 1))]
    ),
    "pipe": lambda folder: os.mkfifo(folder / NAME),
    "device": lambda folder: (folder / NAME).symlink_to("/dev/zero"),
    "socket": _socket,
    "loop of links": lambda folder: (folder / NAME).symlink_to(NAME),
    "folder": lambda folder: (folder / NAME).mkdir(),
}
"""Functions that make one file each in an empty folder, by the bag's name; none runs on import."""
