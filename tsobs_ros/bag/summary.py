# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summaries of bags: files, times and topics, also of bags that are not finished or damaged."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
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
from tsobs_ros.bag.metadata import BagMetadata, QosProfile, TopicInfo
from tsobs_ros.bag.reader import UNCHECKED, BagReader
from tsobs_ros.bag.recovery import DamagedBag
from tsobs_ros.errors import BagReadError, printable
from tsobs_ros.files import open_regular

_FEW_TIMES = 2**16


@dataclass(frozen=True)
class FileSummary:
    """One file of a bag: name, size in bytes, and how many messages it holds."""

    name: str
    size: int
    messages: int


@dataclass(frozen=True)
class BagSummary:
    """The summary of a bag.

    Attributes:
        path: The bag.
        problem: The reason for reading it through, message by message; empty for a finished bag.
        files: Its files.
        topics: Its topics.
        start_ns: The smallest log time, ns since the epoch; None without messages.
        end_ns: The largest log time, ns since the epoch; None without messages.
        metadata: The content of its metadata.yaml, if it has any.
        largest_gaps_ns: The longest time between two messages of a topic, ns, if it is known.
        spans_ns: The time from the first to the last message of a topic, ns, if it is known.
        unchecked: The number of messages that no checksum covers, so that damage is not noticed.
    """

    path: Path
    problem: str
    files: tuple[FileSummary, ...]
    topics: tuple[TopicInfo, ...]
    start_ns: int | None
    end_ns: int | None
    metadata: BagMetadata | None
    largest_gaps_ns: Mapping[str, int]
    spans_ns: Mapping[str, int]
    unchecked: int

    @property
    def ros_distro(self) -> str:
        """The ROS distribution it was recorded with; empty if unknown."""
        return self.metadata.ros_distro if self.metadata else ""

    @property
    def custom_data(self) -> Mapping[str, str]:
        """The notes of its recorder."""
        return (self.metadata.custom_data if self.metadata else None) or {}

    @property
    def messages(self) -> int:
        """The number of messages in all files."""
        return sum(file.messages for file in self.files)

    @property
    def size(self) -> int:
        """The size of all files, bytes."""
        return sum(file.size for file in self.files)

    @property
    def duration_ns(self) -> int:
        """The time from the smallest to the largest log time, ns."""
        return 0 if self.start_ns is None or self.end_ns is None else self.end_ns - self.start_ns

    def rate(self, topic: TopicInfo) -> float | None:
        """Return a topic's mean rate, without its largest gap, Hz; None if that is unknown.

        A gap, and the time before the first message, would make 200 Hz look like 93.
        """
        steps, span = topic.count - 1, self.spans_ns.get(topic.name, self.duration_ns) or 0
        if steps > 1:
            gap = self.largest_gaps_ns.get(topic.name, 0)
            steps, span = (steps - 1, span - gap) if gap else (steps, span)
        return steps * 1e9 / span if steps > 0 and span > 0 else None

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "bag": str(self.path),
            "problem": self.problem,
            "storage_id": "mcap",
            "ros_distro": self.ros_distro,
            "size": self.size,
            "messages": self.messages,
            "unchecked": self.unchecked,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "duration_ns": self.duration_ns,
            "custom_data": dict(self.custom_data),
            "files": [asdict(file) for file in self.files],
            "topics": [
                {
                    "name": topic.name,
                    "type": topic.type,
                    "messages": topic.count,
                    "serialization_format": "cdr",
                    "qos": [profile.to_map() for profile in topic.qos_profiles],
                    "type_hash": topic.type_hash,
                    "largest_gap_ns": self.largest_gaps_ns.get(topic.name),
                    "rate": self.rate(topic),
                }
                for topic in self.topics
            ],
        }

    def text(self) -> str:
        """Return text in the manner of `ros2 bag info`."""
        lines = [f"NOT FINISHED: {self.problem}"] if self.problem else []
        for place, file in enumerate(self.files):
            what = f"{file.name} ({_bytes(file.size)}, {file.messages} messages)"
            lines.append(f"{'' if place else 'Files:':14}{what}")
        lines += [
            f"Bag size:     {_bytes(self.size)}",
            "Storage id:   mcap",
            f"ROS distro:   {self.ros_distro or 'unknown'}",
            f"Duration:     {self.duration_ns * 1e-9:.9f} s",
            f"Start:        {_time(self.start_ns)}",
            f"End:          {_time(self.end_ns)}",
            f"Messages:     {self.messages}",
        ]
        if self.unchecked:
            lines.append(f"Unchecked:    {self.unchecked} {UNCHECKED}")
        lines += [f"Custom data:  {key}: {value}" for key, value in self.custom_data.items()]
        for topic in self.topics:
            lines.append(
                f"Topic:        {topic.name} | {topic.type} | {topic.count} messages | "
                f"cdr | {_qos(topic.qos_profiles)}{self._pace(topic)}"
            )
        return "\n".join(map(printable, lines))

    def _pace(self, topic: TopicInfo) -> str:
        rate = self.rate(topic)
        text = "" if rate is None else f" | {rate:.4g} Hz"
        gap = self.largest_gaps_ns.get(topic.name)
        return text if gap is None else f"{text} | largest gap {gap * 1e-9:.6g} s"


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
    found, unchecked = _look_into_indexes(reader.summaries)
    return BagSummary(
        path=path,
        problem="",
        files=tuple(
            FileSummary(i.path.name, i.path.stat().st_size, i.statistics.message_count)
            for i in reader.summaries
        ),
        topics=tuple(reader.topics.values()),
        start_ns=reader.start_time,
        end_ns=reader.end_time,
        metadata=reader.metadata,
        largest_gaps_ns={topic: each.gap for topic, each in found.items() if each.gap is not None},
        spans_ns={topic: each.last - each.first for topic, each in found.items()},
        unchecked=unchecked,
    )


def _of_damaged(path: Path, error: BagReadError) -> BagSummary:
    damaged = DamagedBag(path)
    if damaged.profiles - {"ros2"} or not damaged.topics:
        raise error
    for damaged_file in damaged.files:
        deque(damaged_file.messages(), maxlen=0)
    files = [each.account for each in damaged.files]
    counts = sum((file.kept for file in files), Counter[str]())
    return BagSummary(
        path=path,
        problem=str(error),
        files=tuple(FileSummary(file.name, file.bytes_read, file.kept.total()) for file in files),
        topics=tuple(replace(topic, count=counts[topic.name]) for topic in damaged.topics.values()),
        start_ns=min((f.start_ns for f in files if f.start_ns is not None), default=None),
        end_ns=max((f.end_ns for f in files if f.end_ns is not None), default=None),
        metadata=damaged.metadata,
        largest_gaps_ns={},
        spans_ns={},
        unchecked=sum(file.unchecked for file in files),
    )


class _Topic:
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


def _look_into_indexes(summaries: Sequence[Summary]) -> tuple[dict[str, _Topic], int]:
    """Return what the indexes and the heads of the chunks tell, without reading any message.

    Topics with fewer than two messages are left out, and those in files without message indexes.
    The number is that of the unchecked messages.

    Raises:
        BagReadError: An index is damaged.
    """
    found: dict[str, _Topic] = {}
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
                            found.setdefault(topics[channel], _Topic()).add(times, span.start)
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


def _qos(profiles: tuple[QosProfile, ...]) -> str:
    if not profiles:
        return "QoS unknown"
    offers = Counter(f"{p.reliability}, {p.durability}" for p in profiles)
    return "; ".join(f"{n} x {offer}" if n > 1 else offer for offer, n in offers.items())
