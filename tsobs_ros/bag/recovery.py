# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of a damaged bag: a whole bag of what its files still hold, and an account of it."""

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from mcap.records import Channel, Header, McapRecord, Metadata, Schema

from tsobs_ros.bag.container import Records
from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    BagMetadata,
    TopicInfo,
    TopicReader,
    read_metadata,
)
from tsobs_ros.bag.walker import Damage, FileWalker, Progress
from tsobs_ros.bag.writer import BagWriter, whole_bag
from tsobs_ros.errors import BagReadError, BagWriteError, printable
from tsobs_ros.files import open_regular
from tsobs_ros.yaml_files import MAX_BYTES, load_yaml

_SHOWN = 10
_MAX_DESCRIPTIONS = 2**26
_NUMBER = re.compile(r"_(\d+)$")


@dataclass
class FileRecovery:
    """The account of one file.

    Attributes:
        name: The name of the file.
        bytes_read: Its size.
        finished: Whether its recorder had closed it.
        kept: The number of messages kept, by topic.
        unchecked: The number of messages kept that no checksum covers.
        dropped: The number of messages found and not kept, by reason.
        missing: The number of messages that the file states, but does not hold, by topic.
        damage: The parts that are lost.
        start_ns: The smallest log time kept, ns since the epoch; None without messages.
        end_ns: The largest log time kept, ns since the epoch; None without messages.
        error: The reason why it was not read at all; empty if it was.
    """

    name: str
    bytes_read: int = 0
    finished: bool = False
    kept: Counter[str] = field(default_factory=Counter)
    unchecked: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    missing: Counter[str] = field(default_factory=Counter)
    damage: list[Damage] = field(default_factory=list)
    start_ns: int | None = None
    end_ns: int | None = None
    error: str = ""

    @property
    def is_whole(self) -> bool:
        """Whether nothing is known to be lost."""
        return not (self.error or self.damage or self.dropped or self.missing)

    def lines(self) -> list[str]:
        """Return lines for people."""
        if self.error:
            return [f"{self.name}: not read: {self.error}"]
        state = "finished" if self.finished else "without what its recorder had not flushed"
        kept = f"{self.kept.total()} messages kept"
        lines = [f"{self.name}: {self.bytes_read} bytes, {state}: {kept}"]
        lines += [f"  kept {count} of {topic}" for topic, count in sorted(self.kept.items())]
        if self.start_ns is not None and self.end_ns is not None:
            duration = (self.end_ns - self.start_ns) * 1e-9
            lines.append(f"  from {self.start_ns} ns to {self.end_ns} ns ({duration:.3f} s)")
        if self.unchecked:
            lines.append(f"  unchecked {self.unchecked}: no checksum covers these messages")
        lines += [f"  lost {count} of {topic}" for topic, count in self.missing.items()]
        lines += [f"  dropped {count}: {reason}" for reason, count in self.dropped.items()]
        lines += [f"  damaged: {part}" for part in self.damage[:_SHOWN]]
        if len(self.damage) > _SHOWN:
            lines.append(f"  damaged: {len(self.damage) - _SHOWN} more parts")
        return lines


@dataclass(frozen=True)
class Recovery:
    """The account of a recovery: the damaged bag, the one made of it, its files, and remarks."""

    source: Path
    output: Path
    files: tuple[FileRecovery, ...]
    remarks: tuple[str, ...]

    @property
    def message_count(self) -> int:
        """The number of messages kept."""
        return sum(file.kept.total() for file in self.files)

    @property
    def unchecked(self) -> int:
        """The number of messages kept that no checksum covers."""
        return sum(file.unchecked for file in self.files)

    @property
    def is_whole(self) -> bool:
        """Whether nothing is known to be lost, and a checksum covers every message."""
        return not self.unchecked and all(file.is_whole for file in self.files)

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "source": str(self.source),
            "output": str(self.output),
            "messages": self.message_count,
            "whole": self.is_whole,
            "remarks": list(self.remarks),
            "files": [
                vars(file) | {"damage": [vars(part) for part in file.damage]} for file in self.files
            ],
        }

    def text(self) -> str:
        """Return the same for people to read."""
        lines = [*self.remarks, *(line for file in self.files for line in file.lines())]
        if not all(file.is_whole for file in self.files):
            verdict = "NOT EVERYTHING, see above"
        elif self.unchecked:
            verdict = f"{self.unchecked} UNCHECKED, damage in them is not noticed"
        else:
            verdict = "nothing known to be lost"
        lines.append(f"{self.message_count} messages in {self.output}: {verdict}")
        return "\n".join(map(printable, lines))


