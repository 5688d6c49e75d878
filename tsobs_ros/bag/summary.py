# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summaries of bags: files, times and topics, also of bags that are not finished or damaged."""

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain, groupby
from operator import attrgetter
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
    RecordError,
    Span,
    Summary,
    chunk_head,
)
from tsobs_ros.bag.metadata import BagMetadata, TopicInfo
from tsobs_ros.bag.reader import UNCHECKED, BagReader
from tsobs_ros.bag.recovery import DamagedBag
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.files import open_regular

_FEW_TIMES = 2**16


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
    times, unchecked = _look_into_indexes(reader.summaries)
    files = [
        {"name": s.path.name, "size": s.path.stat().st_size, "messages": s.statistics.message_count}
        for s in reader.summaries
    ]
    found = _summary(files, reader.start_time, reader.end_time, reader.metadata)
    topics = [
        _topic(topic, times.get(topic.name), found["duration_ns"])
        for topic in reader.topics.values()
    ]
    found |= {"unchecked": unchecked, "topics": topics}
    return BagSummary(bag=str(path), problem="", **found)


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
        _topic(replace(topic, count=counts[topic.name]), None, found["duration_ns"])
        for topic in damaged.topics.values()
    ]
    unchecked = sum(each.unchecked for each in accounts)
    found |= {"unchecked": unchecked, "topics": topics}
    return BagSummary(bag=str(path), problem=str(error), **found)


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


def _topic(topic: TopicInfo, times: "_Times | None", duration: int) -> dict[str, Any]:
    """Return what there is of a topic.

    Its rate is the mean without the largest gap: that, and the time before the first message, would
    make 200 Hz look like 93.
    """
    gap, steps = None if times is None else times.gap, topic.count - 1
    span = duration if times is None else times.last - times.first
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


class _Times:
    """The times of a topic: the first, the last, and the largest gap between two."""

    def __init__(self) -> None:
        self.first, self.last = 2**64, 0
        self.gap: int | None = None
        # Times that those of later chunks may still fall between, and new ones.
        self._open: NDArray[np.uint64] = np.empty(0, np.uint64)
        self._added: list[NDArray[np.uint64]] = []
        self._room = _FEW_TIMES

    def add(self, times: NDArray[np.uint64], start: int) -> None:
        """Take a chunk's times, in any order; no later chunk starts before this one's start."""
        self._added.append(times)
        self._room -= times.size
        if self._room < 0:
            self.measure(start)

    def measure(self, start: int = 2**64 - 1) -> None:
        """Measure the gaps up to the start of a chunk."""
        self._open = np.sort(np.concatenate((self._open, *self._added)))
        end = max(1, int(np.searchsorted(self._open, np.uint64(start), side="right")))
        if end > 1:
            self.gap = max(self.gap or 0, int(np.diff(self._open[:end]).max()))
        self.first = min(self.first, int(self._open[0]))
        self.last = max(self.last, int(self._open[-1]))
        self._open = self._open[end - 1 :]
        # Sorting only what has doubled takes n log n, however the chunks overlap.
        self._added, self._room = [], max(_FEW_TIMES, self._open.size)


def _look_into_indexes(summaries: Sequence[Summary]) -> tuple[dict[str, _Times], int]:
    """Return the times in the indexes of the chunks, without reading any message.

    Topics with fewer than two messages are left out, and those in files without message indexes.
    The number is that of the unchecked messages.

    Raises:
        BagReadError: An index is damaged.
    """
    found: dict[str, _Times] = {}
    unknown: set[str] = set()
    checked: Counter[int] = Counter()
    unchecked: set[int] = set()
    spans = sorted(chain.from_iterable(each.spans for each in summaries), key=attrgetter("start"))
    sizes = [each.path.stat().st_size for each in summaries]
    # Files seldom overlap, so each is opened about once, and only one is open at a time.
    for rank, group in groupby(spans, key=attrgetter("rank")):
        path = summaries[rank].path
        topics = {id_: channel.topic for id_, channel in summaries[rank].channels.items()}
        try:
            with open_regular(path) as stream:
                for span in group:
                    if not (is_checked := _has_checksum(stream, span)):
                        unchecked.add(rank)
                    if not span.places:
                        unknown.update(topics.values())
                    for channel, offset in span.index_offsets.items():
                        times = _index_times(stream, offset)
                        sizes[rank] -= INDEX_HEAD.size + 2 * times.nbytes
                        if sizes[rank] < 0:
                            raise ValueError("the message indexes overlap")
                        checked[rank] += times.size if is_checked else 0
                        if channel in topics and times.size:
                            found.setdefault(topics[channel], _Times()).add(times, span.start)
        except (OSError, ValueError, OverflowError) as error:
            raise BagReadError(f"{path}: {error}") from error
    for each in found.values():
        each.measure()
    known = {t: each for t, each in found.items() if each.gap is not None and t not in unknown}
    counts = [summaries[rank].statistics.message_count - checked[rank] for rank in unchecked]
    return known, sum(counts)


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
    # A copy, as the other half of the entries is not needed.
    return np.frombuffer(entries, "<u8")[::2].copy()


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
