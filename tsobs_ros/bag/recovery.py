# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of a damaged bag: a whole bag of what its files still hold, and an account of it."""

import re
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, McapRecord, Metadata, Schema, Statistics

from tsobs_ros.bag.cdr import MessageLayout, UnknownLayoutError
from tsobs_ros.bag.container import RecordError, split_messages
from tsobs_ros.bag.damaged_file import Content, Damage, DamagedFile, Lost, parse_record
from tsobs_ros.bag.definitions import MessageDefinition, find_definition
from tsobs_ros.bag.metadata import (
    EMPTY_START_NS,
    TYPE_HASH,
    BagMetadata,
    OfferedQos,
    QosProfile,
    TopicInfo,
    read_metadata,
)
from tsobs_ros.bag.writer import LIBRARY, BagWriter, whole_bag
from tsobs_ros.errors import BagReadError, BagWriteError, printable
from tsobs_ros.files import open_regular

Progress = Callable[[int], object]
Keep = Callable[[str, bytes, int, int], object]
"""Takes a message: topic, data, log time [ns] and publish time [ns]."""

_SHOWN = 10
_MAX_DESCRIPTIONS = 2**26
_NUMBER = re.compile(r"_(\d+)$")


class _Destinations(NamedTuple):
    """Topics of a file's channels, and why the messages of other channels have none."""

    topics: dict[int, str]
    reasons: dict[int, str]


