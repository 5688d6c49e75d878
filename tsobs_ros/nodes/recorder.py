# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `recorder` node: records topics to an MCAP bag as rosbag2 does, and counts what it misses."""

import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import chain, count
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.clock import Clock, ClockType

from tsobs_ros.bag.syncing import BackgroundSync
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.errors import NodeError
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.diagnostics import DiagnosticsPublisher
from tsobs_ros.nodes.managed import ManagedNode, ManagedParameters
from tsobs_ros.nodes.parameters import parameter
from tsobs_ros.nodes.recorder_topics import TopicFinder

_GRAPH_PERIOD = 0.1
_DIAGNOSTICS_PERIOD = 1.0
_MIB = 2**20
# Well before the disk is as full as recording ends at.
_FREE_DISK_WARNING = 2.0


@dataclass(frozen=True)
class RecorderParameters(ManagedParameters):
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


class Recorder(ManagedNode[RecorderParameters]):
    """Records from its activation until it is closed.

    Configuring begins the bag and subscribes, activating records, deactivating pauses: what arrives
    meanwhile is discarded. Cleaning up closes the bag.

    Args:
        node_kwargs: Arguments of `rclpy.node.Node`, such as `context` or `parameter_overrides`.

    Raises:
        ParameterError: A parameter has a wrong type or value.
        BagWriteError: The bag exists already or cannot be created.
        NodeError: The disk is too full to begin.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("recorder", RecorderParameters, **node_kwargs)
        self._full = False
        self.start()

    def configure(self) -> None:
        """Begin the bag and look for the topics."""
        parameters = self.parameters
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
        self.at_cleanup(self._writer.close)
        self._sync = BackgroundSync(self._writer.sync, parameters.sync_period)
        self.at_cleanup(self._sync.stop)
        self._diagnostics = DiagnosticsPublisher(self, hardware_id=str(path))
        # Not the node's clock: simulated time may be slow, stop or never begin.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        for period, callback in (
            (_GRAPH_PERIOD, self._look_for_topics),
            (parameters.drain_period, self._drain),
            (parameters.flush_period, self._flush),
            (_DIAGNOSTICS_PERIOD, self._publish_diagnostics),
        ):
            self.create_timer(period, callback, clock=steady)
        self.get_logger().info(f"recording to {self._writer.path}")

    def activate(self) -> None:
        """Record what arrives from here on."""
        self._discard()

    def deactivate(self) -> None:
        """Record what has arrived, and discard what arrives from here on."""
        self._record()

    def cleanup(self) -> None:
        """Say what the bag holds that is about to be closed."""
        statistics = self.statistics
        self.get_logger().info(
            f"closing {self.path}: {statistics.messages} messages of {len(statistics.topics)} "
            f"topics, {statistics.lost} lost"
        )

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

    @property
    def finished(self) -> bool:
        """Whether the disk is full; a process then ends."""
        return super().finished or self._full

    def _look_for_topics(self) -> None:
        for topic in self._finder.poll():
            self._writer.add_topic(
                topic.name, topic.definition.type, topic.offers, definition=topic.definition
            )
            self.get_logger().info(f"recording {topic.name} [{topic.definition.type}]")

    def _drain(self) -> None:
        if self.active:
            self._record()
        else:
            self._discard()

    def _discard(self) -> None:
        for topic in self._finder.recorded.values():
            topic.discard()

    def _record(self) -> None:
        simulated_ns = None
        if self.get_clock().ros_time_is_active:
            simulated_ns = self.get_clock().now().nanoseconds
            if simulated_ns == 0:
                return  # no /clock yet: let messages wait rather than stamp them with 1970
        limit = self.parameters.queue_depth
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
        free, minimum = _free_disk(self.path), self.parameters.minimum_free_disk
        if free < minimum:
            self.get_logger().error(f"disk almost full ({free:.0f} MiB free): recording ends here")
            self.close()
            self._full = True
        elif free < _FREE_DISK_WARNING * minimum and not self._free_disk_warned:
            self._free_disk_warned = True
            self.get_logger().warning(
                f"{free:.0f} MiB of disk space are left, recording ends at {minimum} MiB"
            )

    def _publish_diagnostics(self) -> None:
        statistics, missing = self.statistics, self._finder.missing
        level, message = Level.OK, "recording" if self.active else "paused"
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
    if output:
        return Path(output).expanduser().absolute()
    dated = Path(datetime.now().strftime("rosbag2_%Y_%m_%d-%H_%M_%S")).absolute()
    others = (dated.with_name(f"{dated.name}_{number}") for number in count(2))
    return next(path for path in chain([dated], others) if not path.exists())


def _free_disk(path: Path) -> float:
    """Return the free space, MiB, on the disk that holds a path or will hold it."""
    existing = next(folder for folder in (path, *path.parents) if folder.exists())
    return shutil.disk_usage(existing).free / _MIB
