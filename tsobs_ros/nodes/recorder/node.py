# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `recorder` node: records topics to an MCAP bag as rosbag2 does, and counts what it misses."""

import time
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType

from tsobs_ros.bag.recording import BufferedMessage, Recording
from tsobs_ros.errors import BagWriteError, NodeError
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.messages import DiagnosticsPublisher
from tsobs_ros.nodes.recorder.disk import free_disk, output_folder
from tsobs_ros.nodes.recorder.parameters import RecorderParameters
from tsobs_ros.nodes.recorder.services import offer_services
from tsobs_ros.nodes.recorder.status import (
    RecorderState,
    RecorderStatistics,
    SnapshotFill,
    TopicStatistics,
    disk_is_filling,
    statuses,
)
from tsobs_ros.nodes.recorder.subscription import loaded_rcl
from tsobs_ros.nodes.recorder.topics import RecordedTopic, TopicFinder
from tsobs_ros.nodes.ticker import Ticker

_GRAPH_PERIOD = 0.1
_DIAGNOSTICS_PERIOD = 1.0


class Recorder(ManagedNode[RecorderParameters]):
    """Records while it is active and not paused.

    Configuring begins the bag and subscribes, activating records, deactivating pauses: what arrives
    meanwhile is discarded. Cleaning up closes the bag.

    Args:
        node_kwargs: Arguments of `rclpy.node.Node`, such as `context` or `parameter_overrides`.

    Raises:
        ParameterError: A parameter has a wrong type or value.
        BagWriteError: The bag exists already or cannot be created.
        NodeError: The disk is too full to begin, or rcl cannot be called.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("recorder", RecorderParameters, **node_kwargs)
        self._full = False
        self.start()

    def configure(self) -> None:
        """Begin the bag and look for the topics."""
        parameters = self.parameters
        loaded_rcl()  # before there is a bag: without it no topic could be recorded
        path = output_folder(parameters.output)
        if free_disk(path) < parameters.minimum_free_disk:
            raise NodeError(
                f"{path}: {free_disk(path):.0f} MiB of disk space are free, less than "
                f"minimum_free_disk ({parameters.minimum_free_disk} MiB)"
            )
        self._finder = TopicFinder(
            self,
            parameters.selection(self.resolve_topic_name, self.resolve_service_name),
            {self.resolve_topic_name(name): name for name in parameters.topics if name != "*"},
            parameters.queue_depth,
            parameters.include_unpublished,
            self.get_logger().warning,
        )
        self._recording = Recording(path, parameters.recording_options())
        self.at_cleanup(self._close_recording)
        self._paused = parameters.start_paused
        self._failed = self._free_disk_warned = False
        self._messages_at_diagnostics = 0
        offer_services(self, parameters.snapshot_mode)
        self._diagnostics = DiagnosticsPublisher(self, hardware_id=str(path))
        self._chores = [
            _Chore(_GRAPH_PERIOD, self._look_for_topics),
            _Chore(parameters.flush_period, self._flush),
            _Chore(_DIAGNOSTICS_PERIOD, self._publish_diagnostics),
        ]
        # Not the node's clock: simulated time may be slow, stop or never begin.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.ticker = Ticker(self, parameters.drain_period, self._tick, executor_clock=steady)
        self.ticker.start()
        self.get_logger().info(f"recording to {path}")

    def activate(self) -> None:
        """Record what arrives from here on."""
        self._discard()

    def deactivate(self) -> None:
        """Record what has arrived, and discard what arrives from here on."""
        if not (self._paused or self._failed):
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
        return self._recording.path

    @property
    def ready(self) -> bool:
        """Whether every listed topic has a publisher that the subscription is matched with."""
        return not self._finder.missing

    @property
    def paused(self) -> bool:
        """Whether the services have paused it."""
        return self._paused

    @property
    def finished(self) -> bool:
        """Whether the disk is full; a process then ends."""
        return super().finished or self._full

    @property
    def statistics(self) -> RecorderStatistics:
        """What has been recorded and lost so far."""
        recording = self._recording
        topics = {
            topic.name: _statistics(topic, recording.counts[topic.name])
            for topic in self._finder.recorded.values()
        }
        return RecorderStatistics(
            messages=sum(topic.messages for topic in topics.values()),
            lost=sum(topic.lost for topic in topics.values()),
            topics=topics,
            discarded=recording.discarded,
            bytes=recording.bytes,
            files=recording.file_count,
        )

    def pause(self) -> None:
        """Record what has arrived, and discard what arrives from here on."""
        self._drain()
        self._paused = True
        self.get_logger().info("paused")

    def resume(self) -> None:
        """Record what arrives from here on, and what was latched meanwhile."""
        self._drain()
        self._paused = False
        self.get_logger().info("resumed")

    def split(self) -> None:
        """Go on in another file of the bag, unless the current one is empty.

        Raises:
            BagWriteError: The disk failed; the bag is closed.
        """
        self._drain()
        self._recording.split()

    def take_snapshot(self) -> int:
        """Begin to write the last seconds, and return how many messages they are."""
        self._drain()
        return self._recording.take_snapshot()

    def _tick(self) -> None:
        now = time.monotonic()
        try:
            if self.configured:  # a full disk ends that, and perhaps not yet the ticks
                self._drain()
                self._recording.write_pending()
            for chore in self._chores:
                if self.configured:
                    chore.run_if_due(now)
        except BagWriteError as error:
            self._failed = True
            raise BagWriteError(
                f"{error}; what was written before: tsobs bag recover {self.path}"
            ) from error

    def _close_recording(self) -> None:
        try:
            self._recording.close()
        except BagWriteError:
            if not self._failed:  # otherwise this has been said, and is why it closes
                raise

    def _look_for_topics(self) -> None:
        for topic in self._finder.poll():
            self._recording.add_topic(topic.name, topic.definition, topic.offers)
            self.get_logger().info(f"recording {topic.name} [{topic.definition.type}]")

    def _drain(self) -> None:
        if self.active and not self._paused:
            self._record()
        else:
            self._discard()

    def _discard(self) -> None:
        for topic in self._finder.recorded.values():
            for received in topic.drain(self.parameters.queue_depth):
                message = BufferedMessage(topic.name, received.data, 0, max(received.source_ns, 0))
                self._recording.discard(message, topic.latched_by(received))

    def _record(self) -> None:
        simulated_ns = None
        if self.get_clock().ros_time_is_active:
            simulated_ns = self.get_clock().now().nanoseconds
            if simulated_ns == 0:
                return  # no /clock yet: let messages wait rather than stamp them with 1970
        limit = self.parameters.queue_depth
        batch = [
            (received.received_ns, received, topic)
            for topic in self._finder.recorded.values()
            for received in topic.drain(limit)
        ]
        # Drained topic by topic, but readers of an unfinished file see it in file order.
        batch.sort(key=itemgetter(0))
        record = self._recording.record
        for received_ns, received, topic in batch:
            log_time_ns = received_ns if simulated_ns is None else simulated_ns
            message = BufferedMessage(
                topic.name,
                received.data,
                log_time_ns or time.time_ns(),
                max(received.source_ns, 0),
            )
            record(message, topic.latched_by(received))

    def _flush(self) -> None:
        self._recording.flush()
        free, minimum = free_disk(self.path), self.parameters.minimum_free_disk
        if free < minimum:
            self.get_logger().error(f"disk almost full ({free:.0f} MiB free): recording ends here")
            self.close()
            self._full = True
        elif disk_is_filling(free, minimum) and not self._free_disk_warned:
            self._free_disk_warned = True
            self.get_logger().warning(
                f"{free:.0f} MiB of disk space are left, recording ends at {minimum} MiB"
            )

    def _publish_diagnostics(self) -> None:
        statistics, snapshot = self.statistics, self._recording.snapshot
        news = statistics.messages - self._messages_at_diagnostics
        self._messages_at_diagnostics = statistics.messages
        clock = self.get_clock()
        state = RecorderState(
            statistics=statistics,
            rate=news / _DIAGNOSTICS_PERIOD,
            recording=self.active and not self._paused,
            clock_awaited=clock.ros_time_is_active and clock.now().nanoseconds == 0,
            waiting_for=self._finder.missing,
            free_disk=free_disk(self.path),
            minimum_free_disk=self.parameters.minimum_free_disk,
            sync_age=self._recording.sync_age,
            sync_period=self.parameters.sync_period,
            snapshot=None
            if snapshot is None
            else SnapshotFill(
                len(snapshot), snapshot.size, snapshot.duration_ns * 1e-9, snapshot.refused
            ),
        )
        self._diagnostics.publish(statuses(state))


class _Chore:
    """Something to be done every so often, looked after at each tick."""

    def __init__(self, period: float, do: Callable[[], None]) -> None:
        self._period = period
        self._do = do
        self._due = 0.0

    def run_if_due(self, now: float) -> None:
        if now >= self._due:
            self._due = now + self._period
            self._do()


def create(**node_kwargs: Any) -> Recorder:
    """Return a recorder that has begun to record; the arguments are those of `Recorder`."""
    return Recorder(**node_kwargs)


def _statistics(topic: RecordedTopic, messages: int) -> TopicStatistics:
    losses = topic.losses
    by_publisher = losses.lost_by_publisher if losses.lost else {}
    losers = {
        topic.publishers.get(p, "a node that left") for p, lost in by_publisher.items() if lost
    }
    return TopicStatistics(messages, losses.lost, losses.complete, tuple(sorted(losers)))
