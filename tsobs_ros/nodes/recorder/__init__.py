# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `recorder` node: topics into an MCAP bag, and an account of what was missed.

topics:
  those that its parameters select (in), else all
  /diagnostics (out)  diagnostic_msgs/msg/DiagnosticArray: counts and losses, once a second

services, std_srvs/srv/Trigger:
  ~/pause             discard what arrives
  ~/resume            go on
  ~/toggle_paused     either of them
  ~/is_paused         `success` is whether it is paused
  ~/split_bagfile     go on in another file
  ~/snapshot          write the last seconds; with `snapshot_mode`
"""

import shutil
import time
from collections.abc import Callable
from datetime import datetime
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

from tsobs_ros.errors import BagWriteError, NodeError
from tsobs_ros.estimation.health import Level
from tsobs_ros.nodes.managed import DIAGNOSTICS_PERIOD, ManagedNode, Statuses
from tsobs_ros.nodes.recorder.parameters import RecorderParameters
from tsobs_ros.nodes.recorder.status import RecorderStatistics, statuses
from tsobs_ros.nodes.recorder.topics import TopicFinder
from tsobs_ros.nodes.runtime import Ticker

_GRAPH_PERIOD = 0.1
_MIB = 2**20


class Recorder(ManagedNode[RecorderParameters]):
    """Records into an MCAP bag as rosbag2 writes it, while it is active and not paused.

    Its services are those of rosbag2's recorder by name, with a type that every installation has.
    Configuring creates the bag and subscribes, activating records, deactivating pauses: what
    arrives meanwhile is discarded. Cleaning up closes the bag.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("recorder", RecorderParameters, **node_kwargs)
        self._full = False
        self.start()

    def configure(self) -> None:
        """Create the bag and look for the topics."""
        parameters = self.parameters
        path = _bag_folder(parameters.output)
        if (free := _free_disk(path)) < parameters.minimum_free_disk:
            raise NodeError(
                f"{path}: {free:.0f} MiB of disk space are free, less than "
                f"minimum_free_disk ({parameters.minimum_free_disk} MiB)"
            )
        self._finder = TopicFinder(self, parameters)
        self._recording = parameters.recording(path)
        self.at_cleanup(self._close_recording)
        self._paused = parameters.start_paused
        self._failed = self._free_disk_warned = False
        self._messages_before = 0
        self._offer_services(parameters.snapshot_mode)
        self.offer_diagnostics(str(path), self._statuses)
        self._chores: dict[Callable[[], None], float] = {
            self._look_for_topics: _GRAPH_PERIOD,
            self._flush: parameters.flush_period,
        }
        self._due = dict.fromkeys(self._chores, 0.0)
        # Not the node's clock: simulated time may be slow, stop or never start.
        self.ticker = Ticker(self, parameters.drain_period, self._tick, executor_clock=self.steady)
        self.ticker.start()
        self.log(Level.OK, f"recording to {path}")

    def activate(self) -> None:
        """Record what arrives from here on."""
        self._discard()

    def deactivate(self) -> None:
        """Record what has arrived, and discard what arrives from here on."""
        if not (self._paused or self._failed):
            self._record()

    def cleanup(self) -> None:
        """Log what the bag holds before it is closed."""
        statistics = self.statistics
        unknown = len(statistics.loss_unknown)
        self.log(
            Level.OK,
            f"closing {self.path}: {statistics.messages} messages of {len(statistics.topics)} "
            f"topics, {statistics.lost} lost since the first of each, {statistics.earlier} "
            "published before" + (f", losses of {unknown} topics unknown" if unknown else ""),
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
    def finished(self) -> bool:
        """Whether the disk is full, or the node was shut down; a process then ends."""
        return super().finished or self._full

    @property
    def statistics(self) -> RecorderStatistics:
        """What has been recorded and lost so far, and what decides how well it goes."""
        recording, clock = self._recording, self.get_clock()
        return RecorderStatistics(
            topics={name: each.losses for name, each in self._finder.recorded.items()},
            recording=recording,
            parameters=self.parameters,
            is_recording=self.active and not self._paused,
            awaits_clock=clock.ros_time_is_active and clock.now().nanoseconds == 0,
            missing=self._finder.missing if self.configured else (),
            free_disk=_free_disk(self.path),
        )

    def _offer_services(self, snapshot_mode: bool) -> None:
        recording = self._recording

        def split() -> str:
            recording.split()
            return f"{recording.file_count} files"

        acts: dict[str, Callable[[], str]] = {
            "pause": lambda: self._pause(True),
            "resume": lambda: self._pause(False),
            "toggle_paused": lambda: self._pause(not self._paused),
            "split_bagfile": split,
        }
        if snapshot_mode:
            acts["snapshot"] = lambda: f"{recording.take_snapshot()} messages"
        self.offer_triggers({name: partial(self._attempt_act, act) for name, act in acts.items()})
        state = ("recording", "paused")
        self.offer_triggers({"is_paused": lambda: (self._paused, state[self._paused])})

    def _attempt_act(self, act: Callable[[], str]) -> tuple[bool, str]:
        """Do what a service asks for, after what has arrived; return its answer."""
        try:
            self._drain()
            return True, act()
        except BagWriteError as error:  # the next tick meets it too, and ends the recording
            return False, str(error)

    def _pause(self, paused: bool) -> str:
        self._paused = paused
        state = "paused" if paused else "recording"
        self.log(Level.OK, state)
        return state

    def _tick(self) -> None:
        now = time.monotonic()
        try:
            if self.configured:  # a full disk ends that, and perhaps not yet the ticks
                self._drain()
                self._recording.write_pending()
            for chore, period in self._chores.items():
                if self.configured and now >= self._due[chore]:
                    self._due[chore] = now + period
                    chore()
        except BagWriteError as error:
            self._failed = True
            raise BagWriteError(
                f"{error}; what was written before: tsobs bag recover {self.path}"
            ) from error

    def _close_recording(self) -> None:
        try:
            self._recording.close()
        except BagWriteError:
            if not self._failed:  # otherwise this has been reported, and is why it closes
                raise

    def _look_for_topics(self) -> None:
        for topic in self._finder.poll():
            self._recording.add_topic(
                topic.name, topic.definition.type, topic.offers, definition=topic.definition
            )
            self.log(Level.OK, f"recording {topic.name} [{topic.definition.type}]")

    def _drain(self) -> None:
        if self.active and not self._paused:
            self._record()
        else:
            self._discard()

    def _discard(self) -> None:
        for topic in self._finder.recorded.values():
            for message, latch in topic.drain(self.parameters.queue_depth):
                self._recording.discard(message, latch)

    def _record(self) -> None:
        simulated_ns = None
        if self.get_clock().ros_time_is_active:
            simulated_ns = self.get_clock().now().nanoseconds
            if simulated_ns == 0:
                return  # no /clock yet: let messages wait rather than stamp them with 1970
        limit, recorded = self.parameters.queue_depth, self._finder.recorded.values()
        batch = [received for topic in recorded for received in topic.drain(limit)]
        # Drained topic by topic, but readers of an unfinished file see it in file order.
        batch.sort(key=lambda received: received[0].log_time_ns)
        for message, latch in batch:
            if simulated_ns is not None:
                message = message._replace(log_time_ns=simulated_ns)
            self._recording.record(message, latch)

    def _flush(self) -> None:
        self._recording.flush()
        statistics, minimum = self.statistics, self.parameters.minimum_free_disk
        free = statistics.free_disk
        if free < minimum:
            self.log(Level.ERROR, f"disk almost full ({free:.0f} MiB free): recording ends here")
            self.close()
            self._full = True
        elif statistics.disk_is_filling and not self._free_disk_warned:
            self._free_disk_warned = True
            self.log(
                Level.WARN,
                f"{free:.0f} MiB of disk space are left, recording ends at {minimum} MiB",
            )

    def _statuses(self) -> Statuses:
        statistics, before = self.statistics, self._messages_before
        self._messages_before = statistics.messages
        return statuses(statistics, rate=(statistics.messages - before) / DIAGNOSTICS_PERIOD), {}


def _bag_folder(output: str) -> Path:
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


Parameters, create = RecorderParameters, Recorder
