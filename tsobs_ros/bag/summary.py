# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summaries of bags: files, times and topics, also of bags that are not finished or damaged."""

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from tsobs_ros.bag.container import (
    CHUNK_HEAD_SIZE,
    INDEX_HEAD,
    MAX_SIZE,
    RECORD,
    ROW,
    RecordError,
    Rows,
    Span,
    chunk_head,
)
from tsobs_ros.bag.metadata import BagMetadata, TopicInfo
from tsobs_ros.bag.reader import UNCHECKED, BagReader
from tsobs_ros.bag.recovery import DamagedBag
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.files import open_regular

_LAST = 2**63 - 2


class BagSummary(dict[str, Any]):
    """The summary of a bag, as plain data.

    The problem is the reason for which it was read message by message, empty for a finished bag.
    `size` is in bytes, log times are in ns since the epoch, the rates of topics in Hz. Unchecked
    messages are those without a checksum. Unknown values, such as the times of a bag without
    messages, are None.
    """

    def text(self) -> str:
        """Return text in the manner of `ros2 bag info`."""
        lines = [f"NOT FINISHED: {self['problem']}"] if self["problem"] else []
        for place, file in enumerate(self["files"]):
            what = f"{file['name']} ({_bytes(file['size'])}, {file['messages']} messages)"
            lines.append(f"{'' if place else 'Files:':14}{what}")
        lines += [
            f"Bag size:     {_bytes(self['size'])}",
            f"Storage id:   {self['storage_id']}",
            f"ROS distro:   {self['ros_distro'] or 'unknown'}",
            f"Duration:     {self['duration_ns'] * 1e-9:.9f} s",
            f"Start:        {_time(self['start_ns'])}",
            f"End:          {_time(self['end_ns'])}",
            f"Messages:     {self['messages']}",
        ]
        if self["unchecked"]:
            lines.append(f"Unchecked:    {self['unchecked']} {UNCHECKED}")
        lines += [f"Custom data:  {key}: {value}" for key, value in self["custom_data"].items()]
        for topic in self["topics"]:
            rate, gap = topic["rate"], topic["largest_gap_ns"]
            parts = [topic["name"], topic["type"], f"{topic['messages']} messages", "cdr"]
            parts += [_qos(topic["qos"])]
            parts += [] if rate is None else [f"{rate:.4g} Hz"]
            parts += [] if gap is None else [f"largest gap {gap * 1e-9:.6g} s"]
            lines.append(f"Topic:        {' | '.join(parts)}")
        return "\n".join(map(printable, lines))


def summarise(bag: str | Path) -> BagSummary:
    """Return the summary of a bag; one that is not finished or is damaged is read through.

    Args:
        bag: A bag folder, or one MCAP file.

    Raises:
        BagReadError: There is no bag of ROS 2, or nothing can be read of it.
    """
    path = Path(bag)
    try:
        reader = BagReader(path)
    except BagReadError as error:
        return _of_damaged(path, error)
    indexes = _Indexes(reader)
    files = [
        {"name": s.path.name, "size": s.path.stat().st_size, "messages": s.statistics.message_count}
        for s in reader.summaries
    ]
    topics = [_topic(topic, *indexes.pace(topic)) for topic in reader.topics.values()]
    return BagSummary(
        bag=str(path),
        problem="",
        **_summary(files, reader.start_time, reader.end_time, reader.metadata),
        unchecked=indexes.unchecked,
        topics=topics,
    )


def _of_damaged(path: Path, error: BagReadError) -> BagSummary:
    damaged = DamagedBag(path)
    if damaged.profiles - {"ros2"} or not damaged.topics:
        raise error
    for file in damaged.files:
        deque(file.messages(), maxlen=0)
    accounts = [file.account for file in damaged.files]
    files = [
        {"name": each.name, "size": each.bytes_read, "messages": each.kept.total()}
        for each in accounts
    ]
    start = min((each.start_ns for each in accounts if each.start_ns is not None), default=None)
    end = max((each.end_ns for each in accounts if each.end_ns is not None), default=None)
    found = _summary(files, start, end, damaged.metadata)
    counts = sum((each.kept for each in accounts), Counter[str]())
    topics = [
        _topic(replace(topic, count=counts[topic.name]), found["duration_ns"], None)
        for topic in damaged.topics.values()
    ]
    unchecked = sum(each.unchecked for each in accounts)
    return BagSummary(
        bag=str(path), problem=str(error), **found, unchecked=unchecked, topics=topics
    )


def _summary(
    files: list[dict[str, Any]], start: int | None, end: int | None, metadata: BagMetadata | None
) -> dict[str, Any]:
    return {
        "storage_id": "mcap",
        "ros_distro": metadata.ros_distro if metadata else "",
        "size": sum(file["size"] for file in files),
        "messages": sum(file["messages"] for file in files),
        "start_ns": start,
        "end_ns": end,
        "duration_ns": 0 if start is None or end is None else end - start,
        "custom_data": dict((metadata.custom_data if metadata else None) or {}),
        "files": files,
    }


def _topic(topic: TopicInfo, span: int, gap: int | None) -> dict[str, Any]:
    """Return what there is of a topic, from its first to its last message [ns].

    Its rate is the mean without the largest gap: that, and the time before the first message, would
    make 200 Hz look like 93.
    """
    steps = topic.count - 1
    if steps > 1 and gap:
        steps, span = steps - 1, span - gap
    return {
        "name": topic.name,
        "type": topic.type,
        "messages": topic.count,
        "serialization_format": "cdr",
        "qos": [profile.to_map() for profile in topic.qos_profiles],
        "type_hash": topic.type_hash,
        "largest_gap_ns": gap,
        "rate": steps * 1e9 / span if steps > 0 and span > 0 else None,
    }


