# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `recorder` node: records topics to an MCAP bag as rosbag2 does, and counts what it misses."""

import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from tsobs_ros.bag.syncing import BackgroundSync
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import NodeError
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.diagnostics import DiagnosticsPublisher
from tsobs_ros.nodes.parameters import ParameterBinding, parameter
from tsobs_ros.nodes.recorder_topics import TopicFinder

_GRAPH_PERIOD = 0.1
_DIAGNOSTICS_PERIOD = 1.0
_MIB = 2**20
# Well before the disk is as full as recording ends at.
_FREE_DISK_WARNING = 2.0


@dataclass(frozen=True)
class RecorderParameters:
    """The node's parameters; `config/recorder.yaml` shows them with their reasons."""

    topics: tuple[str, ...] = parameter(
        (), "Topics to record; empty, or with '*' in it, for all that are visible", read_only=True
    )
    all: bool = parameter(False, "Record all visible topics, whatever is listed", read_only=True)
    output: str = parameter(
        "", "Folder of the bag, which must not exist; empty for a dated name", read_only=True
    )
    compression: str = parameter(
        "zstd", "Compression of the chunks", choices=("none", "lz4", "zstd"), read_only=True
    )
    flush_period: float = parameter(
        1.0, "What is older survives a kill", unit="s", minimum=0.01, maximum=10, read_only=True
    )
    sync_period: float = parameter(
        5.0, "What is older survives a power cut", unit="s", minimum=0.1, read_only=True
    )
    drain_period: float = parameter(
        0.01, "How often queues are emptied", unit="s", minimum=0.001, maximum=1, read_only=True
    )
    queue_depth: int = parameter(
        5000, "Messages of a topic that may wait to be drained", minimum=1, read_only=True
    )
    minimum_free_disk: int = parameter(
        256, "Free disk space at which recording ends", unit="MiB", minimum=0
    )


class TopicStatistics(NamedTuple):
    """Counts of one topic.

    Attributes:
        messages: Messages recorded.
        lost: Messages known to be lost, from gaps in the publisher's numbering.
        loss_known: Whether that is all: false once the topic had several publishers at a time.
    """

    messages: int
    lost: int
    loss_known: bool


class RecorderStatistics(NamedTuple):
    """Counts of the whole recording, and of each topic by its full name."""

    messages: int
    lost: int
    topics: Mapping[str, TopicStatistics]


