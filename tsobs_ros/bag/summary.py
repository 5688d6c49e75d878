# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a bag is about: its files, its times and its topics; also of one that is not finished."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tsobs_ros.bag.folder import find_files
from tsobs_ros.bag.mcap.gaps import largest_gaps
from tsobs_ros.bag.metadata import BagMetadata
from tsobs_ros.bag.qos import QosProfile
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.bag.recovery.destinations import KnownTopics
from tsobs_ros.bag.recovery.harvest import harvest
from tsobs_ros.bag.recovery.survey import survey
from tsobs_ros.errors import BagReadError


@dataclass(frozen=True)
class FileSummary:
    """One file of a bag: name, size in bytes, and how many messages it holds."""

    name: str
    size: int
    messages: int


@dataclass(frozen=True)
class TopicSummary:
    """One topic of a bag.

    Attributes:
        name: The full topic name.
        type: The message type, `package/msg/Type`.
        messages: How many messages of it the bag holds.
        serialization_format: How they are encoded.
        qos: What its publishers offered.
        type_hash: The RIHS01 hash of its type, or an empty string.
        largest_gap_ns: The longest time between two messages, ns; None if that is not known.
    """

    name: str
    type: str
    messages: int
    serialization_format: str
    qos: tuple[QosProfile, ...]
    type_hash: str
    largest_gap_ns: int | None


@dataclass(frozen=True)
class BagSummary:
    """What a bag is about.

    Attributes:
        path: The bag.
        problem: Why it had to be read through, message by message; empty for a finished bag.
        files: Its files.
        topics: Its topics.
        start_ns: The smallest log time, ns since the epoch; None without messages.
        end_ns: The largest log time, ns since the epoch; None without messages.
        ros_distro: The ROS distribution it was recorded with; empty if unknown.
        custom_data: What its recorder wanted remembered.
    """

    path: Path
    problem: str
    files: tuple[FileSummary, ...]
    topics: tuple[TopicSummary, ...]
    start_ns: int | None
    end_ns: int | None
    ros_distro: str
    custom_data: Mapping[str, str]

    @property
    def messages(self) -> int:
        """How many messages the bag holds."""
        return sum(file.messages for file in self.files)

    @property
    def size(self) -> int:
        """The size of all files, bytes."""
        return sum(file.size for file in self.files)

    @property
    def duration_ns(self) -> int:
        """The time from the smallest to the largest log time, ns."""
        return 0 if self.start_ns is None or self.end_ns is None else self.end_ns - self.start_ns

    def rate(self, topic: TopicSummary) -> float | None:
        """Return a topic's mean rate over the whole bag, Hz; None if that has no duration."""
        return topic.messages * 1e9 / self.duration_ns if self.duration_ns else None

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "bag": str(self.path),
            "problem": self.problem,
            "storage_id": "mcap",
            "ros_distro": self.ros_distro,
            "size": self.size,
            "messages": self.messages,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "duration_ns": self.duration_ns,
            "custom_data": dict(self.custom_data),
            "files": [asdict(file) for file in self.files],
            "topics": [
                {
                    **asdict(topic),
                    "qos": [profile.to_map() for profile in topic.qos],
                    "rate": self.rate(topic),
                }
                for topic in self.topics
            ],
        }

    def text(self) -> str:
        """Return the same for people to read, much as `ros2 bag info` does."""
        lines = [f"NOT FINISHED: {self.problem}"] if self.problem else []
        files = [f"{f.name} ({_bytes(f.size)}, {f.messages} messages)" for f in self.files]
        lines += [
            f"Files:        {f'{chr(10)}              '.join(files)}",
            f"Bag size:     {_bytes(self.size)}",
            "Storage id:   mcap",
            f"ROS distro:   {self.ros_distro or 'unknown'}",
            f"Duration:     {self.duration_ns * 1e-9:.9f} s",
            f"Start:        {_time(self.start_ns)}",
            f"End:          {_time(self.end_ns)}",
            f"Messages:     {self.messages}",
        ]
        lines += [f"Custom data:  {key}: {value}" for key, value in self.custom_data.items()]
        for topic in self.topics:
            lines.append(
                f"Topic:        {topic.name} | {topic.type} | {topic.messages} messages | "
                f"{topic.serialization_format} | {_qos(topic.qos)}{self._pace(topic)}"
            )
        return "\n".join(lines)

    def _pace(self, topic: TopicSummary) -> str:
        rate = self.rate(topic) if topic.messages > 1 else None
        text = "" if rate is None else f" | {rate:.4g} Hz"
        gap = topic.largest_gap_ns
        return text if gap is None else f"{text} | largest gap {gap * 1e-9:.6g} s"


def summarise(bag: str | Path) -> BagSummary:
    """Tell what a bag is about; one that is not finished or is damaged is read through for it.

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
    gaps = largest_gaps(reader.indexes)
    metadata = reader.metadata
    return BagSummary(
        path=path,
        problem="",
        files=tuple(
            FileSummary(i.path.name, i.path.stat().st_size, i.statistics.message_count)
            for i in reader.indexes
        ),
        topics=tuple(
            TopicSummary(
                topic.name,
                topic.type,
                topic.count,
                "cdr",
                topic.qos_profiles,
                topic.type_hash,
                gaps.get(topic.name) if topic.count > 1 else None,
            )
            for topic in reader.topics.values()
        ),
        start_ns=reader.start_time,
        end_ns=reader.end_time,
        ros_distro=metadata.ros_distro if metadata else "",
        custom_data=(metadata.custom_data if metadata else None) or {},
    )


def _of_damaged(path: Path, error: BagReadError) -> BagSummary:
    """Read all of a bag whose end or description is missing."""
    found = find_files(path)
    try:
        surveys = [survey(file) for file in found.paths if file.is_file()]
    except OSError:
        raise error from None
    if any(told.profile not in (None, "ros2") for told in surveys):
        raise error
    known = KnownTopics(surveys, found.metadata)
    files = [harvest(told, known.destinations(told), lambda _: None) for told in surveys]
    if not known.topics:
        raise error
    counts = sum((file.kept for file in files), Counter[str]())
    metadata: BagMetadata | None = found.metadata or next(
        (told.metadata for told in surveys if told.metadata), None
    )
    return BagSummary(
        path=path,
        problem=str(error),
        files=tuple(FileSummary(file.name, file.size, file.kept.total()) for file in files),
        topics=tuple(
            TopicSummary(
                topic.name,
                topic.definition.type,
                counts[topic.name],
                "cdr",
                topic.qos,
                topic.definition.type_hash,
                None,
            )
            for topic in known.topics.values()
        ),
        start_ns=min((f.start_ns for f in files if f.start_ns is not None), default=None),
        end_ns=max((f.end_ns for f in files if f.end_ns is not None), default=None),
        ros_distro=metadata.ros_distro if metadata else "",
        custom_data=(metadata.custom_data if metadata else None) or {},
    )


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