class DamagedBag:
    """The messages of a bag that may be damaged, read once.

    A topic is looked for in the chunks of a file and in its summary.

    Args:
        bag: A bag folder, with or without metadata.yaml, or one MCAP file.
        is_trusted: Whether to read chunks however much they decompress to.

    Attributes:
        files: The accounts of its files, in the order of recording.
        topics: The topics found so far, by name.
        metadata: The metadata of the bag, of its folder or else of a file; None if it is lost.
        profiles: The profiles in the headers of the files so far.
        remarks: Further facts for a user.

    Raises:
        BagReadError: There is no bag.
    """

    def __init__(self, bag: Path, *, is_trusted: bool = False) -> None:
        self._paths, self.metadata, self.remarks = _find_files(bag)
        self._is_trusted = is_trusted
        self.files = [FileRecovery(path.name) for path in self._paths]
        self.topics: dict[str, TopicInfo] = {}
        self.profiles: set[str] = set()

    def messages(
        self, place: int, progress: Progress = lambda _: None
    ) -> Iterator[tuple[str, bytes, int, int]]:
        """Yield topic, data, log time and publish time [ns] of what is kept of a file; count it."""
        account, path = self.files[place], self._paths[place]
        try:
            with open_regular(path) as stream:
                yield from _File(self, account, stream).messages(progress, self._is_trusted)
        except OSError as error:
            account.error = error.strerror or str(error)


class _File:
    """One file: what describes its topics, and its messages."""

    def __init__(self, bag: DamagedBag, account: FileRecovery, stream: IO[bytes]) -> None:
        self._bag, self._account, self._stream = bag, account, stream
        self._has_header = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        # The topic of each channel, or why its messages are dropped.
        self._topics: dict[int, str] = {}
        self._reasons: dict[int, str] = {}
        self._read_topic = TopicReader()
        self._room, self._metadata_room = _MAX_DESCRIPTIONS, MAX_BYTES

    def messages(
        self, progress: Progress, is_trusted: bool
    ) -> Iterator[tuple[str, bytes, int, int]]:
        account = self._account
        account.bytes_read = self._stream.seek(0, 2)
        walker = FileWalker(self._stream, account.bytes_read, is_trusted=is_trusted)
        account.damage, account.finished = walker.damage, walker.has_end
        summary = walker.summary
        for record in (*summary.schemas.values(), *summary.channels.values()) if summary else ():
            self._describe(record)
        for part in walker.parts(progress):
            for described in part.described():
                self._describe(described)
            if part.content is not None:
                counted = account.kept.total()
                yield from self._kept(part.content)
                account.unchecked += 0 if part.is_checked else account.kept.total() - counted
        counts = summary.statistics.channel_message_counts.items() if summary else ()
        stated = Counter({self._topics.get(id_, f"channel {id_}"): n for id_, n in counts})
        account.missing = stated - account.kept

    def _kept(self, content: Records) -> Iterator[tuple[str, bytes, int, int]]:
        account = self._account
        for channel, log_time, publish_time, data in content.messages():
            if (topic := self._topics.get(channel)) is None:
                lost = f"of channel {channel}, whose topic is lost"
                account.dropped[self._reasons.get(channel, lost)] += 1
            elif not (0 <= log_time < EMPTY_START_NS and 0 <= publish_time < EMPTY_START_NS):
                account.dropped[f"of {topic}, whose times do not fit 63 bits"] += 1
            else:
                yield topic, data, log_time, publish_time
                account.kept[topic] += 1
                if account.start_ns is None or log_time < account.start_ns:
                    account.start_ns = log_time
                if account.end_ns is None or log_time > account.end_ns:
                    account.end_ns = log_time

    def _describe(self, record: McapRecord | None) -> None:
        match record:
            case Header() if not self._has_header:
                self._has_header = True
                self._bag.profiles.add(record.profile)
                if record.profile != "ros2":  # the header may be damaged: CDR is enough
                    remark = f"{self._account.name}: its profile is '{record.profile}'"
                    self._bag.remarks.append(f"{remark}, expected 'ros2'")
            case Metadata(name="rosbag2"):
                text = record.metadata.get("serialized_metadata", "")
                self._metadata_room -= len(text)
                if self._metadata_room >= 0 and self._bag.metadata is None:
                    with suppress(ValueError):
                        self._bag.metadata = BagMetadata.from_map(load_yaml(text))
            case Schema():
                known = self._schemas.get(record.id)
                if known is None and self._has_room(len(record.data)):
                    self._schemas[record.id] = record
                elif known is not None and known.name != record.name:
                    for id_, channel in self._channels.items():
                        if channel.schema_id == record.id:
                            self._contradict(id_)
            case Channel():
                self._describe_channel(record)

    def _describe_channel(self, channel: Channel) -> None:
        if known := self._channels.get(channel.id):
            mine, its = ((c.topic, c.schema_id, c.message_encoding) for c in (known, channel))
            if mine != its:
                self._contradict(channel.id)
            return
        if not self._has_room(sum(map(len, (*channel.metadata, *channel.metadata.values())))):
            return
        self._channels[channel.id] = channel
        try:
            topic = self._read_topic(channel, self._schemas.get(channel.schema_id))
            if self._bag.topics.setdefault(topic.name, topic).type != topic.type:
                raise ValueError(f"is a {topic.type} here, but not elsewhere")
            self._topics[channel.id] = topic.name
        except ValueError as error:
            self._reasons[channel.id] = f"of {channel.topic}, which {error}"

    def _contradict(self, id_: int) -> None:
        """Drop further messages of a channel that is described as another: of another file."""
        self._topics.pop(id_, None)
        self._reasons[id_] = f"of channel {id_}, which is described as two topics"

    def _has_room(self, size: int) -> bool:
        self._room -= size
        return self._room >= 0