class Recorder(Node):
    """Records until it is closed.

    Args:
        node_kwargs: Arguments of `rclpy.node.Node`, such as `context` or `parameter_overrides`.

    Raises:
        ParameterError: A parameter has a wrong type or value.
        BagWriteError: The bag exists already or cannot be created.
        NodeError: The disk is too full to begin.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("recorder", **node_kwargs)
        self.finished = False
        self._closed = True
        try:
            self._binding = ParameterBinding(self, RecorderParameters)
            self._start()
        except BaseException:
            super().destroy_node()
            raise

    def _start(self) -> None:
        parameters = self._binding.value
        everything = parameters.all or "*" in parameters.topics
        self._finder = TopicFinder(
            self,
            () if everything else parameters.topics,
            parameters.queue_depth,
            lambda message: self.get_logger().warning(message),
        )
        path = _output(parameters.output)
        self._free_disk_warned = False
        if _free_disk(path) < parameters.minimum_free_disk:
            raise NodeError(
                f"{path}: {_free_disk(path):.0f} MiB of disk space are free, less than "
                f"minimum_free_disk ({parameters.minimum_free_disk} MiB)"
            )
        self._writer = BagWriter(path, compression=parameters.compression)
        self._closed = False
        self._sync = BackgroundSync(self._writer.sync, parameters.sync_period)
        self._diagnostics = DiagnosticsPublisher(self, hardware_id=str(path))
        # Not the node's clock: simulated time may be slow, stop or never begin.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._our_timers = [
            self.create_timer(period, callback, clock=steady)
            for period, callback in (
                (_GRAPH_PERIOD, self._look_for_topics),
                (parameters.drain_period, self._drain),
                (parameters.flush_period, self._flush),
                (_DIAGNOSTICS_PERIOD, self._publish_diagnostics),
            )
        ]
        self.get_logger().info(f"recording to {self._writer.path}")

    @property
    def path(self) -> Path:
        """The bag's folder."""
        return self._writer.path

    @property
    def ready(self) -> bool:
        """Whether every listed topic has a publisher that the subscription is matched with."""
        return not self._finder.missing

    @property
    def statistics(self) -> RecorderStatistics:
        """What has been recorded and lost so far."""
        topics = {
            topic.name: TopicStatistics(topic.messages, topic.losses.lost, topic.losses.complete)
            for topic in self._finder.recorded.values()
        }
        return RecorderStatistics(
            messages=sum(topic.messages for topic in topics.values()),
            lost=sum(topic.lost for topic in topics.values()),
            topics=topics,
        )

    def close(self) -> None:
        """Record what has arrived, then finish the bag; safe to call twice.

        Raises:
            BagWriteError: The bag could not be finished; it can be recovered as far as flushed.
        """
        if self._closed:
            return
        try:
            self._drain()
        finally:
            self._closed = True
            for timer in self._our_timers:
                timer.cancel()
            self._sync.stop()
            self._writer.close()
        statistics = self.statistics
        self.get_logger().info(
            f"closed {self.path}: {statistics.messages} messages of {len(statistics.topics)} "
            f"topics, {statistics.lost} lost"
        )

    def destroy_node(self) -> None:
        """Close the bag, then destroy the node."""
        try:
            self.close()
        finally:
            super().destroy_node()

    def _look_for_topics(self) -> None:
        for topic in self._finder.poll():
            self._writer.add_topic(
                topic.name, topic.definition.type, topic.offers, definition=topic.definition
            )
            self.get_logger().info(f"recording {topic.name} [{topic.definition.type}]")

    def _drain(self) -> None:
        simulated_ns = None
        if self.get_clock().ros_time_is_active:
            simulated_ns = self.get_clock().now().nanoseconds
            if simulated_ns == 0:
                return  # no /clock yet: let messages wait rather than stamp them with 1970
        limit = self._binding.value.queue_depth
        batch = [
            (info.received_ns, topic.name, data, info.source_ns)
            for topic in self._finder.recorded.values()
            for data, info in topic.drain(limit)
        ]
        # Drained topic by topic, but readers of an unfinished file see it in file order.
        batch.sort(key=itemgetter(0))
        for received_ns, name, data, source_ns in batch:
            log_time_ns = received_ns if simulated_ns is None else simulated_ns
            self._writer.write(name, data, log_time_ns or time.time_ns(), max(source_ns, 0))

    def _flush(self) -> None:
        self._writer.flush()
        if self._sync.error is not None:
            raise self._sync.error
        free, minimum = _free_disk(self.path), self._binding.value.minimum_free_disk
        if free < minimum:
            self.get_logger().error(f"disk almost full ({free:.0f} MiB free): recording ends here")
            self.close()
            self.finished = True
        elif free < _FREE_DISK_WARNING * minimum and not self._free_disk_warned:
            self._free_disk_warned = True
            self.get_logger().warning(
                f"{free:.0f} MiB of disk space are left, recording ends at {minimum} MiB"
            )

    def _publish_diagnostics(self) -> None:
        statistics, missing = self.statistics, self._finder.missing
        level, message = Level.OK, "recording"
        if statistics.lost:
            level, message = Level.WARN, f"{statistics.lost} messages lost"
        elif missing:
            level, message = Level.WARN, f"waiting for {missing[0]}"
        values = {
            "messages": str(statistics.messages),
            "lost": str(statistics.lost),
            "topics": str(len(statistics.topics)),
            "waiting for": ", ".join(missing),
            "free disk space (MiB)": f"{_free_disk(self.path):.0f}",
        }
        self._diagnostics.publish([Status("recording", level, message, values)])


def create(**node_kwargs: Any) -> Recorder:
    """Return a recorder that has begun to record; the arguments are those of `Recorder`."""
    return Recorder(**node_kwargs)


def _output(output: str) -> Path:
    """Return the bag's folder as an absolute path, a dated one in the current folder if unnamed."""
    name = output or datetime.now().strftime("rosbag2_%Y_%m_%d-%H_%M_%S")
    return Path(name).expanduser().absolute()


def _free_disk(path: Path) -> float:
    """Return the free space, MiB, on the disk that holds a path or will hold it."""
    existing = next(folder for folder in (path, *path.parents) if folder.exists())
    return shutil.disk_usage(existing).free / _MIB
