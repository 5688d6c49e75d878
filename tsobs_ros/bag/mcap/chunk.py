# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Chunks of an MCAP file: their head and the records they hold."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from tsobs_ros.bag.mcap.records import MAX_RECORD_SIZE, RecordError

_HEAD = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_PIECE_SIZE = 65_536


class Chunk(NamedTuple):
    """A chunk as stored.

    Attributes:
        start: The smallest log time in it, ns.
        end: The largest log time in it, ns.
        size: The size of its records, bytes.
        crc: Their CRC-32; 0 if there is none.
        compression: How they are compressed: `lz4`, `zstd` or an empty string.
        data: The compressed records.
    """

    start: int
    end: int
    size: int
    crc: int
    compression: str
    data: memoryview


def parse_chunk(body: bytes, size: int | None = None) -> Chunk:
    """Return the chunk that a record's body holds.

    Args:
        body: The body.
        size: The size of the whole body, of which `body` is the front; by default it is whole.

    Raises:
        RecordError: The body is not that of a chunk.
    """
    try:
        start, end, content_size, crc, name_size = _HEAD.unpack_from(body)
        length_at = _HEAD.size + name_size
        (length,) = _LENGTH.unpack_from(body, length_at)
        compression = body[_HEAD.size : length_at].decode("ascii")
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordError(f"not a chunk: {error}") from error
    data_at = length_at + _LENGTH.size
    if data_at + length != (len(body) if size is None else size):
        raise RecordError("the chunk states another size than its record")
    data = memoryview(body)[data_at:]
    return Chunk(start, end, content_size, crc, compression, data)


def chunk_records(chunk: Chunk) -> bytes:
    """Return the records in a chunk, decompressed and checked.

    Raises:
        RecordError: They cannot be decompressed, or are not those the chunk was made of.
    """
    if chunk.size > MAX_RECORD_SIZE:
        raise RecordError(f"the chunk states {chunk.size} bytes of content, too many to read")
    try:
        data = _decompress(chunk.compression, chunk.data, chunk.size)
    except Exception as error:  # the libraries raise errors of their own, of several roots
        raise RecordError(f"the chunk cannot be decompressed: {error}") from error
    if len(data) != chunk.size:
        raise RecordError(f"the chunk states {chunk.size} bytes of content, but has {len(data)}")
    if chunk.crc and (crc := zlib.crc32(data)) != chunk.crc:
        raise RecordError(f"the chunk's checksum (crc) is {chunk.crc:08x}, its content's {crc:08x}")
    return data


def _decompress(compression: str, data: memoryview, size: int) -> bytes:
    if not compression:
        return bytes(data)
    # Imported here: whoever has only uncompressed bags needs neither library.
    if compression == "lz4":
        import lz4.frame

        # Unlike the plain function, it believes no size that the frame itself states.
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    if compression == "zstd":
        import zstandard

        stated = zstandard.get_frame_parameters(data).content_size
        if stated not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise RecordError(f"zstd states {stated} bytes of content, the chunk {size}")
        return bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))
    raise RecordError(f"compression '{compression}' is not known")


def chunk_front(chunk: Chunk) -> bytes:
    """Return as much of a chunk's records as its damaged or cut-off data yields."""
    front = bytearray()
    limit = chunk.size if chunk.size <= MAX_RECORD_SIZE else 0
    # Decompressors raise errors of their own kinds; what came before them is kept.
    with suppress(Exception):
        for piece in _pieces(chunk.compression, chunk.data):
            if len(front) >= limit:
                break
            front += piece
    del front[limit:]
    return bytes(front)


def _pieces(compression: str, data: memoryview) -> Iterator[bytes]:
    """Yield the decompressed data in pieces too small for a hostile frame to do harm."""
    if not compression:
        yield bytes(data)
    elif compression == "lz4":
        import lz4.frame

        decompressor = lz4.frame.LZ4FrameDecompressor()
        yield decompressor.decompress(data, max_length=_PIECE_SIZE)
        while not (decompressor.needs_input or decompressor.eof):
            yield decompressor.decompress(b"", max_length=_PIECE_SIZE)
    elif compression == "zstd":
        import zstandard

        reader = zstandard.ZstdDecompressor().stream_reader(data)
        while piece := reader.read(_PIECE_SIZE):
            yield piece
