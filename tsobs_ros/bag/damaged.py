# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags that may be damaged: the topics and messages their files still hold, and what is lost."""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from mcap.records import Channel, Header, McapRecord, Metadata, Schema

from tsobs_ros.bag.container import Records, by_channel
from tsobs_ros.bag.metadata import EMPTY_START_NS, BagMetadata, Descriptions, TopicInfo
from tsobs_ros.bag.walker import Damage, FileWalker, Part, Progress
from tsobs_ros.files import open_regular
from tsobs_ros.yaml_files import MAX_BYTES, load_yaml


class DamagedFile:
    """One file: what describes its topics, its messages, and an account of what is lost.

    Args:
        path: The file.
        of_bag: The topics of the bag by name, to which those of the file are added.

    Attributes:
        name: The name of the file.
        bytes_read: Its size.
        finished: Whether its recorder had closed it.
        kept: The number of messages kept, by topic.
        unchecked: The number of messages kept that no checksum covers.
        dropped: The number of messages found and not kept, by reason.
        missing: The number of messages that the file states, but does not hold, by topic.
        damage: The parts that are lost.
        error: The reason why it was not read at all; empty if it was.
        described: Its topics, those whose messages can be kept.
        counts: The number of messages found, by channel.
        times: The smallest and the largest log time kept of each topic, ns since the epoch.
        profile: The profile in its header; None without one.
        metadata: The metadata of the bag that it carries.
    """

    def __init__(self, path: Path, of_bag: dict[str, TopicInfo]) -> None:
        self.path, self.name = path, path.name
        self.bytes_read = self.unchecked = 0
        self.finished = False
        self.kept, self.dropped, self.missing = Counter[str](), Counter[str](), Counter[str]()
        self.damage: list[Damage] = []
        self.error = ""
        self.described = Descriptions(of_bag)
        self.counts = Counter[int]()
        self.times: dict[str, tuple[int, int]] = {}
        self.profile: str | None = None
        self.metadata: BagMetadata | None = None
        self._metadata_room = MAX_BYTES

    @property
    def is_whole(self) -> bool:
        """Whether nothing is known to be lost."""
        return not (self.error or self.damage or self.dropped or self.missing)

    @property
    def span(self) -> tuple[int, int] | None:
        """The smallest and the largest log time kept, ns since the epoch; None without messages."""
        starts, ends = zip(*self.times.values(), strict=True) if self.times else ((), ())
        return (min(starts), max(ends)) if starts else None

    def parts(
        self,
        progress: Progress = lambda _: None,
        *,
        is_trusted: bool = False,
        described_by_summary: bool = True,
    ) -> Iterator[tuple[Part, Records | None]]:
        """Yield what is intact and, of messages, which are kept; count them.

        Args:
            progress: Called with the number of bytes that were read since the last call.
            is_trusted: Whether to read chunks however much they decompress to.
            described_by_summary: Whether messages may come before the description of their topic.
        """
        counts = dict[int, int]()
        try:
            with open_regular(self.path) as stream:
                self.bytes_read = stream.seek(0, 2)
                walker = FileWalker(stream, self.bytes_read, is_trusted=is_trusted)
                self.damage, self.finished = walker.damage, walker.has_end
                if described_by_summary and walker.summary is not None:
                    self.described.add_all(walker.summary.schemas, walker.summary.channels)
                    counts = walker.summary.statistics.channel_message_counts
                for part in walker.parts(progress):
                    for record in part.described():
                        self._describe(record)
                    yield part, None if part.content is None else self._keep(part, part.content)
        except OSError as error:
            self.error = error.strerror or str(error)
        names = {id_: topic.name for id_, topic in self.described.topics.items()}
        stated = Counter[str]()
        for id_, number in counts.items():
            stated[names.get(id_, f"channel {id_}")] += number
        self.missing = stated - self.kept

    def _keep(self, part: Part, content: Records) -> Records:
        rows, kept = content.rows, np.zeros(len(content.rows), np.bool_)
        times = np.stack([rows["log_time"], rows["publish_time"]])
        fits = (times.min(axis=0) >= 0) & (times.max(axis=0) < EMPTY_START_NS)
        for id_, places in by_channel(rows):
            self.counts[id_] += len(places)
            if (topic := self.described.topics.get(id_)) is None:
                lost = f"channel {id_} is not described before its messages"
                self.dropped[self.described.problems.get(id_, lost)] += len(places)
                continue
            own = places[fits[places]]
            if len(own) < len(places):
                self.dropped[f"{topic.name}: times do not fit 63 bits"] += len(places) - len(own)
            if len(own):
                kept[own] = True
                self.kept[topic.name] += len(own)
                first, last = int(times[0, own].min()), int(times[0, own].max())
                start, end = self.times.get(topic.name, (first, last))
                self.times[topic.name] = min(start, first), max(end, last)
        self.unchecked += 0 if part.is_checked else int(kept.sum())
        return content if kept.all() else Records(content.data, rows[kept])

    def _describe(self, record: McapRecord | None) -> None:
        match record:
            case None:
                self.described.problems["record"] = "a record between its messages is malformed"
            case Header() if self.profile is None:
                self.profile = record.profile
            case Metadata(name="rosbag2"):
                text = record.metadata.get("serialized_metadata", "")
                self._metadata_room -= len(text)
                if self._metadata_room >= 0 and self.metadata is None:
                    with suppress(ValueError):
                        self.metadata = BagMetadata.from_map(load_yaml(text))
            case Schema() | Channel():
                self.described.add(record)
