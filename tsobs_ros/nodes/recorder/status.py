# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a recorder has recorded and lost, and what it says of that in /diagnostics."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tsobs_ros.estimation.health import Level, Status

_MIB = 2**20
# How much longer than planned a sync may take before it is worth a warning [s].
_SYNC_GRACE = 5.0
# Well before the disk is as full as recording ends at.
_FREE_DISK_WARNING = 2.0


class TopicStatistics(NamedTuple):
    """Counts of one topic.

    Attributes:
        messages: Messages recorded.
        lost: Messages known to be lost, from gaps in the publishers' numbering.
        loss_known: Whether that is all: false where the middleware does not number messages.
        losers: The nodes whose messages are lost.
    """

    messages: int
    lost: int
    loss_known: bool
    losers: tuple[str, ...] = ()


class RecorderStatistics(NamedTuple):
    """Counts of the whole recording, and of each topic by its full name.

    Attributes:
        messages: Messages recorded.
        lost: Messages known to be lost.
        topics: Counts of each topic.
        discarded: Messages that came while the recording was paused.
        bytes: Bytes of the messages recorded.
        files: Files of the bag.
    """

    messages: int
    lost: int
    topics: Mapping[str, TopicStatistics]
    discarded: int = 0
    bytes: int = 0
    files: int = 1


class SnapshotFill(NamedTuple):
    """What is in the snapshot buffer: messages, bytes, seconds, and what was too large for it."""

    messages: int
    size: int
    duration: float
    refused: int


class RecorderState(NamedTuple):
    """All that decides what a recorder says of itself.

    Attributes:
        statistics: Its counts.
        rate: Messages a second, lately.
        recording: Whether it records, rather than being paused or inactive.
        clock_awaited: Whether simulated time has not begun.
        waiting_for: Listed topics that nobody publishes.
        free_disk: Free disk space [MiB].
        minimum_free_disk: At which recording ends [MiB].
        sync_age: Time since all that was flushed was forced to the disk [s].
        sync_period: How long that should be [s].
        snapshot: What is in the snapshot buffer, in snapshot mode.
    """

    statistics: RecorderStatistics
    rate: float
    recording: bool
    clock_awaited: bool
    waiting_for: Sequence[str]
    free_disk: float
    minimum_free_disk: int
    sync_age: float
    sync_period: float
    snapshot: SnapshotFill | None = None


def disk_is_filling(free_disk: float, minimum_free_disk: int) -> bool:
    """Return whether recording is about to end for want of disk space, both in MiB."""
    return free_disk < _FREE_DISK_WARNING * minimum_free_disk


def statuses(state: RecorderState) -> list[Status]:
    """Return what to publish: the recording as a whole, and the counts of its topics."""
    level, message = _verdict(state)
    counts = state.statistics
    values = {
        "messages": str(counts.messages),
        "messages a second": f"{state.rate:.1f}",
        "MiB": f"{counts.bytes / _MIB:.1f}",
        "lost": str(counts.lost),
        "discarded while paused": str(counts.discarded),
        "topics": str(len(counts.topics)),
        "waiting for": ", ".join(state.waiting_for),
        "paused": str(not state.recording).lower(),
        "files": str(counts.files),
        "free disk space (MiB)": f"{state.free_disk:.0f}",
        "last sync (s ago)": f"{state.sync_age:.1f}",
    }
    if (fill := state.snapshot) is not None:
        values["snapshot buffer"] = (
            f"{fill.messages} messages, {fill.duration:.1f} s, {fill.size / _MIB:.1f} MiB"
        )
        values["too large for the snapshot buffer"] = str(fill.refused)
    return [Status("recording", level, message, values), _topics(counts.topics)]


def _verdict(state: RecorderState) -> tuple[Level, str]:
    """Return the worst that is to be said."""
    counts = state.statistics
    if counts.lost:
        return Level.WARN, f"{counts.lost} messages lost"
    if state.snapshot is not None and state.snapshot.refused:
        return Level.WARN, f"{state.snapshot.refused} messages too large for the snapshot buffer"
    if disk_is_filling(state.free_disk, state.minimum_free_disk):
        return Level.WARN, f"{state.free_disk:.0f} MiB of disk space are left"
    if state.sync_age > state.sync_period + _SYNC_GRACE:
        return Level.WARN, f"the disk has not kept up for {state.sync_age:.0f} s"
    if state.clock_awaited:
        return Level.WARN, "waiting for /clock"
    if state.waiting_for:
        return Level.WARN, f"waiting for {state.waiting_for[0]}"
    if not state.recording:
        return Level.OK, "paused"
    return Level.OK, "recording" if state.snapshot is None else "keeping the last seconds"


def _topics(topics: Mapping[str, TopicStatistics]) -> Status:
    lossy = [name for name, topic in topics.items() if topic.lost]
    unknown = [name for name, topic in topics.items() if not topic.loss_known]
    level, message = Level.OK, "nothing lost"
    if lossy:
        level, message = Level.WARN, f"messages lost of {', '.join(sorted(lossy))}"
    elif unknown:
        message = f"losses unknown of {', '.join(sorted(unknown))}"
    return Status("topics", level, message, {n: _counts(t) for n, t in sorted(topics.items())})


def _counts(topic: TopicStatistics) -> str:
    lost = f"{topic.lost} lost" if topic.loss_known else f"at least {topic.lost} lost"
    losers = f" of {', '.join(topic.losers)}" if topic.losers else ""
    return f"{topic.messages} messages, {lost}{losers}"