def recover(
    bag: str | Path,
    output: str | Path,
    *,
    compression: str = "zstd",
    is_trusted: bool = False,
    progress: Progress = lambda _: None,
) -> Recovery:
    """Make a whole bag of what a damaged one still holds; the damaged one is only read.

    Every message is kept as it was recorded, in the order of recording. The new bag has a file for
    each file that messages were found in. Memory is bounded by the largest chunk.

    Args:
        bag: A bag folder, with or without metadata.yaml, or one MCAP file.
        output: The folder to make, which must not exist.
        compression: Of the new bag's chunks: `none`, `lz4` or `zstd`.
        is_trusted: Whether to read chunks however much they decompress to.
        progress: Called with the number of bytes that were read since the last call.

    Raises:
        BagReadError: There is no bag, or no message of ROS 2 can be recovered.
        BagWriteError: The output exists or cannot be written.
    """
    source, target = Path(bag), Path(output).absolute()
    damaged = DamagedBag(source, is_trusted=is_trusted)
    if target.exists():
        raise BagWriteError(f"{target}: exists already, bags are not overwritten")
    if source.resolve() in target.resolve().parents:
        raise BagWriteError(f"{target}: is inside of the bag {source}, which is not touched")
    writer: BagWriter | None = None

    def add_topics(writer: BagWriter) -> int:
        for each in damaged.topics.values():
            writer.add_topic(each.name, each.type, each.qos_profiles, definition=each.definition)
        return len(damaged.topics)

    with ExitStack() as stack:
        added = 0
        for place in range(len(damaged.files)):
            if writer is not None:
                writer.split()
            for message in damaged.messages(place, progress):
                if writer is None:
                    notes = damaged.metadata.custom_data if damaged.metadata else None
                    new = whole_bag(target, compression=compression, custom_data=notes)
                    writer = stack.enter_context(new)
                if added < len(damaged.topics):
                    added = add_topics(writer)
                writer.write(*message)
            if writer is not None:
                added = add_topics(writer)  # those without messages, too
    if writer is None:
        each = (
            f"{file.name}: {file.error or next(map(str, file.damage), 'it holds no messages')}"
            for file in damaged.files
        )
        raise BagReadError(f"{source}: no message can be recovered: {'; '.join(each)}")
    return Recovery(source, target, tuple(damaged.files), tuple(damaged.remarks))


def _find_files(bag: Path) -> tuple[list[Path], BagMetadata | None, list[str]]:
    """Return the files of a bag in order of recording, missing ones included, and what names them.

    Raises:
        BagReadError: There is no such folder or file, or no MCAP file in it.
    """
    if not bag.is_dir():
        if not bag.exists():
            raise BagReadError(f"{bag}: there is no such bag")
        return [bag], None, []
    metadata, remarks = None, []
    try:
        metadata = read_metadata(bag)
    except BagReadError as reason:
        remarks.append(str(reason))
    listed = [bag / Path(file.path).name for file in metadata.files] if metadata else []
    try:
        # Not glob, which takes a folder that cannot be read for an empty one.
        present = sorted((p for p in bag.iterdir() if p.suffix == ".mcap"), key=_by_number)
    except OSError as reason:
        raise BagReadError(f"{bag}: cannot read it: {reason}") from reason
    unlisted = [path for path in present if path not in listed]
    if not (listed or unlisted):
        raise BagReadError(f"{bag}: not a bag, there is no .mcap file in it")
    if metadata:
        remarks += [f"{path.name}: not named by metadata.yaml" for path in unlisted]
    return [*listed, *unlisted], metadata, remarks


def _by_number(path: Path) -> tuple[int, str]:
    match = _NUMBER.search(path.stem)
    return (int(match[1]) if match else -1, path.name)