@dataclass
class FileRecovery:
    """The account of one file.

    Attributes:
        name: The name of the file.
        size: The number of bytes read.
        is_finished: Whether its recorder had closed it.
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
    size: int = 0
    is_finished: bool = False
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
        wrong = self.error or self.damage or self.dropped or self.missing or self.excess
        return not wrong

    @property
    def reason(self) -> str:
        """The first reasons why something is lost."""
        if self.error or not self.size:
            return self.error or "it is empty"
        parts = [str(part) for part in self.damage[:1]]
        parts += [f"{count} messages {reason}" for reason, count in self.dropped.items()]
        return ", ".join(parts[:2]) or "it holds no messages"

    def add(self, content: Content, destinations: _Destinations, keep: Keep) -> None:
        """Keep the messages of a piece of the file, and count them."""
        topics, counts = destinations.topics, Counter[str]()
        for channel, log_time, publish_time, _, data in split_messages(content.records):
            topic = topics.get(channel)
            if topic is None:
                lost = f"of channel {channel}, whose topic is lost"
                self.dropped[destinations.reasons.get(channel, lost)] += 1
            elif log_time >= EMPTY_START_NS or publish_time >= EMPTY_START_NS:
                self.dropped[f"of {topic}, whose times do not fit 63 bits"] += 1
            else:
                keep(topic, data, log_time, publish_time)
                counts[topic] += 1
                if self.start_ns is None or self.end_ns is None:
                    self.start_ns = self.end_ns = log_time
                elif log_time < self.start_ns:
                    self.start_ns = log_time
                elif log_time > self.end_ns:
                    self.end_ns = log_time
        self.kept += counts
        self.unchecked += 0 if content.is_checked else counts.total()

    def as_mapping(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "name": self.name,
            "bytes_read": self.size,
            "finished": self.is_finished,
            "error": self.error,
            "kept": dict(self.kept),
            "unchecked": self.unchecked,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "dropped": dict(self.dropped),
            "missing": self.missing,
            "excess": self.excess,
            "damage": [vars(part) for part in self.damage],
            "bytes_damaged": sum(part.size for part in self.damage),
        }

    def lines(self) -> list[str]:
        """Return lines for people."""
        if self.error:
            return [f"{self.name}: not read: {self.error}"]
        state = "finished" if self.is_finished else "without what its recorder had not flushed"
        lines = [f"{self.name}: {self.size} bytes, {state}: {self.kept.total()} messages kept"]
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
        remarks: What else a user should know.
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


class _File:
    """The records of a file that describe its topics and itself, wherever they are."""

    def __init__(self, path: Path, *, keep_unchecked: bool, is_trusted: bool) -> None:
        self.path = path
        self.size = 0
        self._options = {"keep_unchecked": keep_unchecked, "is_trusted": is_trusted}
        self._damage: list[Damage] = []
        self.error = ""
        self.profile: str | None = None
        self.library = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.statistics: Statistics | None = None
        self.metadata: BagMetadata | None = None
        self.is_finished = False

        self._lost: dict[int, Lost] = {}
        self._metadata_texts: deque[str] = deque(maxlen=2)
        self._definitions: dict[int, MessageDefinition | None] = {}
        self._room = _MAX_DESCRIPTIONS

    def read(self, progress: Progress) -> None:
        """Read the file once, from its start to its end, for what it says of itself."""
        try:
            with open_regular(self.path) as stream:
                self.size = stream.seek(0, 2)
                for piece in self._pieces(stream, progress):
                    self._add(piece)
        except OSError as error:
            self.error = error.strerror or str(error)
        # The last one tells most.
        for text in reversed(self._metadata_texts):
            with suppress(ValueError):
                self.metadata = BagMetadata.from_yaml(text)
                break

    def contents(self, account: FileRecovery, progress: Progress) -> Iterator[Content]:
        """Yield the messages in the file, and enter what is lost into its account."""
        with open_regular(self.path) as stream:
            for piece in self._pieces(stream, progress):
                if isinstance(piece, Content):
                    yield piece
        account.damage = self._damage

    def contradicted(self, content: Content) -> Iterator[int]:
        """Yield the channels that a chunk describes as others: it may be of another file."""
        for description in content.descriptions:
            with suppress(RecordError):
                match parse_record(description):
                    case Channel() as record if known := self.channels.get(record.id):
                        mine, its = (
                            (one.topic, one.schema_id, one.message_encoding)
                            for one in (known, record)
                        )
                        if mine != its:
                            yield record.id
                    case Schema() as record if (schema := self.schemas.get(record.id)) and (
                        schema.name != record.name
                    ):
                        yield from (i for i, c in self.channels.items() if c.schema_id == schema.id)

    def _pieces(self, stream: IO[bytes], progress: Progress) -> Iterator[Content | McapRecord]:
        damaged = DamagedFile(stream, self.size, lost=self._lost, **self._options)
        yield from damaged.pieces(progress)
        self._lost, self._damage = damaged.lost, damaged.damage

    def _add(self, piece: Content | McapRecord) -> None:
        # The first of two records with one id is kept: chunks, which have checksums, come first.
        match piece:
            case Content():
                for description in piece.descriptions:
                    known = self.schemas if description[0] == Opcode.SCHEMA else self.channels
                    if int.from_bytes(description[9:11], "little") not in known:
                        with suppress(RecordError):
                            self._add(parse_record(description))
            case Header() if self.profile is None:
                self.profile, self.library = piece.profile, piece.library
            case Schema() if piece.id not in self.schemas and self._has_room(len(piece.data)):
                self.schemas[piece.id] = piece
            case Channel() if piece.id not in self.channels and self._has_room(
                sum(len(key) + len(value) for key, value in piece.metadata.items())
            ):
                self.channels[piece.id] = piece
            case Statistics() if piece.message_count == sum(piece.channel_message_counts.values()):
                self.statistics = piece
            case Footer():
                self.is_finished = True
            case Metadata(name="rosbag2"):
                self._metadata_texts.append(piece.metadata.get("serialized_metadata", ""))

    def _has_room(self, size: int) -> bool:
        self._room -= size
        return self._room >= 0

    def definition(self, channel: Channel) -> MessageDefinition | None:
        """Return the definition that the file has of a channel's type, if it is intact."""
        if (schema := self.schemas.get(channel.schema_id)) is None:
            return None
        if schema.id not in self._definitions:
            text = schema.data.decode(errors="replace")
            definition = MessageDefinition(schema.name, text, "", schema.encoding)
            self._definitions[schema.id] = definition if _is_sound(definition) else None
        if (found := self._definitions[schema.id]) is None:
            return None
        hash_ = channel.metadata.get("topic_type_hash", "")
        return found._replace(type_hash=hash_ if TYPE_HASH.fullmatch(hash_) else "")


