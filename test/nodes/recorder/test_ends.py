# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording begins with a new folder, and ends with a closed bag or what was flushed of it."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.recovery import recover
from tsobs_ros.errors import BagReadError, BagWriteError, NodeError

SIZE = 100_000
LIMIT_KIB = 1000
TEXTS = [str(index) for index in range(150)]


@pytest.mark.parametrize(
    ("output", "free", "error", "reason"),
    [
        ("there", 0, BagWriteError, "there: exists already"),
        ("file/bag", 0, BagWriteError, "file/bag: cannot create it: .*Not a directory"),
        ("bag", 10**9, NodeError, "MiB of disk space are free"),
    ],
)
def test_where_a_bag_cannot_be_it_is_refused(
    recording, tmp_path: Path, output: str, free: int, error: type[Exception], reason: str
) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(error, match=reason):
        recording.start(output=str(tmp_path / output), minimum_free_disk=free)
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "file", tmp_path / "there"]


def test_an_unnamed_bag_gets_a_dated_name(recording, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = recording.start(output="").path
    assert path.parent == tmp_path
    assert path.match("rosbag2_[0-9][0-9][0-9][0-9]_[0-9][0-9]_[0-9][0-9]-*")


def test_closing_records_what_has_arrived(ros, recording, capfd) -> None:
    recorder = recording.start(topics=["joints"])
    publisher = ros.node("source").create_publisher(String, "joints", 200)
    ros.spin_until(lambda: not recorder.finder.missing, what="the recorder's subscription")
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, what="the publisher's match")
    for text in TEXTS:
        publisher.publish(String(data=text))
    assert publisher.wait_for_all_acked()

    recorder.close()
    recorder.close()

    assert recording.texts(recorder.path) == TEXTS
    lines = capfd.readouterr().err
    closing = f"closing {recorder.path}: 150 messages of 1 topics, 0 lost since the first of each"
    assert lines.count(f"{closing}, 0 published before\n") == 1
    assert lines.count(f"recording to {recorder.path}") == 1
    assert lines.count("recording /joints [std_msgs/msg/String]") == 1


def test_a_disk_that_gets_too_full_ends_the_recording_with_a_closed_bag(
    ros, recording, capfd
) -> None:
    recorder = recording.start(topics=["a"])
    recording.say(recorder, "a", "in time")
    recorder.set_parameters([Parameter("minimum_free_disk", value=10**9)])
    ros.spin_until(lambda: recorder.finished, what="the end")
    assert "MiB free): recording ends here" in capfd.readouterr().err
    assert recording.texts(recorder.path) == ["in time"]


def test_a_bag_that_was_deleted_meanwhile_is_an_error(recording) -> None:
    recorder = recording.start(topics=["a"])
    recording.say(recorder, "a", "in vain")
    (recorder.path / "bag_0.mcap").unlink()
    with pytest.raises(BagWriteError, match=r"bag_0\.mcap: cannot write it: No such file"):
        recorder.close()


@pytest.fixture
def started(ros, ros_process, tmp_path: Path) -> Callable[..., tuple[Any, Any]]:
    """Start a recorder of /a as a process, and what publishes texts to it."""

    def start(prefix: tuple[str, ...] = (), **parameters: Any) -> tuple[Any, Callable[..., None]]:
        values = {"output": str(tmp_path / "bag"), "topics": ["a"], **parameters}
        process = ros_process("recorder", parameters=values, prefix=prefix)
        publisher = ros.node("source").create_publisher(String, "a", 200)
        ros.spin_until(lambda: publisher.get_subscription_count() == 1, 30.0, what="the match")

        def say(*said: str) -> None:
            for text in said:
                publisher.publish(String(data=text))
            publisher.wait_for_all_acked()

        return process, say

    return start


def unfinished_texts(path: Path) -> list[str]:
    """Read a file that may have no end, in file order, as recovery tools do."""
    stored = []
    with path.open("rb") as stream, contextlib.suppress(EndOfFile):
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Message):
                stored.append(deserialize_message(record.data, String).data)
    return stored


def test_what_was_flushed_survives_a_kill(ros, started, tmp_path: Path) -> None:
    process, say = started(flush_period=0.2)
    say(*TEXTS)
    # Far less than a chunk, and nothing follows: only the timer can have flushed it.
    file = tmp_path / "bag" / "bag_0.mcap"
    ros.spin_until(lambda: unfinished_texts(file) == TEXTS, what="the flush")
    process.signal(signal.SIGKILL)
    assert process.finish().exit_code == -signal.SIGKILL

    assert unfinished_texts(file) == TEXTS
    with pytest.raises(BagReadError, match=r"bag_0\.mcap: the file has no end"):
        BagReader(tmp_path / "bag")


def test_a_terminal_that_goes_costs_no_message(ros, recording, tmp_path: Path) -> None:
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        ["setsid", "--ctty", "sh", "-c", 'trap "" HUP; exec "$@"', "sh",
         sys.executable, "-m", "tsobs_ros.executables", "recorder",
         "--ros-args", "-p", f"output:={tmp_path / 'bag'}", "-p", "topics:=[a, b]"],
        stdin=end, stdout=end, stderr=end, env=ros.environment,
    )  # fmt: skip
    os.close(end)
    try:
        for topic in "ab":
            publisher = ros.node(f"source_of_{topic}").create_publisher(String, topic, 200)
            ros.spin_until(lambda p=publisher: p.get_subscription_count() == 1, 30.0, "the match")
            for text in TEXTS:
                publisher.publish(String(data=text))
            assert publisher.wait_for_all_acked()
            if topic == "a":
                os.close(terminal)  # from here on SIGHUP, and EIO for each line that is printed
        process.send_signal(signal.SIGTERM)
        assert process.wait(30.0) == 0
    finally:
        process.kill()
        process.wait()
    assert recording.texts(tmp_path / "bag") == TEXTS * 2


def test_a_disk_that_fails_ends_the_process_and_keeps_what_was_written(
    started, recording, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    limited = ("bash", "-c", f'ulimit -f {LIMIT_KIB}; exec "$@"', "bash")
    process, say = started(prefix=limited, compression="none", flush_period=0.01)
    said = [f"{index}".ljust(SIZE) for index in range(LIMIT_KIB * 1024 // SIZE + 3)]
    say(*said)
    finished = process.finish()

    assert finished.exit_code == 1
    (error,) = [line for line in finished.stderr.splitlines() if line.startswith("error: ")]
    assert error == (
        f"error: {bag / 'bag_0.mcap'}: cannot write it: [Errno 27] File too large; what was "
        f"written before: tsobs bag recover {bag}"
    )
    assert "Traceback" not in finished.stderr
    recover(bag, tmp_path / "recovered")
    stored = recording.texts(tmp_path / "recovered")
    assert len(stored) >= 1
    assert stored == said[: len(stored)]
