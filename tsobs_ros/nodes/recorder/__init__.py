# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The `recorder` node: topics into an MCAP bag, and counts of missed messages.

topics:
  the topics that the parameters select (in), by default all
  /diagnostics (out)  diagnostic_msgs/msg/DiagnosticArray: counts and losses, once per second

services, std_srvs/srv/Trigger:
  ~/pause             discard new messages, unless they are latched
  ~/resume            continue recording
  ~/split_bagfile     continue in another file
"""

import shutil
from datetime import datetime
from functools import partial
from itertools import chain, count
from operator import attrgetter
from pathlib import Path

from tsobs_ros.bag.recording import Recording
from tsobs_ros.errors import BagWriteError, NodeError
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.managed import ManagedNode
from tsobs_ros.nodes.parameters import expanded
from tsobs_ros.nodes.recorder.topics import LossCounter, RecorderParameters, TopicFinder
from tsobs_ros.nodes.runtime import Ticker

# Periods of emptying the queues, and of looking for topics in the ROS graph [s].
_DRAIN_PERIOD, _GRAPH_PERIOD = 0.01, 0.1
_MIB = 2**20
# Free disk space at which to warn, as a multiple of `minimum_free_disk`.
_FREE_DISK_WARNING = 2.0


class Recorder(ManagedNode[RecorderParameters]):
    """Records into an MCAP bag as rosbag2 writes it, while it is active and not paused.

    Its services have the names of rosbag2's recorder, but a type that every installation has.
    Configuring creates the bag and subscribes, activating records, deactivating pauses: new
    messages are discarded, unless they are latched. Cleaning up closes the bag.

    Attributes:
        recording: The bag with its counts.
        finder: The recorded topics, and the missing ones.
    """

    def configure(self) -> None:
        """Create the bag and look for the topics."""
        parameters = self.parameters
        path = _bag_folder(parameters.output)
        if (free := _free_disk(path)) < parameters.minimum_free_disk:
            raise NodeError(
                f"{path}: {free:.0f} MiB of disk space are free, less than "
                f"minimum_free_disk ({parameters.minimum_free_disk} MiB)"
            )
        self.finder = TopicFinder(self)
        self.recording = Recording(
            path,
            compression=parameters.compression,
            max_size=parameters.max_bag_size,
            max_duration_ns=round(parameters.max_bag_duration * 1e9),
            sync_period=parameters.sync_period,
        )
        self.at_cleanup(self._close_recording)
        self._paused = self._failed = False
        # The last log time under simulated time, and how far it is ahead of the clock [ns].
        self._latest = self._ahead = 0
        acts = {"pause": partial(self._pause, True), "resume": partial(self._pause, False)}
        self.offer_triggers({**acts, "split_bagfile": self._split})
        self.offer_diagnostics(str(path), self._statuses)
        # Not the node's clock: simulated time may be slow, stop or never start.
        self.ticker = Ticker(self, _DRAIN_PERIOD, self._tick, executor_clock=self.steady)
        self.at_cleanup(self._log_end)
        self.log(Level.OK, f"recording to {path}")

    def activate(self) -> None:
        """Record the messages that arrive from now on."""
        if self._is_timeless:
            self.log(Level.OK, "waiting for /clock")
        self._drain()

    def deactivate(self) -> None:
        """Record the messages that have arrived, and discard later ones."""
        if not (self._paused or self._failed):
            self._take(is_recording=True)

    def _log_end(self) -> None:
        """Log the counts of the bag before it is closed."""
        if self._is_timeless:
            limit, topics = self.parameters.queue_depth, self.finder.recorded.values()
            waiting = sum(len(topic.drain(limit)) for topic in topics)
            self.log(Level.WARN, f"not recorded without a /clock: {waiting} messages")
        unknown = len(self.loss_unknown)
        self.log(
            Level.OK,
            f"closing {self.path}: {self.messages} messages of {len(self.finder.recorded)} "
            f"topics, {self.lost} lost since the first of each, {self.earlier} published before"
            + (f", topics with unknown losses: {unknown}" if unknown else ""),
        )

    @property
    def path(self) -> Path:
        """The bag's folder."""
        return self.recording.path

    @property
    def messages(self) -> int:
        """The number of messages recorded."""
        return sum(self.recording.counts.values())

    @property
    def _is_timeless(self) -> bool:
        """Whether there has been no /clock yet."""
        return self.now() == 0

    @property
    def _losses(self) -> dict[str, LossCounter]:
        return {name: topic.losses for name, topic in sorted(self.finder.recorded.items())}

    @property
    def lost(self) -> int:
        """The number of messages known to be lost."""
        return sum(losses.lost for losses in self._losses.values())

    @property
    def earlier(self) -> int:
        """The number of messages that publishers sent before their first one that arrived."""
        return sum(losses.earlier for losses in self._losses.values())

    @property
    def loss_unknown(self) -> list[str]:
        """The topics whose losses are not all known."""
        return [name for name, losses in self._losses.items() if not losses.is_exact]

    def _pause(self, paused: bool) -> str:
        self._drain()
        self._paused = paused
        return "paused" if paused else "recording"

    def _split(self) -> str:
        self._drain()
        self.recording.split()
        return f"{self.recording.file_count} files"

    def _tick(self) -> None:
        if not self.configured:  # a full disk causes a clean-up before the last tick
            return
        try:
            self._drain()
            if self.is_due("graph", _GRAPH_PERIOD):
                self._look_for_topics()
            if self.is_due("flush", self.parameters.flush_period):
                self._flush()  # which may end the recording
        except BagWriteError as error:
            self._failed = True
            raise BagWriteError(
                f"{error}; what was written before: tsobs bag recover {self.path}"
            ) from error

    def _close_recording(self) -> None:
        try:
            self.recording.close()
        except BagWriteError:
            if not self._failed:  # else it has been reported and caused this clean-up
                raise

    def _look_for_topics(self) -> None:
        for topic in self.finder.poll():
            self.recording.add_topic(
                topic.name, topic.definition.type, topic.offers, definition=topic.definition
            )
            self.log(Level.OK, f"recording {topic.name} [{topic.definition.type}]")

    def _drain(self) -> None:
        self._take(is_recording=self.active and not self._paused)

    def _take(self, *, is_recording: bool) -> None:
        """Record the messages that have arrived, in a pause only latched ones."""
        clock = self.get_clock()
        now, is_simulated = clock.now().nanoseconds, clock.ros_time_is_active
        if now == 0:
            return  # no /clock yet: let messages wait rather than stamp them with 1970
        log_time = self._carried_on(now) if is_simulated else 0
        limit, recorded = self.parameters.queue_depth, self.finder.recorded.values()
        batch = [message for topic in recorded for message in topic.drain(limit)]
        # Topics are drained one by one, but an unfinished file is read in the order of writing.
        batch.sort(key=attrgetter("log_time_ns"))
        for message in batch:
            if is_simulated:
                message = message._replace(log_time_ns=log_time)
            if is_recording or message.latched:
                self.recording.record(message)
            else:
                self.recording.discarded += 1

    def _carried_on(self, now: int) -> int:
        """Return the log time at a simulated time; it never goes back, as readers sort by it."""
        if now >= self._latest:
            self._ahead = 0
        elif (back := self._latest - self._ahead - now) > 0:
            self._ahead += back
            text = f"the clock went back by {back * 1e-9:.3f} s: log times carry on from the last"
            self.log(Level.WARN, text)
        self._latest = now + self._ahead
        return self._latest

    def _flush(self) -> None:
        self.recording.flush()
        if (free := _free_disk(self.path)) < self.parameters.minimum_free_disk:
            self.log(Level.ERROR, f"disk almost full ({free:.0f} MiB free): recording ends here")
            self.close()
            self.done = True

    def _statuses(self) -> list[Status]:
        recording, missing, free = self.recording, self.finder.missing, _free_disk(self.path)
        is_recording = self.active and not self._paused
        values = {
            "messages": str(self.messages),
            "MiB": f"{recording.bytes / _MIB:.1f}",
            "lost": str(self.lost),
            "published before the first": str(self.earlier),
            "losses unknown of": ", ".join(self.loss_unknown),
            "discarded while paused": str(recording.discarded),
            "waiting for": ", ".join(missing),
            "files": str(recording.file_count),
            "free disk space (MiB)": f"{free:.0f}",
        }
        low = free < _FREE_DISK_WARNING * self.parameters.minimum_free_disk
        warnings = {
            f"{self.lost} messages lost": self.lost > 0,
            f"{free:.0f} MiB of disk space are left": low,
            "waiting for /clock": self._is_timeless,
            f"waiting for {', '.join(missing[:1])}": bool(missing),
        }
        worst = next((text for text, holds in warnings.items() if holds), None)
        message = worst or ("recording" if is_recording else "paused")
        level = Level.OK if worst is None else Level.WARN
        counts = {
            name: f"{recording.counts[name]} messages, {losses}"
            for name, losses in self._losses.items()
        }
        topics = Status("topics", Level.OK, f"{len(counts)} topics", counts)
        return [Status("recording", level, message, values), topics]


def _bag_folder(output: str) -> Path:
    """Return the bag's folder as an absolute path, a dated one in the current folder if unnamed."""
    if output:
        return expanded("output", output).absolute()
    dated = Path(datetime.now().strftime("rosbag2_%Y_%m_%d-%H_%M_%S")).absolute()
    others = (dated.with_name(f"{dated.name}_{number}") for number in count(2))
    return next(path for path in chain([dated], others) if not path.exists())


def _free_disk(path: Path) -> float:
    """Return the free space, MiB, on the disk that holds a path or will hold it."""
    existing = next(folder for folder in (path, *path.parents) if folder.exists())
    return shutil.disk_usage(existing).free / _MIB


Parameters = RecorderParameters
create = partial(Recorder, "recorder", Parameters)
