# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Summaries of bags: files, times and topics, also of unfinished or damaged bags."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec

from tsobs_ros.bag.container import Span, by_channel
from tsobs_ros.bag.damaged import DamagedFile
from tsobs_ros.bag.metadata import BagFiles, TopicInfo
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.errors import BagReadError, printable


class BagSummary(dict[str, Any]):
    """The summary of a bag, as plain data.

    `problem` is the reason why the bag was read message by message, empty for a finished bag.
    `size` is in bytes, log times are in ns since the epoch, mean rates of topics are in Hz. Unknown
    values, such as the times of a bag without messages, are None.
    """

    def text(self) -> str:
        """Return text in the style of `ros2 bag info`."""
        lines = [f"NOT FINISHED: {self['problem']}"] if self["problem"] else []
        for place, file in enumerate(self["files"]):
            what = f"{file['name']} ({file['size'] / 2**20:.1f} MiB, {file['messages']} messages)"
            lines.append(f"{'' if place else 'Files:':14}{what}")
        lines += [
            f"Bag size:     {self['size'] / 2**20:.1f} MiB",
            f"Storage id:   {self['storage_id']}",
            f"ROS distro:   {self['ros_distro'] or 'unknown'}",
            f"Duration:     {self['duration_ns'] * 1e-9:.9f} s",
            f"Start:        {_time(self['start_ns'])}",
            f"End:          {_time(self['end_ns'])}",
            f"Messages:     {self['messages']}",
        ]
        lines += [f"Custom data:  {key}: {value}" for key, value in self["custom_data"].items()]
        for topic in self["topics"]:
            parts = [topic["name"], topic["type"], f"{topic['messages']} messages", "cdr"]
            parts += [_qos(topic["qos"])]
            parts += [] if topic["rate"] is None else [f"{topic['rate']:.4g} Hz"]
            lines.append(f"Topic:        {' | '.join(parts)}")
        return "\n".join(map(printable, lines))


def summarise(bag: str | Path) -> BagSummary:
    """Return the summary of a bag; an unfinished or damaged bag is read completely.

    Raises:
        BagReadError: There is no bag of ROS 2, or nothing in it can be read.
    """
    path, problem = Path(bag), ""
    try:
        reader = BagReader(path)
        metadata, start, end = reader.metadata, reader.start_time, reader.end_time
        files = [
            (file.name, file.stat().st_size, one.statistics.message_count)
            for file, one in zip(reader.files, reader.summaries, strict=True)
        ]
        durations = _durations(reader)
        topics = [(one, durations[name]) for name, one in reader.topics.items()]
    except BagReadError as error:
        problem, there, described = str(error), BagFiles(path), dict[str, TopicInfo]()
        damaged = [DamagedFile(file, described) for file in there.to_recover()]
        for file in damaged:
            for _ in file.parts():
                pass
        if {file.profile for file in damaged} - {None, "ros2"} or not described:
            raise
        metadata = there.metadata or next((f.metadata for f in damaged if f.metadata), None)
        files = [(file.name, file.bytes_read, file.kept.total()) for file in damaged]
        topics, of_bag = [], []
        for name, one in described.items():
            times = [time for file in damaged for time in file.times.get(name, ())]
            of_bag += times
            count = sum(file.kept[name] for file in damaged)
            duration = max(times, default=0) - min(times, default=0)
            topics.append((replace(one, count=count), duration))
        start, end = min(of_bag, default=None), max(of_bag, default=None)
    return BagSummary(
        bag=str(path),
        problem=problem,
        storage_id="mcap",
        ros_distro=metadata.ros_distro if metadata else "",
        size=sum(size for _, size, _ in files),
        messages=sum(count for *_, count in files),
        start_ns=start,
        end_ns=end,
        duration_ns=0 if start is None or end is None else end - start,
        custom_data=dict((metadata.custom_data if metadata else None) or {}),
        files=[dict(zip(("name", "size", "messages"), file, strict=True)) for file in files],
        topics=[_topic(*each) for each in topics],
    )


def _durations(reader: BagReader) -> dict[str, int]:
    """Return the time [ns] from the first to the last message of each topic."""

    @cache
    def times(span: Span) -> list[tuple[str, int, int]]:
        """Return the smallest and the largest log time of each channel's topic in a chunk."""
        rows, channels = reader.read(span)[0].rows, reader.summaries[span.rank].channels
        each = ((channels[id_].topic, rows["log_time"][own]) for id_, own in by_channel(rows))
        return [(name, int(own.min()), int(own.max())) for name, own in each]

    first, last = dict.fromkeys(reader.topics, 2**63), dict.fromkeys(reader.topics, 0)
    for span in sorted(reader.spans, key=attrgetter("start")):
        if any(span.start < first[name] for name in reader.topics_of(span)):
            for name, start, _ in times(span):
                first[name] = min(first[name], start)
    for span in sorted(reader.spans, key=attrgetter("end"), reverse=True):
        if any(span.end > last[name] for name in reader.topics_of(span)):
            for name, _, end in times(span):
                last[name] = max(last[name], end)
    return {name: last[name] - first[name] for name in reader.topics}


def _topic(topic: TopicInfo, duration: int) -> dict[str, Any]:
    """Return the entry of a topic, whose messages span `duration` [ns]."""
    is_periodic = topic.count > 1 and duration > 0
    return {
        "name": topic.name,
        "type": topic.type,
        "messages": topic.count,
        "serialization_format": "cdr",
        "qos": msgspec.to_builtins(list(topic.qos_profiles)),
        "type_hash": topic.type_hash,
        "rate": (topic.count - 1) * 1e9 / duration if is_periodic else None,
    }


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
