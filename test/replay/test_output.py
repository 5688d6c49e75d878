# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""New bags of estimates, with what was recorded."""

from pathlib import Path
from typing import Any

import pytest

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.verification import verify
from tsobs_ros.replay.source import BagSource

TRUTH = "/ground_truth/joint_states"

Message = tuple[str, bytes, int]


def with_truth(messages: list[Message]) -> list[Message]:
    """Add some truth, which a recorder receives a moment before a measurement, or at once."""
    encode = JointStateEncoder(["elbow_link", "elbow_motor"])
    found = []
    for number, one in enumerate(messages):
        truth = encode(one[2], [0.1, 0.2], [0.3, 0.4])
        found += [(TRUTH, truth, one[2] - 1000 * (number % 2)), one]
    return found


def write_bag(path: Path, messages: list[Message], size: int = 40, **options: Any) -> Path:
    """Write JointStates as the recorder does, so many messages a chunk."""
    with BagWriter(path, **options) as writer:
        for number, (topic, data, time) in enumerate(messages):
            writer.add_topic(topic, JOINT_STATE)
            writer.write(topic, data, time, time - 10)
            if number % size == size - 1:
                writer.flush()
    return path


@pytest.mark.parametrize("options", [{}, {"rate": 130.0, "window": 32}])
def test_a_new_bag_has_what_was_recorded(arms, estimate, tmp_path, options) -> None:
    written = with_truth(arms.messages(100))
    estimate(write_bag(tmp_path / "bag", written), output="new", **options)

    assert verify(tmp_path / "new").holds
    messages = list(BagReader(tmp_path / "new").messages())
    recorded = [(m.topic, m.data, m.log_time) for m in messages if "observer" not in m.topic]
    assert recorded == sorted(written, key=lambda one: one[2])
    # What is made of a measurement comes behind it, but what it is made with in front.
    assert [one.topic for one in messages[:2]] == ["/observer/design", TRUTH]
    topics = [m.topic for m in messages if m.log_time == arms.messages(50)[-1][2]]
    if "rate" not in options:
        assert topics.index("/joint_measurements") < topics.index("/observer/joint_states")


def test_live_estimates_are_replaced(arms, estimate, tmp_path) -> None:
    estimate(write_bag(tmp_path / "bag", with_truth(arms.messages(60))), output="live")
    estimate(tmp_path / "live", output="again")

    live, again = (sorted(BagReader(tmp_path / name).messages()) for name in ("live", "again"))
    assert live == again


def damaged(path: Path, messages: list[Message], topic: str) -> Path:
    """Write a bag, and change a byte of a topic's messages in the middle of it."""
    bag = write_bag(path, messages, size=1, compression="none")
    file = bag / f"{path.name}_0.mcap"
    data = bytearray(file.read_bytes())
    middle = [one[1] for one in messages if one[0] == topic][len(messages) // 4]
    data[data.index(middle) + 60] ^= 1
    file.write_bytes(data)
    return bag


@pytest.mark.parametrize("topic", [TRUTH, "/joint_measurements"])
def test_a_damaged_bag_is_copied_up_to_the_damage(arms, estimate, tmp_path, topic) -> None:
    written = with_truth(arms.messages(60))
    source = BagSource(damaged(tmp_path / "bag", written, topic))

    run = estimate(source, output="new")

    assert "damaged" in str(source.damage)
    assert verify(tmp_path / "new").holds
    topics = BagReader(tmp_path / "new").topics
    assert topics[TRUTH].count in (30, 31)
    # Damage in the truth costs no estimates.
    used = 60 if topic == TRUTH else 30
    assert run.used == topics["/observer/joint_states"].count == used