def _is_sound(definition: MessageDefinition) -> bool:
    if definition.encoding == "ros2msg":
        try:
            MessageLayout(definition.type, definition.text)
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
        keep_unchecked: Whether to give what can be read of chunks whose checksum fails, too.
        is_trusted: Whether to read chunks however much they decompress to.

    Attributes:
        topics: The topics found, by name.
        metadata: The metadata of the bag, of its folder or else of a file; None if it is lost.
        profiles: The profile in the header of each file, by its name, if it has one.
        remarks: What else a user should know.

    Raises:
        BagReadError: There is no bag.
    """

    def __init__(
        self,
        bag: Path,
        progress: Progress = lambda _: None,
        *,
        keep_unchecked: bool = False,
        is_trusted: bool = False,
    ) -> None:
        found = _find_files(bag)
        self._files = [
            _File(path, keep_unchecked=keep_unchecked, is_trusted=is_trusted)
            for path in found.paths
        ]
        for file in self._files:
            file.read(progress)
        stated = [found.metadata, *(file.metadata for file in self._files)]
        self.metadata = next(filter(None, stated), None)
        self.custom_data = next((m.custom_data for m in stated if m and m.custom_data), None)
        self.profiles = {f.path.name: f.profile for f in self._files if f.profile is not None}
        self.remarks = [found.metadata_error] if found.metadata_error else []
        if found.metadata:
            self.remarks += [f"{path.name}: not named by metadata.yaml" for path in found.unlisted]
        # The header may be what is damaged: what counts is whether messages are in CDR.
        self.remarks += [
            f"{name}: its profile is '{profile}', expected 'ros2'"
            for name, profile in self.profiles.items()
            if profile != "ros2"
        ]
        self._listed: tuple[TopicInfo, ...] = max(
            (metadata.topics for metadata in stated if metadata), key=len, default=()
        )
        self._definitions: dict[tuple[str, str], MessageDefinition] = {}
        for file in self._files:
            for channel in file.channels.values():
                if definition := file.definition(channel):
                    key = (definition.type, definition.type_hash)
                    self._definitions.setdefault(key, definition)
        self.topics: dict[str, TopicInfo] = {}
        self._destinations = [self._destinations_of(file) for file in self._files]

    def read(
        self,
        keep: Keep,
        *,
        progress: Progress = lambda _: None,
        start_file: Callable[[], object] = lambda: None,
    ) -> tuple[FileRecovery, ...]:
        """Read all messages, file by file, in the order of recording.

        Args:
            keep: Called with each message.
            progress: Called with the number of bytes that were read since the last call.
            start_file: Called before the first message of each file.

        Returns:
            The account of each file.
        """
        accounts = []
        for file, destinations in zip(self._files, self._destinations, strict=True):
            account = FileRecovery(file.path.name, file.size, file.is_finished, error=file.error)
            if not file.error:
                start_file()
                for id_, count in (
                    file.statistics.channel_message_counts if file.statistics else {}
                ).items():
                    account.stated[destinations.topics.get(id_, f"channel {id_}")] += count
                own = _Destinations(dict(destinations.topics), dict(destinations.reasons))
                for content in file.contents(account, progress):
                    for id_ in file.contradicted(content):
                        own.topics.pop(id_, None)
                        own.reasons[id_] = f"of channel {id_}, which is described as two topics"
                    account.add(content, own, keep)
            accounts.append(account)
        return tuple(accounts)

    def _destinations_of(self, file: _File) -> _Destinations:
        found = _Destinations({}, {})
        offered = OfferedQos()
        by_name = {listed.name: listed for listed in self._listed}
        for id_, channel in file.channels.items():
            topic = channel.topic
            if channel.message_encoding != "cdr":
                found.reasons[id_] = f"of {topic}, which is encoded in '{channel.message_encoding}'"
                continue
            definition = file.definition(channel) or self._listed_definition(by_name.get(topic))
            qos: tuple[QosProfile, ...] = ()
            with suppress(ValueError):
                qos = offered[channel]
            self._add(found, id_, topic, definition, qos)
        if file.library.startswith(f"{LIBRARY} "):
            # Our files number the channels in the order in which the metadata lists the topics.
            for id_, listed in enumerate(self._listed, start=1):
                if id_ not in file.channels and (definition := self._listed_definition(listed)):
                    self._add(found, id_, listed.name, definition, listed.qos_profiles)
        return found

    def _add(
        self,
        found: _Destinations,
        id_: int,
        name: str,
        definition: MessageDefinition | None,
        qos: tuple[QosProfile, ...],
    ) -> None:
        if definition is None:
            found.reasons[id_] = f"of {name}, whose type is lost"
            return
        topic = TopicInfo(name, definition.type, 0, qos, definition.type_hash, definition)
        if self.topics.setdefault(name, topic).type != definition.type:
            found.reasons[id_] = f"of {name} as {definition.type}, which is two types"
        else:
            found.topics[id_] = name

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

    def keep(topic: str, data: bytes, log_time: int, publish_time: int) -> None:
        nonlocal writer
        if writer is None:
            writer = stack.enter_context(
                whole_bag(target, compression=compression, custom_data=damaged.custom_data)
            )
            for each in damaged.topics.values():
                writer.add_topic(
                    each.name, each.type, each.qos_profiles, definition=each.definition
                )
        writer.write(topic, data, log_time, publish_time)

    with ExitStack() as stack:
        files = damaged.read(
            keep,
            progress=progress,
            start_file=lambda: writer.split() if writer else None,
        )
    if writer is None:
        reasons = "; ".join(f"{file.name}: {file.reason}" for file in files)
        raise BagReadError(f"{source}: no message can be recovered: {reasons}")
    return Recovery(source, target, files, tuple(damaged.remarks))


class _BagFiles(NamedTuple):
    """The files of a bag in order of recording, missing ones included, and what describes them.

    `unlisted` are those that the metadata does not name, `metadata_error` is why there is none.
    """

    paths: tuple[Path, ...]
    metadata: BagMetadata | None
    metadata_error: str
    unlisted: tuple[Path, ...]


def _find_files(bag: Path) -> _BagFiles:
    """Return the files of a bag folder, or of a single file.

    Raises:
        BagReadError: There is no such folder or file, or no MCAP file in it.
    """
    if not bag.is_dir():
        if not bag.exists():
            raise BagReadError(f"{bag}: there is no such bag")
        return _BagFiles((bag,), None, "", ())
    metadata, error = None, ""
    try:
        metadata = read_metadata(bag)
    except BagReadError as reason:
        error = str(reason)
    listed = [bag / Path(file.path).name for file in metadata.files] if metadata else []
    try:
        # Not glob, which takes a folder that cannot be read for an empty one.
        present = sorted((p for p in bag.iterdir() if p.suffix == ".mcap"), key=_by_number)
    except OSError as reason:
        raise BagReadError(f"{bag}: cannot read it: {reason}") from reason
    unlisted = [path for path in present if path not in listed]
    if not (listed or unlisted):
        raise BagReadError(f"{bag}: not a bag, there is no .mcap file in it")
    return _BagFiles((*listed, *unlisted), metadata, error, tuple(unlisted))


def _by_number(path: Path) -> tuple[int, str]:
    match = _NUMBER.search(path.stem)
    return (int(match[1]) if match else -1, path.name)
