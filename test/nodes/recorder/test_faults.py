# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A disk that fails ends the recording with a reason, and what was written stays."""

from pathlib import Path

import pytest
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from tsobs_ros.bag import BagReader
from tsobs_ros.bag.recovery import recover
from tsobs_ros.errors import BagWriteError

SIZE = 100_000
LIMIT_KIB = 1000


def test_a_full_disk_ends_the_process_and_keeps_what_was_written(
    ros, ros_process, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    parameters = {"output": str(bag), "topics": ["a"], "compression": "none", "flush_period": 0.01}
    limited = ["bash", "-c", f'ulimit -f {LIMIT_KIB}; exec "$@"', "bash"]
    process = ros_process("recorder", parameters=parameters, prefix=limited)
    publisher = ros.node("source").create_publisher(String, "a", 100)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, 20.0, what="the match")
    fitting = LIMIT_KIB * 1024 // SIZE
    texts = [f"{index}".ljust(SIZE) for index in range(fitting + 3)]
    for text in texts:
        publisher.publish(String(data=text))
    finished = process.finish()

    assert finished.exit_code == 1
    (error,) = [line for line in finished.stderr.splitlines() if line.startswith("error: ")]
    assert error == (
        f"error: {bag / 'bag_0.mcap'}: cannot write it: [Errno 27] File too large; what was "
        f"written before: tsobs bag recover {bag}"
    )
    assert "Traceback" not in finished.stderr
    recover(bag, tmp_path / "recovered")
    read = BagReader(tmp_path / "recovered").messages()
    stored = [deserialize_message(message.data, String).data for message in read]
    assert stored == texts[: len(stored)]
    assert len(stored) >= 1


def test_a_disk_that_gets_too_full_ends_the_process_with_a_closed_bag(
    ros, ros_process, tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    process = ros_process("recorder", parameters={"output": str(bag), "topics": ["a"]})
    node = ros.node("operator")
    publisher = node.create_publisher(String, "a", 100)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, 20.0, what="the match")
    publisher.publish(String(data="in time"))
    assert publisher.wait_for_all_acked()
    client = AsyncParameterClient(node, "recorder")
    ros.spin_until(client.services_are_ready, what="the parameter services")
    # The end of the process tells that this has arrived; its answer may be lost with the process.
    client.set_parameters([Parameter("minimum_free_disk", value=10**9)])
    finished = process.finish()
    assert finished.exit_code == 0
    assert "MiB free): recording ends here" in finished.stderr
    assert "Traceback" not in finished.stderr
    assert BagReader(bag).message_count == 1


def test_where_nothing_can_be_written_is_refused(recording) -> None:
    with pytest.raises(BagWriteError, match="/proc/bag: cannot create it"):
        recording.start(output="/proc/bag", minimum_free_disk=0)


def test_a_file_in_the_place_of_a_folder_is_refused(recording, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BagWriteError, match=r"file/bag: cannot create it: .*Not a directory"):
        recording.start(output=str(tmp_path / "file" / "bag"))