class _Indexes:
    """What the message indexes of a bag state: times of topics, without reading a message.

    `unchecked` is the number of messages without a checksum.

    Raises:
        BagReadError: An index is damaged.
    """

    def __init__(self, reader: BagReader) -> None:
        numbers = {name: number for number, name in enumerate(reader.topics)}
        self._reader, self._numbers = reader, numbers
        self._topics = [
            {id_: numbers[channel.topic] for id_, channel in summary.channels.items()}
            for summary in reader.summaries
        ]
        # The topics in chunks without indexes.
        self._unknown = {
            number
            for summary, topics in zip(reader.summaries, self._topics, strict=True)
            if not all(span.places for span in summary.spans)
            for number in topics.values()
        }
        self._room = [summary.path.stat().st_size for summary in reader.summaries]
        self._checked = Counter[int]()
        self._with_unchecked = set[int]()
        # First and last time of each topic, and its largest gap, once there are any.
        self._first, self._last, self._gap = np.full((3, len(numbers)), -1)
        spans = chain.from_iterable(summary.spans for summary in reader.summaries)
        for rows, _ in reader.in_log_order(spans, self._load, ROW.itemsize):
            self._measure(rows[np.argsort(rows["channel"], kind="stable")])
        self.unchecked = sum(
            reader.summaries[rank].statistics.message_count - self._checked[rank]
            for rank in self._with_unchecked
        )

    def pace(self, topic: TopicInfo) -> tuple[int, int | None]:
        """Return the time from a topic's first to its last message, and its largest gap [ns]."""
        number = self._numbers[topic.name]
        if self._gap[number] < 0 or number in self._unknown:
            start, end = self._reader.start_time, self._reader.end_time
            return (0 if start is None or end is None else end - start), None
        return int(self._last[number] - self._first[number]), int(self._gap[number])

    def _load(self, span: Span) -> tuple[Rows, bytes]:
        """Return the messages that a chunk's indexes state."""
        path, topics = self._reader.files[span.rank], self._topics[span.rank]
        parts = [np.zeros(0, ROW)]
        try:
            with open_regular(path) as stream:
                if not (is_checked := _has_checksum(stream, span)):
                    self._with_unchecked.add(span.rank)
                for channel, offset in span.index_offsets.items():
                    times = _index_times(stream, offset)
                    self._checked[span.rank] += times.size if is_checked else 0
                    self._room[span.rank] -= INDEX_HEAD.size + 2 * times.nbytes
                    if self._room[span.rank] < 0:
                        raise ValueError("the message indexes overlap")
                    parts.append(np.zeros(times.size if channel in topics else 0, ROW))
                    parts[-1]["channel"] = topics.get(channel, 0)
                    parts[-1]["log_time"] = np.minimum(times, _LAST)[: len(parts[-1])]
        except (OSError, ValueError, OverflowError) as error:
            raise BagReadError(f"{path}: {error}") from error
        rows = np.concatenate(parts)
        return rows[np.argsort(rows["log_time"], kind="stable")], b""

    def _measure(self, rows: Rows) -> None:
        """Take messages that are sorted by topic and then by time, behind all before."""
        topics, times = rows["channel"], rows["log_time"]
        begins = np.flatnonzero(np.diff(topics, prepend=-1))
        of_begins, ends = topics[begins], np.append(begins[1:], len(rows)) - 1
        before = np.append(-1, times[:-1])
        before[begins] = self._last[of_begins]
        has_one = before >= 0
        np.maximum.at(self._gap, topics[has_one], times[has_one] - before[has_one])
        is_new = self._first[of_begins] < 0
        self._first[of_begins[is_new]] = times[begins[is_new]]
        self._last[of_begins] = times[ends]


def _has_checksum(stream: IO[bytes], span: Span) -> bool:
    if span.is_chunk:
        stream.seek(span.offset)
        with suppress(RecordError):
            return chunk_head(stream.read(CHUNK_HEAD_SIZE))[0].uncompressed_crc != 0
    return False


def _index_times(stream: IO[bytes], offset: int) -> NDArray[np.uint64]:
    """Return the log times in the message index at an offset, in its order."""
    stream.seek(offset)
    head = stream.read(INDEX_HEAD.size).ljust(INDEX_HEAD.size, b"\0")
    opcode, length, _, size = INDEX_HEAD.unpack(head)
    is_index = opcode == Opcode.MESSAGE_INDEX and size <= MAX_SIZE and size % 16 == 0
    if not is_index or length != INDEX_HEAD.size - RECORD.size + size:
        raise ValueError(f"the index states a message index at byte {offset}, but there is none")
    if len(entries := stream.read(size)) != size:
        raise ValueError(f"the message index at byte {offset} is cut off")
    return np.frombuffer(entries, "<u8")[::2]


def _bytes(size: int) -> str:
    value, unit = float(size), "B"
    for larger in ("KiB", "MiB", "GiB", "TiB"):
        if value < 1024:
            break
        value, unit = value / 1024, larger
    return f"{value:.1f} {unit}" if unit != "B" else f"{size} B"


def _time(stamp: int | None) -> str:
    if stamp is None:
        return "none"
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    date = datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
    return f"{date}.{nanoseconds:09d} UTC ({seconds}.{nanoseconds:09d})"


def _qos(profiles: Iterable[Mapping[str, Any]]) -> str:
    offers = Counter(f"{p['reliability']}, {p['durability']}" for p in profiles)
    texts = (f"{n} x {offer}" if n > 1 else offer for offer, n in offers.items())
    return "; ".join(texts) or "QoS unknown"
