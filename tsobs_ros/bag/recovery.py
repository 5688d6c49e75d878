# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of a damaged bag: a whole bag of what its files still hold, and an account of it."""

import re
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import IO, Any

from mcap.records import Channel, Footer, Header, McapRecord, Metadata, Schema, Statistics

from tsobs_ros.bag.container import Records
from tsobs_ros.bag.definitions import (
    MessageDefinition,
    MessageLayout,
    UnknownLayoutError,
    find_definition,
)
from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    TYPE_HASH,
    BagMetadata,
    OfferedQos,
    QosProfile,
    TopicInfo,
    read_metadata,
)
from tsobs_ros.bag.walker import Damage, FileWalker, Progress
from tsobs_ros.bag.writer import LIBRARY, BagWriter, whole_bag
from tsobs_ros.errors import BagReadError, BagWriteError, printable
from tsobs_ros.files import open_regular

_SHOWN = 10
_MAX_DESCRIPTIONS = 2**26
_NUMBER = re.compile(r"_(\d+)$")


@dataclass
class FileRecovery:
    """The account of one file.

    Attributes:
        name: The name of the file.
        bytes_read: The number of bytes read.
        finished: Whether its recorder had closed it.
        kept: The number of messages kept, by topic.
        unchecked: The number of messages kept that no checksum covers.
        dropped: The number of messages found and not kept, by reason.
        damage: The parts that are lost.
        stated: The number of messages by topic that the file itself states; empty if it is lost.
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
    damage: list[Damage] = field(default_factory=list)
    stated: Counter[str] = field(default_factory=Counter)
    start_ns: int | None = None
    end_ns: int | None = None
    error: str = ""

    @property
    def missing(self) -> dict[str, int]:
        """The number of messages that the file states, but does not hold, by topic."""
        return dict(self.stated - self.kept)

    @property
    def excess(self) -> dict[str, int]:
        """The number of messages that the file holds beyond those that it states, by topic."""
        return dict(self.kept - self.stated) if self.stated else {}

    @property
    def is_whole(self) -> bool:
        """Whether nothing is known to be lost, or to be too much."""
        return not (self.error or self.damage or self.dropped or self.missing or self.excess)

    @property
    def reason(self) -> str:
        """The first reasons why something is lost."""
        if self.error or not self.bytes_read:
            return self.error or "it is empty"
        parts = [str(part) for part in self.damage[:1]]
        parts += [f"{count} messages {reason}" for reason, count in self.dropped.items()]
        return ", ".join(parts[:2]) or "it holds no messages"

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        parts, size = [vars(part) for part in self.damage], sum(part.size for part in self.damage)
        computed = {"missing": self.missing, "excess": self.excess}
        return vars(self) | computed | {"damage": parts, "bytes_damaged": size}

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
        lines += [f"  {count} of {t} more than the file states" for t, count in self.excess.items()]
        lines += [f"  dropped {count}: {reason}" for reason, count in self.dropped.items()]
        lines += [f"  damaged: {part}" for part in self.damage[:_SHOWN]]
        if len(self.damage) > _SHOWN:
            lines.append(f"  damaged: {len(self.damage) - _SHOWN} more parts")
        return lines


@dataclass(frozen=True)
class Recovery:
    """The account of a recovery.

    Attributes:
        source: The damaged bag.
        output: The bag made of it.
        files: The account of each file.
        remarks: Further facts for a user.
    """

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
            "files": [file.as_mapping() for file in self.files],
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


class DamagedFile:
    """One file: the records that describe its topics, wherever they are, and its messages.

    Args:
        path: The file.
        progress: Called with the number of bytes that were read since the last call.
        options: Those of `FileWalker`.

    Attributes:
        account: The account of what was read.
        topics: The topics of its channels, which others find.
        reasons: Why messages of other channels are dropped.
    """

    def __init__(self, path: Path, progress: Progress, **options: bool) -> None:
        self.path = path
        self.account = FileRecovery(path.name)
        self.profile: str | None = None
        self.library = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: BagMetadata | None = None
        self.topics: dict[int, str] = {}
        self.reasons: dict[int, str] = {}
        self._options, self._bad = options, dict[int, str]()
        self._counts: dict[int, int] = {}
        self._metadata_texts: deque[str] = deque(maxlen=2)
        self._room = _MAX_DESCRIPTIONS
        try:
            with open_regular(path) as stream:
                self.account.bytes_read = stream.seek(0, 2)
                walker = self._walker(stream)
                self.account.damage = walker.damage
                if summary := walker.summary:
                    stated = summary.schemas.values(), summary.channels.values()
                    for record in (*chain.from_iterable(stated), summary.statistics):
                        self._describe(record)
                for part in walker.parts(progress):
                    for described in part.described():
                        self._describe(described)
        except OSError as error:
            self.account.error = error.strerror or str(error)
        # One text of a type, however many channels have it.
        self._definitions = {
            id_: MessageDefinition(s.name, s.data.decode(errors="replace"), "", s.encoding)
            for id_, s in self.schemas.items()
            if _is_sound(s)
        }
        # The last one has the most.
        for text in reversed(self._metadata_texts):
            with suppress(ValueError):
                self.metadata = BagMetadata.from_yaml(text)
                break

    def _walker(self, stream: IO[bytes]) -> FileWalker:
        return FileWalker(stream, self.account.bytes_read, bad=self._bad, **self._options)

    def messages(
        self, progress: Progress = lambda _: None
    ) -> Iterator[tuple[str, bytes, int, int]]:
        """Yield topic, data, log time and publish time [ns] of what is kept, and count it.

        Args:
            progress: Called with the number of bytes that were read since the last call.
        """
        account = self.account
        for id_, count in self._counts.items():
            account.stated[self.topics.get(id_, f"channel {id_}")] += count
        if account.error:
            return
        with open_regular(self.path) as stream:
            walker = self._walker(stream)
            for part in walker.parts(progress):
                if part.content is None:
                    continue
                for described in part.described():
                    for id_ in self._contradicted(described):
                        self.topics.pop(id_, None)
                        self.reasons[id_] = f"of channel {id_}, which is described as two topics"
                counted = account.kept.total()
                yield from self._kept(part.content)
                account.unchecked += 0 if part.is_checked else account.kept.total() - counted
        if walker.damage != account.damage:
            raise BagReadError(f"{self.path}: changed while it was read")

    def _kept(self, content: Records) -> Iterator[tuple[str, bytes, int, int]]:
        account = self.account
        for channel, log_time, publish_time, data in content.messages():
            if (topic := self.topics.get(channel)) is None:
                lost = f"of channel {channel}, whose topic is lost"
                account.dropped[self.reasons.get(channel, lost)] += 1
            elif not (0 <= log_time < EMPTY_START_NS and 0 <= publish_time < EMPTY_START_NS):
                account.dropped[f"of {topic}, whose times do not fit 63 bits"] += 1
            else:
                yield topic, data, log_time, publish_time
                account.kept[topic] += 1
                if account.start_ns is None or log_time < account.start_ns:
                    account.start_ns = log_time
                if account.end_ns is None or log_time > account.end_ns:
                    account.end_ns = log_time

    def _contradicted(self, record: McapRecord | None) -> Iterator[int]:
        """Yield the channels that a chunk describes as others: it may be of another file."""
        match record:
            case Channel() if known := self.channels.get(record.id):
                mine, its = (
                    (one.topic, one.schema_id, one.message_encoding) for one in (known, record)
                )
                if mine != its:
                    yield record.id
            case Schema() if (schema := self.schemas.get(record.id)) and schema.name != record.name:
                yield from (i for i, c in self.channels.items() if c.schema_id == schema.id)

    def _describe(self, record: McapRecord | None) -> None:
        # The first of two records with one id is kept.
        match record:
            case Header() if self.profile is None:
                self.profile, self.library = record.profile, record.library
            case Schema() if record.id not in self.schemas and self._has_room(len(record.data)):
                self.schemas[record.id] = record
            case Channel() if record.id not in self.channels and self._has_room(
                sum(len(key) + len(value) for key, value in record.metadata.items())
            ):
                self.channels[record.id] = record
            case Statistics() if record.message_count == sum(
                record.channel_message_counts.values()
            ):
                self._counts = record.channel_message_counts
            case Footer():
                self.account.finished = True
            case Metadata(name="rosbag2"):
                self._metadata_texts.append(record.metadata.get("serialized_metadata", ""))

    def _has_room(self, size: int) -> bool:
        self._room -= size
        return self._room >= 0

    def definition(self, channel: Channel) -> MessageDefinition | None:
        """Return the definition that the file has of a channel's type, if it is intact."""
        if (found := self._definitions.get(channel.schema_id)) is None:
            return None
        hash_ = channel.metadata.get("topic_type_hash", "")
        return found._replace(type_hash=hash_ if TYPE_HASH.fullmatch(hash_) else "")


