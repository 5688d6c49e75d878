# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Making a whole bag of one whose recorder was killed, or that was damaged later."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Self

from tsobs_ros.bag.folder import BagFiles, find_files
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.bag.recovery.destinations import KnownTopics, Topic
from tsobs_ros.bag.recovery.harvest import harvest
from tsobs_ros.bag.recovery.report import FileRecovery, Recovery
from tsobs_ros.bag.recovery.survey import Survey, survey
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import BagReadError, BagWriteError


def recover(
    bag: str | Path,
    output: str | Path,
    *,
    compression: str = "zstd",
    keep_unchecked: bool = False,
    progress: Callable[[int], object] = lambda _: None,
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
        progress: Called with the number of bytes that were got through since the last call; all of
            the bag is got through twice.

    Returns:
        What was kept and what was lost.

    Raises:
        BagReadError: There is no bag, or no message of ROS 2 can be recovered.
        BagWriteError: The output exists or cannot be written.
    """
    source, target = Path(bag), Path(output).absolute()
    found = find_files(source)
    if target.exists():
        raise BagWriteError(f"{target}: exists already, bags are not overwritten")
    if source.resolve() in target.resolve().parents:
        raise BagWriteError(f"{target}: is inside of the bag {source}, which is not touched")
    surveys = [_survey(path, progress) for path in found.paths]
    readable = [told for told in surveys if isinstance(told, Survey)]
    known = KnownTopics(readable, found.metadata)
    destinations = {told.path: known.destinations(told) for told in readable}
    metadata = [found.metadata, *(told.metadata for told in readable)]
    custom_data = next((m.custom_data for m in metadata if m and m.custom_data), None)
    files = []
    with _Output(
        known.topics.values(),
        lambda: BagWriter(target, compression=compression, custom_data=custom_data),
    ) as writer:
        for told in surveys:
            if isinstance(told, Survey):
                writer.split()
                told = harvest(
                    told,
                    destinations[told.path],
                    writer.write,
                    keep_unchecked=keep_unchecked,
                    progress=progress,
                )
            files.append(told)
    result = Recovery(source, target, tuple(files), _remarks(found, readable))
    if not result.message_count:
        raise BagReadError(f"{source}: no message can be recovered: {result.reasons()}")
    return result


class _Output:
    """The bag that messages are copied to; it is made when the first one is there."""

    def __init__(self, topics: Iterable[Topic], open_bag: Callable[[], BagWriter]) -> None:
        self._topics = topics
        self._open_bag = open_bag
        self._writer: BagWriter | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def write(self, message: BagMessage) -> None:
        """Append a message."""
        if self._writer is None:
            self._writer = self._open_bag()
            for name, definition, qos in self._topics:
                self._writer.add_topic(name, definition.type, qos, definition=definition)
        topic, _, data, log_time, publish_time = message
        self._writer.write(topic, data, log_time, publish_time)

    def split(self) -> None:
        """Begin another file."""
        if self._writer is not None:
            self._writer.split()


def _survey(path: Path, progress: Callable[[int], object]) -> Survey | FileRecovery:
    try:
        told = survey(path, progress)
    except OSError as error:
        return FileRecovery(path.name, error=error.strerror or str(error))
    return told


def _remarks(found: BagFiles, surveys: Iterable[Survey]) -> tuple[str, ...]:
    remarks = [found.metadata_error] if found.metadata_error else []
    if found.metadata:
        remarks += [f"{path.name}: not named by metadata.yaml" for path in found.unlisted]
    for told in surveys:
        # The header may be what is damaged: what counts is whether messages are in CDR.
        if told.profile not in (None, "ros2"):
            remarks.append(f"{told.path.name}: its profile is '{told.profile}', expected 'ros2'")
    return tuple(remarks)
