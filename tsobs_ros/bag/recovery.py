# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Making a whole bag of one whose recorder was killed, or that was damaged later."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tsobs_ros.bag._destinations import Destinations, KnownTopics
from tsobs_ros.bag._files import BagFiles, find_files
from tsobs_ros.bag._messages import decode_messages
from tsobs_ros.bag._scan import Content, Damage, MessageCount, Scan
from tsobs_ros.bag._survey import Survey, survey
from tsobs_ros.bag.metadata import EMPTY_START_NS
from tsobs_ros.bag.recovery_report import DamagedPart, FileRecovery, Recovery
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import BagReadError, BagWriteError


def recover(
    bag: str | Path,
    output: str | Path,
    *,
    compression: str = "zstd",
    keep_unchecked: bool = False,
    progress: Callable[[float], None] = lambda _: None,
) -> Recovery:
    """Make a complete bag of what a damaged one still holds; the damaged one is not touched.

    Every message is kept as it was recorded, in the order of recording. The new bag has a file for
    each file that messages were found in. Memory is bounded by the largest chunk.

    Args:
        bag: A bag folder, with or without metadata.yaml, or one MCAP file.
        output: The folder to make, which must not exist.
        compression: Of the new bag's chunks: `none`, `lz4` or `zstd`.
        keep_unchecked: Also keep what can be read of chunks whose checksum fails, although some of
            it is wrong.
        progress: Called now and then with the part that is done, from 0 to 1.

    Returns:
        What was kept and what was lost.

    Raises:
        BagReadError: There is no bag of ROS 2, or no message can be recovered.
        BagWriteError: The output exists or cannot be written.
    """
    source, target = Path(bag), Path(output).absolute()
    found = find_files(source)
    if target.exists():
        raise BagWriteError(f"{target}: exists already, bags are not overwritten")
    if source.resolve() in target.resolve().parents:
        raise BagWriteError(f"{target}: is inside of the bag {source}, which is not touched")
    surveys = [_survey(path) for path in found.paths]
    readable = [told for told in surveys if isinstance(told, Survey)]
    known = KnownTopics(readable, found.metadata)
    destinations = {told.path: known.destinations(told) for told in readable}
    custom_data = found.metadata.custom_data if found.metadata else None
    for told in readable:
        custom_data = custom_data or (told.metadata.custom_data if told.metadata else None)

    def open_output() -> BagWriter:
        writer = BagWriter(target, compression=compression, custom_data=custom_data)
        for topic in known.topics.values():
            writer.add_topic(
                topic.name, topic.definition.type, topic.qos, definition=topic.definition
            )
        return writer

    copying = _Copying(open_output, keep_unchecked, progress, sum(t.size for t in readable))
    with copying:
        files = tuple(
            copying.copy(told, destinations[told.path]) if isinstance(told, Survey) else told
            for told in surveys
        )
    result = Recovery(source, target, files, _remarks(found))
    if not result.message_count:
        raise BagReadError(f"{source}: no message can be recovered: {result.reasons()}")
    return result


class _Copying:
    """Copies the messages of one file after the other to a bag that is made for the first one."""

    def __init__(
        self,
        open_output: Callable[[], BagWriter],
        keep_unchecked: bool,
        progress: Callable[[float], None],
        total: int,
    ) -> None:
        self._open_output = open_output
        self._keep_unchecked = keep_unchecked
        self._progress = progress
        self._total = total
        self._done = 0
        self._writer: BagWriter | None = None

    def __enter__(self) -> "_Copying":
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def copy(self, told: Survey, destinations: Destinations) -> FileRecovery:
        """Copy a file's messages and return what became of them."""
        file = FileRecovery(told.path.name, told.size, told.is_finished)
        if told.statistics:
            counts = told.statistics.channel_message_counts
            file.stated = Counter()
            for channel, count in counts.items():
                file.stated[destinations[channel][0] or f"channel {channel}"] += count
        if self._writer is not None:
            self._writer.split()
        damage: DamagedPart | None = None
        with told.path.open("rb") as stream:
            for piece in Scan(stream, told.size).pieces():
                if isinstance(piece, MessageCount):
                    # The index of a chunk follows it, also where the chunk is damaged.
                    if damage is not None:
                        damage.messages = (damage.messages or 0) + piece.messages
                    continue
                damage = None
                if isinstance(piece, Content):
                    self._write(piece.records, destinations, file)
                    self._progress((self._done + piece.offset) / self._total)
                elif isinstance(piece, Damage):
                    damage = DamagedPart(piece.offset, piece.size, piece.reason)
                    file.damage.append(damage)
                    if self._keep_unchecked:
                        self._write(piece.unchecked, destinations, file)
        self._done += told.size
        return file

    def _write(self, records: bytes, destinations: Destinations, file: FileRecovery) -> None:
        for topic, reason, data, log_time, publish_time in decode_messages(records, destinations):
            if not topic:
                file.dropped[reason] += 1
            elif max(log_time, publish_time) >= EMPTY_START_NS:
                file.dropped[f"of {topic}, stamped after the year 2262"] += 1
            else:
                if self._writer is None:
                    self._writer = self._open_output()
                self._writer.write(topic, data, log_time, publish_time)
                file.keep(topic, log_time)


def _survey(path: Path) -> Survey | FileRecovery:
    try:
        told = survey(path)
    except OSError as error:
        return FileRecovery(path.name, error=error.strerror or str(error))
    if told.profile not in (None, "ros2"):
        raise BagReadError(
            f"{path}: not a bag of ROS 2: its profile is '{told.profile}', expected 'ros2'"
        )
    return told


def _remarks(found: BagFiles) -> tuple[str, ...]:
    remarks = [found.metadata_error] if found.metadata_error else []
    if found.metadata:
        remarks += [f"{path.name}: not named by metadata.yaml" for path in found.unlisted]
    return tuple(remarks)