def _is_sound(schema: Schema) -> bool:
    if schema.encoding == "ros2msg":
        try:
            MessageLayout(schema.name, schema.data.decode(errors="replace"))
        except UnknownLayoutError:
            pass
        except ValueError:
            return False
    return True


class DamagedBag:
    """The files of a bag that may be damaged, and the topics in them.

    A topic is looked for in all places where a bag repeats itself: the chunks and the summary of a
    file, the other files, and metadata.yaml with the installed definition, if its hash is the same.

    Args:
        bag: A bag folder, with or without metadata.yaml, or one MCAP file.
        progress: Called with the number of bytes that were read since the last call.
        options: Those of `FileWalker`.

    Attributes:
        files: Its files, in the order of recording.
        topics: The topics found, by name.
        metadata: The metadata of the bag, of its folder or else of a file; None if it is lost.
        profiles: The profiles in the headers of the files.
        remarks: Further facts for a user.

    Raises:
        BagReadError: There is no bag.
    """

    def __init__(self, bag: Path, progress: Progress = lambda _: None, **options: bool) -> None:
        paths, metadata, self.remarks = _find_files(bag)
        self.files = [DamagedFile(path, progress, **options) for path in paths]
        stated = [metadata, *(file.metadata for file in self.files)]
        self.metadata = next(filter(None, stated), None)
        self.custom_data = next((m.custom_data for m in stated if m and m.custom_data), None)
        self.profiles = {file.profile for file in self.files} - {None}
        # The header may be damaged: messages in CDR are enough.
        self.remarks += [
            f"{file.path.name}: its profile is '{file.profile}', expected 'ros2'"
            for file in self.files
            if file.profile not in (None, "ros2")
        ]
        self._listed: tuple[TopicInfo, ...] = max(
            (each.topics for each in stated if each), key=len, default=()
        )
        self._definitions: dict[tuple[str, str], MessageDefinition] = {}
        for file in self.files:
            for channel in file.channels.values():
                if definition := file.definition(channel):
                    key = (definition.type, definition.type_hash)
                    self._definitions.setdefault(key, definition)
        self.topics: dict[str, TopicInfo] = {}
        for file in self.files:
            self._find_topics(file)

    def _find_topics(self, file: DamagedFile) -> None:
        offered = OfferedQos()
        by_name = {listed.name: listed for listed in self._listed}
        for id_, channel in file.channels.items():
            listed = by_name.get(channel.topic)
            definition = file.definition(channel) or self._listed_definition(listed)
            qos: tuple[QosProfile, ...] = ()
            with suppress(ValueError):
                qos = offered[channel]
            if channel.message_encoding != "cdr":
                reason = f"which is encoded in '{channel.message_encoding}'"
                file.reasons[id_] = f"of {channel.topic}, {reason}"
            elif definition is None:
                file.reasons[id_] = f"of {channel.topic}, whose type is lost"
            else:
                self._add(file, id_, channel.topic, definition, qos)
        if file.library.startswith(f"{LIBRARY} "):
            # Our files number the channels in the order in which the metadata lists the topics.
            for id_, listed in enumerate(self._listed, start=1):
                if id_ not in file.channels and (definition := self._listed_definition(listed)):
                    self._add(file, id_, listed.name, definition, listed.qos_profiles)

    def _add(
        self,
        file: DamagedFile,
        id_: int,
        name: str,
        definition: MessageDefinition,
        qos: tuple[QosProfile, ...],
    ) -> None:
        topic = TopicInfo(name, definition.type, 0, qos, definition.type_hash, definition)
        if self.topics.setdefault(name, topic).type != definition.type:
            file.reasons[id_] = f"of {name} as {definition.type}, which is two types"
        else:
            file.topics[id_] = name

    def _listed_definition(self, listed: TopicInfo | None) -> MessageDefinition | None:
        """Return a definition that is certainly the one the topic had: its hash is the same."""
        if listed is None or not (hash_ := listed.type_hash):
            return None
        if known := self._definitions.get((listed.type, hash_)):
            return known
        with suppress(BagWriteError):
            if (installed := find_definition(listed.type)).type_hash == hash_:
                return installed
        return None


