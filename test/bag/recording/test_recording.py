# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording is complete by file, by snapshot and after a pause; latched messages are in each."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader as RosbagsReader

from tsobs_ros.bag import BagReader, QosProfile
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.metadata import read_metadata
from tsobs_ros.bag.recording import Recording, RecordingOptions
from tsobs_ros.bag.recording.snapshot import BufferedMessage
from tsobs_ros.bag.verification import verify
from tsobs_ros.errors import BagWriteError

TOPICS = ("/map", "/a")

# std_msgs/String in CDR, with nothing and with a map in it.
EMPTY = b"\0\1\0\0\1\0\0\0\0"
MAP = b"\0\1\0\0\4\0\0\0map\0"


def begin(path: Path, options: RecordingOptions) -> Recording:
    recording = Recording(path, options)
    for topic in TOPICS:
        definition = find_definition("std_msgs/msg/String")
        recording.add_topic(topic, definition, [QosProfile()])
    return recording


def message(topic: str, time: int, data: bytes = EMPTY) -> BufferedMessage:
    return BufferedMessage(topic, data, time, time)


def stored(path: Path) -> list[tuple[str, int, int]]:
    return [(m.topic, m.log_time, m.publish_time) for m in BagReader(path).messages()]


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Give a path for a bag, and check that it is strictly one, for other readers too."""
    path = tmp_path / "bag"
    yield path
    found = verify(path)
    assert (found.errors, found.remarks) == ((), ())
    ours = [(m.topic, m.data) for m in BagReader(path).messages()]
    with RosbagsReader(path) as reader:
        assert [(c.topic, bytes(data)) for c, _, data in reader.messages()] == ours
    theirs = []
    for file in read_metadata(path).files:
        with (path / file.path).open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            theirs += [(c.topic, m.data) for _, c, m in reader.iter_messages()]
    assert theirs == ours


def test_every_file_begins_with_what_is_latched(folder: Path) -> None:
    recording = begin(folder, RecordingOptions(max_duration_ns=9))
    recording.record(message("/map", 1, MAP), latched_by=b"p")
    for time in range(2, 25):
        recording.record(message("/a", time))
    recording.split()
    recording.split()
    recording.record(message("/map", 30, MAP), latched_by=b"p")
    recording.close()

    files = [BagReader(folder / f.path) for f in read_metadata(folder).files]
    begins = [next((m.topic, m.log_time, m.publish_time) for m in f.messages()) for f in files]
    assert begins == [("/map", 1, 1), ("/map", 11, 1), ("/map", 21, 1), ("/map", 30, 30)]
    assert recording.file_count == 4
    assert recording.counts == {"/map": 2, "/a": 23}


def test_nothing_is_repeated_where_that_is_not_wanted(folder: Path) -> None:
    recording = begin(folder, RecordingOptions(max_duration_ns=9, repeat_latched=0))
    recording.record(message("/map", 1, MAP), latched_by=b"p")
    recording.record(message("/a", 11))
    recording.close()
    assert stored(folder) == [("/map", 1, 1), ("/a", 11, 11)]


def test_what_is_latched_during_a_pause_comes_after_it(folder: Path) -> None:
    recording = begin(folder, RecordingOptions())
    recording.record(message("/a", 1))
    for topic, who in (("/a", None), ("/map", b"p"), ("/map", b"p")):
        recording.discard(message(topic, 2, MAP), latched_by=who)
    recording.record(message("/a", 5))
    recording.record(message("/a", 6))
    recording.close()
    assert stored(folder) == [("/a", 1, 1), ("/map", 5, 2), ("/a", 5, 5), ("/a", 6, 6)]
    assert recording.discarded == 3
    assert recording.bytes == 3 * len(EMPTY) + len(MAP)


def test_snapshots_hold_the_last_seconds_and_what_is_latched(folder: Path) -> None:
    options = RecordingOptions(snapshot_duration_ns=10, snapshot_size=10**6)
    recording = begin(folder, options)
    recording.record(message("/map", 1, MAP), latched_by=b"p")
    for time in range(50):
        recording.record(message("/a", 10 + time))
    assert recording.take_snapshot() == 12
    for time in range(100, 103):
        recording.record(message("/a", time))
    assert recording.take_snapshot() == 4
    assert not recording.write_pending()
    recording.record(message("/a", 200))
    recording.close()

    first = [("/map", 49, 1)] + [("/a", time, time) for time in range(49, 60)]
    second = [("/map", 100, 1)] + [("/a", time, time) for time in range(100, 103)]
    assert stored(folder) == first + second


def test_a_large_snapshot_is_written_bit_by_bit_and_to_the_end(folder: Path) -> None:
    options = RecordingOptions(snapshot_duration_ns=10**9, snapshot_size=10**8)
    recording = begin(folder, options)
    for time in range(1, 12_001):
        recording.record(message("/a", time))
    assert recording.take_snapshot() == 12_000
    assert recording.take_snapshot() == 0
    assert recording.write_pending()
    recording.close()
    assert len(stored(folder)) == 12_000


def test_a_disk_that_fails_to_sync_ends_the_recording(tmp_path: Path, monkeypatch) -> None:
    recording = begin(tmp_path / "bag", RecordingOptions(sync_period=0.001))
    recording.record(message("/a", 1))

    def fail(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    def flush_until_it_fails() -> None:
        while True:
            recording.flush()

    with monkeypatch.context() as patch:
        patch.setattr("os.fdatasync", fail)
        with pytest.raises(BagWriteError, match="Input/output error"):
            flush_until_it_fails()
    recording.close()
    assert stored(tmp_path / "bag") == [("/a", 1, 1)]
