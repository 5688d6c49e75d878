# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorder's counts, of lost messages too, and its statuses in /diagnostics."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from tsobs_ros.bag.recording import Recording
from tsobs_ros.estimation.health import Level, Status
from tsobs_ros.nodes.recorder.parameters import RecorderParameters

_MIB = 2**20
# How much later than planned a sync may end without a warning [s].
_SYNC_GRACE = 5.0
# Free disk space at which to warn, as a multiple of that at which recording ends.
_FREE_DISK_WARNING = 2.0


class LossCounter:
    """Counts the numbers that are missing between two that arrived from the same publisher.

    The middleware gives the number of a message, but not its publisher. A gap is therefore a loss
    only while the topic has one publisher; with several, losses are unknown. The first number that
    arrives of a publisher shows how many messages it had sent before. What it sends after the last
    that arrives leaves no trace.

    >>> counter = LossCounter()
    >>> counter.add([7, 8, 11], lambda: frozenset({b"plant"}))
    >>> counter.earlier, counter.lost, counter.is_exact
    (6, 2, True)

    Attributes:
        earlier: The number of messages that publishers sent before the first that arrived of each.
        lost: The number of messages known to be lost since then.
        is_exact: False once these may be too small: the topic has had several publishers at a
            time, or the middleware does not number messages.
        since_ns: Time of the first arrival, ns since the epoch; None before it.
    """

    def __init__(self) -> None:
        self.since_ns: int | None = None
        self.earlier = 0
        self.lost = 0
        self.is_exact = True
        # Numbers begin at 1, so the first one is never the next one.
        self._next = 0
        self._publishers: frozenset[bytes] = frozenset()
        self._gone = False

    def see(self, publishers: frozenset[bytes]) -> None:
        """Take in who publishes the topic now; its queue has been emptied since the last call."""
        self.is_exact &= len(publishers) <= 1
        gone = not publishers & self._publishers
        if gone and self._gone:
            self._next = 0  # all that it sent has been counted
        self._gone = gone

    def add(
        self, numbers: Iterable[int | None], current_publishers: Callable[[], frozenset[bytes]]
    ) -> None:
        """Take in the numbers of new messages, in order of arrival.

        Args:
            numbers: Each publisher's count of its messages, from 1; None from a middleware that
                does not number them.
            current_publishers: Returns who publishes the topic now.
        """
        publishers: frozenset[bytes] | None = None  # asked for only if a number is not the next
        for number in numbers:
            if number == self._next:
                self._next += 1
            elif number is None:
                self.is_exact = False
            else:
                publishers = current_publishers() if publishers is None else publishers
                self._jump(number, publishers)

    def _jump(self, number: int, publishers: frozenset[bytes]) -> None:
        if self._next and len(self._publishers) == 1 and publishers <= self._publishers:
            if number < self._next:
                self.is_exact = False  # another publisher, which came and went between two looks
                return
            self.lost += number - self._next
        else:
            # Another publisher; unless its numbers start lower, this one may be the old one's last.
            unclear = bool(self._publishers) and 0 < self._next < number
            if len(publishers) > 1 or unclear:
                self.is_exact = False
            elif self.is_exact:
                self.earlier += number - 1
            self._publishers = frozenset() if unclear else publishers
        self._next = number + 1

    def text(self, messages: int) -> str:
        """Return the counts of a topic in words, with the number of its messages recorded."""
        if self.since_ns is None:
            return "0 messages, nothing has arrived"
        if not self.is_exact:
            lost = f"at least {self.lost} lost" if self.lost else "losses unknown"
            return f"{messages} messages, {lost}"
        since = datetime.fromtimestamp(self.since_ns // 10**6 / 1e3, UTC)
        return (
            f"{messages} messages, {self.lost} lost since "
            f"{since.isoformat(timespec='milliseconds')}, {self.earlier} published before"
        )


@dataclass(frozen=True)
class RecorderStatistics:
    """All that decides a recorder's statuses.

    Attributes:
        topics: What is missing of each topic, by its full name.
        recording: The bag with its counts.
        parameters: The recorder's.
        is_recording: Whether what arrives is recorded.
        awaits_clock: Whether messages wait for the first time on /clock.
        missing: Listed topics without a publisher.
        free_disk: Free disk space [MiB].
    """

    topics: Mapping[str, LossCounter]
    recording: Recording
    parameters: RecorderParameters
    is_recording: bool
    awaits_clock: bool
    missing: Sequence[str]
    free_disk: float

    @property
    def messages(self) -> int:
        """The messages recorded."""
        return sum(self.recording.counts.values())

    @property
    def lost(self) -> int:
        """The messages known to be lost."""
        return sum(topic.lost for topic in self.topics.values())

    @property
    def earlier(self) -> int:
        """The messages published before the first that arrived of each publisher."""
        return sum(topic.earlier for topic in self.topics.values())

    @property
    def loss_unknown(self) -> list[str]:
        """The topics whose losses are not all known."""
        return sorted(name for name, topic in self.topics.items() if not topic.is_exact)

    @property
    def disk_is_filling(self) -> bool:
        """Whether recording will soon end for want of disk space."""
        return self.free_disk < _FREE_DISK_WARNING * self.parameters.minimum_free_disk


def statuses(counts: RecorderStatistics, rate: float) -> list[Status]:
    """Return what to publish: the recording as a whole, and the counts of its topics.

    Args:
        counts: The recorder's.
        rate: Messages per second [1/s].
    """
    recording, topics = counts.recording, sorted(counts.topics.items())
    values = {
        "messages": str(counts.messages),
        "messages a second": f"{rate:.1f}",
        "MiB": f"{recording.bytes / _MIB:.1f}",
        "lost": str(counts.lost),
        "published before the first": str(counts.earlier),
        "losses unknown of": ", ".join(counts.loss_unknown),
        "discarded while paused": str(recording.discarded),
        "topics": str(len(counts.topics)),
        "waiting for": ", ".join(counts.missing),
        "paused": str(not counts.is_recording).lower(),
        "files": str(recording.file_count),
        "free disk space (MiB)": f"{counts.free_disk:.0f}",
        "last sync (s ago)": f"{recording.sync_age:.1f}",
    }
    if (buffer := recording.snapshot) is not None:
        duration, size = buffer.duration_ns * 1e-9, buffer.size / _MIB
        values["snapshot buffer"] = f"{len(buffer)} messages, {duration:.1f} s, {size:.1f} MiB"
        values["too large for the snapshot buffer"] = str(buffer.refused)
    level, message = Level.OK, "nothing lost since the first of each"
    if lossy := [name for name, losses in topics if losses.lost]:
        level, message = Level.WARN, f"messages lost of {', '.join(lossy)}"
    elif counts.loss_unknown:
        message = f"losses unknown of {', '.join(counts.loss_unknown)}"
    texts = {name: losses.text(recording.counts[name]) for name, losses in topics}
    return [
        Status("recording", *_verdict(counts), values),
        Status("topics", level, message, texts),
    ]


def _verdict(counts: RecorderStatistics) -> tuple[Level, str]:
    """Return the most serious thing there is to report."""
    snapshot, sync_age = counts.recording.snapshot, counts.recording.sync_age
    refused = 0 if snapshot is None else snapshot.refused
    warnings = (
        (counts.lost, f"{counts.lost} messages lost"),
        (refused, f"{refused} messages too large for the snapshot buffer"),
        (counts.disk_is_filling, f"{counts.free_disk:.0f} MiB of disk space are left"),
        (
            sync_age > counts.parameters.sync_period + _SYNC_GRACE,
            f"the disk has not kept up for {sync_age:.0f} s",
        ),
        (counts.awaits_clock, "waiting for /clock"),
        (counts.missing, f"waiting for {', '.join(counts.missing[:1])}"),
    )
    for is_so, message in warnings:
        if is_so:
            return Level.WARN, message
    if not counts.is_recording:
        return Level.OK, "paused"
    return Level.OK, "recording" if snapshot is None else "keeping the last seconds"
