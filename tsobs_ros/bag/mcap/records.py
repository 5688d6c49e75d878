# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of an MCAP file: their frame, and their content checked before it is believed.

The library `mcap` knows every record's fields, but takes a length as the file states it. Here no
length is believed that the file cannot hold, and a content that ends early is an error.
"""

import struct
from io import BytesIO
from typing import IO, Any, NamedTuple

from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
FRAME = struct.Struct("<BQ")
"""What every record begins with: its opcode and the length of its body."""

MESSAGE = struct.Struct("<BQHIQQ")
"""A message's frame and head: opcode, length, channel, sequence, log time, publish time."""

MESSAGE_OPCODE = int(Opcode.MESSAGE)
"""A plain number: packing and comparing it is faster than doing so with the enumeration's."""

MESSAGE_HEAD_SIZE = MESSAGE.size - FRAME.size

INDEX_HEAD = struct.Struct("<HI")
"""What the body of a message index begins with: its channel and the size of its entries."""

INDEX_ENTRY = struct.Struct("<QQ")
"""An entry of a message index: a message's log time and its place in the chunk."""

MAX_RECORD_SIZE = 2**28
"""The largest record that is read, and the largest content of a chunk; larger ones are damage."""

_KINDS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.MESSAGE_INDEX: records.MessageIndex,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}


class RecordError(ValueError):
    """Bytes that are not the record they should be."""


class Frame(NamedTuple):
    """Where a record is: the offsets of its first byte, of its body, and of what follows it."""

    opcode: int
    start: int
    body: int
    end: int


def read_frame(stream: IO[bytes], offset: int, end: int) -> Frame:
    """Return the frame of the record at an offset.

    Args:
        stream: The file.
        offset: Where the record begins.
        end: The end of what the file holds of it.

    Raises:
        RecordError: There is no whole record of a size that can be believed.
    """
    stream.seek(offset)
    head = stream.read(FRAME.size)
    if len(head) < FRAME.size or offset + FRAME.size > end:
        raise RecordError(f"the record at byte {offset} is cut off")
    opcode, length = FRAME.unpack(head)
    body = offset + FRAME.size
    if length > end - body:
        raise RecordError(
            f"the record at byte {offset} states a length of {length} bytes, {end - body} follow"
        )
    return Frame(opcode, offset, body, body + length)


def read_body(stream: IO[bytes], frame: Frame) -> bytes:
    """Return the body of a record.

    Raises:
        RecordError: It is larger than any record should be, or the file has become shorter.
    """
    size = frame.end - frame.body
    if size > MAX_RECORD_SIZE:
        raise RecordError(f"the record at byte {frame.start} has {size} bytes, too many to read")
    stream.seek(frame.body)
    body = stream.read(size)
    if len(body) < size:
        raise RecordError(f"the record at byte {frame.start} is cut off")
    return body


def parse(opcode: int, body: bytes, *, exact: bool = False) -> Any:
    """Return the record of a body, of any kind but chunk, message and attachment; else None.

    Args:
        opcode: The kind.
        body: The body.
        exact: Whether to refuse a body with more fields, which later versions may append.

    Raises:
        RecordError: The body is not such a record, or is shorter than the lengths in it.
    """
    kind = _KINDS.get(opcode)
    if kind is None:
        return None
    written: Any = RecordBuilder()
    try:
        record = kind.read(ReadDataStream(BytesIO(body)))
        record.write(written)
    except (McapError, struct.error, ValueError) as error:
        raise RecordError(f"not a record of the kind {Opcode(opcode).name}: {error}") from error
    # The library takes a string that ends early as it is.
    content = written.end()[FRAME.size :]
    if body != content if exact else not body.startswith(content):
        raise RecordError(f"not a record of the kind {Opcode(opcode).name}")
    return record
