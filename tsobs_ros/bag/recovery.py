# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of a damaged bag: a whole bag of the messages that are left, and an account of it."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from tsobs_ros.bag.damaged import DamagedFile, Progress
from tsobs_ros.bag.metadata import BagFiles, TopicInfo
from tsobs_ros.bag.writer import whole_bag
from tsobs_ros.errors import BagReadError, BagWriteError, printable

_SHOWN = 10
_ACCOUNT = ("name", "bytes_read", "finished", "kept", "unchecked", "dropped", "missing", "error")


@dataclass(frozen=True)
class Recovery:
    """The account of a recovery: the damaged bag, the new bag, the damaged files, and remarks."""

    source: Path
    output: Path
    files: tuple[DamagedFile, ...]
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
        """Return the account as plain data."""
        return {
            "source": str(self.source),
            "output": str(self.output),
            "messages": self.message_count,
            "whole": self.is_whole,
            "remarks": list(self.remarks),
            "files": [
                {name: getattr(file, name) for name in _ACCOUNT}
                | {"start_ns": (file.span or [None])[0], "end_ns": (file.span or [None])[-1]}
                | {"damage": [vars(part) for part in file.damage]}
                for file in self.files
            ],
        }

    def text(self) -> str:
        """Return the account as text for people."""
        lines = [*self.remarks, *(line for file in self.files for line in _lines(file))]
        if not all(file.is_whole for file in self.files):
            verdict = "NOT EVERYTHING, see above"
        elif self.unchecked:
            verdict = f"{self.unchecked} UNCHECKED, damage in them is not noticed"
        else:
            verdict = "nothing known to be lost"
        lines.append(f"{self.message_count} messages in {self.output}: {verdict}")
        return "\n".join(map(printable, lines))


def _lines(file: DamagedFile) -> list[str]:
    """Return the lines on a file, for people."""
    if file.error:
        return [f"{file.name}: not read: {file.error}"]
    state = "finished" if file.finished else "without what its recorder had not flushed"
    kept = f"{file.kept.total()} messages kept"
    lines = [f"{file.name}: {file.bytes_read} bytes, {state}: {kept}"]
    lines += [f"  kept {count} of {topic}" for topic, count in sorted(file.kept.items())]
    if file.span is not None:
        start, end = file.span
        lines.append(f"  from {start} ns to {end} ns ({(end - start) * 1e-9:.3f} s)")
    if file.unchecked:
        lines.append(f"  unchecked {file.unchecked}: no checksum covers these messages")
    lines += [f"  lost {count} of {topic}" for topic, count in file.missing.items()]
    lines += [f"  dropped {count}: {reason}" for reason, count in file.dropped.items()]
    lines += [f"  damaged: {part}" for part in file.damage[:_SHOWN]]
    if len(file.damage) > _SHOWN:
        lines.append(f"  damaged: {len(file.damage) - _SHOWN} more parts")
    return lines


def recover(
    bag: str | Path,
    output: str | Path,
    *,
    compression: str = "zstd",
    is_trusted: bool = False,
    progress: Progress = lambda _: None,
) -> Recovery:
    """Make a whole bag of the messages left in a damaged one; the damaged bag is only read.

    Every message is kept as it was recorded, in the order of recording. The new bag has one file
    per file with messages. Memory is bounded by the largest chunk.

    Args:
        output: The folder to make, which must not exist.
        compression: Compression of the new bag's chunks: `none`, `lz4` or `zstd`.
        is_trusted: Whether to read chunks of any decompressed size.
        progress: Called with the number of bytes that were read since the last call.

    Raises:
        BagReadError: There is no bag, or no message of ROS 2 can be recovered.
        BagWriteError: The output exists or cannot be written.
    """
    source, target = Path(bag), Path(output).absolute()
    there, topics = BagFiles(source), dict[str, TopicInfo]()
    files = [DamagedFile(path, topics) for path in there.to_recover()]
    if target.exists():
        raise BagWriteError(f"{target}: exists already, bags are not overwritten")
    if source.resolve() in target.resolve().parents:
        raise BagWriteError(f"{target}: is inside of the bag {source}, which is not touched")
    found = (
        (file, kept)
        for file in files
        for _, kept in file.parts(progress, is_trusted=is_trusted)
        if kept is not None and len(kept.rows)
    )
    if (first := next(found, None)) is None:
        each = (
            f"{file.name}: {file.error or next(map(str, file.damage), 'it holds no messages')}"
            for file in files
        )
        raise BagReadError(f"{source}: no message can be recovered: {'; '.join(each)}")
    previous, added = first[0], 0
    chunks = chain([first], found)
    del first  # a chunk may be large
    metadata = there.metadata or previous.metadata
    notes = metadata.custom_data if metadata else None
    with whole_bag(target, compression=compression, custom_data=notes) as writer:
        for file, kept in chunks:
            if file is not previous:
                writer.split()
            previous = file
            if added < len(topics):
                writer.add_topics(topics.values())
                added = len(topics)
            writer.copy(kept, {id_: one.name for id_, one in file.described.topics.items()})
        writer.add_topics(topics.values())  # topics without messages, too
    return Recovery(source, target, tuple(files), tuple(_remarks(there, files)))


def _remarks(there: BagFiles, files: list[DamagedFile]) -> Iterator[str]:
    if there.problem:
        yield there.problem
    else:
        for file in files[len(there.listed) :]:
            yield f"{file.path.name}: not named by metadata.yaml"
    for file in files:
        if file.profile not in (None, "ros2"):  # the header may be damaged: CDR is enough
            yield f"{file.path.name}: its profile is '{file.profile}', expected 'ros2'"
