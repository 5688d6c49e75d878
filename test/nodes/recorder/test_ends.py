# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording begins with a new folder, and ends with a closed bag or what was flushed of it."""

import contextlib
import signal
from pathlib import Path

import pytest
from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from tsobs_ros.bag import BagReader
from tsobs_ros.errors import BagReadError, BagWriteError, NodeError, ParameterError


def test_an_existing_folder_is_refused(recording, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagWriteError, match="bag: exists already"):
        recording.start()
    assert list((tmp_path / "bag").iterdir()) == []


def test_an_unnamed_bag_gets_a_dated_name(recording, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = recording.start(output="").path
    assert path.parent == tmp_path
    assert path.match("rosbag2_[0-9][0-9][0-9][0-9]_[0-9][0-9]_[0-9][0-9]-*")


def test_a_wrong_compression_is_refused(recording) -> None:
    with pytest.raises(ParameterError, match="compression"):
        recording.start(compression="zip")


def test_a_disk_that_is_too_full_is_refused(recording, tmp_path: Path) -> None:
    with pytest.raises(NodeError, match="MiB of disk space are free"):
        recording.start(minimum_free_disk=10**9)
    assert not (tmp_path / "bag").exists()


def test_a_disk_that_gets_too_full_ends_the_recording(ros, recording) -> None:
    recorder = recording.start(topics=["joints"], flush_period=0.05)
    publisher = ros.node("source").create_publisher(JointState, "joints", 10)
    recording.publish(recorder, publisher, recording.joint_states(5))
    recorder.set_parameters([Parameter("minimum_free_disk", value=10**9)])

    ros.spin_until(lambda: recorder.finished, what="the end of the recording")
    assert BagReader(recorder.path).message_count == 5


def test_closing_records_what_has_arrived(ros, recording, capfd) -> None:
    recorder = recording.start(topics=["joints"], drain_period=1.0)
    publisher = ros.node("source").create_publisher(JointState, "joints", 100)
    ros.spin_until(lambda: recorder.ready, what="the recorder's subscription")
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, what="the publisher's match")
    for message in recording.joint_states(40):
        publisher.publish(message)
    assert publisher.wait_for_all_acked()

    recorder.close()
    recorder.close()

    assert BagReader(recorder.path).message_count == 40
    lines = capfd.readouterr().err
    assert lines.count(f"closing {recorder.path}: 40 messages of 1 topics, 0 lost") == 1
    assert lines.count(f"recording to {recorder.path}") == 1
    assert lines.count("recording /joints [sensor_msgs/msg/JointState]") == 1


def stored_messages(path: Path) -> list[bytes]:
    """Read a file that may have no end, in file order, as recovery tools do."""
    stored = []
    with path.open("rb") as stream, contextlib.suppress(EndOfFile):
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Message):
                stored.append(record.data)
    return stored


def test_what_was_flushed_survives_a_kill(ros, ros_process, recording, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    process = ros_process(
        "recorder", parameters={"output": str(bag), "topics": ["joints"], "flush_period": 0.2}
    )
    publisher = ros.node("source").create_publisher(JointState, "joints", 200)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, 20.0, what="the match")
    messages = recording.joint_states(150)
    for message in messages:
        publisher.publish(message)
    # Far less than a chunk, and nothing follows: only the timer can have flushed it.
    file = bag / "bag_0.mcap"
    ros.spin_until(lambda: len(stored_messages(file)) == len(messages), what="the flush")
    publisher.publish(JointState())

    process.signal(signal.SIGKILL)
    assert process.finish().exit_code == -signal.SIGKILL

    stored = [deserialize_message(data, JointState) for data in stored_messages(file)]
    assert stored[: len(messages)] == messages
    with pytest.raises(BagReadError, match=r"bag_0\.mcap: the file has no end"):
        BagReader(bag)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_closes_the_bag(ros, ros_process, recording, tmp_path: Path, number: int) -> None:
    bag = tmp_path / "bag"
    process = ros_process("recorder", parameters={"output": str(bag), "topics": ["joints"]})
    publisher = ros.node("source").create_publisher(JointState, "joints", 200)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, 20.0, what="the match")
    messages = recording.joint_states(150)
    for message in messages:
        publisher.publish(message)
    assert publisher.wait_for_all_acked()

    process.signal(number)
    finished = process.finish()

    assert finished.exit_code == 0
    assert "Traceback" not in finished.stderr
    read = [deserialize_message(m.data, JointState) for m in BagReader(bag).messages()]
    assert read == messages