def recover(
    bag: str | Path,
    output: str | Path,
    *,
    compression: str = "zstd",
    keep_unchecked: bool = False,
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
        keep_unchecked: Whether to keep what can be read of chunks whose checksum fails, too,
            although some of it is wrong.
        is_trusted: Whether to read chunks however much they decompress to.
        progress: Called with the number of bytes that were read since the last call; all of the bag
            is read twice.

    Returns:
        The account of what was kept and what was lost.

    Raises:
        BagReadError: There is no bag, or no message of ROS 2 can be recovered.
        BagWriteError: The output exists or cannot be written.
    """
    source, target = Path(bag), Path(output).absolute()
    damaged = DamagedBag(source, progress, keep_unchecked=keep_unchecked, is_trusted=is_trusted)
    if target.exists():
        raise BagWriteError(f"{target}: exists already, bags are not overwritten")
    if source.resolve() in target.resolve().parents:
        raise BagWriteError(f"{target}: is inside of the bag {source}, which is not touched")
    writer: BagWriter | None = None

    with ExitStack() as stack:
        for file in damaged.files:
            if writer is not None:
                writer.split()
            for message in file.messages(progress):
                if writer is None:
                    new = whole_bag(
                        target, compression=compression, custom_data=damaged.custom_data
                    )
                    writer = stack.enter_context(new)
                    for each in damaged.topics.values():
                        writer.add_topic(
                            each.name, each.type, each.qos_profiles, definition=each.definition
                        )
                writer.write(*message)
    files = tuple(file.account for file in damaged.files)
    if writer is None:
        reasons = "; ".join(f"{file.name}: {file.reason}" for file in files)
        raise BagReadError(f"{source}: no message can be recovered: {reasons}")
    return Recovery(source, target, files, tuple(damaged.remarks))


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
